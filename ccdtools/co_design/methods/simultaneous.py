"""Simultaneous co-design: trajectories and design in one nonlinear program.

References
----------
Allison, Guo and Han, "Co-design of an active suspension using simultaneous dynamic optimization", Journal of Mechanical
Design 136, 2014; Herber and Allison, Journal of Mechanical Design 141, 2019.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import CONTROL, controller_of
from ccdtools.co_design.design_search import OTHERS
from ccdtools.co_design.landscape import start_points, valleys
from ccdtools.co_design.methods.open_loop import (
    at_the_mean,
    check_open_loop,
    drawn,
    lqr_or_none,
    open_loop_problem,
    told,
)
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult, CoDesignStatus, History
from ccdtools.controllers.controllers import Controller, LinearFeedback
from ccdtools.plants.design_space import DesignSpace
from ccdtools.progress import bar
from ccdtools_ground.door import as_choice, as_count
from mpc.optimal_control import OptimalControlStatus, Solution, build, solve

UNKNOWNS = ("trajectory", "gain")
RUNS = {"trajectory": 8, "gain": 16}  # Scenarios; each has trajectories of its own.


@dataclass(frozen=True)
class Simultaneous:
    """Trajectories and design in one program, solved by Ipopt.

    Attributes
    ----------
    unknowns : {"trajectory", "gain"}
        What is found with the design: inputs of every scenario, its disturbance known ahead; or one feedback gain that
        all scenarios share, u = −K x, saturated.
    control : {"lqr", "mpc"}
        What closes the loop where inputs were found: they themselves hold for their disturbances alone.
    runs : int, optional
        Scenarios: 8 of inputs, 16 of a gain by default; of a worst case always one of every case.
    starts : int
        Designs to start from: the given one, and the best valleys of the landscape of saturated LQR.
    iterations : int
        Of Ipopt, at most, from each start.
    """

    designs_only: ClassVar[bool] = True  # what controls follows from the design

    unknowns: str = "trajectory"
    control: str = "lqr"
    runs: int | None = None
    starts: int = 2
    iterations: int = 500

    def __post_init__(self) -> None:
        as_choice("unknowns", self.unknowns, UNKNOWNS)
        as_choice("control", self.control, CONTROL)
        for name in ("starts", "iterations"):
            as_count(name, getattr(self, name))
        if self.runs is not None:
            as_count("runs", self.runs)

    @property
    def name(self) -> str:
        """Name of the method in tables."""
        return "simultaneous" if self.unknowns == "trajectory" else "simultaneous gain"

    def run(
        self, problem: CoDesignProblem, design: Array, rng: np.random.Generator, *, progress: bool = False
    ) -> CoDesignResult:
        """Best design and its controller, from a feasible one (np,) and other starts."""
        check_open_loop(problem)
        scenarios = drawn(problem, self.runs or RUNS[self.unknowns], rng)
        found = valleys(problem, design, rng=rng) if self.starts > 1 else ()
        ends = []
        points = start_points(problem.design, design, found, self.starts)
        with bar(label=self.name, total=len(points), progress=progress) as shown:
            for v in points:
                ends.append(self._from(problem, scenarios, problem.design.settled(v)))
                shown.update()
        best, iterations = min(ends, key=lambda end: (not _feasible(end[0]), end[0].cost))
        result = self._result(problem, best)
        history = History.of([(iterations, iterations, result.design, -float(best.cost), 0.0, 0.0)])
        return replace(result, evaluations=sum(count for _, count in ends), history=history, valleys=found)

    def _from(self, problem: CoDesignProblem, scenarios: tuple[Array, Array], design: Array) -> tuple[Solution, int]:
        """Solution from one start, and its iterations of Ipopt."""
        gain = lqr_or_none(problem, design).K if self.unknowns == "gain" else None
        stated = partial(open_loop_problem, scenarios=scenarios, design=design, gain=gain)
        first = at_the_mean(problem, stated, max_iterations=self.iterations)
        solution = solve(build(stated(problem)), start=first, max_iterations=self.iterations)
        return solution, solution.iterations + (0 if first is None else first.iterations)

    def _result(self, problem: CoDesignProblem, best: Solution) -> CoDesignResult:
        """Result of the best start."""
        space = problem.design
        design = space.project(best.p[: space.dim])
        bounds, constraints = space.active_bounds(design), space.active_constraints(design)
        others = (OTHERS,) if space.integer and self.starts == 1 else ()
        gain = self.unknowns == "gain"
        runs = len(best.phases)
        words = (f"one saturated gain in {runs} scenarios" if gain else
                 f"the best inputs in {runs} scenarios whose disturbances are known ahead")  # fmt: skip
        status = CoDesignStatus.AT_BOUND if bounds or constraints else CoDesignStatus.CONVERGED
        if best.status is OptimalControlStatus.INFEASIBLE:
            status = CoDesignStatus.INFEASIBLE
        elif not best.solved or others:
            status = CoDesignStatus.BUDGET_SPENT
        if gain:
            K = best.p[space.dim :].reshape(problem.model.nu, problem.model.nx, order="F")
            controller: Controller = LinearFeedback(K, *problem.input_bounds_at(design))
        else:
            controller = controller_of(self.control, problem, design)
        held = {**bounds, **constraints} if _feasible(best) else {}
        return CoDesignResult(
            design=design, controller=controller, method=self.name, status=status, criterion=f"return of {words}",
            objective=-float(best.cost) if _feasible(best) else np.nan, slope=float(best.residuals.worst),
            multipliers={name: _multipliers(best, space)[name] for name in held},
            notes=(*told(problem, best, fed_back=gain), *others),
        )  # fmt: skip


def _feasible(solution: Solution) -> bool:
    """Whether all limits are kept."""
    return not (solution.status is OptimalControlStatus.INFEASIBLE or solution.conflicts)


def _multipliers(solution: Solution, space: DesignSpace) -> dict[str, float]:
    """Rise of the return per unit of each design constraint or bound."""
    prices: dict[str, float] = {}
    for rows in solution.program.rows:
        if rows.name == "p_constraints":
            own = solution.multipliers["rows"][rows.first : rows.last]
            prices |= dict(zip(space.constraint_names, own.tolist()))
    return prices | dict(zip(space.names, np.abs(solution.p_gradient[: space.dim] * space.free).tolist()))
