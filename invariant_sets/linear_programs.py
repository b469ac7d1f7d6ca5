"""Small dense linear programs: DAQP, then HiGHS, then rationals; every answer and every verdict is checked here.

A solver only proposes an active set. Point and multipliers are recomputed from it, and an optimum counts once primal
feasibility, dual feasibility and complementarity hold. "Unbounded" needs a ray, "infeasible" a Farkas certificate.

DAQP reads raw memory, so every array handed to it is a C-contiguous float64 array.

References
----------
Arnström, Bemporad, Axehill (2022), A dual active-set solver for embedded quadratic programming using
recursive LDLᵀ updates, IEEE Trans. Automatic Control 67(8).
Boyd, Vandenberghe (2004), Convex Optimization, section 5.8: certificates of infeasibility.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import daqp
import numpy as np

from invariant_sets.exact_programs import exact_optimum
from invariant_sets.exceptions import NumericalError
from invariant_sets.tolerances import (
    ACTIVE,
    LP_COARSE,
    LP_PROXIMAL,
    LP_RESIDUAL,
    LP_ROUNDING,
    LP_SOLVER,
    RAY,
    STEEP_RAY,
    THIN,
    UNEVEN,
)

Array = np.ndarray
_BOXES = 10.0 ** np.arange(3, 16, 3)  # half widths tried in turn where a program without a ray has not been solved


@dataclass(frozen=True)
class Optimum:
    """A checked minimiser of cᵀx over A x <= b.

    Attributes
    ----------
    value : float
        cᵀx.
    x : (n,) array
        Minimiser.
    dual : (m,) array
        Multipliers, >= 0, with c + Aᵀ dual = 0.
    residual : float
        Largest violation of the optimality conditions, what rounding of large data explains taken off.
    exact : bool
        Whether it is at most `LP_ROUNDING` without that.
    """

    value: float
    x: Array
    dual: Array
    residual: float
    exact: bool = False


@dataclass(frozen=True)
class Ball:
    """A largest ball in {A x <= b}, with the multipliers that prove that there is no larger one.

    Attributes
    ----------
    radius : float
        Negative: the least violation that every point must accept.
    centre : (n,) array
        Its centre.
    dual : (m,) array
        Multipliers of the rows; they sum to one unless the cap or the box holds the radius.
    """

    radius: float
    centre: Array
    dual: Array


def minimise(c: Array, A: Array, b: Array) -> tuple[float, Array | None]:
    """Return the least cᵀx over A x <= b and a minimiser.

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
        optimum = _from_daqp(c, A, b)
        if optimum is not None and optimum.residual <= LP_RESIDUAL:
            return optimum.value, optimum.x
    return _verdict(c, A, b)


def least_value(c: Array, A: Array, b: Array) -> float:
    """Return the value of `minimise`, right to `LP_ROUNDING` where the first answer of DAQP is."""
    optimum = _quick_optimum(c, A, b)
    return minimise(c, A, b)[0] if optimum is None else optimum.value


def maximise_rows(D: Array, A: Array, b: Array) -> Array:
    """Return the (k,) maxima of the rows of D over A x <= b: +inf unbounded, −inf if empty."""
    costs, A, b = (np.ascontiguousarray(array, dtype=np.float64) for array in (-D, A, b))
    values, known = np.zeros(len(costs)), np.zeros(len(costs), bool)
    if len(costs) > 1 and len(b) and np.abs(A).max(axis=0).min() >= UNEVEN:
        values, known = _at_once(costs, A, b)
    for i in np.flatnonzero(~known):
        values[i] = minimise(costs[i], A, b)[0]
    return -values


def maximise_in_box(D: Array, A: Array, b: Array, box: float) -> Array:
    """Return the (k,) maxima of the rows of D over {A x <= b, |x| <= box}, which must hold a point."""
    rows, right = _with_box(A, b, box, A.shape[1])
    values, known = _at_once(-D, rows, right, coarse=True)
    for i in np.flatnonzero(~known):
        optimum = _optimum(-D[i], rows, right)
        if optimum is None:
            raise NumericalError("A linear program", A.shape, "neither DAQP nor HiGHS solves it")
        values[i] = optimum.value
    return -values


def inscribed_ball(A: Array, b: Array, cap: float) -> tuple[float, Array]:
    """Return radius and centre of a largest ball in A x <= b (rows of unit norm), the radius at most `cap`.

    A negative radius is the least violation that every point must accept: the set is empty.
    """
    ball = largest_ball(A, b, cap)
    return ball.radius, ball.centre


def largest_ball(A: Array, b: Array, cap: float, box: float | None = None) -> Ball:
    """Return a largest `Ball` in A x <= b (rows of unit norm), radius at most `cap`, centre in |x| <= `box`.

    Raises
    ------
    NumericalError
        If no answer passes its check.
    """
    m, n = A.shape
    rows = np.ones((m + 1, n + 1))
    rows[:m, :n] = A
    rows[m, :n] = 0.0
    right = np.append(b, cap)
    cost = np.zeros(n + 1)
    cost[n] = -1.0
    for half in (None, *_BOXES) if box is None else (box,):
        program = (rows, right) if half is None else _with_box(rows, right, half, n)
        optimum = _quick_optimum(cost, *program)
        if optimum is None or -optimum.value <= THIN:  # verdicts on flat sets hang on the last digits
            optimum = _optimum(cost, *program)
        if optimum is not None:
            return Ball(-optimum.value, optimum.x[:n], optimum.dual[:m])
    raise NumericalError("The largest ball", (m, n), "neither DAQP nor HiGHS finds it")


def ray_along(d: Array, F: Array) -> Array | None:
    """Return a direction r with F r <= 0 and dᵀr > 0, |r| <= 1; None if there is none but for rounding."""
    optimum = _optimum(-d, *_with_box(F, np.zeros(len(F)), 1.0, F.shape[1]))
    if optimum is None or -optimum.value <= STEEP_RAY * np.abs(d).max():
        return None
    rise = F @ optimum.x - RAY * (np.abs(F) @ np.abs(optimum.x))
    return optimum.x if (rise <= 0).all() else None


def _verdict(c: Array, A: Array, b: Array) -> tuple[float, Array | None]:
    """Return what `minimise` does where no optimum was found: infeasible and unbounded by their certificates."""
    ball = largest_ball(A, b, 1.0)
    if ball.radius < -LP_RESIDUAL:  # its multipliers are the Farkas certificate
        return np.inf, None
    if not c.any():
        return 0.0, ball.centre
    if ray_along(-c, A) is not None:
        return -np.inf, None
    room = b - A @ ball.centre + max(-ball.radius, 0.0)
    for half in _BOXES:  # about the inner point, so that every box holds a point
        optimum = _optimum(c, *_with_box(A, room / half, 1.0, A.shape[1]))
        if optimum is not None and np.abs(optimum.x).max() < 1.0:
            x = ball.centre + half * optimum.x
            return float(c @ x), x
    return -np.inf, None


def _with_box(A: Array, b: Array, box: float, width: int) -> tuple[Array, Array]:
    """Return the rows with |xᵢ| <= box added for the first `width` variables."""
    eye = np.eye(width, A.shape[1])
    return np.vstack([A, eye, -eye]), np.append(b, np.full(2 * width, box))


def _at_once(costs: Array, A: Array, b: Array, *, coarse: bool = False) -> tuple[Array, Array]:
    """Return the least values (k,) that DAQP finds, and which of them (k,) are right.

    They are recomputed from their active rows and right to `LP_ROUNDING`; if `coarse`, as found, to `LP_RESIDUAL`.
    """
    X, dual, solved = np.zeros(costs.shape), np.zeros((len(costs), len(b))), np.zeros(len(costs), bool)
    for i, c in enumerate(costs):
        x, _, flag, info = daqp.solve(None, c, A, b, primal_tol=LP_SOLVER, eta_prox=LP_PROXIMAL)
        if flag == 1:
            X[i], dual[i], solved[i] = x, info["lam"], True
    if not coarse:
        solved &= _at_corners(A, b, X, dual)
    values = (costs * X).sum(axis=1)
    slope = np.abs(costs + dual @ A)
    wrong = np.array([(X @ A.T - b).max(axis=1), -dual.min(axis=1), slope.max(axis=1), (slope * np.abs(X)).sum(axis=1),
                      np.abs(values + dual @ b)])
    return values, solved & (wrong <= (LP_RESIDUAL if coarse else LP_ROUNDING)).all(axis=0)


def _at_corners(A: Array, b: Array, X: Array, dual: Array) -> Array:
    """Move the points X (k, n) to the corners of their active rows; return which of them (k,) have one."""
    n = X.shape[1]
    active = dual > 0.0
    corners = np.count_nonzero(active, axis=1) == n
    rows = np.nonzero(active[corners])[1].reshape(-1, n)
    try:
        X[corners] = np.linalg.solve(A[rows], b[rows][:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        return np.zeros(len(X), bool)
    return corners


def _quick_optimum(c: Array, A: Array, b: Array) -> Optimum | None:
    """Return the optimum that DAQP finds if it is exact as it is; None if not."""
    columns = np.abs(A).max(axis=0)
    if 0 < columns.min() < UNEVEN:
        return None
    x, _, flag, info = daqp.solve(None, c, A, b, primal_tol=LP_SOLVER, eta_prox=LP_PROXIMAL)
    optimum = _measured(c, A, b, x, info["lam"]) if flag == 1 else None
    return optimum if optimum is not None and optimum.exact else None


def _optimum(c: Array, A: Array, b: Array) -> Optimum | None:
    """Return a checked optimum, proposed by DAQP or else by HiGHS, or an exact one; None if there is none."""
    columns = np.abs(A).max(axis=0)
    if columns.min() >= UNEVEN or columns.min() == 0:
        return _best(c, A, b) or _exact(c, A, b)
    size = np.abs(c / columns).max()  # solved in variables that matter alike
    optimum = _best(np.ascontiguousarray(c / columns / size), np.ascontiguousarray(A / columns), b)
    if optimum is None:
        return _exact(c, A, b)
    return Optimum(optimum.value * size, optimum.x / columns, optimum.dual * size, optimum.residual)


def _exact(c: Array, A: Array, b: Array) -> Optimum | None:
    """Return the optimum in rational arithmetic; rows that miss each other by rounding are allowed to. None if none."""
    for rounding in (0.0, LP_ROUNDING, LP_SOLVER):
        answer = exact_optimum(c, A, b + rounding * (np.abs(b) + 1.0))
        if answer is not None:
            return Optimum(*answer, residual=rounding)
    return None


def _best(c: Array, A: Array, b: Array) -> Optimum | None:
    """Return the first proposed optimum within `LP_RESIDUAL`, or the best one within `LP_COARSE`."""
    coarse = []
    for propose in (_from_daqp, _from_highs, partial(_from_highs, method="highs-ipm")):
        optimum = propose(c, A, b)
        if optimum is not None and optimum.residual <= LP_RESIDUAL:
            return optimum
        if optimum is not None and optimum.residual <= LP_COARSE:
            coarse.append(optimum)
    return min(coarse, key=lambda optimum: optimum.residual, default=None)


def _from_daqp(c: Array, A: Array, b: Array) -> Optimum | None:
    """Return the optimum that DAQP proposes, recomputed; None if it proposes none."""
    x, _, flag, info = daqp.solve(None, c, A, b, primal_tol=LP_SOLVER, eta_prox=LP_PROXIMAL)
    return _recomputed(c, A, b, x, info["lam"]) if flag == 1 else None


def _from_highs(c: Array, A: Array, b: Array, method: str = "highs-ds") -> Optimum | None:
    """Return the optimum that HiGHS proposes, recomputed; None if it proposes none."""
    from scipy.optimize import linprog

    answer = linprog(c, A_ub=A, b_ub=b, bounds=(None, None), method=method,
                     options={"primal_feasibility_tolerance": LP_SOLVER, "dual_feasibility_tolerance": LP_SOLVER})
    if answer.status != 0:
        return None
    return _recomputed(c, A, b, np.asarray(answer.x), -np.asarray(answer.ineqlin.marginals))


def _recomputed(c: Array, A: Array, b: Array, x: Array, dual: Array) -> Optimum:
    """Return the better of the optimum proposed and those in which its active rows hold with equality."""
    best = None
    for least in (0.0, ACTIVE * dual.max(initial=0.0)):
        exact = _at_active_rows(c, A, b, x, np.flatnonzero(dual > least))
        if exact is not None and exact.residual <= LP_ROUNDING:
            return exact
        best = exact if best is None or (exact is not None and exact.residual < best.residual) else best
    proposed = _measured(c, A, b, x, dual)
    return proposed if best is None or proposed.residual < best.residual else best


def _at_active_rows(c: Array, A: Array, b: Array, x: Array, active: Array) -> Optimum | None:
    """Return point and multipliers with which the `active` rows hold with equality, None if they are dependent."""
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
    """Return the point and its multipliers with the largest violation of the optimality conditions."""
    value = float(c @ x)
    excess = A @ x - b
    slope = np.abs(c + dual @ A)
    gap = abs(value + float(b @ dual))
    size = np.abs(x)
    skewed = max(-float(dual.min()), float(slope.max()), float(slope @ size))
    worst = max(0.0, float(excess.max()), gap, skewed)
    exact = worst <= LP_ROUNDING
    if not exact:  # not for small data, so allow for the rounding of large ones
        excess -= LP_ROUNDING * (np.abs(A) @ size + np.abs(b))
        gap -= LP_ROUNDING * float(np.abs(c) @ size + np.abs(b) @ np.abs(dual))
        worst = max(0.0, float(excess.max()), gap, skewed)
    return Optimum(value, x, np.maximum(dual, 0.0), worst, exact)
