"""`Polyhedron`: the rows of a convex set, and what can be asked of them point by point and direction by direction."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from invariant_sets.exceptions import EmptySetError, InputError, TimeLimitError, UnboundedError
from invariant_sets.hulls import cone_volume, facets_and_vertices, hull_of_points, hull_volume
from invariant_sets.interior_form import Body, body_of, body_of_vertices, support
from invariant_sets.time_limits import NO_DEADLINE, Deadline, LimitReached, check_time_limit
from invariant_sets.tolerances import MEMBERSHIP, ROUNDING, TINY
from invariant_sets.validation import as_batch, as_matrix, as_vector, check_count, check_finite, check_tolerance, frozen

Array = np.ndarray
_MANY_VERTICES = 5  # dimensions from which the hull of the vertices takes much longer than that of the rows


@dataclass(frozen=True, eq=False, repr=False, init=False)
class Polyhedron:
    """{x : A x <= b, A_eq x = b_eq}. It is never changed; vertices and the like are computed once, on demand.

    Parameters
    ----------
    A : (m, n) array, optional
        Normals, outward. They need not be of unit length. May be left out with b if there are equalities.
    b : (m,) array, optional
        Right-hand sides.
    A_eq : (k, n) array, optional
        Equality rows.
    b_eq : (k,) array, optional
        Equality values.

    Raises
    ------
    InputError
        If a shape does not fit or a number is not finite.

    Notes
    -----
    A set thinner than 1e-9 of its own bounding box counts as flat (of lower dimension), and one that misses
    feasibility by more than that counts as empty. Rows hold to a relative 1e-12 of their own data.
    """

    A: Array
    b: Array
    A_eq: Array
    b_eq: Array
    _vertices: Array | None  # where the set was made of its vertices
    _enumerated: Array | None  # once they have been asked for: they only make supports quicker

    def __init__(self, A: Any = None, b: Any = None, A_eq: Any = None, b_eq: Any = None) -> None:
        for matrix, vector, one, other in ((A, b, "A", "b"), (A_eq, b_eq, "A_eq", "b_eq")):
            if (matrix is None) != (vector is None):
                missing = one if matrix is None else other
                raise InputError(missing, "nothing", f"{one} and {other} together", f"Give {missing} too.")
        if A is None and A_eq is None:
            raise InputError("A", "neither A nor A_eq", "at least one of them", "Polytope(np.zeros((0, n)), []) is Rⁿ.")
        A_eq = None if A_eq is None else as_matrix(A_eq, "A_eq")
        A = np.zeros((0, A_eq.shape[1])) if A is None and A_eq is not None else as_matrix(A, "A")
        b = as_vector([] if b is None else b, "b", size=len(A))
        n = A.shape[1]
        if n == 0:
            raise InputError("A", "shape (m, 0)", "at least one column")
        A_eq = np.zeros((0, n)) if A_eq is None else as_matrix(A_eq, "A_eq", columns=n)
        b_eq = np.zeros(0) if b_eq is None else as_vector(b_eq, "b_eq", size=len(A_eq))
        self._fill(A, b, A_eq, b_eq, None)

    def _fill(self, A: Array, b: Array, A_eq: Array, b_eq: Array, V: Array | None) -> None:
        """Set the fields, once."""
        for name, array in (("A", A), ("b", b), ("A_eq", A_eq), ("b_eq", b_eq), ("_vertices", V), ("_enumerated", V)):
            object.__setattr__(self, name, None if array is None else frozen(array))

    @classmethod
    def _with_vertices(cls, A: Array, b: Array, A_eq: Array, b_eq: Array, V: Array | None) -> Self:
        """Return the set of these rows, whose vertices V (k, n) are known already; arrays are not copied."""
        P = cls.__new__(cls)
        P._fill(A, b, A_eq, b_eq, V)
        return P

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self)._with_vertices, (self.A, self.b, self.A_eq, self.b_eq, self._vertices)

    # --- construction -------------------------------------------------------------------------------------

    @classmethod
    def from_bounds(cls, lower: Any, upper: Any) -> Self:
        """Return the box lower <= x <= upper; an infinite bound is no bound.

        Parameters
        ----------
        lower, upper : (n,) arrays
            Bounds in the units of x. ±inf is allowed.

        Raises
        ------
        InputError
            If a lower bound is above its upper bound, or shapes do not match.
        """
        lower = as_vector(lower, "lower", finite=False)
        if len(lower) == 0:
            raise InputError("lower", "no bounds", "one for each coordinate")
        upper = as_vector(upper, "upper", size=len(lower), finite=False)
        for name, bound in (("lower", lower), ("upper", upper)):
            check_finite(np.where(np.isinf(bound), 0.0, bound), name)
        if (lower == np.inf).any() or (upper == -np.inf).any():
            name = "lower" if (lower == np.inf).any() else "upper"
            raise InputError(name, "an infinite bound that excludes every point", "lower < inf and upper > -inf")
        reversed_ = np.flatnonzero(lower > upper)
        if len(reversed_):
            i = int(reversed_[0])
            raise InputError("lower", f"{lower[i]:g} above upper, {upper[i]:g}, at index {i}", "lower <= upper",
                             "Exchange them; the empty set is Polytope.empty(n).")
        eye = np.eye(len(lower))
        has_upper = np.isfinite(upper)
        has_lower = np.isfinite(lower)
        return cls(np.vstack([eye[has_upper], -eye[has_lower]]), np.append(upper[has_upper], -lower[has_lower]))

    @classmethod
    def from_vertices(cls, V: Any, *, time_limit: float | None = None) -> Self:
        """Return the convex hull of the points V (k, n), k >= 1. Flat hulls get equalities.

        Parameters
        ----------
        V : (k, n) array
            Points, in the units of x.
        time_limit : float, optional
            Seconds; none if left out. The cost of the hull is estimated before it is begun.

        Raises
        ------
        TimeLimitError
            If the hull would take longer, or more memory than a hull may have. Its `outer` is the box of the points.

        References
        ----------
        Barber, Dobkin, Huhdanpaa (1996), The Quickhull algorithm, ACM TOMS 22(4).
        """
        V = as_matrix(V, "V")
        if V.shape[0] == 0 or V.shape[1] == 0:
            raise InputError("V", f"shape {V.shape}", "(k, n) with k >= 1 and n >= 1")
        deadline = Deadline.after(check_time_limit(time_limit))
        try:
            deadline.check_hull(*V.shape)
        except LimitReached as limit:
            box = cls.from_bounds(V.min(axis=0), V.max(axis=0))
            raise TimeLimitError("from_vertices", time_limit, str(limit), box) from None
        A, b, A_eq, b_eq, extreme = hull_of_points(V)
        return cls._with_vertices(A, b, A_eq, b_eq, counter_clockwise(V[extreme]))

    @classmethod
    def empty(cls, n: int) -> Self:
        """Return the empty set in n dimensions, as the row 0 x <= −1."""
        return cls(np.zeros((1, check_count(n, "n", 1))), [-1.0])

    # --- shape --------------------------------------------------------------------------------------------

    @property
    def dim(self) -> int:
        """Dimension n of the space."""
        return self.A.shape[1]

    @cached_property
    def _body(self) -> Body | None:
        """The set in coordinates that suit it; None if it is empty."""
        if self._vertices is not None and not len(self.b_eq) and len(self._vertices) > self.dim:
            body = body_of_vertices(self.A, self.b, self._vertices)
            if body is not None:
                return body
        return body_of(self.A, self.b, self.A_eq, self.b_eq)

    @property
    def is_empty(self) -> bool:
        """Whether no point satisfies the rows."""
        return self._body is None

    @property
    def is_bounded(self) -> bool:
        """Whether the set fits into a box. The empty set is bounded."""
        return self._vertices is not None or self._body is None or self._body.bounded

    @property
    def affine_dim(self) -> int:
        """Dimension of the affine hull: n if full-dimensional, 0 for a point, −1 for the empty set."""
        return -1 if self._body is None else self._body.basis.shape[1]

    @cached_property
    def vertices(self) -> Array:
        """Vertices (k, n), counter-clockwise in the plane; (0, n) if empty. Raises `UnboundedError`."""
        if self._vertices is not None:
            return self._vertices
        if self._body is None:
            return frozen(np.zeros((0, self.dim)))
        body = self._require_bounded("vertices")
        if body.basis.shape[1] == 0:
            return frozen(body.centre[None].copy())
        try:
            NO_DEADLINE.check_hull(len(body.g), body.basis.shape[1])
        except LimitReached as limit:
            raise TimeLimitError("vertices", None, str(limit)) from None
        Y = counter_clockwise(facets_and_vertices(body.F, body.g)[1])
        V = frozen(body.centre + Y @ body.basis.T)
        object.__setattr__(self, "_enumerated", V)
        return V

    @cached_property
    def volume(self) -> float:
        """Volume in the n-dimensional space; 0 if flat or empty. Raises `UnboundedError`."""
        body = self._body
        if body is None or body.basis.shape[1] < self.dim:
            return 0.0
        self._require_bounded("volume")
        unit = abs(float(np.linalg.det(body.basis)))
        if self.dim >= _MANY_VERTICES:
            self.vertices  # noqa: B018  # the limits on the size of the hull
            found = cone_volume(body.F, body.g)
            if found is not None:
                return found * unit
        return hull_volume((self.vertices - body.centre) @ body.inverse.T) * unit

    def _require_bounded(self, what: str) -> Body:
        """Return the body, or raise `EmptySetError` or `UnboundedError`."""
        body = self._require_point(what)
        if not body.bounded:
            raise UnboundedError(what)
        return body

    def _require_point(self, what: str) -> Body:
        """Return the body, or raise `EmptySetError`."""
        if self._body is None:
            raise EmptySetError(what)
        return self._body

    # --- questions ----------------------------------------------------------------------------------------

    def contains(self, x: Any, tol: float = MEMBERSHIP) -> Any:
        """Return whether points lie in the set.

        Parameters
        ----------
        x : (n,) or (k, n) array
            One point or a batch. A point with NaN is in no set.
        tol : float
            A row may be violated by `tol` times its range over the bounding box of the set, or by the rounding of
            its own data (a relative 1e-12) if that is more. 0 is strict.

        Returns
        -------
        bool, or (k,) array of bools
        """
        tol = check_tolerance(tol)
        points, single = as_batch(x, "x", self.dim, finite=False, copy=False)
        allowed, allowed_eq = self._allowed(tol)
        with np.errstate(invalid="ignore", over="ignore"):
            inside = _rows_hold(points, self.A, self.b + allowed)
            if len(self.b_eq):
                inside &= (np.abs(points @ self.A_eq.T - self.b_eq) <= allowed_eq).all(axis=1)
        return bool(inside[0]) if single else inside

    def __contains__(self, x: Any) -> bool:
        """Return whether one point (n,) lies in the set, to the tolerance of `contains`."""
        return bool(self.contains(as_vector(x, "x", size=self.dim, finite=False)))

    def _allowed(self, tol: float, over: Polyhedron | None = None) -> tuple[Array, Array]:
        """Return what each inequality and equality may be violated by; ranges over the box of `over` too, if given."""
        scale, scale_eq = self._row_scales
        if over is not None:
            wider, wider_eq = over._scales_along(self)
            scale = np.maximum(scale, wider)
            scale_eq = np.maximum(scale_eq, wider_eq)
        terms = np.zeros(self.dim)
        for one in (self, over):
            if one is not None and one._body is not None:
                terms = np.maximum(terms, one._body.terms)
        rounding = min(tol, ROUNDING)
        return (np.maximum(tol * scale, rounding * (np.abs(self.b) + np.abs(self.A) @ terms)),
                np.maximum(tol * scale_eq, rounding * (np.abs(self.b_eq) + np.abs(self.A_eq) @ terms)))

    @cached_property
    def _row_scales(self) -> tuple[Array, Array]:
        """The range of each inequality and equality over the bounding box of the set."""
        return self._scales_along(self)

    def _scales_along(self, other: Polyhedron) -> tuple[Array, Array]:
        """Return the range of each row of `other` over the bounding box of this set."""
        return np.abs(other.A) @ self._widths, np.abs(other.A_eq) @ self._widths

    @cached_property
    def _widths(self) -> Array:
        """The widths (n,) of the bounding box, by the vertices where they are known; 0 where it is flat."""
        if self._vertices is not None and not len(self.b_eq):
            lower = self._vertices.min(axis=0)
            upper = self._vertices.max(axis=0)
            if (upper - lower > ROUNDING * np.abs(lower + upper)).all():
                return upper - lower
        return np.zeros(self.dim) if self._body is None else 2 * self._body.half_widths

    @cached_property
    def _relative_rows(self) -> tuple[Array, Array]:
        """All rows as inequalities, divided by their range over the bounding box of the set."""
        scale, scale_eq = (np.where(ranges > 0.0, ranges, 1.0) for ranges in self._row_scales)
        equalities = self.A_eq / scale_eq[:, None]
        values = self.b_eq / scale_eq
        rows = np.concatenate([self.A / scale[:, None], equalities, -equalities])
        return frozen(rows), frozen(np.concatenate([self.b / scale, values, -values]))

    def bounding_box(self) -> tuple[Array, Array]:
        """Return the smallest box (lower, upper), each (n,), infinite where unbounded. Raises `EmptySetError`."""
        self._require_point("bounding_box")
        eye = np.eye(self.dim)
        return 0.0 - self._supports(-eye), self._supports(eye) + 0.0  # no negative zeros

    def support(self, d: Any) -> Any:
        """Return h(d) = max dᵀx over the set: +inf if unbounded in d, −inf if empty.

        Parameters
        ----------
        d : (n,) or (k, n) array
            One direction or a batch.

        Returns
        -------
        float, or (k,) array
        """
        directions, single = as_batch(d, "d", self.dim)
        values = self._supports(directions)
        return float(values[0]) if single else values

    def _supports(self, D: Array) -> Array:
        """Return the support in the directions D (k, n), without a check of D."""
        if self._body is None:
            return np.full(len(D), -np.inf)
        if self._enumerated is not None or (self._body.bounded and self.dim <= 4):
            return (D @ self.vertices.T).max(axis=1)
        return support(self._body, D)


def counter_clockwise(V: Array) -> Array:
    """Return points of the plane in the order of their angle about the mean; others as they are."""
    if V.shape[1] != 2 or len(V) < 3:
        return V
    x = V - V.sum(axis=0) / len(V)
    x = x / np.maximum(np.abs(x).max(axis=0), TINY)
    return V[np.argsort(np.arctan2(x[:, 1], x[:, 0]))]


def _rows_hold(points: Array, A: Array, b: Array, chunk: int = 1 << 13) -> Array:
    """Return A x <= b for every point, in chunks that stay in the cache."""
    inside = np.ones(len(points), bool)
    limit = b[:, None]
    for start in range(0, len(points) if len(b) else 0, chunk):
        part = slice(start, start + chunk)
        np.less_equal(A @ points[part].T, limit).all(axis=0, out=inside[part])
    return inside
