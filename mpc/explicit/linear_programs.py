"""Linear programs and the QP at one parameter, checked: proofs of infeasibility."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from scipy.optimize import linprog, nnls

from mpc.checks import Array
from mpc.dense_qp import DenseQP
from mpc.explicit.scaled_qp import ScaledQP
from mpc.tolerances import KKT, LP_OPTIONS, PRIMAL, SOLVERS, TIE

SOLVED, INFEASIBLE = 0, 2  # what `status` says


def solve_exactly(cost: Array, rows: Array, right: Array, limits: Any, deadline: float = np.inf) -> Any:
    """Minimise cost'x subject to rows x <= right, as in `scipy.optimize.linprog`.

    HiGHS accepts 1e-7 by its default, in the rows and in the optimality: more than the room that is asked for here.
    Where it does not end with the least tolerance it may with its own.
    """
    options: dict[str, Any] = dict(LP_OPTIONS)
    if np.isfinite(deadline):
        options["time_limit"] = max(deadline - time.perf_counter(), 0.0)
    program = linprog(cost, A_ub=rows, b_ub=right, bounds=limits, method="highs", options=options)
    left = deadline - time.perf_counter()
    if program.status in (SOLVED, INFEASIBLE) or left <= 0:
        return program
    coarse = {"time_limit": left} if np.isfinite(left) else {}
    return linprog(cost, A_ub=rows, b_ub=right, bounds=limits, method="highs", options=coarse)


def proves_infeasible(y: Array, rows: Array, right: Array, reach: float) -> bool:
    """Whether multipliers prove infeasibility for |x| <= `reach` (Farkas).

    What a solver leaves of y' rows is taken out by least squares where it is in the way.
    """
    if not (y >= 0).all():
        return False
    if y @ right < -reach * np.abs(y @ rows).sum():
        return True
    taken = np.flatnonzero(y > SOLVERS * y.max(initial=0.0))
    if not len(taken) or not y @ right < 0:
        return False
    own = y[taken] - np.linalg.lstsq(rows[taken].T, rows[taken].T @ y[taken], rcond=None)[0]
    return bool((own >= 0).all() and own @ right[taken] < -reach * np.abs(own @ rows[taken]).sum())


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
        taken = tuple(int(i) for i in np.flatnonzero(y > PRIMAL * y.max(initial=0.0)))
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
