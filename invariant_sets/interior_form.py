"""`Body`: a set as {centre + basis y : F y <= g}, full-dimensional and well scaled in y; found from any rows.

What is large, small or zero is judged by the set's own extents, which a `Window` finds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from invariant_sets.equalities import AffineHull, eliminated, opposite_rows, starting_scale
from invariant_sets.linear_programs import inscribed_ball, maximise_rows
from invariant_sets.tolerances import CANCELLED, FLAT, NULL_SPACE, ROUNDING, THIN
from invariant_sets.windows import UNLIKE, Window, half_widths, hidden_equalities, look

Array = np.ndarray


@dataclass(frozen=True)
class Body:
    """{centre + basis y : F y <= g}: full-dimensional in y, 0 in its interior, extents of order one.

    Attributes
    ----------
    centre : (n,) array
        An interior point relative to the affine hull.
    basis : (n, k) array
        Columns span the affine hull; they carry the scale. Diagonal if k = n.
    F, g : (m, k) and (m,) arrays
        Rows of unit norm, g > 0. Rows that can never touch a bounded set are left out.
    bounded : bool
        Whether the set is bounded.
    free : (k,) int array
        The coordinate of x that column j of the basis moves and no other column does.
    half_widths : (n,) array
        Half the widths of the bounding box; 0 where it is flat, a length of the rows where it has no end.
    terms : (n,) array
        Size of the terms that each coordinate of the centre was computed from, in the units of x: the set's place is
        known to `PLACE` of it. Where slanted rows meet it is larger than the coordinate.
    """

    centre: Array
    basis: Array
    F: Array
    g: Array
    bounded: bool
    free: Array
    half_widths: Array
    terms: Array

    @property
    def inverse(self) -> Array:
        """The matrix (k, n) that takes x − centre to y."""
        inverse = np.zeros(self.basis.shape[::-1])
        columns = np.arange(len(self.free))
        inverse[columns, self.free] = 1 / self.basis[self.free, columns]
        return inverse

    @property
    def normals(self) -> Array:
        """Rows (n − k, n) that span the orthogonal complement of the hull, one for each coordinate that is not free."""
        n = len(self.centre)
        rows = np.eye(n) - self.basis @ self.inverse
        return rows[np.setdiff1d(np.arange(n), self.free)]


def body_of(A: Array, b: Array, A_eq: Array, b_eq: Array) -> Body | None:
    """Return the `Body` of {A x <= b, A_eq x = b_eq}, or None if the set is empty."""
    used = A.any(axis=1)
    used_eq = A_eq.any(axis=1)
    if (b[~used] < 0).any() or b_eq[~used_eq].any():
        return None
    A = A[used]
    b = b[used]
    E = A_eq[used_eq]
    e = b_eq[used_eq]
    if not len(e) and len(b) and (np.count_nonzero(A, axis=1) == 1).all():
        return _box(A, b)
    chosen, needless = opposite_rows(A, b)
    if len(chosen):
        E = np.vstack([E, A[chosen]])
        e = np.append(e, b[chosen])
        A = A[~needless]
        b = b[~needless]
    scale, far = starting_scale(A, b, E, e)
    if far.any():
        near = body_of(A[~far], b[~far], E, e)
        if near is not None and (support(near, A[far]) <= b[far]).all():
            return near
    return _solved(A, b, E, e, scale)


def _solved(A: Array, b: Array, E: Array, e: Array, scale: Array) -> Body | None:
    """Return the `Body`, None if the set is empty.

    Equality rows are eliminated first. Those that hide in the inequalities are added as they show, and all is done
    again in units that suit the set.
    """
    n = A.shape[1]
    centre = np.zeros(n)
    hidden = 0
    rescaled = 0
    while True:  # every pass adds an equality, of which there are n at most, or rescales, three times at most
        hull = eliminated(E, e, centre, scale)
        if hull is None:
            return None
        window = look(A, b, hull.centre, hull.basis, cancelled=FLAT if hidden else CANCELLED)
        if window is None:
            return None
        widths = half_widths(window)
        within_rounding = window.is_flat and window.pinch.decided_by_rounding  # such a set tells no scale
        endless = window.basis[:, window.unbounded].any(axis=1)  # what is seen of it is the window's own width
        measured = np.where((widths > 0.0) & ~endless & (not within_rounding), widths, scale)
        if not window.is_flat and len(e) and rescaled < 3 and np.abs(np.log10(measured / scale)).max() > UNLIKE:
            centre = window.centre
            scale = measured
            rescaled += 1
        elif window.basis.shape[1] == 0 or not window.is_flat or hidden > n:
            return _body(window, hull, widths)
        else:
            rows = hidden_equalities(window)
            centre = window.centre + window.basis @ window.ball.centre
            E = np.vstack([E, A[rows]])
            e = np.append(e, b[rows] if within_rounding else A[rows] @ centre)
            scale = measured
            hidden += 1
            rescaled = 0


def support(body: Body, D: Array) -> Array:
    """Return the (k,) maxima of the rows of D (k, n) over the body, +inf where there is none."""
    local = D @ body.basis
    cancelled = np.abs(local) <= CANCELLED * (np.abs(D) @ np.abs(body.basis))
    local = np.where(cancelled, 0.0, local) if body.basis.shape[1] < body.basis.shape[0] else local
    size = np.abs(local).max(axis=1, initial=0.0)
    moving = size > 0
    spread = np.zeros(len(D))
    spread[moving] = size[moving] * maximise_rows(local[moving] / size[moving, None], body.F, body.g)
    values = D @ body.centre + spread
    return np.where(np.abs(values) > CANCELLED * (np.abs(D) @ np.abs(body.centre)), values, 0.0)


def _box(A: Array, b: Array) -> Body | None:
    """Return the `Body` of rows that hold one coordinate each, None if empty."""
    n = A.shape[1]
    column = np.abs(A).argmax(axis=1)
    slope = A[np.arange(len(b)), column]
    bound = b / slope
    upper = np.full(n, np.inf)
    lower = np.full(n, -np.inf)
    np.minimum.at(upper, column[slope > 0], bound[slope > 0])
    np.maximum.at(lower, column[slope < 0], bound[slope < 0])
    size = np.maximum(np.where(np.isfinite(lower), np.abs(lower), 0), np.where(np.isfinite(upper), np.abs(upper), 0))
    if (lower - upper > ROUNDING * size).any():
        return None
    solid = upper - lower > ROUNDING * size
    unit = np.where(size > 0, size, 1.0)
    low = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper - 2 * unit, -unit))
    high = np.where(np.isfinite(upper), upper, low + 2 * unit)
    centre = low / 2 + high / 2
    half = high / 2 - low / 2
    sides = np.vstack([np.eye(n)[:, solid], -np.eye(n)[:, solid]])
    ends = np.concatenate([(upper - centre), (centre - lower)]) / np.tile(np.where(solid, half, 1.0), 2)
    used = np.isfinite(ends) & np.tile(solid, 2)
    return Body(centre, np.diag(half)[:, solid], sides[used], ends[used], bool(used.sum() == 2 * solid.sum()),
                np.flatnonzero(solid), np.where(solid, half, 0.0), np.abs(centre))


def _body(window: Window, hull: AffineHull, widths: Array) -> Body:
    """Return the window as a `Body` about the centre of its ball, without rows that cannot touch the set."""
    y = window.ball.centre
    bounded = not window.unbounded.any()
    touching = np.arange(len(window.g))
    if bounded:
        touching = np.flatnonzero(window.g <= (1 + THIN) * np.abs(window.F).sum(axis=1))
    F = window.F[touching]
    g = window.g[touching]
    centre = window.centre + window.basis @ y
    return Body(centre, window.basis, F, np.maximum(g - F @ y, FLAT), bounded, hull.free, widths,
                np.maximum(np.abs(centre), hull.terms))


def body_of_vertices(A: Array, b: Array, V: Array) -> Body | None:
    """Return the `Body` of {A x <= b} with the vertices V (k, n); None if it is flat or V are not its vertices."""
    lower = V.min(axis=0)
    upper = V.max(axis=0)
    centre = (lower + upper) / 2
    half = (upper - lower) / 2
    if (half <= ROUNDING * np.abs(centre)).any():
        return None
    F = A * half
    g = b - A @ centre
    norms = np.linalg.norm(F, axis=1)
    if not norms.all():
        return None
    F = F / norms[:, None]
    g = g / norms
    radius, y = inscribed_ball(F, g, cap=1.0)
    if radius <= FLAT or (((V - centre) / half @ F.T).max(axis=0) > g + THIN).any():
        return None
    centre = centre + half * y
    return Body(centre, np.diag(half), F, g - F @ y, True, np.arange(len(half)), half, np.abs(centre))


def null_space(rows: Array) -> Array:
    """Return an orthonormal basis (n, k) of {x : rows x = 0}."""
    _, s, vt = np.linalg.svd(rows, full_matrices=True)
    rank = int((s > NULL_SPACE * max(s.max(initial=0.0), np.finfo(float).tiny)).sum())
    return vt[rank:].T


def normals(basis: Array) -> Array:
    """Return orthonormal rows (n − k, n) that are orthogonal to the k columns of a basis."""
    left, _, _ = np.linalg.svd(basis / np.linalg.norm(basis, axis=0), full_matrices=True)
    return left[:, basis.shape[1]:].T


def unit_rows(A: Array, b: Array, *, always: bool = False):
    """Return the rows scaled to unit norm without zero rows; (None, b) if a zero row says 0 <= negative."""
    norms = np.linalg.norm(A, axis=1)
    reference = norms.max(initial=0.0)
    zero = norms <= CANCELLED * reference if reference > 0 else np.ones(len(b), bool)
    if zero.any():
        if not always and (b[zero] < -FLAT * np.maximum(1.0, np.abs(b).max())).any():
            return None, b
        A = A[~zero]
        b = b[~zero]
        norms = norms[~zero]
    return A / norms[:, None], b / norms
