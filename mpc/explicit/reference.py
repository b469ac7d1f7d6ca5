"""The exploration written once more in NumPy, slow and without tricks, to check the compiled one."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import daqp
import numpy as np

from mpc.checks import Array
from mpc.explicit.scaled_qp import LeastDistance

if TYPE_CHECKING:
    from mpc.explicit.mpqp import MPQPStatus

_RADIUS = 1e-7
_INDEPENDENT = 1e-10
Members = frozenset[int]


def explore_all(
    data: LeastDistance, max_regions: int, deadline: float
) -> tuple[MPQPStatus, list[tuple[int, ...]], Array, np.ndarray[Any, np.dtype[np.int64]]]:
    """Explore optimal active sets of every dimension, changing any one constraint at a time.

    Arnström and Axehill (IEEE CDC 2024) show that the graph of optimal active sets is connected when those of lower
    dimension are kept as nodes; no facet, hash of bits or redundancy test is needed, only linear programs.
    """
    from mpc.explicit.mpqp import MPQPStatus

    start = _first(data)
    if start is None:
        return MPQPStatus.INFEASIBLE, [], np.zeros((0, data.D.shape[1])), np.zeros(1, dtype=np.int64)
    seen, stack, regions, status = {start}, [start], {}, MPQPStatus.COMPLETE
    while stack:
        active = stack.pop()
        rows = _region(data, active)
        radius = -1.0 if rows is None else _radius(*rows)
        if rows is None or radius < -_RADIUS:
            continue
        if radius >= _RADIUS:
            regions[active] = _facets(*rows)
        for neighbour in _neighbours(data, active):
            if neighbour not in seen:
                seen.add(neighbour)
                stack.append(neighbour)
        if len(regions) >= max_regions or time.perf_counter() > deadline:
            limit = len(regions) >= max_regions
            status = MPQPStatus.REGION_LIMIT if limit else MPQPStatus.TIME_LIMIT
            break
    sizes = np.cumsum([0] + [len(rows) for rows in regions.values()])
    facets = np.vstack([np.zeros((0, data.D.shape[1])), *regions.values()])
    return status, [tuple(sorted(active)) for active in regions], facets, sizes.astype(np.int64)


def _first(data: LeastDistance) -> Members | None:
    """Active set at the feasible parameter nearest to the centre."""
    n = data.D.shape[1] - 1
    joint, _, flag, _ = daqp.solve(np.eye(data.J.shape[1]), np.zeros(data.J.shape[1]), data.J, data.Jb - 1e-3)
    if flag != 1:
        return None
    b = data.D[:, :n] @ joint[:n] + data.D[:, n]
    nz = data.M.shape[1]
    _, _, flag, info = daqp.solve(np.eye(nz), np.zeros(nz), data.M, b, primal_tol=1e-9)
    return frozenset(np.flatnonzero(info["lam"] > 1e-9).tolist()) if flag == 1 else None


def _law(data: LeastDistance, active: Members) -> Array | None:
    """Multiplier law of an active set, None when its rows are dependent."""
    act = sorted(active)
    if len(act) > data.M.shape[1]:
        return None
    gram = data.M[act] @ data.M[act].T
    if act and np.linalg.eigvalsh(gram)[0] < _INDEPENDENT:
        return None
    return np.asarray(-np.linalg.solve(gram, data.D[act]), dtype=np.float64)


def _region(data: LeastDistance, active: Members) -> tuple[Array, Array] | None:
    law = _law(data, active)
    if law is None:
        return None
    act = sorted(active)
    rest = [i for i in range(len(data.D)) if i not in active]
    slack = data.D[rest] + data.M[rest] @ data.M[act].T @ law
    rows = np.vstack([law, slack])
    norm = np.linalg.norm(rows[:, :-1], axis=1)
    constant = norm <= 1e-10 * np.maximum(np.abs(rows).sum(axis=1), 1.0)
    if (rows[constant, -1] < -1e-9).any() or (np.abs(law[constant[: len(act)], -1]) < 1e-9).any():
        return None
    rows = rows[~constant] / norm[~constant, None]
    return np.vstack([-rows[:, :-1], data.TA]), np.concatenate([rows[:, -1], data.Tb])


def _radius(A: Array, b: Array) -> float:
    """Largest r <= 1 with a ball of radius r in the region; negative for an empty one."""
    n = A.shape[1]
    rows = np.ascontiguousarray(np.hstack([A, np.ones((len(A), 1))]))
    upper = np.concatenate([np.full(n, 4.0), [1.0], b])
    lower = np.concatenate([np.full(n, -4.0), [-8.0], np.full(len(b), -1e30)])
    cost = np.zeros(n + 1)
    cost[n] = -1.0
    point, _, flag, _ = daqp.solve(None, cost, rows, upper, lower)
    # the second look: the margin is measured, not believed
    return min(float(point[n]), float((b - A @ point[:n]).min())) if flag == 1 else -1.0


def _facets(A: Array, b: Array) -> Array:
    """Rows [A, b] that are facets: relaxing them lets the region grow."""
    kept: list[int] = []
    for i in range(len(A)):
        others = [j for j in (*kept, *range(i + 1, len(A)))]
        upper = np.ascontiguousarray(np.concatenate([np.full(A.shape[1], 4.0), b[others]]))
        lower = np.concatenate([np.full(A.shape[1], -4.0), np.full(len(others), -1e30)])
        point, _, flag, _ = daqp.solve(None, np.ascontiguousarray(-A[i]), np.ascontiguousarray(A[others]), upper, lower)
        if flag != 1 or A[i] @ point > b[i] + 1e-9:
            kept.append(i)
    return np.hstack([A[kept], b[kept, None]])


def _neighbours(data: LeastDistance, active: Members) -> list[Members]:
    """One constraint more, one less, or one exchanged where the rows would be dependent."""
    found = [active - {j} for j in active]
    act = sorted(active)
    gram = data.M[act] @ data.M[act].T
    for i in set(range(len(data.M))) - active:
        more = active | {i}
        if _law(data, more) is not None:
            found.append(more)
            continue
        coefficient = np.linalg.solve(gram, data.M[act] @ data.M[i]) if act else np.zeros(0)
        found.extend(more - {act[a]} for a in np.flatnonzero(coefficient > 1e-9))
    return found
