"""Known active sets and regions, in growing arrays for the kernels."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mpc.checks import Array, Flags, Ints
from mpc.explicit.kernels import active_sets, exploration, places
from mpc.explicit.kernels.data import DONE, KNOWN, QUEUED, ROWS, Facets, Graph, QPData
from mpc.explicit.partition import MPQPStatus
from mpc.explicit.scaled_qp import ScaledQP
from mpc.tolerances import INSIDE


class Found(NamedTuple):
    """Scaled facets [a, b] of region r: rows[offsets[r] : offsets[r + 1]].

    qp : the problem explored, perhaps without rows that the others imply; active sets are numbers of its rows.
    centres : a point in each region; uncovered : feasible parameters met that lie in no region.
    """

    status: MPQPStatus
    qp: ScaledQP
    active_sets: list[tuple[int, ...]]
    rows: Array
    offsets: Ints
    centres: Array
    uncovered: int = 0


class RegionGraph:
    """Graph of the optimal active sets known so far."""

    def __init__(self, qp: ScaledQP) -> None:
        self.qp = qp
        self.parameters = qp.D.shape[1] - 1
        self.data = QPData(qp.M, qp.D, qp.tie, qp.gram, qp.TA, qp.Tb)
        self.graph, self.facets = _room(len(qp.M), self.parameters)

    @property
    def done(self) -> int:
        """Number of regions whose facets are known."""
        return int(self.graph.counts[DONE])

    @property
    def queued(self) -> int:
        """Number of regions found."""
        return int(self.graph.counts[QUEUED])

    def explore(self, regions: int) -> None:
        """Find facets and neighbours of at most so many more regions."""
        if not exploration.explore(self.data, self.graph, self.facets, regions):
            return
        # the scarcer room is doubled: that for facets or for active sets
        facets = self.facets
        if self.graph.counts[ROWS] + len(self.qp.M) + len(self.qp.Tb) > len(facets.rows):
            longer = {name: _longer(getattr(facets, name)) for name in ("rows", "hits", "behind")}
            self.facets = facets._replace(**longer)
        else:
            self._grow_sets()

    def consider(self, act: tuple[int, ...]) -> None:
        """Queue an active set that has a region and is new."""
        self.make_room(1)
        mask = np.zeros(self.graph.masks.shape[1], dtype=np.uint64)
        active_sets.to_mask(np.array(act, dtype=np.int64), len(act), mask)
        active_sets.consider(self.data, self.graph, mask)

    def seed(self, targets: Array) -> Array:
        """Queue active sets near `targets`; return their feasible parameters."""
        self.make_room(4 * len(targets))
        found = np.empty_like(targets)
        return found[: int(places.seed(self.data, self.graph, *self.qp.joint, targets, found))]

    def look_at(self, points: Array) -> Flags:
        """Queue active sets at points; return which are feasible parameters."""
        self.make_room(4 * len(points))
        return np.asarray(places.look_at(self.data, self.graph, points))

    def covered(self, points: Array, distance: float = INSIDE) -> Flags:
        """Whether points lie in a done region, or near one."""
        return np.asarray(places.covered(self.facets, self.graph.counts, points, distance))

    def make_room(self, sets: int) -> None:
        """Make room for so many more active sets."""
        while self.graph.counts[KNOWN] + sets >= len(self.graph.masks):
            self._grow_sets()

    def _grow_sets(self) -> None:
        """Double the room for active sets."""
        graph = self.graph
        facets = self.facets
        self.facets = facets._replace(offsets=_longer(facets.offsets), centres=_longer(facets.centres))
        longer = {name: _longer(getattr(graph, name)) for name in ("masks", "kinds", "queue")}
        self.graph = graph._replace(**longer, table=np.full(8 * len(graph.masks), -1, dtype=np.int64))
        active_sets.rehash(self.graph.masks, self.graph.table, self.graph.counts[KNOWN])


def _room(m: int, n: int, capacity: int = 1024) -> tuple[Graph, Facets]:
    """Empty graph for m rows, and facets in n parameters."""
    graph = Graph(
        masks=np.zeros((capacity, max(1, (m + 63) // 64)), dtype=np.uint64), kinds=np.zeros(capacity, dtype=np.int8),
        table=np.full(4 * capacity, -1, dtype=np.int64), queue=np.zeros(capacity, dtype=np.int64),
        counts=np.zeros(4, dtype=np.int64),
    )  # fmt: skip
    rows = np.empty((16 * capacity, n + 1))
    behind = np.zeros(len(rows), dtype=np.int8)
    hits = np.empty((len(rows), n))
    return graph, Facets(np.zeros(capacity + 1, dtype=np.int64), rows, np.empty((capacity, n)), hits, behind)


def _longer(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Copy with room for twice as many entries."""
    longer = np.empty((2 * len(array), *array.shape[1:]), array.dtype)
    longer[: len(array)] = array
    return longer
