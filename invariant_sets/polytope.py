"""`Polytope`: a convex polyhedron given by inequalities and optional equalities."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from invariant_sets import hulls as rep
from invariant_sets.body_rows import hull_of_points, largest_ball, minimal_rows
from invariant_sets.exceptions import EmptySetError, InputError, UnboundedError
from invariant_sets.interior_form import Body, body_of, support
from invariant_sets.operations import SetOperations, same_space
from invariant_sets.sampling import hit_and_run
from invariant_sets.validation import (
    as_batch,
    as_matrix,
    as_vector,
    check_count,
    check_finite,
    check_rng,
    check_tolerance,
    frozen,
)

Array = np.ndarray


@dataclass(frozen=True, eq=False, repr=False, init=False)
class Polytope(SetOperations):
    """{x : A x <= b, A_eq x = b_eq}. It is never changed; vertices and the like are computed once, on demand.

    Parameters
    ----------
    A : (m, n) array
        Normals, outward. They need not be of unit length.
    b : (m,) array
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
    feasibility by more than that counts as empty.
    """

    A: Array
    b: Array
    A_eq: Array
    b_eq: Array

    def __init__(self, A: Any, b: Any, A_eq: Any = None, b_eq: Any = None) -> None:
        A = as_matrix(A, "A")
        n = A.shape[1]
        if n == 0:
            raise InputError("A has shape (m, 0), expected at least one column.")
        if (A_eq is None) != (b_eq is None):
            raise InputError("A_eq and b_eq must be given together, got only one of them.")
        A_eq = np.zeros((0, n)) if A_eq is None else as_matrix(A_eq, "A_eq", columns=n)
        b_eq = np.zeros(0) if b_eq is None else as_vector(b_eq, "b_eq", size=len(A_eq))
        arrays = {"A": A, "b": as_vector(b, "b", size=len(A)), "A_eq": A_eq, "b_eq": b_eq}
        for name, array in arrays.items():
            object.__setattr__(self, name, frozen(array))

    # --- construction -------------------------------------------------------------------------------------

    @classmethod
    def from_bounds(cls, lower: Any, upper: Any) -> Polytope:
        """Return the box lower <= x <= upper; an infinite bound is no bound, lower > upper is the empty set.

        Parameters
        ----------
        lower, upper : (n,) arrays
            Bounds in the units of x. ±inf is allowed.
        """
        lower = as_vector(lower, "lower", finite=False)
        upper = as_vector(upper, "upper", size=len(lower), finite=False)
        for name, bound in (("lower", lower), ("upper", upper)):
            check_finite(np.where(np.isinf(bound), 0.0, bound), name)
        if (lower == np.inf).any() or (upper == -np.inf).any():
            raise InputError("lower must be below +inf and upper above -inf; got an infinite bound that "
                             "excludes every point.")
        eye, has_upper, has_lower = np.eye(len(lower)), np.isfinite(upper), np.isfinite(lower)
        return cls(np.vstack([eye[has_upper], -eye[has_lower]]), np.append(upper[has_upper], -lower[has_lower]))

    @classmethod
    def from_vertices(cls, V: Any) -> Polytope:
        """Return the convex hull of the points V (k, n), k >= 1. Flat hulls get equalities.

        References
        ----------
        Barber, Dobkin, Huhdanpaa (1996), The Quickhull algorithm, ACM TOMS 22(4).
        """
        V = as_matrix(V, "V")
        if V.shape[0] == 0 or V.shape[1] == 0:
            raise InputError(f"V has shape {V.shape}, expected (k, n) with k >= 1 and n >= 1.")
        A, b, A_eq, b_eq, extreme = hull_of_points(V)
        P = cls(A, b, A_eq, b_eq)
        if V.shape[1] != 2:  # in the plane they come in order, from the inequalities
            P.__dict__["vertices"] = frozen(V[extreme])
        return P

    # --- shape --------------------------------------------------------------------------------------------

    @property
    def dim(self) -> int:
        """Dimension n of the space."""
        return self.A.shape[1]

    @cached_property
    def _body(self) -> Body | None:
        return body_of(self.A, self.b, self.A_eq, self.b_eq)

    @property
    def is_empty(self) -> bool:
        """Whether no point satisfies the rows."""
        return self._body is None

    @property
    def is_bounded(self) -> bool:
        """Whether the set fits into a box. The empty set is bounded."""
        return "vertices" in self.__dict__ or self._body is None or self._body.bounded

    @property
    def affine_dim(self) -> int:
        """Dimension of the affine hull: n if full-dimensional, 0 for a point, −1 for the empty set."""
        return -1 if self._body is None else self._body.basis.shape[1]

    @cached_property
    def vertices(self) -> Array:
        """Vertices (k, n), counter-clockwise in the plane; (0, n) if empty. Raises `UnboundedError`."""
        if self._body is None:
            return frozen(np.zeros((0, self.dim)))
        body = self._require_bounded("vertices")
        if body.basis.shape[1] == 0:
            return frozen(body.centre[None].copy())
        Y = rep.facets_and_vertices(body.F, body.g)[1]
        if Y.shape[1] == 2:
            Y = Y[np.argsort(np.arctan2(Y[:, 1], Y[:, 0]))]
        V = body.centre + Y @ body.basis.T
        return frozen(V)

    @cached_property
    def volume(self) -> float:
        """Volume in the n-dimensional space; 0 if flat or empty. Raises `UnboundedError`."""
        body = self._body
        if body is None or body.basis.shape[1] < self.dim:
            return 0.0
        self._require_bounded("volume")
        Y = (self.vertices - body.centre) @ np.linalg.inv(body.basis).T
        return rep.hull_volume(Y) * abs(float(np.linalg.det(body.basis)))

    def _require_bounded(self, what: str) -> Body:
        if self._body is None:
            raise EmptySetError(f"{what} needs a point, but the set is empty.")
        if not self._body.bounded:
            raise UnboundedError(f"{what} needs a bounded set, but this one is unbounded; intersect it with a box.")
        return self._body

    # --- questions ----------------------------------------------------------------------------------------

    def contains(self, x: Any, tol: float = 1e-9) -> Any:
        """Return whether points lie in the set.

        Parameters
        ----------
        x : (n,) or (k, n) array
            One point or a batch. A point with NaN is in no set.
        tol : float
            Positive accepts points up to tol·max(1, |bᵢ|)-violations of a row as given.

        Returns
        -------
        bool, or (k,) array of bools
        """
        tol = check_tolerance(tol)
        points, single = as_batch(x, "x", self.dim, finite=False, copy=False)
        scale, scale_eq = self._row_scales
        with np.errstate(invalid="ignore"):
            inside = _rows_hold(points, self.A, self.b + tol * scale)
            if len(self.b_eq):
                inside &= (np.abs(points @ self.A_eq.T - self.b_eq) <= tol * scale_eq).all(axis=1)
        return bool(inside[0]) if single else inside

    @cached_property
    def _row_scales(self) -> tuple[Array, Array]:
        """What a relative tolerance means for each inequality and equality: its range over the bounding box."""
        if "vertices" in self.__dict__ and len(self.vertices):
            extent = np.ptp(self.vertices, axis=0)
        elif self._body is not None:
            extent = 2 * np.linalg.norm(self._body.basis, axis=1)
        else:
            extent = np.zeros(self.dim)
        largest = extent.max() if extent.any() else 1.0
        extent = np.where(extent > 1e-15 * largest, extent, largest)  # a flat coordinate has only rounding
        return np.abs(self.A) @ extent, np.abs(self.A_eq) @ extent

    def is_subset(self, other: Polytope, tol: float = 1e-9) -> bool:
        """Return whether P ⊆ Q. The empty set is a subset of every set.

        Parameters
        ----------
        other : Polytope
            Q, of the same dimension.
        tol : float
            Positive accepts points that leave Q by up to tol times the width of the sets.
        """
        other, tol = same_space(self, other), check_tolerance(tol)
        if self._body is None:
            return True
        if other._body is None:
            return False
        slack = [tol * np.maximum(mine, theirs) for mine, theirs in
                 zip(self._scales_along(other), other._row_scales)]
        return bool((self._supports(other.A) <= other.b + slack[0]).all()
                    and (self._supports(other.A_eq) <= other.b_eq + slack[1]).all()
                    and (self._supports(-other.A_eq) <= -other.b_eq + slack[1]).all())

    def _scales_along(self, other: Polytope) -> tuple[Array, Array]:
        extent = 2 * np.linalg.norm(self._body.basis, axis=1)  # type: ignore[union-attr]
        return np.abs(other.A) @ extent, np.abs(other.A_eq) @ extent

    def equals(self, other: Polytope, tol: float = 1e-9) -> bool:
        """Return whether P and Q are the same set of points, to `tol` of their width; rows may differ."""
        return self.is_subset(other, tol) and same_space(self, other).is_subset(self, tol)

    def chebyshev_ball(self) -> tuple[Array, float]:
        """Return centre (n,) and radius of a largest ball inside; 0 if flat, inf if none is largest.

        The ball is Euclidean in the units of x. Raises `EmptySetError`.

        References
        ----------
        Boyd, Vandenberghe (2004), Convex Optimization, section 8.5.1.
        """
        if self._body is None:
            raise EmptySetError("chebyshev_ball needs a point, but the set is empty.")
        return largest_ball(self._body)

    def bounding_box(self) -> tuple[Array, Array]:
        """Return the smallest box (lower, upper), each (n,), infinite where unbounded. Raises `EmptySetError`."""
        if self._body is None:
            raise EmptySetError("bounding_box needs a point, but the set is empty.")
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
        body = self._body
        if body is None:
            return np.full(len(D), -np.inf)
        if body.bounded and (self.dim <= 4 or "vertices" in self.__dict__):
            return (D @ self.vertices.T).max(axis=1)
        return support(body, D)

    # --- new sets -----------------------------------------------------------------------------------------

    def minimal(self) -> Polytope:
        """Return the same set without redundant rows (weakly redundant ones and duplicates too).

        Equalities hidden in the inequalities become rows of A_eq. The empty set becomes 0·x <= −1.
        """
        if self._body is None:
            return Polytope(np.zeros((1, self.dim)), [-1.0])
        return Polytope(*minimal_rows(self._body))

    def sample(self, n: int, *, rng: np.random.Generator) -> Array:
        """Return n points, nearly uniform in the set (relative to its affine hull), by hit and run.

        Parameters
        ----------
        n : int
            Number of points.
        rng : numpy.random.Generator
            Source of randomness.

        Returns
        -------
        (n, dim) array

        Raises
        ------
        EmptySetError, UnboundedError

        References
        ----------
        Smith (1984), Operations Research 32(6); see `sampling`. Assumes a bounded set.
        """
        n, rng = check_count(n, "n"), check_rng(rng)
        body = self._require_bounded("sample")
        if body.basis.shape[1] == 0:
            return np.repeat(body.centre[None], n, axis=0)
        return body.centre + hit_and_run(body, n, rng) @ body.basis.T

    def __repr__(self) -> str:
        equalities = f", {len(self.b_eq)} equalities" if len(self.b_eq) else ""
        return f"Polytope(dim={self.dim}, {len(self.b)} inequalities{equalities})"

    def _repr_html_(self) -> str:
        facts: dict[str, Any] = {"dimension": self.dim, "inequalities": len(self.b), "equalities": len(self.b_eq),
                 "empty": self.is_empty, "bounded": self.is_bounded, "dimension of its affine hull": self.affine_dim}
        if not self.is_empty:
            lower, upper = self.bounding_box()
            for i in range(self.dim):
                facts[f"x<sub>{i}</sub>"] = f"[{lower[i]:.6g}, {upper[i]:.6g}]"
        rows = "".join(f"<tr><th>{name}</th><td>{value}</td></tr>" for name, value in facts.items())
        return f"<table><caption>Polytope</caption>{rows}</table>"

    def plot(self, ax: Any = None, **style: Any) -> Any:
        """Draw the set, or its projection on the first three coordinates, and return the artist.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Where to draw; a new one if left out.
        **style
            Passed to the matplotlib artist, for example color, alpha, label.
        """
        from invariant_sets.plotting import plot_polytope

        return plot_polytope(self, ax=ax, **style)


def _rows_hold(points: Array, A: Array, b: Array, chunk: int = 1 << 13) -> Array:
    """Return A x <= b for every point, in chunks that stay in the cache."""
    inside = np.ones(len(points), bool)
    limit = b[:, None]
    for start in range(0, len(points) if len(b) else 0, chunk):
        part = slice(start, start + chunk)
        np.less_equal(A @ points[part].T, limit).all(axis=0, out=inside[part])
    return inside
