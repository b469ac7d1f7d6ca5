"""Sequential design: first the plant, then its controller.

References
----------
Fathy, Reyer, Papalambros and Ulsoy, "On the coupling between the plant and controller optimization problems", ACC
2001: what it gives away against co-design is the coupling.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import CONTROL, PASSIVE, controller_of
from ccdtools.co_design.design_search import best_design
from ccdtools.co_design.differentiable_model import ScenarioTensors, fewer_runs, scenario_tensors
from ccdtools.co_design.methods.loop_cost import LoopCost
from ccdtools.co_design.methods.simultaneous import Simultaneous
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult
from ccdtools.co_design.tolerances import STABLE
from ccdtools_ground.door import as_choice, as_count

CRITERIA = ("auto", "passive", "open_loop")
RUNS = 1000  # Scenarios of 100 steps.


@dataclass(frozen=True)
class Sequential:
    """Plant first, then its controller.

    Attributes
    ----------
    criterion : {"auto", "passive", "open_loop"}
        What the plant is designed by: its return without any input; or the best return that given inputs can have,
        feedback left out. "auto": the first where the plant comes to rest by itself, the second where it does not, or
        runs are lost without an input.
    control : {"lqr", "mpc"}
        What the plant is then given.
    starts, evaluations : int
        Of the search for the plant.
    """

    designs_only: ClassVar[bool] = True  # what controls follows from the design

    criterion: str = "auto"
    control: str = "lqr"
    starts: int = 3
    evaluations: int = 100

    def __post_init__(self) -> None:
        as_choice("criterion", self.criterion, CRITERIA)
        as_choice("control", self.control, CONTROL)
        for name in ("starts", "evaluations"):
            as_count(name, getattr(self, name))

    @property
    def name(self) -> str:
        """Name of the method in tables."""
        return "sequential"

    def run(
        self, problem: CoDesignProblem, design: Array, rng: np.random.Generator, *, progress: bool = False
    ) -> CoDesignResult:
        """Plant preferred by the criterion, with its controller, from a design (np,)."""
        scenarios = scenario_tensors(problem, fewer_runs(RUNS, problem.steps, problem.model), rng)
        criterion = self.criterion
        if criterion == "auto":
            criterion = "passive" if _stands_alone(problem, design, scenarios) else "open_loop"
        if criterion == "open_loop":
            plant = Simultaneous("trajectory", starts=self.starts).run(problem, design, rng, progress=progress)
        else:
            unlimited = replace(problem, limit_tolerance="off")  # what keeps the limits is not there yet
            plant = best_design(
                unlimited, lambda v: LoopCost(unlimited, PASSIVE, scenarios), design, rng, name=self.name,
                starts=self.starts, evaluations=self.evaluations, progress=progress,
            )  # fmt: skip
        return replace(plant, method=self.name, controller=controller_of(self.control, problem, plant.design))


def _stands_alone(problem: CoDesignProblem, design: Array, scenarios: ScenarioTensors) -> bool:
    """True if the plant without input is stable and loses no runs."""
    A, _, _ = problem.model.matrices(design)
    if np.abs(np.linalg.eigvals(A)).max() > 1 - STABLE:
        return False
    lost = LoopCost(problem, PASSIVE, scenarios).seen(problem.design.to_unit(design)).diverged
    return not bool(lost.any())
