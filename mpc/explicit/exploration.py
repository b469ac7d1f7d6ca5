"""Compiled exploration from facet to facet, in portions."""

from __future__ import annotations

import time

import daqp
import numpy as np

from mpc.checks import Array, Ints
from mpc.explicit.holes import Search
from mpc.explicit.partition import MPQPStatus
from mpc.explicit.region_graph import Found
from mpc.explicit.scaled_qp import ScaledQP
from mpc.tolerances import NO_BOUND, PRIMAL


def explore_compiled(qp: ScaledQP, most: int, deadline: float, feasible: Array | None = None) -> Found:
    """Regions of all optimal active sets, or those found by a limit.

    most : regions; deadline : `time.perf_counter()` [s]; feasible : (k, nt) parameters from which to start where random
    ones find nothing.
    """
    now = time.perf_counter()
    # implied rows cost time, and several active sets may be optimal with them
    kept = irredundant_rows(qp, now + 0.25 * (deadline - now))
    for problem in (qp.rows(kept), qp) if len(kept) < len(qp.M) else (qp,):
        search = Search(problem)
        search.begin(feasible, deadline)
        if search.queued:
            break
    status = None
    if not search.queued:
        late = time.perf_counter() > deadline
        status = MPQPStatus.TIME_LIMIT if late else MPQPStatus.INFEASIBLE
        status = MPQPStatus.INACCURATE if search.uncovered else status
    while status is None:
        search.advance(most)
        if search.queued > search.done >= most:
            status = MPQPStatus.REGION_LIMIT
        elif time.perf_counter() > deadline:
            status = MPQPStatus.TIME_LIMIT
        elif search.done == search.queued and not (search.look_across(deadline) or search.look_around(deadline)):
            status = MPQPStatus.INACCURATE if search.uncovered else MPQPStatus.COMPLETE
    return search.found(status)


def irredundant_rows(qp: ScaledQP, deadline: float = np.inf) -> Ints:
    """Irredundant rows of M, without those that only touch.

    A row is kept in doubt, and when it was not looked at before the deadline, `time.perf_counter()` [s].
    """
    J, h = qp.joint
    kept = np.ones(len(J), dtype=bool)
    for i in reversed(range(len(qp.M))):
        if time.perf_counter() > deadline:
            break
        kept[i] = False
        kept[i] = not is_implied(J[i], float(h[i]), J[kept], h[kept])
    return np.flatnonzero(kept[: len(qp.M)])


def is_implied(row: Array, bound: float, J: Array, h: Array) -> bool:
    """Whether multipliers y >= 0 prove row x <= bound for all Jx <= h."""
    # the point that lies farthest across the row, within one unit of it
    normals = np.ascontiguousarray(np.vstack([J, row]))
    bounds = np.append(h, bound + 1.0)
    most = 3 * sum(normals.shape)  # iterations
    point, _, flag, info = daqp.solve(
        None, np.ascontiguousarray(-row), normals, bounds, np.full(len(bounds), -NO_BOUND), iter_limit=most
    )
    if flag != 1 or not row @ point <= bound + PRIMAL:
        return False
    y = np.maximum(info["lam"][:-1], 0.0)
    active = np.flatnonzero(y)
    refined = np.zeros(len(y))  # combines the same rows to `row` best
    refined[active] = np.maximum(np.linalg.lstsq(J[active].T, row, rcond=None)[0], 0.0)
    size = 1.0 + np.abs(point)
    return any(proof @ h + np.abs(row - proof @ J) @ size <= bound + PRIMAL for proof in (y, refined))
