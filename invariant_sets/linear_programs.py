"""Small dense linear programs with checked verdicts and optima.

"Unbounded" needs a ray, "infeasible" a Farkas certificate. For an optimum a solver only proposes an active set: point
and multipliers are recomputed from it, and it counts once primal feasibility, dual feasibility and complementarity
hold.

DAQP reads raw memory, so every array handed to it is a C-contiguous float64 array.

References
----------
Boyd, Vandenberghe (2004), Convex Optimization, section 5.8: certificates of infeasibility.
Arnström, Bemporad, Axehill (2022), A dual active-set solver for embedded quadratic programming using
recursive LDLᵀ updates, IEEE Trans. Automatic Control 67(8).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import daqp
import numpy as np

from invariant_sets.exceptions import NumericalError
from invariant_sets.rational_programs import exact_optimum
from invariant_sets.tolerances import COARSE, FLAT, LP_SOLVER, MUCH, ROUNDING

Array = np.ndarray
_BOXES = MUCH ** np.arange(1.0, 6.0)  # half widths tried in turn if a program without a ray is unsolved


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
    if 0 < columns.min() < 1 / MUCH:  # solved in variables that matter alike
        size = max(float(np.abs(c / columns).max()), np.finfo(float).tiny)
        rows = A / columns
        norms = np.linalg.norm(rows, axis=1)
        value, x = minimise(c / columns / size, rows / norms[:, None], b / norms)
        return value * size, None if x is None else x / columns
    if c.any():
        optimum = from_daqp(c, A, b)
        if optimum is not None and optimum.residual <= FLAT:
            return optimum.value, optimum.x
    return _verdict(c, A, b)


def least_value(c: Array, A: Array, b: Array) -> float:
    """Value of `minimise`, to `ROUNDING` where DAQP's first answer is."""
    optimum = quick_optimum(c, A, b)
    return minimise(c, A, b)[0] if optimum is None else optimum.value


def maximise_rows(D: Array, A: Array, b: Array) -> Array:
    """Maxima (k,) of rows of D over A x <= b; +inf unbounded, −inf empty."""
    costs, A, b = (np.ascontiguousarray(array, dtype=np.float64) for array in (-D, A, b))
    values = np.zeros(len(costs))
    known = np.zeros(len(costs), bool)
    if len(costs) > 1 and len(b) and np.abs(A).max(axis=0).min() >= 1 / MUCH:
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
    for half in (None, *_BOXES) if box is None else (box,):
        program = (rows, right) if half is None else _with_box(rows, right, half, n)
        optimum = quick_optimum(cost, *program)
        if optimum is None or -optimum.value <= COARSE:  # verdicts on flat sets hang on the last digits
            optimum = checked_optimum(cost, *program)
        if optimum is not None:
            return Ball(-optimum.value, optimum.x[:n], optimum.dual[:m])
    raise NumericalError("The largest ball", (m, n), "neither DAQP nor HiGHS finds it")


def ray_along(d: Array, F: Array) -> Array | None:
    """Direction r with F r <= 0, dᵀr > 0, |r| <= 1, or None."""
    optimum = checked_optimum(-d, *_with_box(F, np.zeros(len(F)), 1.0, F.shape[1]))
    if optimum is None or -optimum.value <= COARSE * np.abs(d).max():
        return None
    for ray in (optimum.x, np.where(np.abs(optimum.x) > ROUNDING * np.abs(optimum.x).max(), optimum.x, 0.0)):
        if (F @ ray <= ROUNDING * (np.abs(F) @ np.abs(ray))).all():  # `contains` allows as much
            return ray
    return None


def _verdict(c: Array, A: Array, b: Array) -> tuple[float, Array | None]:
    """Answer of `minimise` for infeasible or unbounded programs, by certificates."""
    ball = largest_ball(A, b)
    if ball.radius < -FLAT:  # its multipliers are the Farkas certificate
        return np.inf, None
    if not c.any():
        return 0.0, ball.centre
    if ray_along(-c, A) is not None:
        return -np.inf, None
    room = b - A @ ball.centre + max(-ball.radius, 0.0)
    for half in _BOXES:  # about the inner point, so that every box holds a point
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


@dataclass(frozen=True)
class Optimum:
    """Checked minimiser of cᵀx over A x <= b."""

    value: float  # cᵀx
    x: Array  # (n,): minimiser
    dual: Array  # (m,): multipliers, >= 0, with c + Aᵀ dual = 0
    residual: float  # largest violation of the optimality conditions, what rounding of large data explains taken off
    exact: bool = False  # whether it is at most `ROUNDING` without that


def optima_at_once(costs: Array, A: Array, b: Array, *, coarse: bool = False) -> tuple[Array, Array]:
    """Least values (k,) by DAQP, and whether each (k,) is right.

    They are right to `ROUNDING`, recomputed where their active rows meet in a corner; if `coarse`, as found, to `FLAT`.
    """
    X = np.zeros(costs.shape)
    dual = np.zeros((len(costs), len(b)))
    solved = np.zeros(len(costs), bool)
    for i, c in enumerate(costs):
        x, _, flag, info = daqp.solve(None, c, A, b, primal_tol=LP_SOLVER, eta_prox=FLAT)
        if flag == 1:
            X[i] = x
            dual[i] = info["lam"]
            solved[i] = True
    if not coarse:
        _move_to_corners(A, b, X, dual)
    values = (costs * X).sum(axis=1)
    slope = np.abs(costs + dual @ A)
    wrong = np.array(
        [
            (X @ A.T - b).max(axis=1),
            -dual.min(axis=1),
            slope.max(axis=1),
            (slope * np.abs(X)).sum(axis=1),
            np.abs(values + dual @ b),
        ]
    )
    return values, solved & (wrong <= (FLAT if coarse else ROUNDING)).all(axis=0)


def _move_to_corners(A: Array, b: Array, X: Array, dual: Array) -> None:
    """Move points X (k, n) to the corners of their active rows, in place."""
    n = X.shape[1]
    active = dual > 0.0
    corners = np.count_nonzero(active, axis=1) == n
    rows = np.nonzero(active[corners])[1].reshape(-1, n)
    with suppress(np.linalg.LinAlgError):
        X[corners] = np.linalg.solve(A[rows], b[rows][:, :, None])[:, :, 0]


def quick_optimum(c: Array, A: Array, b: Array) -> Optimum | None:
    """Optimum by DAQP if exact as it is, otherwise None."""
    x, _, flag, info = daqp.solve(None, c, A, b, primal_tol=LP_SOLVER, eta_prox=FLAT)
    optimum = _measured(c, A, b, x, info["lam"]) if flag == 1 else None
    return optimum if optimum is not None and optimum.exact else None


def checked_optimum(c: Array, A: Array, b: Array) -> Optimum | None:
    """Checked optimum by DAQP, HiGHS or rational arithmetic, or None."""
    return _best(c, A, b) or _exact(c, A, b)


def _exact(c: Array, A: Array, b: Array) -> Optimum | None:
    """Optimum in rational arithmetic, with rows relaxed by rounding, or None."""
    for rounding in (0.0, ROUNDING, LP_SOLVER):
        answer = exact_optimum(c, A, b + rounding * (np.abs(b) + 1.0))
        if answer is not None:
            return Optimum(*answer, residual=rounding)
    return None


def _best(c: Array, A: Array, b: Array) -> Optimum | None:
    """First proposed optimum within `FLAT`, else best within `COARSE`."""
    coarse = []
    for propose in (from_daqp, _from_highs, partial(_from_highs, method="highs-ipm")):
        optimum = propose(c, A, b)
        if optimum is not None and optimum.residual <= FLAT:
            return optimum
        if optimum is not None and optimum.residual <= COARSE:
            coarse.append(optimum)
    return min(coarse, key=lambda optimum: optimum.residual, default=None)


def from_daqp(c: Array, A: Array, b: Array) -> Optimum | None:
    """Optimum by DAQP, recomputed, or None."""
    x, _, flag, info = daqp.solve(None, c, A, b, primal_tol=LP_SOLVER, eta_prox=FLAT)
    return _recomputed(c, A, b, x, info["lam"]) if flag == 1 else None


def highs(c: Array, A: Array, b: Array, method: str = "highs-ds") -> tuple[Array, Array] | None:
    """Minimiser (n,) and multipliers (m,) by HiGHS at its tightest tolerances, or None."""
    from scipy.optimize import linprog

    answer = linprog(
        c,
        A_ub=A,
        b_ub=b,
        bounds=(None, None),
        method=method,
        options={
            "primal_feasibility_tolerance": LP_SOLVER,
            "dual_feasibility_tolerance": LP_SOLVER,
            "maxiter": 100 * sum(A.shape),
        },
    )  # else interior points may not end
    return (np.asarray(answer.x), -np.asarray(answer.ineqlin.marginals)) if answer.status == 0 else None


def _from_highs(c: Array, A: Array, b: Array, method: str = "highs-ds") -> Optimum | None:
    """Optimum by HiGHS, recomputed, or None."""
    answer = highs(c, A, b, method)
    return None if answer is None else _recomputed(c, A, b, *answer)


def _recomputed(c: Array, A: Array, b: Array, x: Array, dual: Array) -> Optimum:
    """Better of the proposed optimum and that of its active rows."""
    best = None
    for least in (0.0, COARSE * dual.max(initial=0.0)):
        exact = _at_active_rows(c, A, b, x, np.flatnonzero(dual > least))
        if exact is not None and exact.residual <= ROUNDING:
            return exact
        best = exact if best is None or (exact is not None and exact.residual < best.residual) else best
    proposed = _measured(c, A, b, x, dual)
    return proposed if best is None or proposed.residual < best.residual else best


def _at_active_rows(c: Array, A: Array, b: Array, x: Array, active: Array) -> Optimum | None:
    """Point and multipliers of the `active` rows, or None."""
    rows = A[active]
    if len(active) == len(c):
        try:
            exact = np.linalg.solve(rows, b[active])
            multipliers = np.linalg.solve(rows.T, -c)
        except np.linalg.LinAlgError:
            return None
    else:
        exact = x + np.linalg.lstsq(rows, b[active] - rows @ x, rcond=None)[0]
        multipliers = np.linalg.lstsq(rows.T, -c, rcond=None)[0]
    dual = np.zeros(len(b))
    dual[active] = multipliers
    return _measured(c, A, b, exact, dual)


def _measured(c: Array, A: Array, b: Array, x: Array, dual: Array) -> Optimum:
    """Point and multipliers with their largest violation of optimality."""
    value = float(c @ x)
    excess = A @ x - b
    slope = np.abs(c + dual @ A)
    gap = abs(value + float(b @ dual))
    size = np.abs(x)
    skewed = max(-float(dual.min()), float(slope.max()), float(slope @ size))
    worst = max(0.0, float(excess.max()), gap, skewed)
    exact = worst <= ROUNDING
    if not exact:  # not for small data, so allow for the rounding of large ones
        excess -= ROUNDING * (np.abs(A) @ size + np.abs(b))
        gap -= ROUNDING * float(np.abs(c) @ size + np.abs(b) @ np.abs(dual))
        worst = max(0.0, float(excess.max()), gap, skewed)
    return Optimum(value, x, np.maximum(dual, 0.0), worst, exact)
