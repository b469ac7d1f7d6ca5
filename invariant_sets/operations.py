"""Operations that make a new set out of one or two.

No operator is overloaded: P.minkowski_sum(Q) and P.pontryagin_difference(Q) are not inverse to each other, which
P + Q and P − Q would suggest. (P ⊖ Q) ⊕ Q ⊆ P ⊆ (P ⊕ Q) ⊖ Q, with equality on the right for convex sets.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import numpy as np

from invariant_sets.bodies import Body, Stated
from invariant_sets.budgets import CHEAP_HULL_DIM
from invariant_sets.exceptions import InputError, TimeLimitError
from invariant_sets.generators import Generators, generators, rows_of
from invariant_sets.hulls import irredundant_rows
from invariant_sets.interior_form import body_of, settled, support, tightened
from invariant_sets.polyhedron import AnySet, Polyhedron, hull_of, nonempty_body, set_of
from invariant_sets.time_limits import Deadline, LimitReached
from invariant_sets.tolerances import FLAT, PLACE, ROUNDING
from invariant_sets.validation import as_coordinates, as_matrix, as_number, as_vector

Array = np.ndarray


class SetOperations(Polyhedron):
    """Set operations for `Polytope`; every one returns a new set."""

    def minimal(self) -> Self:
        """Same set without redundant rows, weakly redundant ones and duplicates.

        Equalities hidden in the inequalities become rows of A_eq. The empty set becomes 0·x <= −1.
        """
        body = self.body
        if body is None:
            return type(self).empty(self.dim)
        kept = irredundant_rows(body.F, body.g) if len(body.g) else np.zeros(0, int)
        body = replace(body, F=body.F[kept], g=body.g[kept], sizes=body.sizes[kept])
        return set_of(type(self), body.rows, self.given_vertices, body)

    def intersection(self, other: Polyhedron) -> Self:
        """Intersection P ∩ Q of sets of the same dimension."""
        other = same_space(self, other)
        return set_of(type(self), Stated(*map(np.concatenate, zip(self.stated, other.stated))))

    def cartesian_product(self, other: Polyhedron) -> Self:
        """Product P × Q = {(x, y) : x in P, y in Q}."""
        from scipy.linalg import block_diag

        other = _checked_set(other)
        pairs = zip(self.stated, other.stated)
        return set_of(type(self), Stated(*(np.append(P, Q) if P.ndim == 1 else block_diag(P, Q) for P, Q in pairs)))

    def minkowski_sum(self, other: Polyhedron, *, time_limit: float | None = None) -> Self:
        """Minkowski sum P ⊕ Q = {x + y : x in P, y in Q}.

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
        deadline = Deadline.after(time_limit)
        mine = self.body
        theirs = other.body
        if mine is None or theirs is None:
            return type(self).empty(self.dim)
        if self.affine_dim == 0:
            return _moved(type(self), other, mine)
        if other.affine_dim == 0:
            return _moved(type(self), self, theirs)
        D = np.vstack([self.A, other.A, np.eye(self.dim), -np.eye(self.dim)])
        try:
            if mine.bounded and theirs.bounded:
                anchor, Y = self.offsets
                further, Z = other.offsets
                deadline.check_hull(len(Y) * len(Z), max(self.affine_dim, other.affine_dim))
                sums = (Y[:, None] + Z).reshape(-1, self.dim)
                return hull_of(type(self), anchor + further, sums, mine.terms + theirs.terms)
            both = _generators_of(self, deadline).plus(_generators_of(other, deadline))
            return type(self)(*rows_of(both, deadline))
        except LimitReached as limit:
            outer = _touching(type(self), D, self.support(D) + other.support(D))
            raise TimeLimitError("minkowski_sum", time_limit, str(limit), outer) from None

    def pontryagin_difference(self, other: Polyhedron) -> Self:
        """Difference P ⊖ Q = {x : x + y in P for all y in Q}.

        P ⊖ ∅ is the whole space, by that definition.

        References
        ----------
        Kolmanovsky, Gilbert (1998), Theory and computation of disturbance invariant sets for discrete-time linear
        systems, Mathematical Problems in Engineering 4(4), section 2. Assumes nothing about Q but its support.
        """
        other = same_space(self, other)
        n = self.dim
        mine = self.body
        theirs = other.body
        if theirs is None:
            return type(self)(np.zeros((0, n)), np.zeros(0))
        if mine is None:
            return type(self).empty(n)
        V = None
        if other.has_vertices:
            anchor, Y = other.offsets
            V = Y + (anchor - theirs.centre)
        left = tightened(mine, theirs, V)
        if V is not None and not (left and left.holds_part_of(mine)):  # what has hardly any room needs all digits
            left = tightened(mine, theirs)
        if left is None:
            return type(self).empty(n)
        solid = left.holds_part_of(mine)
        if mine.bounded:
            if solid:
                return set_of(type(self), left.rows, body=left, settled=False)
            found = settled(left)
        else:  # no length that Q could be small to: by the rows as they are stated
            A, b, E, e, terms, sizes = self.stated
            size = theirs.terms + theirs.half_widths
            rows = Stated(
                A, b - support(theirs, A), E, e - support(theirs, E), terms + np.abs(A) @ size, sizes + np.abs(E) @ size
            )
            if solid:
                return set_of(type(self), rows)
            found = body_of(rows)
        return type(self).empty(n) if found is None else set_of(type(self), found.rows, body=found)

    def affine_map(self, M: Any, c: Any = None, *, time_limit: float | None = None) -> Self:
        """Image {M x + c : x in P}, M of any rank and size.

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
        deadline = Deadline.after(time_limit)
        body = self.body
        if body is None:
            return type(self).empty(len(M))
        flat = body.bounded and self.affine_dim < self.dim and self.affine_dim <= CHEAP_HULL_DIM
        rows = None if flat else _mapped_rows(body, M, c)
        if rows is not None:
            return set_of(type(self), rows)
        try:
            if body.bounded:
                anchor, Y = self.offsets
                deadline.check_hull(len(Y), min(len(M), body.basis.shape[1]))
                terms = np.abs(Y) @ np.abs(M).T
                moves = Y @ M.T
                moves = np.where(np.abs(moves) > ROUNDING * terms, moves, 0.0)
                return hull_of(type(self), M @ anchor + c, moves, np.abs(M) @ body.terms + np.abs(c))
            return type(self)(*rows_of(_generators_of(self, deadline).image(M, c), deadline))
        except LimitReached as limit:
            D = np.vstack([np.eye(len(M)), -np.eye(len(M))])
            outer = _touching(type(self), D, self.support(D @ M) + D @ c)
            raise TimeLimitError("affine_map", time_limit, str(limit), outer) from None

    def preimage(self, M: Any, c: Any = None) -> Self:
        """Preimage {x : M x + c in P}, unbounded for singular M.

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
        A, b, E, e, terms, sizes = self.stated
        A, b, terms = _pulled_back(A, b, terms, M, c)
        E, e, sizes = _pulled_back(E, e, sizes, M, c)
        return set_of(type(self), Stated(A, b, E, e, terms, sizes))

    def projection(self, coordinates: Any, *, time_limit: float | None = None) -> Self:
        """Projection onto the given coordinates, in the given order.

        `time_limit` as in `affine_map`.
        """
        kept = as_coordinates(coordinates, self.dim)
        return self.affine_map(np.eye(self.dim)[kept], time_limit=time_limit)

    def slice(self, coordinates: Any, values: Any) -> Self:
        """Cut at values of `coordinates`, as a set of the others."""
        fixed = as_coordinates(coordinates, self.dim)
        values = as_vector(values, "values", size=len(fixed))
        free = np.setdiff1d(np.arange(self.dim), fixed)
        if len(free) == 0:
            raise InputError("coordinates", f"all {self.dim} of them", "fewer", "Use contains for a point.")
        M = np.eye(self.dim)[:, free]
        c = np.zeros(self.dim)
        c[fixed] = values
        return self.preimage(M, c)

    def scale(self, factor: float) -> Self:
        """Set {factor·x : x in P}; factor 0 gives {0}."""
        k = as_number("factor", factor, expected="a finite number; affine_map takes a matrix")
        n = self.dim
        if self.is_empty:
            return type(self).empty(n)
        if k == 0.0:
            return type(self)(A_eq=np.eye(n), b_eq=np.zeros(n))
        sign = np.sign(k)
        return set_of(type(self), Stated(*(abs(k) * part if part.ndim == 1 else sign * part for part in self.stated)))


def same_space(P: Polyhedron, Q: AnySet, name: str = "other") -> AnySet:
    """Q, or raise `InputError` unless a `Polytope` of P's dimension."""
    Q = _checked_set(Q, name)
    if Q.dim != P.dim:
        raise InputError(name, f"a set of dimension {Q.dim}", f"dimension {P.dim}")
    return Q


def _checked_set(Q: AnySet, name: str = "other") -> AnySet:
    """Q, or raise `InputError` unless it is a `Polytope`."""
    if not isinstance(Q, Polyhedron):
        raise InputError(name, type(Q).__name__, "a Polytope")
    return Q


def _moved(kind: type[AnySet], P: Polyhedron, point: Body) -> AnySet:
    """Nonempty P moved by a point."""
    A, b, A_eq, b_eq, terms, terms_eq = P.stated
    c = point.centre
    rows = Stated(
        A, b + A @ c, A_eq, b_eq + A_eq @ c, terms + np.abs(A) @ point.terms, terms_eq + np.abs(A_eq) @ point.terms
    )
    body = nonempty_body(P, "minkowski_sum")
    body = replace(body, centre=body.centre + c, terms=body.terms + point.terms)
    return set_of(kind, rows, None if P.given_vertices is None else P.given_vertices + c, body)


def _touching(kind: type[AnySet], D: Array, values: Array) -> AnySet:
    """Set of the rows D x <= values with finite values."""
    finite = np.isfinite(values)
    return kind(D[finite], values[finite])


def _generators_of(P: Polyhedron, deadline: Deadline) -> Generators:
    """Points, rays and lines of a nonempty set."""
    body = nonempty_body(P, "generators")
    if body.bounded:
        return Generators(P.vertices, np.zeros((0, P.dim)), np.zeros((0, P.dim)))
    found = generators(body.F, body.g, deadline)
    points = body.centre + found.points @ body.basis.T
    terms = np.abs(body.centre) + np.abs(found.points) @ np.abs(body.basis.T)
    points = np.where(np.abs(points) > ROUNDING * terms, points, 0.0)  # a cone has no size that rounding is small to
    return Generators(points, found.rays @ body.basis.T, found.lines @ body.basis.T)


def _mapped_rows(body: Body, M: Array, c: Array) -> Stated | None:
    """Rows of a body's image under M; None if not injective."""
    G = M @ body.basis
    terms = np.abs(M) @ np.abs(body.basis)
    G = np.where(np.abs(G) > ROUNDING * terms, G, 0.0)
    origin = M @ body.centre + c
    sizes = np.abs(M) @ body.terms + np.abs(c)
    G = np.where(np.abs(G).max(axis=1, keepdims=True, initial=0.0) > PLACE * sizes[:, None], G, 0.0)
    size = np.abs(G).max(axis=1, initial=0.0)
    units = np.where(size > 0, size, np.where(origin != 0, np.abs(origin), 1.0))  # of the image coordinates
    left, s, vt = np.linalg.svd(G / units[:, None], full_matrices=True)
    rank = int((s > FLAT * s.max(initial=0.0)).sum()) if s.any() else 0
    if rank < body.basis.shape[1]:
        return None
    back = vt.T @ (left[:, :rank].T / s[:rank, None]) / units  # image → y
    rows = body.F @ back
    rows = np.where(np.abs(rows) * units > ROUNDING * np.abs(rows * units).max(axis=1, keepdims=True), rows, 0.0)
    normal = np.where(np.abs(left[:, rank:].T) > ROUNDING, left[:, rank:].T, 0.0) / units
    return Stated(
        rows, body.g + rows @ origin, normal, normal @ origin, body.g + np.abs(rows) @ sizes, np.abs(normal) @ sizes
    ).unit


def _pulled_back(A: Array, b: Array, terms: Array, M: Array, c: Array) -> tuple[Array, Array, Array]:
    """Rows A (M x + c) <= b on x, with sizes of their terms."""
    rows = A @ M
    rows = np.where(np.abs(rows) > PLACE * (np.abs(A) @ np.abs(M)), rows, 0.0)
    return rows, b - A @ c, terms + np.abs(A) @ np.abs(c)
