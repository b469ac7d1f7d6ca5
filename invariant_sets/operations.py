"""Operations that make a new set out of one or two: the second half of `Polytope`.

No operator is overloaded: P.minkowski_sum(Q) and P.pontryagin_difference(Q) are not inverse to each other, which
P + Q and P − Q would suggest. (P ⊖ Q) ⊕ Q ⊆ P ⊆ (P ⊕ Q) ⊖ Q, with equality on the right for convex sets.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from invariant_sets.exceptions import InputError
from invariant_sets.interior_form import FLAT, Body, unit_rows
from invariant_sets.linear_programs import inscribed_ball
from invariant_sets.projection import project_rows
from invariant_sets.validation import as_floats, as_matrix, as_vector, check_finite

if TYPE_CHECKING:
    from invariant_sets.polytope import Polytope

Array = np.ndarray
_EPS = 32 * np.finfo(float).eps
_ROUND = 1e-12  # of the width of the sets: what a difference of supports may be wrong by


class SetOperations:
    """Set operations, to be inherited by `Polytope`. Every one returns a new set."""

    A: Array
    b: Array
    A_eq: Array
    b_eq: Array

    if TYPE_CHECKING:  # supplied by Polytope
        @property
        def _body(self) -> Body | None: ...
        @property
        def dim(self) -> int: ...
        @property
        def is_empty(self) -> bool: ...
        @property
        def vertices(self) -> Array: ...
        def _supports(self, D: Array) -> Array: ...

    def intersection(self, other: Polytope) -> Polytope:
        """Return P ∩ Q, both of the same dimension."""
        other = same_space(self, other)
        return _new(self, np.vstack([self.A, other.A]), np.append(self.b, other.b),
                    np.vstack([self.A_eq, other.A_eq]), np.append(self.b_eq, other.b_eq))

    def cartesian_product(self, other: Polytope) -> Polytope:
        """Return P × Q = {(x, y) : x in P, y in Q}."""
        other = _polytope(other, self)
        return _new(self, _diagonal(self.A, other.A), np.append(self.b, other.b),
                    _diagonal(self.A_eq, other.A_eq), np.append(self.b_eq, other.b_eq))

    def minkowski_sum(self, other: Polytope) -> Polytope:
        """Return P ⊕ Q = {x + y : x in P, y in Q}: everything that can be reached by adding the two.

        Notes
        -----
        Bounded sets through sums of vertices and their hull (Qhull), unbounded ones by Fourier–Motzkin.
        """
        other = same_space(self, other)
        if self.is_empty or other.is_empty:
            return _nothing(self)
        if self._body.bounded and other._body.bounded:  # type: ignore[union-attr]
            sums = self.vertices[:, None, :] + other.vertices[None, :, :]
            return type(self).from_vertices(sums.reshape(-1, self.dim))  # type: ignore[attr-defined]
        both = np.hstack([np.eye(self.dim), np.eye(self.dim)])
        return self.cartesian_product(other).affine_map(both)

    def pontryagin_difference(self, other: Polytope) -> Polytope:
        """Return P ⊖ Q = {x : x + y in P for every y in Q}: P, tightened by all that Q may do.

        P ⊖ ∅ is the whole space, by that definition.

        References
        ----------
        Kolmanovsky, Gilbert (1998), Theory and computation of disturbance invariant sets for discrete-time linear
        systems, Mathematical Problems in Engineering 4(4), section 2. Assumes nothing about Q but its support.
        """
        other = same_space(self, other)
        n = self.dim
        if other.is_empty:
            return _new(self, np.zeros((0, n)), np.zeros(0))
        if self.is_empty:
            return _nothing(self)
        reach = other._supports(self.A) if len(self.b) else np.zeros(0)
        upper, lower = ((other._supports(self.A_eq), -other._supports(-self.A_eq)) if len(self.b_eq)
                        else (np.zeros(0), np.zeros(0)))
        size = np.maximum(1.0, np.abs(upper))
        if np.isinf(reach).any() or np.isinf(upper).any() or (upper - lower > FLAT * size).any():
            return _nothing(self)
        right, middle = self.b - reach, (upper + lower) / 2
        if len(right):
            right = self._without_rounding(other, right, _EPS * (np.abs(self.b) + np.abs(reach)))
        return _nothing(self) if right is None else _new(self, self.A, right, self.A_eq, self.b_eq - middle)

    def _without_rounding(self, other: Polytope, right: Array, error: Array) -> Array | None:
        """Return the right-hand sides of P ⊖ Q with rows that meet in one point, up to rounding, meeting exactly.

        P ⊖ P is {0}, a point whose own size says nothing about rounding; that of P does. None if empty.
        """
        body, theirs = self._body, other._body
        assert body is not None
        assert theirs is not None
        extent = 2 * np.linalg.norm(np.hstack([body.basis, theirs.basis]), axis=1)
        margin = _ROUND * (np.abs(self.A) @ extent) + error
        slope, point = self.A @ body.basis, body.centre - theirs.centre
        norms = np.linalg.norm(slope, axis=1)
        moving = norms > 1e-13 * norms.max(initial=0.0)
        if moving.any():
            room = (right - self.A @ point)[moving]
            _, y = inscribed_ball(slope[moving] / norms[moving, None], room / norms[moving], cap=1.0)
            point = point + body.basis @ y
        level = self.A @ point
        if (right - level < -margin).any():
            return None
        return np.where(right - level <= margin, level, right)

    def affine_map(self, M: Any, c: Any = None) -> Polytope:
        """Return {M x + c : x in P}. M may be singular or change the dimension.

        Parameters
        ----------
        M : (k, n) array
            Matrix, k >= 1.
        c : (k,) array, optional
            Translation; zero if left out.

        Notes
        -----
        Where M is injective on the affine hull the rows are transformed. Elsewhere bounded sets go through the
        hull of the mapped vertices, unbounded ones through Fourier–Motzkin.
        """
        M = as_matrix(M, "M", columns=self.dim)
        if len(M) == 0:
            raise InputError(f"M has shape {M.shape}, expected at least one row.")
        c = np.zeros(len(M)) if c is None else as_vector(c, "c", size=len(M))
        body = self._body
        if body is None:
            return _nothing(self, len(M))
        origin, G = M @ body.centre + c, M @ body.basis
        size = np.abs(M) @ np.abs(body.basis).max(axis=1, initial=0.0)  # the units of each image coordinate
        units = np.where(size > 0, size, 1.0)
        left, s, vt = np.linalg.svd(G / units[:, None], full_matrices=True)
        rank = int((s > FLAT * s.max(initial=0.0)).sum()) if s.any() else 0
        if rank < body.basis.shape[1] and body.bounded:
            return type(self).from_vertices(self.vertices @ M.T + c)  # type: ignore[attr-defined]
        F, g = unit_rows(*project_rows(body.F @ vt.T, body.g, rank), always=True)
        back = left[:, :rank].T / s[:rank, None] / units  # image → the first `rank` coordinates of vt y
        normal = left[:, rank:].T / units
        return _new(self, F @ back, g + F @ back @ origin, normal, normal @ origin)

    def preimage(self, M: Any, c: Any = None) -> Polytope:
        """Return {x : M x + c in P}. M may be singular; the result is then unbounded.

        Parameters
        ----------
        M : (n, k) array
            Matrix, k >= 1.
        c : (n,) array, optional
            Translation; zero if left out.
        """
        M = as_matrix(M, "M", rows=self.dim)
        if M.shape[1] == 0:
            raise InputError(f"M has shape {M.shape}, expected at least one column.")
        c = np.zeros(self.dim) if c is None else as_vector(c, "c", size=self.dim)
        return _new(self, self.A @ M, self.b - self.A @ c, self.A_eq @ M, self.b_eq - self.A_eq @ c)

    def projection(self, coordinates: Any) -> Polytope:
        """Return the projection onto the given coordinates, in the given order: some value of the others exists."""
        kept = self._coordinates(coordinates)
        return self.affine_map(np.eye(self.dim)[kept])

    def slice(self, coordinates: Any, values: Any) -> Polytope:
        """Return the cut where `coordinates` have the given values, as a set of the other coordinates."""
        fixed = self._coordinates(coordinates)
        values = as_vector(values, "values", size=len(fixed))
        free = np.setdiff1d(np.arange(self.dim), fixed)
        if len(free) == 0:
            raise InputError(f"coordinates fixes all {self.dim} coordinates; use contains for a point.")
        M, c = np.eye(self.dim)[:, free], np.zeros(self.dim)
        c[fixed] = values
        return self.preimage(M, c)

    def scale(self, factor: float) -> Polytope:
        """Return {factor·x : x in P}, about the origin. Factor 0 gives {0}, a negative one also reflects."""
        value = as_floats(factor, "factor")
        if value.ndim != 0:
            raise InputError(f"factor has shape {value.shape}, expected a number; use affine_map for a matrix.")
        check_finite(value, "factor")
        n, k = self.dim, float(value)
        if self.is_empty:
            return _nothing(self)
        if k == 0.0:
            return _new(self, np.zeros((0, n)), np.zeros(0), np.eye(n), np.zeros(n))
        sign = np.sign(k)
        return _new(self, sign * self.A, abs(k) * self.b, sign * self.A_eq, abs(k) * self.b_eq)

    def _coordinates(self, coordinates: Any) -> Array:
        index = np.atleast_1d(np.asarray(coordinates))
        if (index.ndim != 1 or len(index) == 0 or index.dtype.kind not in "iu" or (index < 0).any()
                or (index >= self.dim).any() or len(np.unique(index)) != len(index)):
            raise InputError(f"coordinates must be distinct integers from 0 to {self.dim - 1}, got {coordinates!r}.")
        return index


def same_space(P: Any, Q: Any, name: str = "other") -> Polytope:
    """Return Q, or raise `InputError` unless it is a `Polytope` of P's dimension."""
    Q = _polytope(Q, P, name)
    if Q.dim != P.dim:
        raise InputError(f"{name} has dimension {Q.dim}, expected {P.dim}.")
    return Q


def _polytope(Q: Any, P: Any, name: str = "other") -> Polytope:
    if not isinstance(Q, SetOperations):
        raise InputError(f"{name} must be a Polytope, got {type(Q).__name__}.")
    return Q  # type: ignore[return-value]


def _new(P: SetOperations, A: Array, b: Array, A_eq: Array | None = None, b_eq: Array | None = None) -> Polytope:
    return type(P)(A, b, A_eq, b_eq)  # type: ignore[call-arg, return-value]


def _nothing(P: SetOperations, dim: int | None = None) -> Polytope:
    return _new(P, np.zeros((1, P.dim if dim is None else dim)), np.array([-1.0]))


def _diagonal(P: Array, Q: Array) -> Array:
    return np.block([[P, np.zeros((len(P), Q.shape[1]))], [np.zeros((len(Q), P.shape[1])), Q]])
