"""The exploration written once more in NumPy, slow and without tricks, to check the compiled one.

It explores the whole graph of optimal active sets of every dimension (Arnström and Axehill 2024) with linear programs;
it finds the same sets, 10 to 50 times more slowly.
"""

from __future__ import annotations

import time
from typing import Any

import daqp
import numpy as np

from mpc.budgets import INSETS
from mpc.checks import Array
from mpc.explicit.exploration import irredundant_rows
from mpc.explicit.mpqp import partitioned
from mpc.explicit.partition import MPQPStatus, Partition
from mpc.explicit.region_graph import Found
from mpc.explicit.scaled_qp import ScaledQP
from mpc.parametric_qp import ParametricQP
from mpc.tolerances import DEPENDENT_ROW, INSIDE, PRIMAL, TIE

_SEEDS = 8
_BOX = 4.0  # linear programs look for parameters in [-4, 4], which holds the set
_NONE = np.full(1, -1e30)
Members = frozenset[int]
Rows = tuple[Array, Array]


def solve_slowly(
    problem: ParametricQP, theta_set: Any, max_regions: int = 100_000, time_limit: float | None = None
) -> Partition:
    """What `solve_mpqp` answers, by this exploration."""
    return partitioned(explore_all, problem, theta_set, max_regions, time_limit)


def explore_all(qp: ScaledQP, most: int, deadline: float, feasible: Array | None = None) -> Found:
    """Regions of all optimal active sets; where several are optimal together, without rows that the others imply."""
    found, tied = _explore(qp, most, deadline, feasible)
    if not tied or found.status is not MPQPStatus.COMPLETE:
        return found
    kept = irredundant_rows(qp, deadline)
    again = found if len(kept) == len(qp.M) else _explore(qp.rows(kept), most, deadline)[0]
    if time.perf_counter() > deadline or again.status is MPQPStatus.TIME_LIMIT:
        return found._replace(status=MPQPStatus.TIME_LIMIT)
    return found if again.status is MPQPStatus.INFEASIBLE else again


def _explore(qp: ScaledQP, most: int, deadline: float, feasible: Array | None = None) -> tuple[Found, bool]:
    """Explore optimal active sets of every dimension, changing any one constraint at a time.

    Arnström and Axehill (IEEE CDC 2024) show that the graph of optimal active sets is connected when those of lower
    dimension are kept as nodes; no facet, hash of bits or redundancy test is needed, only linear programs.
    The second value says whether several sets are optimal on one region.
    """
    stack = _first(qp, feasible)
    status = MPQPStatus.COMPLETE if stack else MPQPStatus.INFEASIBLE
    seen = set(stack)
    regions = {}
    centres = [np.zeros((0, qp.D.shape[1] - 1))]
    tied = False
    while stack:
        active = stack.pop()
        rows, zero, canonical = _region(qp, active)
        centre, radius = (np.zeros(0), -1.0) if rows is None else _ball(*rows)
        if rows is None or radius < -INSIDE:
            continue
        if radius >= INSIDE:
            tied = tied or zero
            if canonical:
                regions[active] = _facets(*rows)
                centres.append(centre[None])
        for neighbour in _neighbours(qp, active):
            if neighbour not in seen:
                seen.add(neighbour)
                stack.append(neighbour)
        if len(regions) >= most and stack:
            status = MPQPStatus.REGION_LIMIT
            break
        if time.perf_counter() > deadline and stack:
            status = MPQPStatus.TIME_LIMIT
            break
    sizes = np.cumsum([0] + [len(rows) for rows in regions.values()])
    facets = np.vstack([np.zeros((0, qp.D.shape[1])), *regions.values()])
    sets = [tuple(sorted(active)) for active in regions]
    return Found(status, qp, sets, facets, sizes.astype(np.int64), np.vstack(centres)), tied


def _first(qp: ScaledQP, feasible: Array | None) -> list[Members]:
    """Independent active sets at feasible parameters near the centre, near random ones, and at some that are known."""
    n = qp.D.shape[1] - 1
    J, h = qp.joint
    targets = np.vstack([np.zeros(n), np.random.default_rng(0).uniform(-1, 1, size=(_SEEDS, n))])
    found: list[Members] = []
    for target in targets:
        cost = np.concatenate([-target, np.zeros(J.shape[1] - n)])
        for inset in INSETS:
            joint, _, flag, _ = daqp.solve(np.eye(len(cost)), cost, J, h - inset, primal_tol=0.01 * PRIMAL)
            if flag == 1:
                active = _optimal_set(qp, qp.D[:, :n] @ joint[:n] + qp.D[:, n])
                if active is not None and active not in found:
                    found.append(active)
                break
    for t in [] if feasible is None else feasible:
        known = _optimal_set(qp, qp.D @ np.append(t, 1.0))
        if known is not None and known not in found:
            found.append(known)
    return found


def _optimal_set(qp: ScaledQP, bounds: Array) -> Members | None:
    """Active set at one parameter, with independent rows; None where it is infeasible."""
    nz = qp.M.shape[1]
    for shift in (0.0, TIE):
        _, _, flag, info = daqp.solve(np.eye(nz), np.zeros(nz), qp.M, bounds + shift * qp.tie, primal_tol=PRIMAL)
        active = frozenset(np.flatnonzero(info["lam"] > PRIMAL).tolist())
        if flag == 1 and _law(qp, active) is not None:
            return active
    return None


def _law(qp: ScaledQP, active: Members) -> Array | None:
    """Multiplier law [t, 1, δ] of an active set, None when its rows are dependent."""
    act = sorted(active)
    if len(act) > qp.M.shape[1]:
        return None
    gram = qp.M[act] @ qp.M[act].T
    if act and np.linalg.eigvalsh(gram)[0] < DEPENDENT_ROW:
        return None
    right = np.hstack([qp.D[act], qp.tie[act, None]])
    return np.asarray(-np.linalg.solve(gram, right), dtype=np.float64)


def _region(qp: ScaledQP, active: Members) -> tuple[Rows | None, bool, bool]:
    """Half-spaces of the region, whether a row is zero on it, and whether the symbolic perturbation keeps the set."""
    law = _law(qp, active)
    if law is None:
        return None, False, False
    act = sorted(active)
    rest = [i for i in range(len(qp.D)) if i not in active]
    slack = np.hstack([qp.D[rest], qp.tie[rest, None]]) + qp.M[rest] @ qp.M[act].T @ law
    rows = np.vstack([law, slack])
    reach = np.linalg.norm(qp.M[act].T @ law[:, :-1], axis=0).sum()  # size of v(t), also where multipliers are huge
    lever = np.linalg.norm(np.linalg.pinv(qp.M[act]), axis=0) if act else np.zeros(0)
    scale = np.concatenate([lever * reach, np.abs(qp.D[rest]).sum(axis=1) + reach])
    norm = np.linalg.norm(rows[:, :-2], axis=1)
    constant = norm <= PRIMAL * scale
    if (rows[constant, -2] < -10 * PRIMAL * scale[constant]).any():
        return None, False, False
    zero = constant & (rows[:, -2] <= 10 * PRIMAL * scale)
    canonical = bool((rows[zero, -1] > 0).all())
    rows = rows[~constant] / norm[~constant, None]
    region = np.vstack([-rows[:, :-2], qp.TA]), np.concatenate([rows[:, -2], qp.Tb])
    return region, bool(zero.any()), canonical


def _ball(A: Array, b: Array) -> tuple[Array, float]:
    """Centre and radius of a largest ball in the region, of radius 1 at most; negative for an empty one."""
    n = A.shape[1]
    rows = np.ascontiguousarray(np.hstack([A, np.ones((len(A), 1))]))
    upper = np.concatenate([np.full(n, _BOX), [1.0], b])
    lower = np.concatenate([np.full(n, -_BOX), [-8.0], np.repeat(_NONE, len(b))])
    cost = np.zeros(n + 1)
    cost[n] = -1.0
    point, _, flag, _ = daqp.solve(None, cost, rows, upper, lower)
    # the radius is recomputed from the point
    return point[:n], min(float(point[n]), float((b - A @ point[:n]).min())) if flag == 1 else -1.0


def _facets(A: Array, b: Array) -> Array:
    """Rows [A, b] that are facets: relaxing them lets the region grow."""
    kept: list[int] = []
    for i in range(len(A)):
        others = [j for j in (*kept, *range(i + 1, len(A)))]
        upper = np.ascontiguousarray(np.concatenate([np.full(A.shape[1], _BOX), b[others]]))
        lower = np.concatenate([np.full(A.shape[1], -_BOX), np.repeat(_NONE, len(others))])
        point, _, flag, _ = daqp.solve(None, np.ascontiguousarray(-A[i]), np.ascontiguousarray(A[others]), upper, lower)
        if flag != 1 or A[i] @ point > b[i] + PRIMAL:
            kept.append(i)
    return np.hstack([A[kept], b[kept, None]])


def _neighbours(qp: ScaledQP, active: Members) -> list[Members]:
    """One constraint more, one less, or one exchanged where the rows would be dependent."""
    found = [active - {j} for j in active]
    act = sorted(active)
    gram = qp.M[act] @ qp.M[act].T
    for i in set(range(len(qp.M))) - active:
        more = active | {i}
        if _law(qp, more) is not None:
            found.append(more)
            continue
        coefficient = np.linalg.solve(gram, qp.M[act] @ qp.M[i]) if act else np.zeros(0)
        found.extend(more - {act[a]} for a in np.flatnonzero(coefficient > PRIMAL))
    return found
