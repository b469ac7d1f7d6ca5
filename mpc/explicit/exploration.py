"""The compiled exploration, run in portions between which limits are checked and memory grows."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np

from mpc.checks import Array
from mpc.explicit.partition import Ints, MPQPStatus
from mpc.explicit.scaled_qp import ScaledQP

_SEEDS = 8  # parameters from which the exploration starts
_ROUNDS = 10  # how often new ones are drawn while none leads to a region
_CAPACITY = 1024  # active sets for which there is room at first
_FACETS = 16  # facets a region for which there is room at first
_LOOK = 0.05  # wall time between two looks at the clock [s]


class Limits(NamedTuple):
    """When to stop: number of regions, and `time.perf_counter()` [s]."""

    max_regions: int
    deadline: float


class Found(NamedTuple):
    """Outcome of an exploration: facets [a, b] of region r in rows[offsets[r] : offsets[r + 1]], scaled.

    tied : whether several active sets are optimal on one region.
    """

    status: MPQPStatus
    active_sets: list[tuple[int, ...]]
    rows: Array
    offsets: Ints
    tied: bool


def explore_compiled(qp: ScaledQP, limits: Limits) -> Found:
    """Regions of all optimal active sets, from facet to facet."""
    from mpc.explicit.kernels.data import DONE, KNOWN, QUEUED, ROWS, QPData
    from mpc.explicit.kernels.exploration import GROW, explore, rehash, seed

    m = len(qp.M)
    n = qp.D.shape[1] - 1
    data = QPData(qp.M, qp.D, qp.tie, qp.gram, qp.TA, qp.Tb)
    graph, facets = _room(m, n)
    counts = graph.counts
    rng = np.random.default_rng(0)
    for _ in range(_ROUNDS):  # more only where every parameter found lies on the border of regions
        hits = seed(data, graph, *qp.joint, rng.uniform(-1, 1, size=(_SEEDS, n)))
        if counts[QUEUED] or not hits:
            break
    status = MPQPStatus.COMPLETE if counts[QUEUED] else MPQPStatus.INFEASIBLE
    portion = 64
    while counts[DONE] < counts[QUEUED]:
        before = int(counts[DONE])
        start = time.perf_counter()
        code = explore(data, graph, facets, min(portion, limits.max_regions - before))
        if code == GROW:
            graph, facets = _grown(graph, facets)
            rehash(graph.masks, graph.table, counts[KNOWN])
        now = time.perf_counter()
        portion = max(1, int(_LOOK * (counts[DONE] - before + 1) / max(now - start, 1e-6)))
        if counts[DONE] == counts[QUEUED] and now < limits.deadline:  # a second look at random parameters
            targets = rng.uniform(-1, 1, size=(min(4 + int(counts[DONE]) // 8, 2000), n))
            if counts[KNOWN] + 4 * len(targets) < len(graph.masks):
                seed(data, graph, *qp.joint, targets)
        if counts[DONE] < counts[QUEUED] and counts[DONE] >= limits.max_regions:
            status = MPQPStatus.REGION_LIMIT
            break
        if counts[DONE] < counts[QUEUED] and now > limits.deadline:
            status = MPQPStatus.TIME_LIMIT
            break
    done = int(counts[DONE])
    sets = _members(graph.masks[graph.queue[:done]], m)
    rows = facets.rows[: counts[ROWS]].copy()
    return Found(status, sets, rows, facets.offsets[: done + 1].copy(), bool(graph.tied.any()))


def _room(m: int, n: int) -> tuple[Any, Any]:
    """An empty graph of active sets among m rows, and facets in n parameters."""
    from mpc.explicit.kernels.data import Facets, Graph

    graph = Graph(
        masks=np.zeros((_CAPACITY, max(1, (m + 63) // 64)), dtype=np.uint64), kinds=np.zeros(_CAPACITY, dtype=np.int8),
        table=np.full(4 * _CAPACITY, -1, dtype=np.int64), queue=np.zeros(_CAPACITY, dtype=np.int64),
        counts=np.zeros(4, dtype=np.int64), tied=np.zeros(m, dtype=bool),
    )  # fmt: skip
    return graph, Facets(np.zeros(_CAPACITY + 1, dtype=np.int64), np.empty((_FACETS * _CAPACITY, n + 1)))


def _grown(graph: Any, facets: Any) -> tuple[Any, Any]:
    """Twice the room; the hash table is empty and has to be filled again."""
    masks, kinds, queue, offsets, rows = (
        np.concatenate([a, np.zeros_like(a)]) for a in (graph.masks, graph.kinds, graph.queue, *facets)
    )
    table = np.full(4 * len(masks), -1, dtype=np.int64)
    grown = graph._replace(masks=masks, kinds=kinds, queue=queue, table=table)
    return grown, facets._replace(offsets=offsets, rows=rows)


def _members(masks: np.ndarray[Any, np.dtype[np.uint64]], m: int) -> list[tuple[int, ...]]:
    """Active sets as tuples, from bit masks."""
    bits = np.unpackbits(np.ascontiguousarray(masks).view(np.uint8), axis=1, bitorder="little")[:, :m]
    return [tuple(int(i) for i in np.flatnonzero(row)) for row in bits]
