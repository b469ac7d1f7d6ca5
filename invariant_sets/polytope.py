"""`Polytope`: a convex polyhedron given by inequalities and optional equalities."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from . import representation as rep
from .exceptions import EmptySetError, InputError, UnboundedError
from .validation import as_batch, as_matrix, as_vector, check_count, check_finite, check_rng, check_tolerance, frozen

Array = np.ndarray


@dataclass(frozen=True, eq=False, repr=False, init=False)
class Polytope:
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
        centre = V.mean(axis=0)
        scale = np.ptp(V, axis=0) / 2
        scale[scale <= 1e-15 * np.abs(V).max(axis=0)] = 1.0
        Y = (V - centre) / scale
        _, s, vt = np.linalg.svd(Y, full_matrices=True)
        rank = int((s > rep.FLAT * max(s.max(initial=0.0), rep.FLAT)).sum())
        N, M = vt[:rank], vt[rank:] / scale
        if rank:
            F, g = rep.hull_rows(Y @ N.T)
            A, b = F @ N / scale, g + F @ N @ (centre / scale)
        else:
            A, b = np.zeros((0, V.shape[1])), np.zeros(0)
        return cls(A, b, M, M @ centre) if len(M) else cls(A, b)

    # --- shape --------------------------------------------------------------------------------------------

    @property
    def dim(self) -> int:
        """Dimension n of the space."""
        return self.A.shape[1]

    @cached_property
    def _body(self) -> rep.Body | None:
        return rep.body_of(self.A, self.b, self.A_eq, self.b_eq)

    @property
    def is_empty(self) -> bool:
        """Whether no point satisfies the rows."""
        return self._body is None

    @property
    def is_bounded(self) -> bool:
        """Whether the set fits into a box. The empty set is bounded."""
        return self._body is None or self._body.bounded

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
        if self.dim == 1:
            content = float(np.ptp(Y))
        else:
            from scipy.spatial import ConvexHull

            content = float(ConvexHull(Y).volume)
        return content * abs(float(np.linalg.det(body.basis)))

    def _require_bounded(self, what: str) -> rep.Body:
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
        points, single = as_batch(x, "x", self.dim, finite=False)
        inside = self._inside(points, tol)
        return bool(inside[0]) if single else inside

    def _inside(self, points: Array, tol: float) -> Array:
        inside = np.ones(len(points), bool)
        if len(self.b):
            with np.errstate(invalid="ignore"):
                inside = _rows_hold(points, self.A, self.b + tol * np.maximum(1.0, np.abs(self.b)))
        if len(self.b_eq):
            with np.errstate(invalid="ignore"):
                gap = np.abs(points @ self.A_eq.T - self.b_eq)
            inside &= (gap <= tol * np.maximum(1.0, np.abs(self.b_eq))).all(axis=1)
        return inside

    def bounding_box(self) -> tuple[Array, Array]:
        """Return the smallest box (lower, upper), each (n,), infinite where unbounded. Raises `EmptySetError`."""
        if self._body is None:
            raise EmptySetError("bounding_box needs a point, but the set is empty.")
        eye = np.eye(self.dim)
        return -self._supports(-eye), self._supports(eye)

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
        values = np.empty(len(D))
        for i, d in enumerate(D):
            local = body.basis.T @ d
            size = np.linalg.norm(local)
            spread = size * (-rep.minimise(-local / size, body.F, body.g)[0]) if size > 1e-12 else 0.0
            values[i] = d @ body.centre + spread
        return values

    # --- new sets -----------------------------------------------------------------------------------------

    def minimal(self) -> Polytope:
        """Return the same set without redundant rows (weakly redundant ones and duplicates too).

        Equalities hidden in the inequalities become rows of A_eq. The empty set becomes 0·x <= −1.
        """
        body = self._body
        if body is None:
            return Polytope(np.zeros((1, self.dim)), [-1.0])
        if body.basis.shape[1] == self.dim:
            kept = rep.irredundant_rows(body.F, body.g) if len(body.g) else np.zeros(0, int)
            inverse = np.linalg.inv(body.basis)
            F = body.F[kept] @ inverse
            norms = np.linalg.norm(F, axis=1)
            return Polytope(F / norms[:, None], (body.g[kept] + F @ body.centre) / norms)
        kept = rep.irredundant_rows(body.F, body.g) if len(body.g) else np.zeros(0, int)
        F = body.F[kept] @ np.linalg.pinv(body.basis)
        _, _, vt = np.linalg.svd(body.basis.T, full_matrices=True)
        M = vt[body.basis.shape[1]:]
        return Polytope(F, body.g[kept] + F @ body.centre, M, M @ body.centre)

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
        Smith (1984), Efficient Monte Carlo procedures for generating points uniformly distributed over bounded
        regions, Operations Research 32(6). Assumes a bounded set; n chains of 20·dim steps run side by side from
        the centre of an inscribed ball.
        """
        n, rng = check_count(n, "n"), check_rng(rng)
        body = self._require_bounded("sample")
        k = body.basis.shape[1]
        Y = np.zeros((n, k))
        for _ in range(20 * k):
            direction = rng.standard_normal((n, k))
            speed, room = direction @ body.F.T, body.g - Y @ body.F.T
            with np.errstate(divide="ignore", invalid="ignore"):
                steps = np.maximum(room, 0.0) / speed
            ahead = np.where(speed > 0, steps, np.inf).min(axis=1)
            behind = np.where(speed < 0, steps, -np.inf).max(axis=1)
            Y += (behind + (ahead - behind) * rng.random(n))[:, None] * direction
        return body.centre + Y @ body.basis.T

    def __repr__(self) -> str:
        equalities = f", {len(self.b_eq)} equalities" if len(self.b_eq) else ""
        return f"Polytope(dim={self.dim}, {len(self.b)} inequalities{equalities})"


def _rows_hold(points: Array, A: Array, b: Array, chunk: int = 1 << 14) -> Array:
    """Return A x <= b for every point, in chunks that stay in the cache."""
    inside = np.empty(len(points), bool)
    for start in range(0, len(points), chunk):
        inside[start:start + chunk] = (points[start:start + chunk] @ A.T <= b).all(axis=1)
    return inside
