"""`Polyhedron`: the rows of a convex set, and questions about it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self, TypeVar

import numpy as np

from invariant_sets.bodies import Body, Stated
from invariant_sets.budgets import CHEAP_HULL_DIM
from invariant_sets.exceptions import EmptySetError, InputError, NumericalError, TimeLimitError, UnboundedError
from invariant_sets.hulls import (
    cone_volume,
    counter_clockwise,
    distinct,
    extreme_points,
    facets_and_vertices,
    hull_volume,
)
from invariant_sets.interior_form import body_of, body_of_vertices, hull_about, settled, support
from invariant_sets.membership import rows_hold
from invariant_sets.time_limits import NO_DEADLINE, Deadline, LimitReached
from invariant_sets.tolerances import MEMBERSHIP, ROUNDING
from invariant_sets.validation import as_batch, as_bounds, as_count, as_matrix, as_vector, check_tolerance, frozen

Array = np.ndarray
AnySet = TypeVar("AnySet", bound="Polyhedron")


@dataclass(frozen=True, eq=False, repr=False, init=False)
class Polyhedron:
    """Convex set {x : A x <= b, A_eq x = b_eq}, never changed.

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
    feasibility by more than that counts as empty. Rows hold to 1e-12 of their own data, |bᵢ| + |Aᵢ||x|.
    """

    A: Array
    b: Array
    A_eq: Array
    b_eq: Array
    # the rest is for the modules of this package, and no part of what users are promised
    stated: Stated  # the rows with the sizes of their terms
    given_vertices: Array | None  # where the set was made of its vertices

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
        _fill(self, Stated.given(A, b, A_eq, b_eq), None)

    def __reduce__(self) -> tuple[Any, ...]:
        settled = "body" in self.__dict__
        body = self.__dict__.get("body" if settled else "_unsettled")
        return set_of, (type(self), self.stated, self.given_vertices, body, settled)

    # --- construction -------------------------------------------------------------------------------------

    @classmethod
    def from_bounds(cls, lower: Any, upper: Any) -> Self:
        """Box lower <= x <= upper; an infinite bound is no bound.

        Parameters
        ----------
        lower, upper : (n,) arrays
            Bounds in the units of x. ±inf is allowed.

        Raises
        ------
        InputError
            If a lower bound is above its upper bound, or shapes do not match.
        """
        lower, upper = as_bounds(lower, upper)
        eye = np.eye(len(lower))
        has_upper = np.isfinite(upper)
        has_lower = np.isfinite(lower)
        return cls(np.vstack([eye[has_upper], -eye[has_lower]]), np.append(upper[has_upper], -lower[has_lower]))

    @classmethod
    def from_vertices(cls, V: Any, *, time_limit: float | None = None) -> Self:
        """Convex hull of the points V (k, n), with equalities if flat.

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
        deadline = Deadline.after(time_limit)
        try:
            deadline.check_hull(*V.shape)
        except LimitReached as limit:
            box = cls.from_bounds(V.min(axis=0), V.max(axis=0))
            raise TimeLimitError("from_vertices", time_limit, str(limit), box) from None
        return hull_of(cls, V[0], V - V[0], np.abs(V).max(axis=0))

    @classmethod
    def empty(cls, n: int) -> Self:
        """Empty set in n dimensions, as the row 0 x <= −1."""
        return cls(np.zeros((1, as_count("n", n))), [-1.0])

    # --- shape --------------------------------------------------------------------------------------------

    @property
    def dim(self) -> int:
        """Dimension n of the space."""
        return int(self.A.shape[1])

    @cached_property
    def body(self) -> Body | None:  # the set in well-scaled coordinates, None if empty: for the package
        unsettled = self.__dict__.get("_unsettled")
        if unsettled is not None:
            body: Body | None = settled(unsettled)
            return body
        if self.given_vertices is not None and not len(self.b_eq) and len(self.given_vertices) > self.dim:
            body = body_of_vertices(self.A, self.b, self.given_vertices)
            if body is not None:
                return body
        return body_of(self.stated)

    @property
    def is_empty(self) -> bool:
        """Whether no point satisfies the rows."""
        return self.body is None

    @property
    def is_bounded(self) -> bool:
        """Whether the set is bounded, as the empty set is."""
        return self.given_vertices is not None or self.body is None or self.body.bounded

    @property
    def affine_dim(self) -> int:
        """Dimension of the affine hull: 0 for a point, −1 if empty."""
        return -1 if self.body is None else self.body.basis.shape[1]

    @cached_property
    def vertices(self) -> Array:
        """Vertices (k, n), counter-clockwise in the plane; (0, n) if empty. Raises `UnboundedError`."""
        if self.given_vertices is not None:
            return self.given_vertices
        if self.body is None:
            return frozen(np.zeros((0, self.dim)))
        body = self._require_bounded("vertices")
        try:
            NO_DEADLINE.check_hull(len(body.g), body.basis.shape[1])
        except LimitReached as limit:
            raise TimeLimitError("vertices", None, str(limit)) from None
        return frozen(body.centre + self.offsets[1])

    @cached_property
    def offsets(self) -> tuple[Array, Array]:  # a point (n,) and the vertices less it (k, n): for the package
        if self.given_vertices is not None:
            return self.given_vertices[0], self.given_vertices - self.given_vertices[0]
        body = self._require_bounded("vertices")
        rows = distinct(np.column_stack([body.F, body.g]))
        Y = facets_and_vertices(body.F[rows], body.g[rows])[1]
        corners = extreme_points(Y, body.F, body.g, ROUNDING * body.sizes.max(initial=0.0))
        return body.centre, counter_clockwise(Y[corners]) @ body.basis.T

    @property
    def has_vertices(self) -> bool:  # whether they are known, which makes supports quicker: for the package
        return self.given_vertices is not None or "vertices" in self.__dict__

    @cached_property
    def volume(self) -> float:
        """Volume in n dimensions; 0 if flat or empty. Raises `UnboundedError`."""
        body = self.body
        if body is None or body.basis.shape[1] < self.dim:
            return 0.0
        self._require_bounded("volume")
        with np.errstate(over="ignore", under="ignore"):
            unit = float(np.abs(np.diag(body.basis)).prod())  # the basis of a solid set is diagonal
        if not 0.0 < unit < np.inf:
            raise NumericalError("The volume", self.A.shape, "it is too large or too small for doubles")
        if self.dim > CHEAP_HULL_DIM:
            self.vertices  # noqa: B018  # the limits on the size of the hull
            found = cone_volume(body.F, body.g)
            if found is not None:
                return found * unit
        return hull_volume((self.vertices - body.centre) @ body.inverse.T) * unit

    def _require_bounded(self, what: str) -> Body:
        """Body, or raise `EmptySetError` or `UnboundedError`."""
        body = nonempty_body(self, what)
        if not body.bounded:
            raise UnboundedError(what)
        return body

    # --- questions ----------------------------------------------------------------------------------------

    def contains(self, x: Any, tol: float = MEMBERSHIP) -> Any:
        """Whether points lie in the set.

        Parameters
        ----------
        x : (n,) or (k, n) array
            One point or a batch. A point with NaN is in no set.
        tol : float
            A row may be violated by `tol` times its range over the bounding box of the set, or by the rounding of
            its own data at the point if that is more: 1e-12 of |bᵢ| + |Aᵢ||x|. 0 is strict.

        Returns
        -------
        bool, or (k,) array of bools
        """
        tol = check_tolerance(tol)
        points, single = as_batch(x, "x", self.dim, finite=False, copy=False)
        A, b = self.one_sided
        slack = np.maximum.reduce([tol * self.ranges, (tol > 0) * self.missed, min(tol, ROUNDING) * self.row_terms])
        with np.errstate(invalid="ignore", over="ignore"):
            inside = rows_hold(points, A, b, slack, min(tol, ROUNDING), self._reach)
        return bool(inside[0]) if single else inside

    def __contains__(self, x: Any) -> bool:
        """Whether one point (n,) lies in the set, as by `contains`."""
        return bool(self.contains(as_vector(x, "x", size=self.dim, finite=False)))

    # what follows is for the modules of this package: the rows as inequalities, two for each equality, with the sizes
    # of their terms, their violations by the set's centre, doubled, and their ranges over the bounding box

    @cached_property
    def one_sided(self) -> tuple[Array, Array]:
        if not len(self.b_eq):
            return self.A, self.b
        return (
            frozen(np.concatenate([self.A, self.A_eq, -self.A_eq])),
            frozen(np.concatenate([self.b, self.b_eq, -self.b_eq])),
        )

    @property
    def row_terms(self) -> Array:
        *_, terms, terms_eq = self.stated
        return np.concatenate([terms, terms_eq, terms_eq]) if len(self.b_eq) else terms

    @cached_property
    def missed(self) -> Array:
        A, b = self.one_sided
        if self._solid_vertices is not None or self.body is None:
            return np.zeros(len(b))
        return np.asarray(2 * np.maximum(A @ self.body.centre - b, 0.0))

    @cached_property
    def ranges(self) -> Array:
        return np.asarray(np.abs(self.one_sided[0]) @ self.widths)

    @cached_property
    def _reach(self) -> Array | None:
        """Size |x| (n,) that no point exceeds; None if unbounded or empty."""
        if self._solid_vertices is not None:
            return np.asarray(1.01 * np.abs(self._solid_vertices).max(axis=0))
        if self.body is None or not self.body.bounded:
            return None
        return np.asarray(1.01 * np.abs(self.body.centre) + 2.02 * self.body.half_widths)

    @cached_property
    def _solid_vertices(self) -> Array | None:
        """Known vertices with a width in every coordinate, otherwise None."""
        V = self.given_vertices
        if V is None or len(self.b_eq):
            return None
        lower = V.min(axis=0)
        upper = V.max(axis=0)
        return V if (upper - lower > ROUNDING * np.abs(lower + upper)).all() else None

    @cached_property
    def widths(self) -> Array:  # of the bounding box (n,), 0 where it is flat: for the package
        if self._solid_vertices is not None:
            return np.asarray(self._solid_vertices.max(axis=0) - self._solid_vertices.min(axis=0))
        return np.zeros(self.dim) if self.body is None else 2 * self.body.half_widths

    @cached_property
    def relative_rows(self) -> tuple[Array, Array]:  # one-sided, divided by range or certainty: for the package
        A, b = self.one_sided
        place = 0.0 if self._reach is None else np.abs(A) @ self._reach
        ranges = np.where(self.ranges > 0.0, self.ranges, 1.0)
        ranges = np.maximum(ranges, ROUNDING / MEMBERSHIP * (self.row_terms + place))
        return frozen(A / ranges[:, None]), frozen(b / ranges)

    def bounding_box(self) -> tuple[Array, Array]:
        """Smallest box (lower, upper), (n,) each, infinite where unbounded. Raises `EmptySetError`."""
        nonempty_body(self, "bounding_box")
        lower, upper = self._box
        return lower.copy(), upper.copy()

    @cached_property
    def _box(self) -> tuple[Array, Array]:
        """Bounding box of a nonempty set."""
        eye = np.eye(self.dim)
        return frozen(0.0 - self._supports(-eye)), frozen(self._supports(eye) + 0.0)  # no negative zeros

    def support(self, d: Any) -> Any:
        """Support h(d) = max dᵀx: +inf if unbounded, −inf if empty.

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
        """Support in the directions D (k, n), unchecked."""
        if self.body is None:
            return np.full(len(D), -np.inf)
        if self.has_vertices or (self.body.bounded and self.dim <= 4):
            return np.asarray((D @ self.vertices.T).max(axis=1))
        return support(self.body, D)


def _fill(P: Polyhedron, rows: Stated, V: Array | None) -> None:
    """Set the fields of P, once."""
    rows = Stated(*map(frozen, rows))
    vertices = None if V is None else frozen(V)
    names = ("A", "b", "A_eq", "b_eq", "stated", "given_vertices")
    for name, value in zip(names, (*rows[:4], rows, vertices)):
        object.__setattr__(P, name, value)


def set_of(
    kind: type[AnySet], rows: Stated, V: Array | None = None, body: Body | None = None, settled: bool = True
) -> AnySet:
    """Set of these rows, with vertices V (k, n) and body where known.

    A body that is not settled says where the set lies; its own extents are found when something asks for them.
    """
    P = kind.__new__(kind)
    _fill(P, rows, V)
    if body is not None:
        P.__dict__["body" if settled else "_unsettled"] = body
    return P


def hull_of(kind: type[AnySet], anchor: Array, Y: Array, terms: Array) -> AnySet:
    """Hull of the points anchor + Y (k, n), with term sizes (n,).

    Far from the origin the differences Y keep the digits that the points themselves have lost.
    """
    body, extreme = hull_about(anchor, Y, terms)
    return set_of(kind, body.rows, counter_clockwise(anchor + Y[extreme]), body)


def nonempty_body(P: Polyhedron, what: str) -> Body:
    """Body, or raise `EmptySetError`."""
    if P.body is None:
        raise EmptySetError(what)
    return P.body
