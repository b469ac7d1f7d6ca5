"""The compiled exploration, run in portions between which limits are checked and memory grows."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np

from mpc.checks import Array
from mpc.explicit.equality_elimination import irredundant_rows
from mpc.explicit.kernels.data import DONE, FULL, KNOWN, QUEUED, ROWS, Facets, Graph, QPData
from mpc.explicit.partition import Ints, MPQPStatus
from mpc.explicit.scaled_qp import ScaledQP

Masks = np.ndarray[Any, np.dtype[np.uint64]]
Bits = np.ndarray[Any, np.dtype[np.uint8]]

_SEEDS = 8  # parameters from which the exploration starts
_ROUNDS = 10  # how often new ones are drawn while none leads to a region
_CAPACITY = 1024  # active sets for which there is room at first
_FACETS = 16  # facets a region for which there is room at first
_LOOK = 0.05  # wall time between two looks at the clock [s]
_MANY = 300  # regions from which on it pays to leave out rows that the others imply


class Limits(NamedTuple):
    """When to stop: number of regions, and `time.perf_counter()` [s]."""

    max_regions: int
    deadline: float


class Found(NamedTuple):
    """Outcome of an exploration: facets [a, b] of region r in rows[offsets[r] : offsets[r + 1]], scaled.

    qp : the problem explored, perhaps without rows that the others imply; active sets are numbers of its rows.
    """

    status: MPQPStatus
    qp: ScaledQP
    active_sets: list[tuple[int, ...]]
    rows: Array
    offsets: Ints


def explore_compiled(qp: ScaledQP, limits: Limits) -> Found:
    """Regions of all optimal active sets, from facet to facet."""
    search = _Search(qp)
    search.begin()
    status = MPQPStatus.COMPLETE if search.queued else MPQPStatus.INFEASIBLE
    while search.done < search.queued:
        search.advance(limits.max_regions)
        late = time.perf_counter() > limits.deadline
        if not search.thinned and (search.done == _MANY or (search.done == search.queued and search.tied)):
            search.thin()
        if search.done == search.queued and not late:
            search.look_again()
        if search.done < search.queued and search.done >= limits.max_regions:
            status = MPQPStatus.REGION_LIMIT
            break
        if search.done < search.queued and late:
            status = MPQPStatus.TIME_LIMIT
            break
    return search.found(status)


class _Search:
    """The graph of active sets of one problem as far as it is explored."""

    def __init__(self, qp: ScaledQP) -> None:
        self.rng = np.random.default_rng(0)
        self.thinned = False
        self.portion = 64
        self._state(qp)
        self.graph, self.facets = _room(len(qp.M), self.parameters)

    def _state(self, qp: ScaledQP) -> None:
        """Take a problem."""
        self.qp = qp
        self.parameters = qp.D.shape[1] - 1
        self.data = QPData(qp.M, qp.D, qp.tie, qp.gram, qp.TA, qp.Tb)

    @property
    def done(self) -> int:
        """Number of regions whose facets are known."""
        return int(self.graph.counts[DONE])

    @property
    def queued(self) -> int:
        """Number of regions found."""
        return int(self.graph.counts[QUEUED])

    @property
    def tied(self) -> bool:
        """Whether several active sets are optimal on one region."""
        return bool(self.graph.tied.any())

    def begin(self) -> None:
        """Queue the regions of a few parameters; more only where each of them lies on the border of regions."""
        for _ in range(_ROUNDS):
            if self._seed(_SEEDS) == 0 or self.queued:
                break

    def look_again(self) -> None:
        """Solve the QP at random parameters: a region that no facet has led to is queued."""
        count = min(4 + self.done // 8, 2000)
        if self.graph.counts[KNOWN] + 4 * count < len(self.graph.masks):
            self._seed(count)

    def _seed(self, count: int) -> int:
        """Queue the active sets at random parameters; the number of these that were feasible."""
        from mpc.explicit.kernels.exploration import seed

        return int(seed(self.data, self.graph, *self.qp.joint, self.rng.uniform(-1, 1, size=(count, self.parameters))))

    def advance(self, most: int) -> None:
        """Find the facets of some more regions, and their neighbours, until it is time to look at the clock."""
        from mpc.explicit.kernels.exploration import GROW, explore

        before = self.done
        start = time.perf_counter()
        stop = most if self.thinned else min(most, _MANY)  # not where the clock says: the regions keep their order
        if explore(self.data, self.graph, self.facets, min(self.portion, stop - before)) == GROW:
            self._grow()
        taken = max(time.perf_counter() - start, 1e-6)
        self.portion = max(1, int(_LOOK * (self.done - before + 1) / taken))

    def thin(self) -> None:
        """Leave out the rows that the others imply; start again where one of them is active on a region found."""
        self.thinned = True
        kept = irredundant_rows(self.qp)
        if len(kept) == len(self.qp.M):
            return
        bits = _bits(self.graph.masks[self.graph.queue[: self.queued]], len(self.qp.M))
        used = np.delete(bits, kept, axis=1).any()
        self._state(self.qp.rows(kept))
        if used:
            self.graph, self.facets = _room(len(kept), self.parameters)
            self.begin()
        else:
            self._renumber(bits[:, kept])

    def _renumber(self, members: Bits) -> None:
        """Keep the regions found, whose active sets are now the rows of `members`; forget the sets without a region."""
        count = len(members)
        old = self.graph
        room = _room(members.shape[1], self.parameters, len(old.masks))[0]
        room.masks[:count] = _masks(members, room.masks.shape[1])
        room.kinds[:count] = FULL
        room.queue[:count] = np.arange(count)
        room.counts[:] = old.counts
        room.counts[KNOWN] = count
        self.graph = room
        self._rehash()

    def _grow(self) -> None:
        """Twice the room for facets if that is scarce, else for active sets."""
        graph = self.graph
        facets = self.facets
        if graph.counts[ROWS] + len(self.qp.M) + len(self.qp.Tb) > len(facets.rows):
            self.facets = facets._replace(rows=_longer(facets.rows))
            return
        self.facets = facets._replace(offsets=_longer(facets.offsets))
        longer = {name: _longer(getattr(graph, name)) for name in ("masks", "kinds", "queue")}
        self.graph = graph._replace(**longer, table=np.full(8 * len(graph.masks), -1, dtype=np.int64))
        self._rehash()

    def _rehash(self) -> None:
        """Fill the hash table."""
        from mpc.explicit.kernels.exploration import rehash

        rehash(self.graph.masks, self.graph.table, self.graph.counts[KNOWN])

    def found(self, status: MPQPStatus) -> Found:
        """The regions done."""
        bits = _bits(self.graph.masks[self.graph.queue[: self.done]], len(self.qp.M))
        sets = [tuple(int(i) for i in np.flatnonzero(row)) for row in bits]
        rows = self.facets.rows[: self.graph.counts[ROWS]].copy()
        return Found(status, self.qp, sets, rows, self.facets.offsets[: self.done + 1].copy())


def _room(m: int, n: int, capacity: int = _CAPACITY) -> tuple[Graph, Facets]:
    """An empty graph of active sets among m rows, and facets in n parameters."""
    graph = Graph(
        masks=np.zeros((capacity, max(1, (m + 63) // 64)), dtype=np.uint64), kinds=np.zeros(capacity, dtype=np.int8),
        table=np.full(4 * capacity, -1, dtype=np.int64), queue=np.zeros(capacity, dtype=np.int64),
        counts=np.zeros(4, dtype=np.int64), tied=np.zeros(m, dtype=bool),
    )  # fmt: skip
    return graph, Facets(np.zeros(capacity + 1, dtype=np.int64), np.empty((_FACETS * capacity, n + 1)))


def _longer(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """A copy with room for twice as many entries, which have no value yet."""
    longer = np.empty((2 * len(array), *array.shape[1:]), array.dtype)
    longer[: len(array)] = array
    return longer


def _bits(masks: Masks, m: int) -> Bits:
    """Members of active sets among m rows, (n, m), from bit masks."""
    return np.unpackbits(np.ascontiguousarray(masks).view(np.uint8), axis=1, bitorder="little")[:, :m]


def _masks(bits: Bits, words: int) -> Masks:
    """Bit masks of so many words from members."""
    padded = np.zeros((len(bits), 64 * words), dtype=np.uint8)
    padded[:, : bits.shape[1]] = bits
    return np.packbits(padded, axis=1, bitorder="little").view(np.uint64)
