"""The compiled exploration, run in portions between which limits are checked and memory grows."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np

from mpc.checks import Array
from mpc.explicit.kernels.data import ASKED, CROSSED, DONE, FULL, KNOWN, OPEN, QUEUED, ROWS, Facets, Graph, QPData
from mpc.explicit.openings import OnlineQP, points_beyond
from mpc.explicit.partition import Ints, MPQPStatus
from mpc.explicit.redundant_rows import irredundant_rows
from mpc.explicit.scaled_qp import ScaledQP
from mpc.tolerances import CROSSING, INSIDE, THIN

Masks = np.ndarray[Any, np.dtype[np.uint64]]
Bits = np.ndarray[Any, np.dtype[np.uint8]]
Bools = np.ndarray[Any, np.dtype[np.bool_]]

_SEEDS = 8  # parameters from which the exploration starts
_ROUNDS = 10  # how often new ones are drawn while none leads to a region
_CAPACITY = 1024  # active sets for which there is room at first
_FACETS = 16  # facets a region for which there is room at first
_LOOK = 0.05  # wall time between two looks at the clock [s]
_MANY = 300  # regions from which on it pays to leave out rows that the others imply
_SHARE = 0.25  # share of the time left that may be spent on that
# what is looked at before a small law is called complete:
_ANYWHERE = 4  # random parameters, and as many near the border,
_BETWEEN = 100  # points between facets,
_BEHIND = 500  # and behind facets that led to a region,
_FARTHEST = 0.01  # at most at this distance, scaled parameters
_PER_REGION = 8  # regions for which, in a large law, there is one more of each,
_MOST = 2000  # but no more than so many
_AT_ONCE = 20_000_000  # pairs of a point and a region between two looks at the clock
_FEW = 16  # points where the QP is solved between two looks at the clock
_ASKED = 64  # points where it is solved once one of them lies in a hole
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
    centres : a point in each region; uncovered : feasible parameters met that lie in no region.
    """

    status: MPQPStatus
    qp: ScaledQP
    active_sets: list[tuple[int, ...]]
    rows: Array
    offsets: Ints
    centres: Array
    uncovered: int = 0


def explore_compiled(qp: ScaledQP, limits: Limits, feasible: Array | None = None) -> Found:
    """Regions of all optimal active sets, from facet to facet; at a limit those found so far.

    feasible : (k, nt) parameters from which to start where random ones find nothing.
    """
    first = _Search(qp, feasible)
    first.begin()
    search = first
    status = None if first.queued else MPQPStatus.INACCURATE if first.uncovered else MPQPStatus.INFEASIBLE
    while status is None:
        search.advance(limits.max_regions)
        if search.queued > search.done >= limits.max_regions:
            status = MPQPStatus.REGION_LIMIT
        elif time.perf_counter() > limits.deadline:
            status = MPQPStatus.TIME_LIMIT
        elif search.should_be_thinned:
            search = search.thinned_out(limits.deadline)
        elif search.done == search.queued and not search.looks_for_holes(limits.deadline):
            status = MPQPStatus.INACCURATE if search.uncovered else MPQPStatus.COMPLETE
    most = max(first, search, key=lambda s: s.done) if status in _LIMITED else search
    return most.found(status)


class _Search:
    """The graph of active sets of one problem as far as it is explored."""

    def __init__(self, qp: ScaledQP, known: Array | None = None) -> None:
        self.known = known  # feasible parameters
        self.rng = np.random.default_rng(0)
        self.thinned = False
        self.thinned_for_speed = False
        self.portion = 64
        self._state(qp)
        self.feasible = np.empty((0, self.parameters))  # parameters that were feasible, with room, and in no region
        self.pending = self.feasible  # those in no region when met, not yet asked about
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
            if len(self._seed(_SEEDS)) == 0 or self.queued:
                break
        if self.known is not None and not self.queued:
            self._ask_at(self.known)

    def looks_for_holes(self, deadline: float) -> bool:
        """Look beyond what is explored; True when that leads to regions, or the deadline is past."""
        return self.looks_across(deadline) or self.looks_again(deadline)

    def looks_across(self, deadline: float) -> bool:
        """Solve the QP beyond facets that led nowhere; True when that leads to regions, or the deadline is past.

        Of very many facets some are drawn: a hole of any size has many.
        """
        still = self._some(np.flatnonzero(self._states == OPEN), min(_ACROSS + self.done // 8, _MOST_ACROSS))
        offsets = self.facets.offsets[: self.done + 1]
        for facet, r in zip(still, np.searchsorted(offsets, still, side="right") - 1):
            if self.queued > self.done or time.perf_counter() > deadline:
                return True
            self.facets.state[facet] = ASKED
            own = slice(offsets[r], offsets[r + 1])
            self._ask_at(points_beyond(self.facets.rows[own], int(facet - own.start), self.qp))
        return self.queued > self.done

    @property
    def _states(self) -> np.ndarray[Any, np.dtype[np.int8]]:
        """What became of the facets."""
        return self.facets.state[: self.graph.counts[ROWS]]

    def _some(self, numbers: Ints, most: int) -> Ints:
        """So many of the numbers, at random and in order, or all of them."""
        return numbers if len(numbers) <= most else np.sort(self.rng.choice(numbers, most, replace=False))

    def _ask_at(self, points: Array) -> None:
        """Solve the QP at points in no region and queue its active sets; note the feasible ones."""
        self.online = self.online or OnlineQP(self.qp)
        for point in points[~self._covered(points)]:
            opening = self.online.at(point)
            for act in opening.candidates:
                self._consider(act)
            if opening.feasible:
                self.feasible = np.vstack([self.feasible, point])

    def _consider(self, act: tuple[int, ...]) -> None:
        """Queue an active set if it has a region and was not met before."""
        from mpc.explicit.kernels.exploration import consider

        self._room_for(1)
        members = np.zeros((1, len(self.qp.M)), dtype=np.uint8)
        members[0, list(act)] = 1
        consider(self.data, self.graph, _masks(members, self.graph.masks.shape[1])[0])

    def _covered(self, points: Array, distance: float = INSIDE) -> Bools:
        """Which points lie in a region that is done, or not farther outside one than a distance."""
        from mpc.explicit.kernels.exploration import covered

        return np.asarray(covered(self.facets, self.graph.counts, points, distance))

    def looks_again(self, deadline: float) -> bool:
        """Look for a hole anywhere, near the border, between facets, and behind those that led to a region.

        Where rounding decides, the region that a facet led to may lie elsewhere. True when that leads to regions, or
        the deadline is past.
        """
        more = min(self.done // _PER_REGION, _MOST)
        between = self._between_facets(_BETWEEN + more)  # feasible, whatever a solver says
        anywhere = self.rng.uniform(-1, 1, size=(_ANYWHERE + more, self.parameters))
        behind = self._behind_facets(_BEHIND + more)
        self._room_for(8 * (_ANYWHERE + more))
        places = np.vstack([between, anywhere, behind, self._seed(_ANYWHERE + more)])
        feasible = np.arange(len(places)) < len(between)
        parts = 1 + len(places) * self.done // _AT_ONCE
        for numbers in np.array_split(np.arange(len(places)), parts):
            if time.perf_counter() > deadline:
                return True
            self._look_at(places[numbers], feasible[numbers])
        self.pending = self.rng.permutation(self.pending[~self._covered(self.pending)])
        return self._asks(deadline)

    def _look_at(self, points: Array, feasible: Bools) -> None:
        """Queue the active sets at points in no region; those that are feasible, or known to be, are pending."""
        from mpc.explicit.kernels.exploration import look_at

        apart = ~self._covered(points)
        self._room_for(8 * int(apart.sum()))
        found = look_at(self.data, self.graph, points[apart])
        self.pending = np.vstack([self.pending, points[apart][found | feasible[apart]]])

    def _asks(self, deadline: float) -> bool:
        """Solve the QP at pending points; True when that leads to regions, or the deadline is past.

        Some are enough once one of them has shown that there is a hole.
        """
        asked = 0
        while self.queued == self.done and len(self.pending) and not (asked >= _ASKED and self.uncovered):
            if time.perf_counter() > deadline:
                return True
            self._ask_at(self.pending[:_FEW])
            self.pending = self.pending[_FEW:]
            asked += _FEW
        return self.queued > self.done

    def _between_facets(self, count: int) -> Array:
        """So many random points between two facets."""
        hits = self.facets.hits[self.rng.integers(self.graph.counts[ROWS], size=(2, count))]
        share = self.rng.uniform(size=(count, 1))
        return np.asarray(share * hits[0] + (1 - share) * hits[1])

    def _behind_facets(self, most: int) -> Array:
        """So many random points behind facets that led to a region: half of them just behind, the others farther."""
        from mpc.explicit.kernels.exploration import behind_facets

        crossed = np.flatnonzero(self._states == CROSSED)
        chosen = np.resize(crossed, most if len(crossed) else 0) if len(crossed) <= most else self._some(crossed, most)
        owners = np.searchsorted(self.facets.offsets[: self.done + 1], chosen, side="right") - 1
        directions = self.rng.normal(size=(len(chosen), self.parameters))
        shares, farther = self.rng.uniform(size=(2, len(chosen)))
        steps = CROSSING * (_FARTHEST / CROSSING) ** np.maximum(0.0, 2.0 * farther - 1.0)
        return np.asarray(behind_facets(self.facets, chosen, owners, directions, shares, steps))

    @property
    def uncovered(self) -> int:
        """Number of feasible parameters met that lie in no region, nor in a thin gap between two."""
        return int((~self._covered(self.feasible, THIN)).sum())

    def _seed(self, count: int) -> Array:
        """Queue the active sets at random parameters, and near the border; those of them that are feasible."""
        from mpc.explicit.kernels.exploration import seed

        targets = self.rng.uniform(-1, 1, size=(count, self.parameters))
        found = np.empty_like(targets)
        return found[: int(seed(self.data, self.graph, *self.qp.joint, targets, found))]

    def _room_for(self, sets: int) -> None:
        """Make room for so many more active sets."""
        while self.graph.counts[KNOWN] + sets >= len(self.graph.masks):
            self._grow_sets()

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
        other = _Search(self.qp.rows(kept), self.known)
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
        room.tied[:] = old.tied[kept]
        self.graph = room
        self._rehash()

    def _grow(self) -> None:
        """Twice the room for facets if that is scarce, else for active sets."""
        facets = self.facets
        if self.graph.counts[ROWS] + len(self.qp.M) + len(self.qp.Tb) > len(facets.rows):
            longer = {name: _longer(getattr(facets, name)) for name in ("rows", "hits", "state")}
            self.facets = facets._replace(**longer)
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
        counts=np.zeros(4, dtype=np.int64), tied=np.zeros(m, dtype=bool),
    )  # fmt: skip
    rows = np.empty((_FACETS * capacity, n + 1))
    state = np.zeros(len(rows), dtype=np.int8)
    hits = np.empty((len(rows), n))
    return graph, Facets(np.zeros(capacity + 1, dtype=np.int64), rows, np.empty((capacity, n)), hits, state)


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
