"""Compiled exploration from facet to facet, in portions."""

from __future__ import annotations

import time

import daqp
import numpy as np

from mpc.checks import Array, Ints
from mpc.explicit.holes import Holes
from mpc.explicit.partition import MPQPStatus
from mpc.explicit.region_graph import Found
from mpc.explicit.scaled_qp import ScaledQP
from mpc.tolerances import NO_BOUND, REDUNDANT, REGIONS_TO_THIN

_LIMITED = (MPQPStatus.REGION_LIMIT, MPQPStatus.TIME_LIMIT)


def explore_compiled(qp: ScaledQP, most: int, deadline: float, feasible: Array | None = None) -> Found:
    """Regions of all optimal active sets, or those found by a limit.

    most : regions; deadline : `time.perf_counter()` [s]; feasible : (k, nt) parameters from which to start where random
    ones find nothing.
    """
    first = Search(qp, feasible)
    first.begin(deadline)
    search = first
    status = None
    if not first.queued:
        late = time.perf_counter() > deadline
        status = MPQPStatus.TIME_LIMIT if late else MPQPStatus.INFEASIBLE
        status = MPQPStatus.INACCURATE if first.uncovered else status
    while status is None:
        search.advance(most)
        if search.queued > search.done >= most:
            status = MPQPStatus.REGION_LIMIT
        elif time.perf_counter() > deadline:
            status = MPQPStatus.TIME_LIMIT
        elif search.should_be_thinned:
            search = search.thinned_out(deadline)
        elif search.done == search.queued and not search.lead_on(deadline):
            status = MPQPStatus.INACCURATE if search.uncovered else MPQPStatus.COMPLETE
    return (max(first, search, key=lambda s: s.done) if status in _LIMITED else search).found(status)


class Search(Holes):
    """Exploration of one problem as far as it has come."""

    def __init__(self, qp: ScaledQP, known: Array | None = None) -> None:
        super().__init__(qp)
        self.known = known  # feasible parameters
        self.thinned = False
        self.thinned_for_speed = False
        self.portion = 64

    def begin(self, deadline: float = np.inf) -> None:
        """Queue regions at random parameters, more where none is found.

        Where the compiled solver finds none at parameters that are feasible, the checked online solver is asked.
        """
        feasible = [np.empty((0, self.parameters)) if self.known is None else self.known]
        for _ in range(10):  # new ones are drawn while none leads to a region
            targets = self.rng.uniform(-1, 1, size=(8, self.parameters))
            seeded = [np.empty((0, self.parameters))]
            for few in self.portions(targets, 2_000):
                seeded.append(self.seed(few))
                if time.perf_counter() > deadline:
                    break
            found = np.vstack(seeded)
            if len(found) == 0 or self.queued or time.perf_counter() > deadline:
                break
            feasible.append(found)
        if not self.queued:
            self.ask_at(np.vstack(feasible), deadline)

    def advance(self, most: int) -> None:
        """Find facets and neighbours of some more regions."""
        before = self.done
        start = time.perf_counter()
        # not where the clock says: the regions keep their order
        stop = min(most, REGIONS_TO_THIN) if before < REGIONS_TO_THIN and not self.thinned else most
        self.explore(min(self.portion, stop - before))
        taken = max(time.perf_counter() - start, 1e-6)
        if self.done > before:  # else there was no room, and it grew
            self.portion = max(1, int(0.05 * (self.done - before) / taken))  # 0.05 s between two looks

    @property
    def should_be_thinned(self) -> bool:
        """Whether redundant rows cost time or make several active sets optimal."""
        pays = self.done >= REGIONS_TO_THIN and not self.thinned_for_speed
        return not self.thinned and (pays or (self.done == self.queued and self.tied))

    def thinned_out(self, deadline: float) -> Search:
        """Search without redundant rows, new where these are active.

        For speed alone a share of the time left is spent on it: what is found by then is left out.
        """
        now = time.perf_counter()
        qp = self.qp
        needed = self.done == self.queued and self.tied
        kept, finished = irredundant_rows(qp, deadline if needed else now + 0.25 * (deadline - now))
        self.thinned = finished or needed
        self.thinned_for_speed = True
        if len(kept) == len(qp.M):
            return self
        if np.delete(self.active_bits(self.queued), kept, axis=1).any():
            return self._started_again(kept, deadline)
        self.keep_rows(kept)
        return self

    def _started_again(self, kept: Ints, deadline: float) -> Search:
        """Search with these rows only; this one where that finds nothing."""
        other = Search(self.qp.rows(kept), self.known)
        other.thinned = self.thinned
        other.thinned_for_speed = True
        other.pending = np.vstack([self.feasible, self.pending])
        other.begin(deadline)
        return other if other.queued else self


def irredundant_rows(qp: ScaledQP, deadline: float = np.inf) -> tuple[Ints, bool]:
    """Irredundant rows of M, without those that only touch, and whether all were looked at.

    A row is kept in doubt, and when it was not looked at before the deadline, `time.perf_counter()` [s].
    """
    J, h = qp.joint
    kept = np.ones(len(J), dtype=bool)
    finished = True
    for i in reversed(range(len(qp.M))):
        finished = time.perf_counter() <= deadline
        if not finished:
            break
        kept[i] = False
        kept[i] = not is_implied(J[i], float(h[i]), J[kept], h[kept])
    return np.flatnonzero(kept[: len(qp.M)]), finished


def is_implied(row: Array, bound: float, J: Array, h: Array) -> bool:
    """Whether multipliers y >= 0 prove row x <= bound for all Jx <= h."""
    # the point that lies farthest across the row, within one unit of it
    normals = np.ascontiguousarray(np.vstack([J, row]))
    bounds = np.append(h, bound + 1.0)
    most = 3 * sum(normals.shape)  # iterations
    point, _, flag, info = daqp.solve(
        None, np.ascontiguousarray(-row), normals, bounds, np.full(len(bounds), -NO_BOUND), iter_limit=most
    )
    if flag != 1 or not row @ point <= bound + REDUNDANT:
        return False
    y = np.maximum(info["lam"][:-1], 0.0)
    active = np.flatnonzero(y)
    refined = np.zeros(len(y))  # combines the same rows to `row` best
    refined[active] = np.maximum(np.linalg.lstsq(J[active].T, row, rcond=None)[0], 0.0)
    size = 1.0 + np.abs(point)
    return any(proof @ h + np.abs(row - proof @ J) @ size <= bound + REDUNDANT for proof in (y, refined))
