"""Operations that make a new set out of one or two.

No operator is overloaded: P.minkowski_sum(Q) and P.pontryagin_difference(Q) are not inverse to each other, which
P + Q and P − Q would suggest. (P ⊖ Q) ⊕ Q ⊆ P ⊆ (P ⊕ Q) ⊖ Q, with equality on the right for convex sets.
"""

from __future__ import annotations

from typing import Any, Self, TypeVar

import numpy as np

from invariant_sets.exceptions import InputError, TimeLimitError
from invariant_sets.generators import Generators, generators, rows_of
from invariant_sets.hulls import irredundant_rows
from invariant_sets.interior_form import Body
from invariant_sets.linear_programs import inscribed_ball
from invariant_sets.polyhedron import Polyhedron
from invariant_sets.time_limits import Deadline, LimitReached, check_time_limit
from invariant_sets.tolerances import CANCELLED, FLAT, ROUNDING
from invariant_sets.validation import as_floats, as_matrix, as_vector, check_finite, shown

Array = np.ndarray
AnySet = TypeVar("AnySet", bound=Polyhedron)


class SetOperations(Polyhedron):
    """Set operations, to be inherited by `Polytope`. Every one returns a new set."""

    def minimal(self) -> Self:
        """Return the same set without redundant rows (weakly redundant ones and duplicates too).

        Equalities hidden in the inequalities become rows of A_eq. The empty set becomes 0·x <= −1.
        """
        body = self._body
        if body is None:
            return type(self).empty(self.dim)
        kept = irredundant_rows(body.F, body.g) if len(body.g) else np.zeros(0, int)
        A = body.F[kept] @ body.inverse
        A_eq = body.normals
        norms = np.linalg.norm(A, axis=1)
        norms_eq = np.linalg.norm(A_eq, axis=1)
        A = A / norms[:, None]
        A_eq = A_eq / norms_eq[:, None]
        right = body.g[kept] / norms + A @ body.centre
        return type(self)._with_vertices(A, right, A_eq, A_eq @ body.centre, self._vertices)

    def intersection(self, other: Polyhedron) -> Self:
        """Return P ∩ Q, both of the same dimension."""
        other = same_space(self, other)
        return type(self)(np.vstack([self.A, other.A]), np.append(self.b, other.b),
                          np.vstack([self.A_eq, other.A_eq]), np.append(self.b_eq, other.b_eq))

    def cartesian_product(self, other: Polyhedron) -> Self:
        """Return P × Q = {(x, y) : x in P, y in Q}."""
        other = _checked_set(other)
        return type(self)(_diagonal(self.A, other.A), np.append(self.b, other.b),
                          _diagonal(self.A_eq, other.A_eq), np.append(self.b_eq, other.b_eq))

    def minkowski_sum(self, other: Polyhedron, *, time_limit: float | None = None) -> Self:
        """Return P ⊕ Q = {x + y : x in P, y in Q}: everything that can be reached by adding the two.

        Parameters
        ----------
        other : Polytope
            Q, of the same dimension.
        time_limit : float, optional
            Seconds; none if left out. The cost of a hull is estimated before it is begun.

        Raises
        ------
        TimeLimitError
            If the sum would take longer, or more memory than a hull may have. Its `outer` is a set that contains the
            sum and touches it along every row of P and Q.

        Notes
        -----
        The hull (Qhull) of the sums of vertices; for unbounded sets, of points and rays.
        """
        other = same_space(self, other)
        deadline = Deadline.after(check_time_limit(time_limit))
        mine = self._body
        theirs = other._body
        if mine is None or theirs is None:
            return type(self).empty(self.dim)
        D = np.vstack([self.A, other.A, np.eye(self.dim), -np.eye(self.dim)])
        try:
            if mine.bounded and theirs.bounded:
                count = len(self.vertices) * len(other.vertices)
                deadline.check_hull(count, max(self.affine_dim, other.affine_dim))
                sums = self.vertices[:, None, :] + other.vertices[None, :, :]
                return type(self).from_vertices(sums.reshape(-1, self.dim))
            both = _generators_of(self, deadline).plus(_generators_of(other, deadline))
            return type(self)(*rows_of(both, deadline))
        except LimitReached as limit:
            outer = _touching(type(self), D, self._supports(D) + other._supports(D))
            raise TimeLimitError("minkowski_sum", time_limit, str(limit), outer) from None

    def pontryagin_difference(self, other: Polyhedron) -> Self:
        """Return P ⊖ Q = {x : x + y in P for every y in Q}: P, tightened by all that Q may do.

        P ⊖ ∅ is the whole space, by that definition.

        References
        ----------
        Kolmanovsky, Gilbert (1998), Theory and computation of disturbance invariant sets for discrete-time linear
        systems, Mathematical Problems in Engineering 4(4), section 2. Assumes nothing about Q but its support.
        """
        other = same_space(self, other)
        n = self.dim
        mine = self._body
        theirs = other._body
        if theirs is None:
            return type(self)(np.zeros((0, n)), np.zeros(0))
        if mine is None:
            return type(self).empty(n)
        reach = other._supports(self.A) if len(self.b) else np.zeros(0)
        upper = np.zeros(0)
        lower = np.zeros(0)
        if len(self.b_eq):
            upper = other._supports(self.A_eq)
            lower = -other._supports(-self.A_eq)
        size = np.abs(self.A_eq) @ (mine.half_widths + theirs.half_widths) + np.abs(upper) * (ROUNDING / FLAT)
        if np.isinf(reach).any() or np.isinf(upper).any() or (upper - lower > FLAT * size).any():
            return type(self).empty(n)
        widths = mine.half_widths + theirs.half_widths
        point = _meeting_point(self.A, self.b - reach, mine, theirs)
        right = self.b - reach
        error = _EPS * (np.abs(self.b) + np.abs(reach)) + ROUNDING * (np.abs(self.A) @ widths)
        values = self.b_eq - (upper + lower) / 2
        error_eq = _EPS * np.abs(self.b_eq) + FLAT * size
        room = right - self.A @ point
        miss = values - self.A_eq @ point
        if (room < -error).any():
            return type(self).empty(n)
        # rows that meet in one point, up to rounding, meet exactly: P ⊖ P is {0}, whose own size says nothing
        return type(self)(self.A, np.where(room <= error, self.A @ point, right),
                          self.A_eq, np.where(np.abs(miss) <= error_eq, self.A_eq @ point, values))

    def affine_map(self, M: Any, c: Any = None, *, time_limit: float | None = None) -> Self:
        """Return {M x + c : x in P}. M may be singular or change the dimension.

        Parameters
        ----------
        M : (k, n) array
            Matrix, k >= 1.
        c : (k,) array, optional
            Translation; zero if left out.
        time_limit : float, optional
            Seconds; none if left out. The cost of a hull is estimated before it is begun.

        Raises
        ------
        TimeLimitError
            If the map would take longer; its `outer` contains the image and touches it along the coordinates.

        Notes
        -----
        Where M is injective on the affine hull the rows are transformed. Elsewhere the image is the hull of the
        mapped vertices, for unbounded sets of the mapped points and rays.
        """
        M = as_matrix(M, "M", columns=self.dim)
        if len(M) == 0:
            raise InputError("M", f"shape {M.shape}", "at least one row")
        c = np.zeros(len(M)) if c is None else as_vector(c, "c", size=len(M))
        deadline = Deadline.after(check_time_limit(time_limit))
        body = self._body
        if body is None:
            return type(self).empty(len(M))
        rows = _mapped_rows(body, M, c)
        if rows is not None:
            return type(self)(*rows)
        try:
            if body.bounded:
                points = self.vertices @ M.T + c
                deadline.check_hull(len(points), min(len(M), body.basis.shape[1]))
                return type(self).from_vertices(_without_cancelled(points, self.vertices, M, c))
            return type(self)(*rows_of(_generators_of(self, deadline).image(M, c), deadline))
        except LimitReached as limit:
            D = np.vstack([np.eye(len(M)), -np.eye(len(M))])
            outer = _touching(type(self), D, self._supports(D @ M) + D @ c)
            raise TimeLimitError("affine_map", time_limit, str(limit), outer) from None

    def preimage(self, M: Any, c: Any = None) -> Self:
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
            raise InputError("M", f"shape {M.shape}", "at least one column")
        c = np.zeros(self.dim) if c is None else as_vector(c, "c", size=self.dim)
        return type(self)(*_pulled_back(self.A, self.b, M, c), *_pulled_back(self.A_eq, self.b_eq, M, c))

    def projection(self, coordinates: Any, *, time_limit: float | None = None) -> Self:
        """Return the projection onto the given coordinates, in the given order: some value of the others exists.

        `time_limit` as in `affine_map`.
        """
        kept = self._coordinates(coordinates)
        return self.affine_map(np.eye(self.dim)[kept], time_limit=time_limit)

    def slice(self, coordinates: Any, values: Any) -> Self:
        """Return the cut where `coordinates` have the given values, as a set of the other coordinates."""
        fixed = self._coordinates(coordinates)
        values = as_vector(values, "values", size=len(fixed))
        free = np.setdiff1d(np.arange(self.dim), fixed)
        if len(free) == 0:
            raise InputError("coordinates", f"all {self.dim} of them", "fewer", "Use contains for a point.")
        M = np.eye(self.dim)[:, free]
        c = np.zeros(self.dim)
        c[fixed] = values
        return self.preimage(M, c)

    def scale(self, factor: float) -> Self:
        """Return {factor·x : x in P}, about the origin. Factor 0 gives {0}, a negative one also reflects."""
        value = as_floats("factor", factor)
        if value.ndim != 0:
            raise InputError("factor", f"shape {value.shape}", "a number", "Use affine_map for a matrix.")
        check_finite(value, "factor")
        n = self.dim
        k = float(value)
        if self.is_empty:
            return type(self).empty(n)
        if k == 0.0:
            return type(self)(A_eq=np.eye(n), b_eq=np.zeros(n))
        sign = np.sign(k)
        return type(self)(sign * self.A, abs(k) * self.b, sign * self.A_eq, abs(k) * self.b_eq)

    def _coordinates(self, coordinates: Any) -> Array:
        """Return distinct indices of coordinates, or raise `InputError`."""
        try:
            index = np.atleast_1d(np.asarray(coordinates))
        except ValueError:  # ragged
            index = np.zeros(0)
        if (index.ndim != 1 or len(index) == 0 or index.dtype.kind not in "iu" or (index < 0).any()
                or (index >= self.dim).any() or len(np.unique(index)) != len(index)):
            raise InputError("coordinates", shown(coordinates), f"distinct integers from 0 to {self.dim - 1}")
        return index


def same_space(P: Polyhedron, Q: AnySet, name: str = "other") -> AnySet:
    """Return Q, or raise `InputError` unless it is a `Polytope` of P's dimension."""
    Q = _checked_set(Q, name)
    if Q.dim != P.dim:
        raise InputError(name, f"a set of dimension {Q.dim}", f"dimension {P.dim}")
    return Q


def _checked_set(Q: AnySet, name: str = "other") -> AnySet:
    """Return Q, or raise `InputError` unless it is a `Polytope`."""
    if not isinstance(Q, Polyhedron):
        raise InputError(name, type(Q).__name__, "a Polytope")
    return Q


def _diagonal(P: Array, Q: Array) -> Array:
    """Return the block diagonal matrix of P and Q."""
    return np.block([[P, np.zeros((len(P), Q.shape[1]))], [np.zeros((len(Q), P.shape[1])), Q]])


def _touching(kind: type[AnySet], D: Array, values: Array) -> AnySet:
    """Return the set of rows D x <= values, of those that are finite."""
    finite = np.isfinite(values)
    return kind(D[finite], values[finite])


def _generators_of(P: Polyhedron, deadline: Deadline) -> Generators:
    """Return points, rays and lines of a set that is not empty."""
    body = P._body
    assert body is not None
    if body.bounded:
        return Generators(P.vertices, np.zeros((0, P.dim)), np.zeros((0, P.dim)))
    found = generators(body.F, body.g, deadline)
    points = body.centre + found.points @ body.basis.T
    terms = np.abs(body.centre) + np.abs(found.points) @ np.abs(body.basis.T)
    points = np.where(np.abs(points) > CANCELLED * terms, points, 0.0)  # a cone has no size that rounding is small to
    return Generators(points, found.rays @ body.basis.T, found.lines @ body.basis.T)


def _mapped_rows(body: Body, M: Array, c: Array) -> tuple[Array, Array, Array, Array] | None:
    """Return the rows of the image of a body under M, None if M is not injective on its hull."""
    G = M @ body.basis
    terms = np.abs(M) @ np.abs(body.basis)
    G = np.where(np.abs(G) > CANCELLED * terms, G, 0.0)
    origin = M @ body.centre + c
    size = np.abs(G).max(axis=1, initial=0.0)
    units = np.where(size > 0, size, np.where(origin != 0, np.abs(origin), 1.0))  # of the image coordinates
    left, s, vt = np.linalg.svd(G / units[:, None], full_matrices=True)
    rank = int((s > FLAT * s.max(initial=0.0)).sum()) if s.any() else 0
    if rank < body.basis.shape[1]:
        return None
    back = vt.T @ (left[:, :rank].T / s[:rank, None]) / units  # image → y
    rows = body.F @ back
    normal = left[:, rank:].T / units
    norms = np.linalg.norm(rows, axis=1)
    norms_eq = np.linalg.norm(normal, axis=1)
    rows = rows / norms[:, None]
    normal = normal / norms_eq[:, None]
    right = body.g / norms + rows @ origin
    terms = body.g / norms + np.abs(rows) @ np.abs(origin)
    right = np.where(np.abs(right) > CANCELLED * terms, right, 0.0)  # a cone has no size that rounding is small to
    return rows, right, normal, normal @ origin


def _without_cancelled(points: Array, V: Array, M: Array, c: Array) -> Array:
    """Return mapped points with coordinates that have cancelled set to zero."""
    terms = np.abs(V) @ np.abs(M).T + np.abs(c)
    return np.where(np.abs(points) > CANCELLED * terms, points, 0.0)


def _pulled_back(A: Array, b: Array, M: Array, c: Array) -> tuple[Array, Array]:
    """Return the rows A (M x + c) <= b on x, with what has cancelled set to zero.

    Where c is a corner, what is left of the right-hand sides may be all that tells the length of the answer.
    """
    rows = A @ M
    right = b - A @ c
    rows = np.where(np.abs(rows) > _EPS * (np.abs(A) @ np.abs(M)), rows, 0.0)
    return rows, np.where(np.abs(right) > CANCELLED * (np.abs(b) + np.abs(A) @ np.abs(c)), right, 0.0)


def _meeting_point(A: Array, right: Array, mine: Body, theirs: Body) -> Array:
    """Return a point of P ⊖ Q as far inside the rows A x <= right as there is, on the hull of P less that of Q."""
    slope = A @ mine.basis
    point = mine.centre - theirs.centre
    norms = np.linalg.norm(slope, axis=1)
    moving = norms > CANCELLED * np.linalg.norm(np.abs(A) @ np.abs(mine.basis), axis=1)
    if not moving.any():
        return point
    room = (right - A @ point)[moving]
    _, y = inscribed_ball(slope[moving] / norms[moving, None], room / norms[moving], cap=1.0)
    return point + mine.basis @ y


_EPS = 32 * np.finfo(float).eps  # of the sum of absolute terms: what a sum may be wrong by
