"""Small dense linear programs with checked verdicts.

"Unbounded" needs a ray, "infeasible" a Farkas certificate; optima come from `checked_optima`.

References
----------
Boyd, Vandenberghe (2004), Convex Optimization, section 5.8: certificates of infeasibility.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from invariant_sets.checked_optima import checked_optimum, from_daqp, optima_at_once, quick_optimum
from invariant_sets.exceptions import NumericalError
from invariant_sets.tolerances import BOXES, CANCELLED, LP_RESIDUAL, STEEP_RAY, THIN, UNEVEN

Array = np.ndarray


@dataclass(frozen=True)
class Ball:
    """Largest ball in {A x <= b}, with the multipliers that prove it."""

    radius: float  # negative: the least violation that every point must accept
    centre: Array  # (n,)
    dual: Array  # (m,): multipliers of the rows; they sum to one unless the cap or the box holds the radius


def minimise(c: Array, A: Array, b: Array) -> tuple[float, Array | None]:
    """Least cᵀx over A x <= b and a minimiser.

    Parameters
    ----------
    c : (n,) array
        Cost.
    A : (m, n) array
        Rows of Euclidean norm near one.
    b : (m,) array
        Right-hand side, of order one where the row can be active.

    Returns
    -------
    value : float
        +inf if infeasible, −inf if unbounded; either is confirmed by a certificate.
    x : (n,) array or None
        A minimiser, None where there is none.

    Raises
    ------
    NumericalError
        If no answer passes its check.
    """
    c, A, b = (np.ascontiguousarray(array, dtype=np.float64) for array in (c, A, b))
    if not len(b):
        return (0.0, np.zeros(len(c))) if not c.any() else (-np.inf, None)
    columns = np.abs(A).max(axis=0)
    if 0 < columns.min() < UNEVEN:  # solved in variables that matter alike
        size = max(float(np.abs(c / columns).max()), np.finfo(float).tiny)
        rows = A / columns
        norms = np.linalg.norm(rows, axis=1)
        value, x = minimise(c / columns / size, rows / norms[:, None], b / norms)
        return value * size, None if x is None else x / columns
    if c.any():
        optimum = from_daqp(c, A, b)
        if optimum is not None and optimum.residual <= LP_RESIDUAL:
            return optimum.value, optimum.x
    return _verdict(c, A, b)


def least_value(c: Array, A: Array, b: Array) -> float:
    """Value of `minimise`, to `LP_ROUNDING` where DAQP's first answer is."""
    optimum = quick_optimum(c, A, b)
    return minimise(c, A, b)[0] if optimum is None else optimum.value


def maximise_rows(D: Array, A: Array, b: Array) -> Array:
    """Maxima (k,) of rows of D over A x <= b; +inf unbounded, −inf empty."""
    costs, A, b = (np.ascontiguousarray(array, dtype=np.float64) for array in (-D, A, b))
    values = np.zeros(len(costs))
    known = np.zeros(len(costs), bool)
    if len(costs) > 1 and len(b) and np.abs(A).max(axis=0).min() >= UNEVEN:
        values, known = optima_at_once(costs, A, b)
    for i in np.flatnonzero(~known):
        values[i] = minimise(costs[i], A, b)[0]
    return -values


def maximise_in_box(D: Array, A: Array, b: Array, box: float) -> Array:
    """Maxima (k,) of rows of D over nonempty {A x <= b, |x| <= box}."""
    rows, right = _with_box(A, b, box, A.shape[1])
    values, known = optima_at_once(-D, rows, right, coarse=True)
    for i in np.flatnonzero(~known):
        optimum = checked_optimum(-D[i], rows, right)
        if optimum is None:
            raise NumericalError("A linear program", A.shape, "neither DAQP nor HiGHS solves it")
        values[i] = optimum.value
    return -values


def largest_ball(A: Array, b: Array, box: float | None = None) -> Ball:
    """Largest `Ball` of radius 1 at most in A x <= b, unit rows, centre in |x| <= `box`.

    Raises
    ------
    NumericalError
        If no answer passes its check.
    """
    m, n = A.shape
    rows = np.ones((m + 1, n + 1))
    rows[:m, :n] = A
    rows[m, :n] = 0.0
    right = np.ones(m + 1)
    right[:m] = b
    cost = np.zeros(n + 1)
    cost[n] = -1.0
    for half in (None, *BOXES) if box is None else (box,):
        program = (rows, right) if half is None else _with_box(rows, right, half, n)
        optimum = quick_optimum(cost, *program)
        if optimum is None or -optimum.value <= THIN:  # verdicts on flat sets hang on the last digits
            optimum = checked_optimum(cost, *program)
        if optimum is not None:
            return Ball(-optimum.value, optimum.x[:n], optimum.dual[:m])
    raise NumericalError("The largest ball", (m, n), "neither DAQP nor HiGHS finds it")


def ray_along(d: Array, F: Array) -> Array | None:
    """Direction r with F r <= 0, dᵀr > 0, |r| <= 1, or None."""
    optimum = checked_optimum(-d, *_with_box(F, np.zeros(len(F)), 1.0, F.shape[1]))
    if optimum is None or -optimum.value <= STEEP_RAY * np.abs(d).max():
        return None
    for ray in (optimum.x, np.where(np.abs(optimum.x) > CANCELLED * np.abs(optimum.x).max(), optimum.x, 0.0)):
        if (F @ ray <= CANCELLED * (np.abs(F) @ np.abs(ray))).all():
            return ray
    return None


def _verdict(c: Array, A: Array, b: Array) -> tuple[float, Array | None]:
    """Answer of `minimise` for infeasible or unbounded programs, by certificates."""
    ball = largest_ball(A, b)
    if ball.radius < -LP_RESIDUAL:  # its multipliers are the Farkas certificate
        return np.inf, None
    if not c.any():
        return 0.0, ball.centre
    if ray_along(-c, A) is not None:
        return -np.inf, None
    room = b - A @ ball.centre + max(-ball.radius, 0.0)
    for half in BOXES:  # about the inner point, so that every box holds a point
        optimum = checked_optimum(c, *_with_box(A, room / half, 1.0, A.shape[1]))
        if optimum is not None and np.abs(optimum.x).max() < 1.0:
            x = ball.centre + half * optimum.x
            return float(c @ x), x
    return -np.inf, None


def _with_box(A: Array, b: Array, box: float, width: int) -> tuple[Array, Array]:
    """Rows with |xᵢ| <= box added for the first `width` variables."""
    m = len(b)
    each = np.arange(width)
    rows = np.zeros((m + 2 * width, A.shape[1]))
    rows[:m] = A
    rows[m + each, each] = 1.0
    rows[m + width + each, each] = -1.0
    right = np.full(m + 2 * width, box)
    right[:m] = b
    return rows, right
