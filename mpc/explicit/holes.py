"""Search for regions and for holes between them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import cached_property

import numpy as np

from mpc.budgets import FARTHEST_BEHIND, POINTS_ANYWHERE, POINTS_BEHIND, POINTS_BETWEEN, QPS_AT_ONCE, REGIONS_PER_POINT
from mpc.checks import Array, Ints
from mpc.explicit.kernels import active_sets, places
from mpc.explicit.kernels.data import FLAT, FULL, INFEASIBLE, ROWS
from mpc.explicit.kernels.halfspace import interior_point
from mpc.explicit.linear_programs import OnlineQP
from mpc.explicit.partition import MPQPStatus
from mpc.explicit.region_graph import Found, RegionGraph
from mpc.explicit.scaled_qp import ScaledQP
from mpc.tolerances import CROSSING, ROUNDED_SUM, THIN


def points_beyond(rows: Array, facet: int, qp: ScaledQP) -> Array:
    """Points of the parameter set just beyond a region's facet [a, b].

    They lie above a point in the middle of the facet; none where the facet is too small for one.
    """
    normal = rows[facet, :-1]
    foot = rows[facet, -1] * normal
    plane = np.linalg.svd(normal[None])[2][1:].T  # directions along the facet
    others = np.delete(rows, facet, axis=0)
    slack = others[:, -1] - others[:, :-1] @ foot
    along = others[:, :-1] @ plane
    length = np.linalg.norm(along, axis=1)
    sides = length > ROUNDED_SUM
    centre = np.zeros(plane.shape[1])
    radius = 1.0
    if len(centre):
        A = np.ascontiguousarray(along[sides] / length[sides, None])
        radius = interior_point(A, slack[sides] / length[sides], np.inf, centre)
    if radius == 0.0:
        return np.empty((0, len(foot)))
    steps = [CROSSING, max(CROSSING, 0.1 * radius)]
    points = np.array([foot + plane @ centre + step * normal for step in steps])
    return points[(points @ qp.TA.T <= qp.Tb).all(axis=1)]


class Search(RegionGraph):
    """Exploration of one problem as far as it has come, and the search for feasible parameters in no region.

    feasible : (k, nt) parameters that were feasible, with room, and in no region when they were met;
    pending : (k, nt) parameters in no region when they were met, about which the QP was not asked yet.
    """

    def __init__(self, qp: ScaledQP) -> None:
        super().__init__(qp)
        self.rng = np.random.default_rng(0)
        self.portion = 64
        self.feasible = np.empty((0, self.parameters))
        self.pending = self.feasible

    @cached_property
    def online(self) -> OnlineQP:
        """QP at one parameter."""
        return OnlineQP(self.qp)

    @property
    def uncovered(self) -> int:
        """Number of feasible parameters found in no region."""
        return int((~self.covered(self.feasible, THIN)).sum()) if len(self.feasible) else 0

    def begin(self, known: Array | None = None, deadline: float = np.inf) -> None:
        """Queue regions at random parameters, more where none is found; `known` ones are feasible.

        Where the compiled solver finds none at parameters that are feasible, the checked online solver is asked.
        """
        feasible = [np.empty((0, self.parameters)) if known is None else known]
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
        self.explore(min(self.portion, most - before))
        taken = max(time.perf_counter() - start, 1e-6)
        if self.done > before:  # else there was no room, and it grew
            self.portion = max(1, int(0.05 * (self.done - before) / taken))  # 0.05 s between two looks

    def look_across(self, deadline: float) -> bool:
        """Solve the QP beyond open facets; True when that leads to regions, or the deadline is past.

        Of very many facets some are drawn: a hole of any size has many.
        """
        count = min(64 + self.done // REGIONS_PER_POINT, 500)
        still = self._some(np.flatnonzero(self.facets.behind[: self.graph.counts[ROWS]] == FLAT), count)
        offsets = self.facets.offsets
        for facet, r in zip(still, self._owners(still)):
            if self.queued > self.done or time.perf_counter() > deadline:
                return True
            self.facets.behind[facet] = INFEASIBLE
            own = slice(offsets[r], offsets[r + 1])
            self.ask_at(points_beyond(self.facets.rows[own], int(facet - own.start), self.qp), deadline)
        return self.queued > self.done

    def look_around(self, deadline: float) -> bool:
        """Look for holes anywhere, near the border, between and behind facets.

        Where rounding decides, the region that a facet led to may lie elsewhere. True when that leads to regions, or
        the deadline is past.
        """
        more = min(self.done // REGIONS_PER_POINT, 2000)
        between = self.between_facets(POINTS_BETWEEN + more)  # feasible, whatever a solver says
        behind = self.behind_facets(POINTS_BEHIND + more)
        anywhere = self.rng.uniform(-1, 1, size=(2 * (POINTS_ANYWHERE + more), self.parameters))
        targets = [anywhere[: POINTS_ANYWHERE + more], behind]
        for few in self.portions(anywhere[POINTS_ANYWHERE + more :]):
            if time.perf_counter() > deadline:
                return True
            targets.append(self.seed(few))  # near the border
        in_time = self._look_at(between, True, deadline) and self._look_at(np.vstack(targets), False, deadline)
        if not in_time:
            return True
        if len(self.pending):
            self.pending = self.rng.permutation(self.pending[~self.covered(self.pending)])
        return self._ask(deadline)

    def between_facets(self, count: int) -> Array:
        """Random points between two facets, `count` of them."""
        draws = self.rng.random((count, 3))
        first, last = self.facets.hits[(self.graph.counts[ROWS] * draws[:, :2]).astype(np.int64).T]
        return np.asarray(draws[:, 2:] * first + (1.0 - draws[:, 2:]) * last)

    def behind_facets(self, most: int) -> Array:
        """Random points behind crossed facets, `most` of them; half just behind."""
        chosen = self._some(np.flatnonzero(self.facets.behind[: self.graph.counts[ROWS]] == FULL), most)
        owners = self._owners(chosen)
        points = np.empty((most if len(chosen) else 0, self.parameters))
        draws = self.rng.random((len(points), self.parameters + 2))
        places.behind_facets(self.facets, chosen, owners, draws, CROSSING, FARTHEST_BEHIND, points)
        return points

    def _owners(self, facets: Ints) -> Ints:
        """Regions to which facets belong."""
        offsets = self.facets.offsets[: self.done + 1]
        return np.searchsorted(offsets, facets, side="right") - 1

    def _some(self, numbers: Ints, most: int) -> Ints:
        """Random choice of at most `most` numbers, in order."""
        return numbers if len(numbers) <= most else np.sort(self.rng.choice(numbers, most, replace=False))

    def _look_at(self, points: Array, feasible: bool, deadline: float) -> bool:
        """Queue active sets at uncovered points; False when time is up.

        feasible : whether they are known to be, whatever the compiled solver says. The feasible points are pending.
        """
        parts = 1 + len(points) * self.done // 20_000_000  # pairs of a point and a region
        for part in np.array_split(points, parts):
            if time.perf_counter() > deadline:
                return False
            for few in self.portions(part[~self.covered(part)]):
                if time.perf_counter() > deadline:
                    return False
                found = self.look_at(few)
                self.pending = np.vstack([self.pending, few if feasible else few[found]])
        return True

    def portions(self, points: Array, rows: int = 20_000) -> Iterator[Array]:
        """Points in portions, smaller with more rows."""
        size = max(1, rows // max(1, len(self.qp.M)))
        return (points[first : first + size] for first in range(0, len(points), size))

    def _ask(self, deadline: float) -> bool:
        """Solve the QP at pending points; True when that leads to regions, or the deadline is past.

        Some are enough once one of them has shown that there is a hole.
        """
        asked = 0
        while self.queued == self.done and len(self.pending) and not (asked >= 64 and self.uncovered):
            if time.perf_counter() > deadline:
                return True
            self.ask_at(self.pending[:QPS_AT_ONCE], deadline)
            self.pending = self.pending[QPS_AT_ONCE:]
            asked += QPS_AT_ONCE
        return self.queued > self.done

    def ask_at(self, points: Array, deadline: float) -> None:
        """Solve the QP at points in no region, as time allows."""
        for point in points[~self.covered(points)]:
            if time.perf_counter() > deadline:
                break
            candidates, feasible = self.online.at(point, deadline)
            for act in candidates:
                self.consider(act)
            if feasible:
                self.feasible = np.vstack([self.feasible, point])

    def found(self, status: MPQPStatus) -> Found:
        """Regions done."""
        act = np.empty(len(self.qp.M) + 1, dtype=np.int64)
        masks = self.graph.masks[self.graph.queue[: self.done]]
        sets = [tuple(act[: active_sets.from_mask(mask, act)].tolist()) for mask in masks]
        rows = self.facets.rows[: self.graph.counts[ROWS]].copy()
        offsets = self.facets.offsets[: self.done + 1].copy()
        return Found(status, self.qp, sets, rows, offsets, self.facets.centres[: self.done].copy(), self.uncovered)
