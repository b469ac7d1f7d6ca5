"""Linear programs at tight tolerances, and proofs of infeasibility."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from scipy.optimize import linprog

from mpc.checks import Array
from mpc.tolerances import LP, LP_OPTIONS

SOLVED, INFEASIBLE, UNBOUNDED = 0, 2, 3  # what `status` says


def solve_exactly(cost: Array, rows: Array, right: Array, limits: Any, deadline: float = np.inf) -> Any:
    """Minimise cost'x subject to rows x <= right, as in `scipy.optimize.linprog`.

    HiGHS accepts 1e-7 by its default, in the rows and in the optimality: more than the room that is asked for here.
    Where it does not end with the least tolerance it may with its own.
    """
    options: dict[str, Any] = dict(LP_OPTIONS)
    if np.isfinite(deadline):
        options["time_limit"] = max(deadline - time.perf_counter(), 0.0)
    program = linprog(cost, A_ub=rows, b_ub=right, bounds=limits, method="highs", options=options)
    left = deadline - time.perf_counter()
    if program.status in (SOLVED, INFEASIBLE, UNBOUNDED) or left <= 0:
        return program
    coarse = {"time_limit": left} if np.isfinite(left) else {}
    return linprog(cost, A_ub=rows, b_ub=right, bounds=limits, method="highs", options=coarse)


def proves_infeasible(y: Array, rows: Array, right: Array, reach: float) -> bool:
    """Whether multipliers prove infeasibility for |x| <= `reach` (Farkas).

    What a solver leaves of y' rows is taken out by least squares where it is in the way.
    """
    if not (y >= 0).all():
        return False
    if y @ right < -reach * np.abs(y @ rows).sum():
        return True
    taken = np.flatnonzero(y > LP * y.max(initial=0.0))
    if not len(taken) or not y @ right < 0:
        return False
    own = y[taken] - np.linalg.lstsq(rows[taken].T, rows[taken].T @ y[taken], rcond=None)[0]
    return bool((own >= 0).all() and own @ right[taken] < -reach * np.abs(own @ rows[taken]).sum())
