"""The cost of the best trajectories of a design, for nested search: the program of simultaneous co-design, p held."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import controller_of
from ccdtools.co_design.methods.open_loop import followed, open_loop_problem
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import History
from ccdtools.controllers.controllers import Controller


@dataclass(eq=False)
class TrajectoryCost:
    """Mean cost of the best inputs of every scenario at a design, with its exact slope by the multipliers.

    Parameters
    ----------
    problem : CoDesignProblem
    scenarios : arrays (n, nx) and (n, T, nw)
    start : (np,) array
        The design that the program is built at.
    control : {"lqr", "mpc"}
        What closes the loop in use.
    """

    problem: CoDesignProblem
    scenarios: tuple[Array, Array]
    start: Array
    control: str = "lqr"
    rows: list[tuple] = field(default_factory=list)
    _last: Any = None

    def __post_init__(self) -> None:
        from mpc.optimal_control import build

        guess = followed(self.problem, self.scenarios, self.start)
        self._program = build(
            open_loop_problem(self.problem, self.scenarios, design=self.start, guess=guess, constrained=False)
        )

    @property
    def words(self) -> str:
        """What it is."""
        return f"the best inputs in {len(self.scenarios[0])} scenarios whose disturbances are known ahead"

    def __call__(self, v: Array) -> tuple[float, Array]:
        """Cost and its slope (np,) at a point (np,) of the unit box; infinite where no inputs keep the limits."""
        from mpc.optimal_control import solve

        p = self.problem.design.from_unit(v)
        solution = solve(self._program, p=p, start=self._last)
        if not solution.solved and self._last is not None:
            solution = solve(self._program, p=p)
        if not solution.solved:
            return np.inf, np.zeros(len(v))
        self._last = solution
        count = len(self.rows) + 1
        self.rows.append((count, count, p, -float(solution.cost), 0.0, 0.0))
        return float(solution.cost), solution.p_gradient * self.problem.design.allowed.width

    @property
    def evaluations(self) -> int:
        """How many there were."""
        return len(self.rows)

    def controller(self, p: Array) -> Controller:
        """What closes the loop at a design."""
        return controller_of(self.control, self.problem, p)

    def history(self) -> History:
        """All evaluations so far."""
        return History(*(np.array(column) for column in zip(*self.rows)))
