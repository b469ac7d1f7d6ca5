"""The compiled exploration, run in portions between which limits are checked and memory grows."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np

from mpc.checks import Array
from mpc.explicit.kernels.data import DONE, FULL, KNOWN, LOST, QUEUED, ROWS, Facets, Graph, QPData
from mpc.explicit.openings import OnlineQP, points_beyond
from mpc.explicit.partition import Ints, MPQPStatus
from mpc.explicit.redundant_rows import irredundant_rows
from mpc.explicit.scaled_qp import ScaledQP
from mpc.tolerances import INSIDE

Masks = np.ndarray[Any, np.dtype[np.uint64]]
Bits = np.ndarray[Any, np.dtype[np.uint8]]

_SEEDS = 8  # parameters from which the exploration starts
_ROUNDS = 10  # how often new ones are drawn while none leads to a region
_CAPACITY = 1024  # active sets for which there is room at first
_FACETS = 16  # facets a region for which there is room at first
_LOOK = 0.05  # wall time between two looks at the clock [s]
_MANY = 300  # regions from which on it pays to leave out rows that the others imply
_SHARE = 0.25  # share of the time left that may be spent on that
_LOST = 64  # feasible parameters without a region that are noted
_ACROSS = 64  # open facets that are looked across in a small law,
_MOST_ACROSS = 500  # and in a large one
_LIMITED = (MPQPStatus.REGION_LIMIT, MPQPStatus.TIME_LIMIT)


class Limits(NamedTuple):
    """When to stop: number of regions, and `time.perf_counter()` [s]."""

    max_regions: int
    deadline: float


class Found(NamedTuple):
    """Outcome of an exploration: facets [a, b] of region r in rows[offsets[r] : offsets[r + 1]], scaled.

    qp : the problem explored, perhaps without rows that the others imply; active sets are numbers of its rows.
    centres : a point in each region; uncovered : facets beyond which a feasible parameter lies in no region.
    """

    status: MPQPStatus
    qp: ScaledQP
    active_sets: list[tuple[int, ...]]
    rows: Array
    offsets: Ints
    centres: Array
    uncovered: int = 0


def explore_compiled(qp: ScaledQP, limits: Limits) -> Found:
    """Regions of all optimal active sets, from facet to facet; at a limit those found so far."""
    first = _Search(qp)
    first.begin()
    search = first
    status = None if first.queued else MPQPStatus.INFEASIBLE
    while status is None:
        search.advance(limits.max_regions)
        if search.queued > search.done >= limits.max_regions:
            status = MPQPStatus.REGION_LIMIT
        elif time.perf_counter() > limits.deadline:
            status = MPQPStatus.TIME_LIMIT
        elif search.should_be_thinned:
            search = search.thinned_out(limits.deadline)
        elif search.done == search.queued and not search.looks_across(limits.deadline) and not search.looks_again():
            status = MPQPStatus.INACCURATE if search.has_lost_parameters() else MPQPStatus.COMPLETE
    most = max(first, search, key=lambda s: s.done) if status in _LIMITED else search
    return most.found(status)


class _Search:
    """The graph of active sets of one problem as far as it is explored."""

    def __init__(self, qp: ScaledQP) -> None:
        self.rng = np.random.default_rng(0)
        self.thinned = False
        self.thinned_for_speed = False
        self.portion = 64
        self.beyond: list[tuple[int, Array]] = []
        self._state(qp)
        self.graph, self.facets = _room(len(qp.M), self.parameters)

    def _state(self, qp: ScaledQP) -> None:
        """Take a problem."""
        self.qp = qp
        self.parameters = qp.D.shape[1] - 1
        self.data = QPData(qp.M, qp.D, qp.tie, qp.gram, qp.TA, qp.Tb)
        self.online: OnlineQP | None = None

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

    def looks_across(self, deadline: float) -> bool:
        """Solve the QP beyond facets that led nowhere; True when that leads to regions, or the deadline is past.

        Of very many facets some are drawn: a hole of any size has many.
        """
        still = np.flatnonzero(self.facets.open[: self.graph.counts[ROWS]])
        most = min(_ACROSS + self.done // 8, _MOST_ACROSS)
        if len(still) > most:
            still = np.sort(self.rng.choice(still, most, replace=False))
        offsets = self.facets.offsets[: self.done + 1]
        for facet, r in zip(still, np.searchsorted(offsets, still, side="right") - 1):
            if self.queued > self.done or time.perf_counter() > deadline:
                return True
            self.facets.open[facet] = False
            self._look_beyond(int(facet), slice(offsets[r], offsets[r + 1]))
        return self.queued > self.done

    def _look_beyond(self, facet: int, own: slice) -> None:
        """Queue the active sets beyond one facet of a region, which owns these rows; note points that stay without."""
        self.online = self.online or OnlineQP(self.qp)
        for point in points_beyond(self.facets.rows[own], facet - own.start, self.qp):
            opening = self.online.at(point)
            if not opening.candidates or self._covers(point):
                continue
            for act in opening.candidates:
                self._consider(act)
            if opening.feasible:
                self.beyond.append((facet, point))

    def _consider(self, act: tuple[int, ...]) -> None:
        """Queue an active set if it has a region and was not met before."""
        from mpc.explicit.kernels.exploration import consider

        while self.graph.counts[KNOWN] + 1 >= len(self.graph.masks):
            self._grow_sets()
        members = np.zeros((1, len(self.qp.M)), dtype=np.uint8)
        members[0, list(act)] = 1
        consider(self.data, self.graph, _masks(members, self.graph.masks.shape[1])[0])

    def _covers(self, point: Array) -> bool:
        """Whether a point lies in a region that is done."""
        rows = self.facets.rows[: self.graph.counts[ROWS]]
        excess = rows[:, :-1] @ point - rows[:, -1]
        return bool(np.maximum.reduceat(excess, self.facets.offsets[: self.done]).min() <= INSIDE)

    def looks_again(self) -> bool:
        """Solve the QP at random parameters, and queue regions that no facet has led to; True when there are any."""
        from mpc.explicit.kernels.exploration import look_at

        count = min(4 + self.done // 8, 2000)
        while self.graph.counts[KNOWN] + 8 * count >= len(self.graph.masks):
            self._grow_sets()
        self._seed(count)
        look_at(self.data, self.graph, self.rng.uniform(-1, 1, size=(count, self.parameters)))
        return self.queued > self.done

    def has_lost_parameters(self) -> bool:
        """Whether a feasible parameter that led to no region lies in none: a random one, or one beyond a facet."""
        return self.uncovered > 0 or any(not self._covers(t) for t in self.graph.lost[: self.graph.counts[LOST]])

    @property
    def uncovered(self) -> int:
        """Number of facets beyond which a feasible parameter lies in no region."""
        return len({facet for facet, point in self.beyond if not self._covers(point)})

    def _seed(self, count: int) -> int:
        """Queue the active sets at random parameters; the number of these that were feasible."""
        from mpc.explicit.kernels.exploration import seed

        return int(seed(self.data, self.graph, *self.qp.joint, self.rng.uniform(-1, 1, size=(count, self.parameters))))

    def advance(self, most: int) -> None:
        """Find the facets of some more regions, and their neighbours, until it is time to look at the clock."""
        from mpc.explicit.kernels.exploration import GROW, explore

        before = self.done
        start = time.perf_counter()
        # not where the clock says: the regions keep their order
        stop = min(most, _MANY) if before < _MANY and not self.thinned else most
        if explore(self.data, self.graph, self.facets, min(self.portion, stop - before)) == GROW:
            self._grow()
        taken = max(time.perf_counter() - start, 1e-6)
        self.portion = max(1, int(_LOOK * (self.done - before + 1) / taken))

    @property
    def should_be_thinned(self) -> bool:
        """Whether rows that others imply are in the way: they cost time, or several active sets are optimal at once."""
        pays = self.done >= _MANY and not self.thinned_for_speed
        return not self.thinned and (pays or (self.done == self.queued and self.tied))

    def thinned_out(self, deadline: float) -> _Search:
        """The search to go on with, without rows that the others imply: a new one where such a row is active.

        For speed alone a share of the time left is spent on it: what is found by then is left out.
        """
        now = time.perf_counter()
        needed = self.done == self.queued and self.tied
        kept, finished = irredundant_rows(self.qp, deadline if needed else now + _SHARE * (deadline - now))
        self.thinned = finished or needed
        self.thinned_for_speed = True
        if len(kept) == len(self.qp.M):
            return self
        bits = _bits(self.graph.masks[self.graph.queue[: self.queued]], len(self.qp.M))
        if np.delete(bits, kept, axis=1).any():
            return self._started_again(kept)
        self._renumber(bits[:, kept], kept)
        return self

    def _started_again(self, kept: Ints) -> _Search:
        """A search with these rows only; this one where that finds no region."""
        other = _Search(self.qp.rows(kept))
        other.thinned = self.thinned
        other.thinned_for_speed = True
        other.begin()
        return other if other.queued else self

    def _renumber(self, members: Bits, kept: Ints) -> None:
        """Keep these rows and the regions found, whose active sets become `members`; forget the sets without region."""
        count = len(members)
        old = self.graph
        room = _room(members.shape[1], self.parameters, len(old.masks))[0]
        self._state(self.qp.rows(kept))
        room.masks[:count] = _masks(members, room.masks.shape[1])
        room.kinds[:count] = FULL
        room.queue[:count] = np.arange(count)
        room.counts[:] = old.counts
        room.counts[KNOWN] = count
        room.lost[:] = old.lost
        room.tied[:] = old.tied[kept]
        self.graph = room
        self._rehash()

    def _grow(self) -> None:
        """Twice the room for facets if that is scarce, else for active sets."""
        facets = self.facets
        if self.graph.counts[ROWS] + len(self.qp.M) + len(self.qp.Tb) > len(facets.rows):
            self.facets = facets._replace(rows=_longer(facets.rows), open=_longer(facets.open))
        else:
            self._grow_sets()

    def _grow_sets(self) -> None:
        """Twice the room for active sets."""
        graph = self.graph
        facets = self.facets
        self.facets = facets._replace(offsets=_longer(facets.offsets), centres=_longer(facets.centres))
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
        offsets = self.facets.offsets[: self.done + 1].copy()
        return Found(status, self.qp, sets, rows, offsets, self.facets.centres[: self.done].copy(), self.uncovered)


def _room(m: int, n: int, capacity: int = _CAPACITY) -> tuple[Graph, Facets]:
    """An empty graph of active sets among m rows, and facets in n parameters."""
    graph = Graph(
        masks=np.zeros((capacity, max(1, (m + 63) // 64)), dtype=np.uint64), kinds=np.zeros(capacity, dtype=np.int8),
        table=np.full(4 * capacity, -1, dtype=np.int64), queue=np.zeros(capacity, dtype=np.int64),
        counts=np.zeros(5, dtype=np.int64), lost=np.zeros((_LOST, n)), tied=np.zeros(m, dtype=bool),
    )  # fmt: skip
    rows = np.empty((_FACETS * capacity, n + 1))
    is_open = np.zeros(len(rows), dtype=bool)
    return graph, Facets(np.zeros(capacity + 1, dtype=np.int64), rows, np.empty((capacity, n)), is_open)


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
