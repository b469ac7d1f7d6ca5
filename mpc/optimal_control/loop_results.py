"""Results of solves for a sample of a phase, by rank."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mpc.optimal_control.ipopt import Found
from mpc.optimal_control.local_statement import Local
from mpc.optimal_control.solution import OptimalControlStatus
from mpc.optimal_control.solving import status_of
from mpc.optimal_control.sqp import Step, next_step
from mpc.plan import Plan, Status
from mpc.tolerances import FEASIBLE, VIOLATION_PRICE as PRICE

RANKS = (Status.SOLVED, Status.SOFTENED, Status.INACCURATE, Status.REPLACED)


@dataclass(frozen=True, eq=False)
class Tried:
    """Result of a solve, its cost and largest violation."""

    found: Found
    cost: float
    violation: float  # of a hard limit, in its unit
    passed: float  # the same in sizes of its row, or the largest gap in sizes of states
    local: Local  # at it

    @cached_property
    def step(self) -> Step | None:
        """Step of a program about it."""
        return next_step(self.local, PRICE * self.local.force, relaxed=self.status is Status.SOFTENED, times=PRICE)

    @cached_property
    def sure(self) -> bool:
        """Whether it is an optimum, and at no saddle."""
        return self.status is Status.SOLVED and not (self.step and self.step.falls)

    @property
    def status(self) -> Status:
        """Status, SOLVED where its own conditions and limits hold."""
        if status_of(self.found) is OptimalControlStatus.SOLVED:
            return Status.SOLVED if self.passed <= FEASIBLE else Status.SOFTENED
        feasible = np.maximum(self.passed, self.found.residuals.primal) <= FEASIBLE and np.isfinite(self.cost)
        return Status.INACCURATE if feasible else Status.REPLACED

    @property
    def rank(self) -> tuple[int, float]:
        """Rank, of optima by cost, of others by violation."""
        worth = self.cost if self.status is Status.SOLVED else self.passed + self.found.residuals.primal
        return RANKS.index(self.status), worth if np.isfinite(worth) else np.inf


def better(found: Plan | None, other: Plan) -> Plan:
    """Softened plan, or the other where better."""
    if found is None or other.status is Status.SOLVED:
        return other
    if other.status is Status.SOFTENED and (other.cost < found.cost or other.violation < found.violation):
        return other
    return found
