"""Cost of a design's best trajectories, for nested search.

The program is that of simultaneous co-design with p held.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import controller_of
from ccdtools.co_design.design_search import DesignCost
from ccdtools.co_design.methods.open_loop import at_the_mean, open_loop_problem, told
from ccdtools.co_design.result import CoDesignResult, CoDesignStatus
from ccdtools.co_design.risk import MEAN, WorstCase
from ccdtools.controllers.controllers import Controller
from mpc.optimal_control import OptimalControlStatus, Solution, build, solve


@dataclass(eq=False)
class TrajectoryCost(DesignCost):
    """Risk of the best inputs' costs, with its slope.

    The cases of a worst case have programs of their own, as nothing but the design ties them together: their costs are
    then counted, and rounded off where two are alike, as those of closed loops are.
    """

    scenarios: tuple[Array, Array]  # (n, nx) and (n, T, nw)
    start: Array  # (np,): the design that the program is built at
    control: str = "lqr"  # "lqr" or "mpc": what closes the loop in use
    evaluations: int = 0  # how many designs were looked at
    failed: Solution | None = None  # of the program that looked for a design within the limits and found none

    def __post_init__(self) -> None:
        parts = [self.scenarios]
        problem = self.problem
        if isinstance(problem.risk, WorstCase):
            parts = [(x0[None], w[None]) for x0, w in zip(*self.scenarios)]
            problem = replace(problem, risk=MEAN)
        p = self.start
        self._programs = [build(open_loop_problem(problem, part, design=p, constrained=False)) for part in parts]
        stated = partial(open_loop_problem, scenarios=self.scenarios, design=p, constrained=False)
        first = at_the_mean(problem, stated, p=p)
        self._last: list[Solution | None] = [first] * len(parts)

    @property
    def words(self) -> str:
        """Description of the cost in words."""
        return f"the best inputs in {len(self.scenarios[0])} scenarios whose disturbances are known ahead"

    def __call__(self, v: Array) -> tuple[float, Callable[[], Array]]:
        """Cost and slope (np,) at a point (np,); infinite where limits break."""
        p = self.problem.design.settled(v)
        self.evaluations += 1
        found: list[Solution] = [solve(program, p=p, start=last) for program, last in zip(self._programs, self._last)]
        for i, program in enumerate(self._programs):  # once more from the guess
            if not found[i].solved and self._last[i] is not None:
                found[i] = solve(program, p=p)
        if not all(solution.solved for solution in found):
            return np.inf, lambda: np.zeros(len(v))
        self._last = list(found)
        cost, slope = self._counted(np.array([solution.cost for solution in found]),
                                    np.array([solution.p_gradient for solution in found]))  # fmt: skip
        self.remember(p, -cost)
        return cost, lambda: slope * self.problem.design.allowed.width

    def _counted(self, costs: Array, slopes: Array) -> tuple[float, Array]:
        """Risk of costs (n,) and its slope (np,) from slopes (n, np)."""
        if len(costs) == 1:
            return float(costs[0]), slopes[0]
        returns = torch.tensor(-costs, requires_grad=True)
        counted = self.problem.risk.values(returns).mean()
        (weights,) = torch.autograd.grad(counted, returns)
        return -float(counted.detach()), weights.numpy() @ slopes

    def first_point(self, v: Array) -> tuple[Array, float]:
        """Point to search from, moved to where inputs can keep the limits, and its cost."""
        cost = self(v)[0]
        if np.isfinite(cost):
            return v, cost
        space = self.problem.design  # trajectories and design in one program, whole numbers held
        self.evaluations += 1
        stated = partial(open_loop_problem, scenarios=self.scenarios, design=space.settled(v))
        solution = solve(build(stated(self.problem)), start=at_the_mean(self.problem, stated))
        if not solution.solved:
            self.failed = solution
            return v, np.inf
        v = space.to_unit(space.project(solution.p))
        return v, self(v)[0]

    def without_design(self, name: str, v: Array) -> CoDesignResult:
        """Note that no trajectories keep the limits, with details."""
        space = self.problem.design
        design = space.settled(v)
        impossible = self.failed is not None and self.failed.status is OptimalControlStatus.INFEASIBLE
        return CoDesignResult(
            design=design, controller=self.controller(design), method=name,
            status=CoDesignStatus.INFEASIBLE if impossible else CoDesignStatus.BUDGET_SPENT,
            criterion=f"return of {self.words}",
            notes=() if self.failed is None else told(self.problem, self.failed),
        )  # fmt: skip

    def controller(self, p: Array) -> Controller:
        """Controller that closes the loop at a design."""
        return controller_of(self.control, self.problem, p)
