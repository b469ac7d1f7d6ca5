"""Linear programs on {F z <= g} in natural units, by HiGHS."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog
from set_cases import Array, Case, Rows


def largest(c: Array, F: Array, g: Array) -> float:
    """Return max cᵀz over F z <= g by HiGHS: −inf if empty, +inf if unbounded; either is confirmed by zero cost."""
    for method in ("highs-ds", "highs-ipm"):
        answer = linprog(
            -c,
            A_ub=F,
            b_ub=g,
            bounds=(None, None),
            method=method,
            options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
        )
        if answer.status == 0:
            return float(-answer.fun)
    feasible = linprog(0 * c, A_ub=F, b_ub=g, bounds=(None, None), method="highs-ds").status == 0
    return np.inf if feasible else -np.inf


def lifted(case: Case, steps: int, target: Rows | None) -> Rows:
    """Return rows on (x₀, u₀, …) that keep x in X and u in U for `steps` steps, and x in the target at the end."""
    n, m = case.B.shape
    width = n + steps * m
    state = np.hstack([np.eye(n), np.zeros((n, steps * m))])
    rows, right = [], []
    for k in range(steps):
        rows.append(case.X[0] @ state)
        right.append(case.X[1])
        pick = np.zeros((m, width))
        pick[:, n + k * m : n + (k + 1) * m] = np.eye(m)
        rows.append(case.U[0] @ pick)
        right.append(case.U[1])
        state = case.A @ state + case.B @ pick
    for F, g in [case.X] if target is None else [target]:
        rows.append(F @ state)
        right.append(g)
    return np.vstack(rows), np.concatenate(right)


def along(rows: Rows, start: Array, direction: Array) -> float:
    """Return the largest t with (start + t direction, ·) in the rows, −inf if there is none."""
    F, g = rows
    n = len(start)
    moving = np.column_stack([F[:, :n] @ direction, F[:, n:]])
    scale = np.maximum(np.abs(moving).max(axis=1), 1e-300)
    used = np.abs(moving).max(axis=1) > 1e-14
    if ((g - F[:, :n] @ start)[~used] < -1e-9).any():
        return -np.inf
    cost = np.zeros(moving.shape[1])
    cost[0] = 1.0
    return largest(cost, moving[used] / scale[used, None], (g - F[:, :n] @ start)[used] / scale[used])


def exit_of(rows: Rows, start: Array, direction: Array) -> float:
    """Return the largest t with start + t direction in {F x <= g}."""
    slope, room = rows[0] @ direction, rows[1] - rows[0] @ start
    return float((room[slope > 1e-14] / slope[slope > 1e-14]).min(initial=np.inf))


def inner_point(rows: Rows, n: int) -> tuple[Array, float] | None:
    """Return a point well inside the rows (the first n coordinates) and the radius there, None if empty."""
    F, g = rows
    norms = np.linalg.norm(F, axis=1)
    used = norms > 1e-14
    F, g = F[used] / norms[used, None], g[used] / norms[used]
    k = F.shape[1]
    cost = np.zeros(k + 1)
    cost[k] = -1.0
    answer = linprog(
        cost,
        A_ub=np.hstack([F, np.ones((len(F), 1))]),
        b_ub=g,
        bounds=[(None, None)] * k + [(None, 1.0)],
        method="highs-ds",
    )
    return None if answer.status != 0 or answer.x[k] < -1e-9 else (answer.x[:n], float(answer.x[k]))


def ranges(rows: Rows) -> Array:
    """Return the width of {F x <= g} along each of its rows, 1 where it has none."""
    F, g = rows
    width = np.array([largest(f, F, g) + largest(-f, F, g) for f in F])
    return np.where(np.isfinite(width) & (width > 1e-12), width, 1.0)
