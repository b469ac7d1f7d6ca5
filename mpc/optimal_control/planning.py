"""Time, shifted plans and beginnings, for every statement."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mpc.budgets import ASIDE, LEAST_SECONDS
from mpc.checks import Array
from mpc.plan import Plan, Status
from mpc.rollout import Given
from mpc.tolerances import COST_ROUNDING, FEASIBLE

SHIFTED = "shifted plan"
Trajectory = tuple[Array, Array]  # states (N + 1, nx) and inputs (N, nu)


@dataclass
class Clock:
    """Time that is left of a sample, which is asked for before every program."""

    limit: float
    began: float = field(default_factory=time.perf_counter)
    asked: float = field(default_factory=time.perf_counter)
    longest: float = 0.0
    stopped: bool = False  # whether it ever said that the time was up

    @property
    def taken(self) -> float:
        """Time since it began."""
        return time.perf_counter() - self.began

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        return self.taken > self.limit

    @property
    def left(self) -> float:
        """Time that is left for a solver."""
        return max(self.limit - self.taken, LEAST_SECONDS)

    @property
    def up(self) -> bool:
        """Whether one more program would probably end too late."""
        before, self.asked = self.asked, time.perf_counter()
        self.longest = max(self.longest, self.asked - before)
        up = self.asked + self.longest - self.began > self.limit
        self.stopped = self.stopped or up
        return up

    def stamped(self, plan: Plan) -> Plan:
        """Plan with its time, LATE where that was up."""
        status = Status.LATE if self.late else plan.status
        return replace(plan, status=status, solve_time=self.taken)


def shifted(plan: Plan, u: Array, after: Array, later: Any) -> Plan:
    """Plan one sample later, with one more input and the state that it leads to.

    `later` are the numbers of its rows, one sample later.
    """
    costates = None if plan.costates is None else np.vstack([plan.costates[1:], plan.costates[-1:]])
    pushes = None if plan.pushes is None else plan.pushes[later]
    hessian = None if plan.hessian is None else np.concatenate([plan.hessian[1:-1], plan.hessian[-2:]])
    inputs, states = np.vstack([plan.inputs[1:], u]), np.vstack([plan.states[1:], after])
    return replace(plan, inputs=inputs, states=states, costates=costates, pushes=pushes, hessian=hessian)


def told_of_inputs(plan: Plan, bounds: tuple[Array, Array], rate_limit: Array | None, given: Given) -> Plan:
    """Plan, INFEASIBLE where no input within bounds can be reached."""
    if rate_limit is None or plan.status in (Status.SOLVED, Status.SOFTENED):
        return plan
    last, (low, high) = given["u_prev"], bounds
    apart = np.maximum(low - last, last - high) > (1 + FEASIBLE) * rate_limit
    return replace(plan, status=Status.INFEASIBLE) if apart.any() else plan


def aside(inputs: Array, sizes: Array) -> Array:
    """Inputs (N, nu) moved off their symmetries, the same every time."""
    return inputs + np.random.default_rng(0).uniform(-ASIDE, ASIDE, inputs.shape) * sizes


def solved(one: Any) -> bool:
    """Whether a result is an optimum."""
    return bool(one.status is Status.SOLVED)


def until_most_agree(tried: Iterable[Any], starts: int, sure: Callable[[Any], bool] = solved) -> Iterator[Any]:
    """Results of starts, until more than half are one optimum that is sure."""
    costs: list[float] = []
    for one in tried:
        yield one
        costs.append(one.cost if sure(one) else np.nan)
        if 2 * np.count_nonzero(np.isclose(costs, costs[-1], rtol=COST_ROUNDING, atol=0.0)) > starts:
            return


def beginnings(first: Trajectory, x: Array, end: Array, led_to: Callable[[Array], Trajectory],
               rng: np.random.Generator, box: tuple[Array, Array]) -> Iterator[Trajectory]:  # fmt: skip
    """Paths to begin at: the first; straight to `end`; where inputs of a box lead, without end."""
    yield first
    N = len(first[1])
    way = np.linspace(0, 1, N + 1)[:, None]
    yield (1 - way) * x + way * end, first[1]
    while True:
        yield led_to(np.repeat(rng.uniform(*box, (1 + N // 5, len(box[0]))), 5, axis=0)[:N])
