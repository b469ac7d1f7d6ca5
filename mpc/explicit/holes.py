"""Search for holes between regions, and the QP solved there."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import cached_property

import numpy as np
from scipy.optimize import nnls

from mpc.checks import Array, Ints
from mpc.dense_qp import DenseQP
from mpc.explicit.kernels import places
from mpc.explicit.kernels.data import ASKED, CROSSED, OPEN, ROWS
from mpc.explicit.kernels.halfspace import interior_point
from mpc.explicit.linear_programs import INFEASIBLE, SOLVED, proves_infeasible, solve_exactly
from mpc.explicit.partition import MPQPStatus
from mpc.explicit.region_graph import Found, RegionGraph
from mpc.explicit.scaled_qp import ScaledQP
from mpc.tolerances import (
    CROSSING,
    FARTHEST_BEHIND,
    KKT,
    OPTIMAL_SET,
    POINTS_ANYWHERE,
    POINTS_BEHIND,
    POINTS_BETWEEN,
    QPS_AT_ONCE,
    REGIONS_PER_POINT,
    ROUNDED_SUM,
    THIN,
    TIE,
)


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


class OnlineQP:
    """Scaled QP at one parameter, by the checked online solver."""

    def __init__(self, qp: ScaledQP) -> None:
        self.qp = qp
        self.free = np.zeros(qp.M.shape[1])
        self.solver = DenseQP(np.eye(len(self.free)), qp.M)

    def at(self, t: Array, deadline: float = np.inf) -> tuple[list[tuple[int, ...]], bool]:
        """Independent active sets at t, and whether t has room; past the deadline that may be missed."""
        bounds = self.qp.D @ np.append(t, 1.0)
        result = self.solver.solve(self.free, bounds, confirm_infeasible=True)
        y = result.multipliers
        if result.infeasible and proves_infeasible(y, self.qp.M, bounds, self.qp.reach):
            return [], False
        if result.infeasible or not result.residuals.primal <= KKT:
            return [], self._has_room(bounds, deadline)
        taken = tuple(int(i) for i in np.flatnonzero(y > OPTIMAL_SET * y.max(initial=0.0)))
        return [taken, self._independent(result.z, bounds)], self._has_room(bounds, deadline)

    def _independent(self, v: Array, bounds: Array) -> tuple[int, ...]:
        """Fewest rows active at v that carry it, linearly independent."""
        near = np.flatnonzero(bounds - self.qp.M @ v <= KKT * (1.0 + np.abs(bounds)))
        if not len(near):
            return ()
        share = nnls(np.ascontiguousarray(self.qp.M[near].T), -v)[0]
        return tuple(int(i) for i in near[share > 0])

    def _has_room(self, bounds: Array, deadline: float) -> bool:
        """Whether a point holds every row without a tolerance."""
        room = TIE * (1.0 + np.abs(bounds))
        found = self.solver.solve(self.free, bounds - room, confirm_infeasible=True).z
        return bool((self.qp.M @ found <= bounds).all()) or self._linear_program_finds_room(bounds, room, deadline)

    def _linear_program_finds_room(self, bounds: Array, room: Array, deadline: float) -> bool:
        """Whether a linear program finds room, for v within reach, or does not end: then nobody can tell."""
        cost = np.append(self.free, -1.0)
        rows = np.hstack([self.qp.M, room[:, None] / TIE])
        limits = [(-self.qp.reach, self.qp.reach)] * len(self.free) + [(None, 1.0)]
        program = solve_exactly(cost, rows, bounds, limits, deadline)
        if program.status != SOLVED:
            return bool(program.status != INFEASIBLE)
        return bool((bounds - self.qp.M @ program.x[:-1] >= room).all())


class Holes(RegionGraph):
    """Graph of regions, searched for feasible parameters in no region.

    feasible : (k, nt) parameters that were feasible, with room, and in no region when they were met;
    pending : (k, nt) parameters in no region when they were met, about which the QP was not asked yet.
    """

    def __init__(self, qp: ScaledQP) -> None:
        super().__init__(qp)
        self.rng = np.random.default_rng(0)
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

    def lead_on(self, deadline: float) -> bool:
        """Look beyond explored regions; True for new ones or past deadline."""
        return self.look_across(deadline) or self.look_around(deadline)

    def look_across(self, deadline: float) -> bool:
        """Solve the QP beyond open facets; True as for `lead_on`.

        Of very many facets some are drawn: a hole of any size has many.
        """
        count = min(64 + self.done // REGIONS_PER_POINT, 500)
        still = self._some(np.flatnonzero(self.facets.state[: self.graph.counts[ROWS]] == OPEN), count)
        offsets = self.facets.offsets
        for facet, r in zip(still, self._owners(still)):
            if self.queued > self.done or time.perf_counter() > deadline:
                return True
            self.facets.state[facet] = ASKED
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
        points = np.empty((count, self.parameters))
        places.between_facets(self.facets, self.graph.counts[ROWS], self.rng.random((count, 3)), points)
        return points

    def behind_facets(self, most: int) -> Array:
        """Random points behind crossed facets, `most` of them; half just behind."""
        chosen = self._some(np.flatnonzero(self.facets.state[: self.graph.counts[ROWS]] == CROSSED), most)
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
        """Solve the QP at pending points; True as for `lead_on`.

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
        bits = self.active_bits(self.done)
        members = np.nonzero(bits)[1].tolist()
        ends = np.cumsum(bits.sum(axis=1, dtype=np.int64)).tolist()
        sets = [tuple(members[first:last]) for first, last in zip([0, *ends], ends)]
        rows = self.facets.rows[: self.graph.counts[ROWS]].copy()
        offsets = self.facets.offsets[: self.done + 1].copy()
        return Found(status, self.qp, sets, rows, offsets, self.facets.centres[: self.done].copy(), self.uncovered)
