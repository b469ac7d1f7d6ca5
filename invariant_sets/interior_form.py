"""`Body`: a set as {centre + basis y : F y <= g}, full-dimensional and well scaled in y; found from any rows.

The set is looked at through a window, a box in coordinates of its own. What the window shows decides the next one: it
moves closer until the extents of the set are one, and further away while the set reaches its edges. So what is
large, small or zero is judged by the set's own extents, and a row that cannot reach the window has no influence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from invariant_sets.equalities import eliminated, starting_scale
from invariant_sets.linear_programs import Ball, largest_ball, maximise_in_box, minimise, ray_along
from invariant_sets.tolerances import CANCELLED, CLOSED, CLOSER, FLAT, ROUNDING, SETTLED, THIN

Array = np.ndarray
_HALF = 4.0  # half width of the window, in coordinates in which the set should have half widths of one
_FURTHER = 1e3  # factor of one step away
_UNLIKE = 3.0  # decades: a scale that is wrong by more is replaced
_STEPS = 80  # windows at most; one step is a factor of 1e3 or more, and doubles span 1e616


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
    """

    centre: Array
    basis: Array
    F: Array
    g: Array
    bounded: bool


@dataclass(frozen=True)
class _Window:
    """What is seen of {x : A x <= b} in x = centre + basis y, |y| <= `_HALF`.

    Attributes
    ----------
    centre, basis : (n,) and (n, k) arrays
        The coordinates.
    F, g, error : (m, k), (m,) and (m,) arrays
        The rows that depend on y, of unit norm, and by how much g may be wrong from rounding.
    index : (m,) int array
        Their numbers in A.
    near : (q,) int array
        Those of F that can touch the window.
    ball : Ball
        A largest ball in the window; its multipliers belong to the rows in `near`.
    unbounded : (k,) bool array
        Coordinates in which the set is known to have no end.
    """

    centre: Array
    basis: Array
    F: Array
    g: Array
    error: Array
    index: Array
    near: Array
    ball: Ball
    unbounded: Array

    @property
    def multipliers(self) -> Array:
        """Multipliers of the ball for all rows, (m,)."""
        full = np.zeros(len(self.g))
        full[self.near] = self.ball.dual
        return full


def body_of(A: Array, b: Array, A_eq: Array, b_eq: Array) -> Body | None:
    """Return the `Body` of {A x <= b, A_eq x = b_eq}, or None if the set is empty."""
    zero, zero_eq = ~A.any(axis=1), ~A_eq.any(axis=1)
    if (b[zero] < 0).any() or b_eq[zero_eq].any():
        return None
    A, b, E, e = A[~zero], b[~zero], A_eq[~zero_eq], b_eq[~zero_eq]
    if not len(e) and len(b) and (np.count_nonzero(A, axis=1) == 1).all():
        return _box(A, b)
    scale, far = starting_scale(A, b, E, e)
    if far.any():
        near = body_of(A[~far], b[~far], E, e)
        if near is None or (support(near, A[far]) <= b[far]).all():
            return near
    return _solved(A, b, E, e, scale)


def _solved(A: Array, b: Array, E: Array, e: Array, scale: Array) -> Body | None:
    """Return the `Body`, None if the set is empty.

    Equality rows are eliminated first. Those that hide in the inequalities are added as they show, and all is done
    again in units that suit the set.
    """
    n = A.shape[1]
    centre = np.zeros(n)
    hidden, rescaled = 0, 0
    while True:  # every pass adds an equality, of which there are n at most, or rescales, three times at most
        hull = eliminated(E, e, centre, scale)
        window = None if hull is None else _look(A, b, *hull, cancelled=FLAT if hidden else CANCELLED)
        if window is None:
            return None
        measured = _half_widths(window, scale)
        if len(e) and rescaled < 3 and np.abs(np.log10(measured / scale)).max() > _UNLIKE:
            centre, scale, rescaled = window.centre, measured, rescaled + 1
        elif window.basis.shape[1] == 0 or window.ball.radius > FLAT or hidden > n:
            return _body(window)
        else:
            rows = _hidden_equalities(window)
            centre = window.centre + window.basis @ window.ball.centre
            level = b[rows] if _pinched(window)[0] == 0 else A[rows] @ centre  # exact, or halfway through a thin set
            E, e = np.vstack([E, A[rows]]), np.append(e, level)
            scale, hidden, rescaled = measured, hidden + 1, 0


def support(body: Body, D: Array) -> Array:
    """Return the (k,) maxima of the rows of D (k, n) over the body, +inf where there is none."""
    local = D @ body.basis
    cancelled = np.abs(local) <= CANCELLED * (np.abs(D) @ np.abs(body.basis))
    local = np.where(cancelled, 0.0, local) if body.basis.shape[1] < body.basis.shape[0] else local
    size = np.abs(local).max(axis=1, initial=0.0)
    spread = np.zeros(len(D))
    for i in np.flatnonzero(size > 0):
        spread[i] = -size[i] * minimise(-local[i] / size[i], body.F, body.g)[0]
    values = D @ body.centre + spread
    return np.where(np.abs(values) > CANCELLED * (np.abs(D) @ np.abs(body.centre)), values, 0.0)


def _box(A: Array, b: Array) -> Body | None:
    """Return the `Body` of rows that hold one coordinate each, None if empty."""
    n = A.shape[1]
    column = np.abs(A).argmax(axis=1)
    slope = A[np.arange(len(b)), column]
    bound = b / slope
    upper, lower = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(upper, column[slope > 0], bound[slope > 0])
    np.maximum.at(lower, column[slope < 0], bound[slope < 0])
    size = np.maximum(np.where(np.isfinite(lower), np.abs(lower), 0), np.where(np.isfinite(upper), np.abs(upper), 0))
    if (lower - upper > ROUNDING * size).any():
        return None
    solid = upper - lower > ROUNDING * size
    unit = np.where(size > 0, size, 1.0)
    low = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper - 2 * unit, -unit))
    high = np.where(np.isfinite(upper), upper, low + 2 * unit)
    centre, half = low / 2 + high / 2, high / 2 - low / 2
    sides = np.vstack([np.eye(n)[:, solid], -np.eye(n)[:, solid]])
    ends = np.concatenate([(upper - centre), (centre - lower)]) / np.tile(np.where(solid, half, 1.0), 2)
    used = np.isfinite(ends) & np.tile(solid, 2)
    return Body(centre, np.diag(half)[:, solid], sides[used], ends[used], bool(used.sum() == 2 * solid.sum()))


def _look(A: Array, b: Array, centre: Array, basis: Array, *, cancelled: float) -> _Window | None:
    """Return the window in which the extents of the set are one; None if the set is empty.

    The window ends where the set is solid and has the right size, or is flat: then `ball.radius` <= `FLAT`, and no
    closer look would change that.
    """
    k = basis.shape[1]
    unbounded, settled, resized = np.zeros(k, bool), False, 0
    for _ in range(_STEPS):
        window = _window(A, b, centre, basis, unbounded, cancelled)
        if window is None or k == 0:
            return window
        radius = window.ball.radius
        if radius > FLAT and settled:
            return window
        if radius <= FLAT:
            level, residual = _pinched(window)
            if level < 0 and radius < -(FLAT if settled else THIN) and not residual.any():
                return None
            if radius < -THIN:
                basis = basis * np.where(residual, _FURTHER, 1.0)
                continue
            if settled or level == 0:
                return window
        lower, upper = _extents(window)
        beyond = ((lower < -0.99 * _HALF) | (upper > 0.99 * _HALF)) & ~unbounded
        if beyond.any():
            endless = _endless(window, lower, upper) & beyond
            unbounded = unbounded | endless
            if (beyond & ~endless).any():
                basis = basis * np.where(beyond & ~endless, _FURTHER, 1.0)
                continue
        middle, half = _frame(window, lower, upper, unbounded)
        right_size = np.abs(np.log10(half[unbounded])).max(initial=0.0) < _UNLIKE or resized > 3
        resized += 1 if unbounded.any() else 0
        settled = bool((half[~unbounded] >= SETTLED).all()) and right_size
        centre, basis = centre + basis @ middle, basis * half
    return window


def _window(A: Array, b: Array, centre: Array, basis: Array, unbounded: Array, cancelled: float) -> _Window | None:
    """Return what is seen in the coordinates given; None if a row that is parallel to the hull excludes all of it."""
    F, g = A @ basis, b - A @ centre
    error = ROUNDING * (np.abs(b) + np.abs(A) @ np.abs(centre))
    if basis.shape[1] < basis.shape[0]:
        terms = np.abs(A) @ np.abs(basis)
        F = np.where(np.abs(F) > cancelled * terms, F, 0.0)
        parallel = ~F.any(axis=1)
        if (g[parallel] < -error[parallel] - 100 * cancelled * terms[parallel].sum(axis=1)).any():
            return None
    else:
        parallel = np.zeros(len(b), bool)
    index = np.flatnonzero(~parallel)
    size = np.abs(F[index]).max(axis=1, initial=0.0)
    F = F[index] / size[:, None]
    norms = np.linalg.norm(F, axis=1)
    F, g, error = F / norms[:, None], g[index] / size / norms, error[index] / size / norms
    near = np.flatnonzero(g <= _HALF * np.abs(F).sum(axis=1))
    ball = Ball(1.0, np.zeros(F.shape[1]), np.zeros(len(near)))
    if len(near):
        ball = largest_ball(F[near], g[near], 1.0, box=_HALF)
    return _Window(centre, basis, F, g, error, index, near, ball, unbounded)


def _pinched(window: _Window) -> tuple[float, Array]:
    """Return how much room the rows that hold the ball leave, and in which coordinates they do not close.

    With multipliers λ >= 0 and Fᵀλ = 0 every point has λᵀg >= 0: a negative λᵀg proves that the set is empty (Farkas),
    and a zero one that the rows hold with equality. Zero is returned where rounding decides.
    """
    dual = window.multipliers
    level, doubt = float(dual @ window.g), float(dual @ window.error)
    terms = dual @ np.abs(window.F)
    residual = np.abs(dual @ window.F) > CLOSED * terms
    return (0.0 if abs(level) <= doubt else level), residual


def _extents(window: _Window) -> tuple[Array, Array]:
    """Return the lower and upper ends (k,) of what is seen of the set, at most `_HALF`."""
    k = window.F.shape[1]
    F, g = window.F[window.near], window.g[window.near] + 1.01 * max(-window.ball.radius, 0.0)
    ends = maximise_in_box(np.vstack([np.eye(k), -np.eye(k)]), F, g, _HALF)
    return -ends[k:], ends[:k]


def _endless(window: _Window, lower: Array, upper: Array) -> Array:
    """Return the coordinates (k,) in which the set has no end, as a ray of its recession cone proves."""
    k = window.F.shape[1]
    answer = np.zeros(k, bool)
    for j in range(k):
        for end, side in ((upper[j], 1.0), (-lower[j], -1.0)):
            if end > 0.99 * _HALF and not answer[j]:
                answer[j] = ray_along(side * np.eye(k)[j], window.F) is not None
    return answer


def _frame(window: _Window, lower: Array, upper: Array, unbounded: Array) -> tuple[Array, Array]:
    """Return middle and half width (k,) of the next window.

    A coordinate without an end gets the smallest length at which a row feels it as much as the other coordinates.
    """
    middle, half = (lower + upper) / 2, np.maximum((upper - lower) / 2, CLOSER)
    if not unbounded.any():
        return middle, half
    ends = np.where(lower > -0.99 * _HALF, lower, np.where(upper < 0.99 * _HALF, upper, window.ball.centre))
    middle = np.where(unbounded, ends, middle)
    slope = np.abs(window.F)
    felt = slope[:, ~unbounded] @ half[~unbounded] + np.abs(window.g - window.F @ middle)
    felt = np.where(felt > np.maximum(window.error, CLOSER), felt, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        length = np.where(slope > CANCELLED, felt[:, None] / slope, np.inf).min(axis=0, initial=np.inf)
    length = np.where(np.isfinite(length), np.clip(length, CLOSER, 1 / CLOSER), 1.0)
    return middle, np.where(unbounded, length, half)


def _half_widths(window: _Window, scale: Array) -> Array:
    """Return half the width of the set in every coordinate of x, (n,); `scale` in those in which it has none."""
    basis, k = window.basis, window.basis.shape[1]
    reach = np.abs(basis).sum(axis=1)
    if k < len(basis) and k > 0 and len(window.near):
        mixed = np.count_nonzero(basis, axis=1) > 1
        D = basis[mixed] / reach[mixed, None]
        g = window.g[window.near] + 1.01 * max(-window.ball.radius, 0.0)
        ends = maximise_in_box(np.vstack([D, -D]), window.F[window.near], g, _HALF)
        reach[mixed] *= np.maximum((ends[:len(D)] + ends[len(D):]) / 2, FLAT)
    return np.where(reach > ROUNDING * np.abs(window.centre), reach, scale)


def _hidden_equalities(window: _Window) -> Array:
    """Return the numbers in A of independent rows that hold with equality on the whole of a flat set.

    The slack of a row of multiplier λᵢ is at most radius / λᵢ: with the largest ones it is a few times `FLAT`.
    """
    dual = window.multipliers
    order = np.argsort(-dual)
    kept: list[int] = []
    directions = np.zeros((0, window.F.shape[1]))
    for i in order[dual[order] > 0.05 * dual.max()]:
        rest = window.F[i] - directions.T @ (directions @ window.F[i])
        size = np.linalg.norm(rest)
        if size > 0.01:
            directions = np.vstack([directions, rest / size])
            kept.append(int(i))
    return window.index[kept]


def _body(window: _Window) -> Body:
    """Return the window as a `Body` about the centre of its ball, without rows that cannot touch the set."""
    y, bounded = window.ball.centre, not window.unbounded.any()
    touching = np.arange(len(window.g))
    if bounded:
        touching = np.flatnonzero(window.g <= (1 + THIN) * np.abs(window.F).sum(axis=1))
    F, g = window.F[touching], window.g[touching]
    return Body(window.centre + window.basis @ y, window.basis, F, np.maximum(g - F @ y, FLAT), bounded)


def null_space(rows: Array) -> Array:
    """Return an orthonormal basis (n, k) of {x : rows x = 0}."""
    _, s, vt = np.linalg.svd(rows, full_matrices=True)
    rank = int((s > 1e-8 * max(s.max(initial=0.0), 1e-300)).sum())
    return vt[rank:].T


def normals(basis: Array) -> Array:
    """Return orthonormal rows (n − k, n) that are orthogonal to the k columns of a basis."""
    left, _, _ = np.linalg.svd(basis / np.linalg.norm(basis, axis=0), full_matrices=True)
    return left[:, basis.shape[1]:].T


def unit_rows(A: Array, b: Array, *, always: bool = False):
    """Return the rows scaled to unit norm without zero rows; (None, b) if a zero row says 0 <= negative."""
    norms = np.linalg.norm(A, axis=1)
    reference = norms.max(initial=0.0)
    zero = norms <= 1e-13 * reference if reference > 0 else np.ones(len(b), bool)
    if zero.any():
        if not always and (b[zero] < -FLAT * np.maximum(1.0, np.abs(b).max())).any():
            return None, b
        A, b, norms = A[~zero], b[~zero], norms[~zero]
    return A / norms[:, None], b / norms
