"""Checked optima of small dense linear programs.

A solver only proposes an active set. Point and multipliers are recomputed from it, and an optimum counts once primal
feasibility, dual feasibility and complementarity hold.

DAQP reads raw memory, so every array handed to it is a C-contiguous float64 array.

References
----------
Arnström, Bemporad, Axehill (2022), A dual active-set solver for embedded quadratic programming using
recursive LDLᵀ updates, IEEE Trans. Automatic Control 67(8).
Lemke (1954), The dual method of solving the linear programming problem; Bland (1977), New finite pivoting rules for
the simplex method: in rational arithmetic. Doubles are rationals, so the data are taken exactly as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

import daqp
import numpy as np

from invariant_sets.tolerances import ACTIVE, LP_COARSE, LP_PROXIMAL, LP_RESIDUAL, LP_ROUNDING, LP_SOLVER, UNEVEN

Array = np.ndarray


@dataclass(frozen=True)
class Optimum:
    """Checked minimiser of cᵀx over A x <= b."""

    value: float  # cᵀx
    x: Array  # (n,): minimiser
    dual: Array  # (m,): multipliers, >= 0, with c + Aᵀ dual = 0
    residual: float  # largest violation of the optimality conditions, what rounding of large data explains taken off
    exact: bool = False  # whether it is at most `LP_ROUNDING` without that


def optima_at_once(costs: Array, A: Array, b: Array, *, coarse: bool = False) -> tuple[Array, Array]:
    """Least values (k,) by DAQP, and whether each (k,) is right.

    They are right to `LP_ROUNDING`, recomputed where their active rows meet in a corner; if `coarse`, as found, to
    `LP_RESIDUAL`.
    """
    X = np.zeros(costs.shape)
    dual = np.zeros((len(costs), len(b)))
    solved = np.zeros(len(costs), bool)
    for i, c in enumerate(costs):
        x, _, flag, info = daqp.solve(None, c, A, b, primal_tol=LP_SOLVER, eta_prox=LP_PROXIMAL)
        if flag == 1:
            X[i] = x
            dual[i] = info["lam"]
            solved[i] = True
    if not coarse:
        _move_to_corners(A, b, X, dual)
    values = (costs * X).sum(axis=1)
    slope = np.abs(costs + dual @ A)
    wrong = np.array([(X @ A.T - b).max(axis=1), -dual.min(axis=1), slope.max(axis=1), (slope * np.abs(X)).sum(axis=1),
                      np.abs(values + dual @ b)])
    return values, solved & (wrong <= (LP_RESIDUAL if coarse else LP_ROUNDING)).all(axis=0)


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
    columns = np.abs(A).max(axis=0)
    if 0 < columns.min() < UNEVEN:
        return None
    x, _, flag, info = daqp.solve(None, c, A, b, primal_tol=LP_SOLVER, eta_prox=LP_PROXIMAL)
    optimum = _measured(c, A, b, x, info["lam"]) if flag == 1 else None
    return optimum if optimum is not None and optimum.exact else None


def checked_optimum(c: Array, A: Array, b: Array) -> Optimum | None:
    """Checked optimum by DAQP, HiGHS or rational arithmetic, or None."""
    columns = np.abs(A).max(axis=0)
    if columns.min() >= UNEVEN or columns.min() == 0:
        return _best(c, A, b) or _exact(c, A, b)
    size = np.abs(c / columns).max()  # solved in variables that matter alike
    optimum = _best(np.ascontiguousarray(c / columns / size), np.ascontiguousarray(A / columns), b)
    if optimum is None:
        return _exact(c, A, b)
    return Optimum(optimum.value * size, optimum.x / columns, optimum.dual * size, optimum.residual)


def _exact(c: Array, A: Array, b: Array) -> Optimum | None:
    """Optimum in rational arithmetic, with rows relaxed by rounding, or None."""
    for rounding in (0.0, LP_ROUNDING, LP_SOLVER):
        answer = exact_optimum(c, A, b + rounding * (np.abs(b) + 1.0))
        if answer is not None:
            return Optimum(*answer, residual=rounding)
    return None


def _best(c: Array, A: Array, b: Array) -> Optimum | None:
    """First proposed optimum within `LP_RESIDUAL`, else best within `LP_COARSE`."""
    coarse = []
    for propose in (from_daqp, _from_highs, partial(_from_highs, method="highs-ipm")):
        optimum = propose(c, A, b)
        if optimum is not None and optimum.residual <= LP_RESIDUAL:
            return optimum
        if optimum is not None and optimum.residual <= LP_COARSE:
            coarse.append(optimum)
    return min(coarse, key=lambda optimum: optimum.residual, default=None)


def from_daqp(c: Array, A: Array, b: Array) -> Optimum | None:
    """Optimum by DAQP, recomputed, or None."""
    x, _, flag, info = daqp.solve(None, c, A, b, primal_tol=LP_SOLVER, eta_prox=LP_PROXIMAL)
    return _recomputed(c, A, b, x, info["lam"]) if flag == 1 else None


def highs(c: Array, A: Array, b: Array, method: str = "highs-ds") -> tuple[Array, Array] | None:
    """Minimiser (n,) and multipliers (m,) by HiGHS at its tightest tolerances, or None."""
    from scipy.optimize import linprog

    answer = linprog(c, A_ub=A, b_ub=b, bounds=(None, None), method=method,
                     options={"primal_feasibility_tolerance": LP_SOLVER, "dual_feasibility_tolerance": LP_SOLVER,
                              "maxiter": 100 * sum(A.shape)})  # else interior points may not end
    return (np.asarray(answer.x), -np.asarray(answer.ineqlin.marginals)) if answer.status == 0 else None


def _from_highs(c: Array, A: Array, b: Array, method: str = "highs-ds") -> Optimum | None:
    """Optimum by HiGHS, recomputed, or None."""
    answer = highs(c, A, b, method)
    return None if answer is None else _recomputed(c, A, b, *answer)


def _recomputed(c: Array, A: Array, b: Array, x: Array, dual: Array) -> Optimum:
    """Better of the proposed optimum and that of its active rows."""
    best = None
    for least in (0.0, ACTIVE * dual.max(initial=0.0)):
        exact = _at_active_rows(c, A, b, x, np.flatnonzero(dual > least))
        if exact is not None and exact.residual <= LP_ROUNDING:
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
    exact = worst <= LP_ROUNDING
    if not exact:  # not for small data, so allow for the rounding of large ones
        excess -= LP_ROUNDING * (np.abs(A) @ size + np.abs(b))
        gap -= LP_ROUNDING * float(np.abs(c) @ size + np.abs(b) @ np.abs(dual))
        worst = max(0.0, float(excess.max()), gap, skewed)
    return Optimum(value, x, np.maximum(dual, 0.0), worst, exact)


def exact_optimum(c: Array, A: Array, b: Array) -> tuple[float, Array, Array] | None:
    """Least value, minimiser (n,) and multipliers (m,) in rational arithmetic, or None.

    None if it is empty, too large, or has no bound on a single variable where the cost asks for one: these bounds are
    the first active rows of the dual simplex method.
    """
    active = _first_bounds(c, A) if A.size <= 20_000 else None
    if active is None:
        return None
    rows = [[Fraction(entry) for entry in row] for row in A.tolist()]
    right = [Fraction(entry) for entry in b.tolist()]
    inverse = [[Fraction(0)] * len(c) for _ in c]  # of the active rows; column k belongs to active[k]
    for j, i in enumerate(active):
        inverse[j][j] = 1 / rows[i][j]
    cost = [Fraction(entry) for entry in c.tolist()]
    for pivot in range(300):
        x = [_dot(line, [right[i] for i in active]) for line in inverse]
        excess = [_dot(row, x) - limit for row, limit in zip(rows, right)]
        violated = [i for i, value in enumerate(excess) if value > 0]
        dual = [-_dot(cost, column) for column in zip(*inverse)]
        if not violated:
            multipliers = np.zeros(len(b))
            multipliers[active] = [float(value) for value in dual]
            return float(_dot(cost, x)), np.array([float(value) for value in x]), multipliers
        entering = max(violated, key=excess.__getitem__) if pivot < 60 else violated[0]  # then Bland's
        weights = [_dot(rows[entering], column) for column in zip(*inverse)]
        ratios = [(dual[k] / weight, active[k], k) for k, weight in enumerate(weights) if weight > 0]
        if not ratios:
            return None
        leaving = min(ratios)[2]
        _exchange(inverse, weights, leaving)
        active[leaving] = entering
    return None


def _first_bounds(c: Array, A: Array) -> list[int] | None:
    """Bound on each single variable, opposing the cost c, or None."""
    single = np.count_nonzero(A, axis=1) == 1
    active = []
    for j, cost in enumerate(c):
        bounds = np.flatnonzero(single & (A[:, j] * cost < 0 if cost else A[:, j] != 0))
        if not len(bounds):
            return None
        active.append(int(bounds[0]))
    return active


def _exchange(inverse: list[list[Fraction]], weights: list[Fraction], leaving: int) -> None:
    """Exchange the active row of column `leaving`, in place."""
    for line in inverse:
        line[leaving] /= weights[leaving]
        for k, weight in enumerate(weights):
            if k != leaving and weight:
                line[k] -= weight * line[leaving]


def _dot(first: Sequence[Fraction], second: Sequence[Fraction]) -> Fraction:
    """Sum of products."""
    return sum((one * other for one, other in zip(first, second) if one and other), Fraction(0))
