"""Points beyond facets that led nowhere, and the QP there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from mpc.checks import Array
from mpc.dense_qp import DenseQP
from mpc.explicit.linear_programs import INFEASIBLE, SOLVED, proves_infeasible, solve_exactly
from mpc.explicit.scaled_qp import ScaledQP
from mpc.tolerances import CROSSING, KKT, LAW_ERROR, OPTIMAL_SET, PARALLEL, TIE

Candidates = list[tuple[int, ...]]


class Opening(NamedTuple):
    """Independent active sets, and whether the parameter has room."""

    candidates: Candidates
    feasible: bool


def points_beyond(rows: Array, facet: int, qp: ScaledQP) -> Array:
    """Points of the parameter set just beyond a region's facet [a, b].

    They lie above a point in the middle of the facet; none where the facet is too small for one.
    """
    from mpc.explicit.kernels.halfspace import interior_point

    normal = rows[facet, :-1]
    foot = rows[facet, -1] * normal
    plane = np.linalg.svd(normal[None])[2][1:].T  # directions along the facet
    others = np.delete(rows, facet, axis=0)
    slack = others[:, -1] - others[:, :-1] @ foot
    along = others[:, :-1] @ plane
    length = np.linalg.norm(along, axis=1)
    sides = length > PARALLEL
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

    def at(self, t: Array, deadline: float = np.inf) -> Opening:
        """Opening at t; past the deadline room may be missed."""
        bounds = self.qp.D @ np.append(t, 1.0)
        result = self.solver.solve(self.free, bounds, confirm_infeasible=True)
        y = result.multipliers
        if result.infeasible and proves_infeasible(y, self.qp.M, bounds, self.qp.reach):
            return Opening([], feasible=False)
        if result.infeasible or not result.residuals.primal <= KKT:
            return Opening([], self._has_room(bounds, deadline))
        taken = tuple(int(i) for i in np.flatnonzero(y > OPTIMAL_SET * y.max(initial=0.0)))
        return Opening([taken, self._independent(result.z, bounds)], self._has_room(bounds, deadline))

    def _independent(self, v: Array, bounds: Array) -> tuple[int, ...]:
        """Fewest rows active at v that carry it, linearly independent."""
        near = np.flatnonzero(bounds - self.qp.M @ v <= LAW_ERROR * (1.0 + np.abs(bounds)))
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
        """Whether a linear program finds room, for v within reach.

        Where HiGHS does not end, nobody can tell, and the parameter counts.
        """
        cost = np.append(self.free, -1.0)
        rows = np.hstack([self.qp.M, room[:, None] / TIE])
        limits = [(-self.qp.reach, self.qp.reach)] * len(self.free) + [(None, 1.0)]
        program = solve_exactly(cost, rows, bounds, limits, deadline)
        if program.status != SOLVED:
            return bool(program.status != INFEASIBLE)
        return bool((bounds - self.qp.M @ program.x[:-1] >= room).all())
