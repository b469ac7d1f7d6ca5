"""Nested co-design: search over designs, each with its controller.

References
----------
Fathy, Reyer, Papalambros and Ulsoy, "On the coupling between the plant and controller optimization problems", ACC
2001; Herber and Allison, "Nested and simultaneous solution strategies for general combined plant and control design
problems", Journal of Mechanical Design 141, 2019.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from types import NoneType
from typing import ClassVar

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import LQR, DesignLaw, mpc_law
from ccdtools.co_design.design_search import DesignCost, best_design
from ccdtools.co_design.differentiable_model import fewer_runs, scenario_tensors
from ccdtools.co_design.methods.loop_cost import LoopCost
from ccdtools.co_design.methods.riccati_cost import RiccatiCost
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult
from ccdtools.co_design.secant import fitted, visited
from ccdtools.exceptions import InputError
from ccdtools.plants.linear_model import LinearModel
from ccdtools.plants.models import for_long_work
from ccdtools_ground.door import as_choice, as_count, as_instance
from learning.networks import ActorCritic
from mpc import NotStabilisableError

RUNS = {
    "lqr": 1000,
    "gain": 1000,
    "mpc": 32,
    "nmpc": 16,
    "riccati": 1,
    "lqg": 1,
    "trajectory": 8,
    "rl": 256,
}  # Scenarios of 100 steps
NAMES = {
    "lqr": "LQR",
    "gain": "gain",
    "mpc": "MPC",
    "nmpc": "NMPC",
    "riccati": "Riccati",
    "lqg": "LQG",
    "trajectory": "trajectory",
    "rl": "RL",
}


@dataclass(frozen=True)
class Nested:
    """Outer search by SQP along slopes, with an inner controller per design.

    Attributes
    ----------
    inner : {"lqr", "gain", "riccati", "lqg", "mpc", "nmpc", "trajectory", "rl"}
        In closed loop on fixed scenarios: saturated LQR ("lqr"; slopes exact, through the Riccati equation and the
        simulation); one saturated gain, found with the design from LQR's on ("gain", in one search), which may keep
        limits that LQR by the cost's weights breaks; linear or nonlinear MPC (slopes by differences of closed loops); a
        policy trained at every design ("rl", the bi-level form; slopes by the envelope theorem). Without a simulation:
        LQR that never saturates ("riccati"), on the estimate of the problem's Kalman filter ("lqg"; slopes by
        differences). In open loop: the best inputs of every scenario, its disturbance known ahead ("trajectory"; slopes
        exact, by multipliers).
    runs : int, optional
        Scenarios of 100 steps; of longer ones, and of models whose samples take longer than 32 Runge–Kutta parts (one
        by collocation takes as long as 60), fewer are taken, except of trajectories. By default 1000 of LQR or a gain,
        32 of MPC, 16 of nonlinear MPC, 8 of trajectories, 256 of learning.
    starts : int
        Designs to start from: the given one, and the best valleys of the landscape of saturated LQR.
    evaluations : int, optional
        With their slopes, at most, of each start; 100 by default, 12 of learning, which starts once. Where the limits
        of the problem have to be priced, every round of prices has as many.
    horizon : int
        Steps of an MPC.
    control : {"lqr", "mpc"}
        What closes the loop where the inside is a trajectory.
    by : {"pathwise", "ppo", "pathwise+ppo"}
        What trains the policy of "rl".
    agent : ActorCritic, optional
        Its warm start; by default one that imitates an expert, as `Learned` has it, is made.
    linearisation : {"auto", "tangent", "secant"}
        What the LQR of a plant that is not linear is of: the tangent at rest, or the secant over the states that its
        own loop visits (see `stochastic_linearisation`; slopes by differences). "auto": the secant where it is better
        in closed loop at the design that the tangent finds; the result's `notes` hold both returns.
    """

    designs_only: ClassVar[bool] = True  # what controls follows from the design

    inner: str = "lqr"
    runs: int | None = None
    starts: int = 3
    evaluations: int | None = None
    horizon: int = 20
    control: str = "lqr"
    by: str = "pathwise"
    agent: ActorCritic | None = None
    linearisation: str = "auto"

    def __post_init__(self) -> None:
        as_choice("inner", self.inner, tuple(RUNS))
        as_choice("control", self.control, ("lqr", "mpc"))
        as_choice("by", self.by, ("pathwise", "ppo", "pathwise+ppo"))
        for name in ("starts", "horizon"):
            as_count(name, getattr(self, name))
        for name in ("runs", "evaluations"):
            if getattr(self, name) is not None:
                as_count(name, getattr(self, name))
        kinds = (ActorCritic, NoneType)
        as_instance("agent", self.agent, kinds, "an ActorCritic", "fit_actor_critic makes one.")
        as_choice("linearisation", self.linearisation, ("auto", "tangent", "secant"))

    @property
    def name(self) -> str:
        """Name of the method in tables."""
        return f"nested {NAMES[self.inner]}"

    def run(
        self, problem: CoDesignProblem, design: Array, rng: np.random.Generator, *, progress: bool = False
    ) -> CoDesignResult:
        """Best design and its controller, from a feasible one (np,) and other starts."""
        starts = 1 if self.inner == "rl" else self.starts
        most = self.evaluations or (12 if self.inner == "rl" else 100)
        if fewer_runs(RUNS["lqr"], 100, problem.model) < RUNS["lqr"]:  # of few runs and many parts loops are compiled
            problem = replace(problem, model=for_long_work(problem.model, most * RUNS["lqr"] * problem.steps))
        search = partial(
            best_design, problem, design=design, rng=rng, name=self.name, evaluations=most, progress=progress
        )
        if self.inner == "lqr" and self.linearisation != "tangent" and not isinstance(problem.model, LinearModel):
            return self._of_better_linearisation(problem, search, rng)
        return search(self._cost_from(problem, rng, progress), starts=starts)

    def _of_better_linearisation(
        self, problem: CoDesignProblem, search: partial[CoDesignResult], rng: np.random.Generator
    ) -> CoDesignResult:
        """Result of the tangent's LQR, or the secant's if asked for or better."""
        scenarios = scenario_tensors(problem, fewer_runs(self.runs or RUNS["lqr"], problem.steps, problem.model), rng)
        tangent: CoDesignResult | None = None
        if self.linearisation == "auto":
            with suppress(InputError, NotStabilisableError):  # the tangent may have no input at all
                tangent = search(lambda v: LoopCost(problem, LQR, scenarios), starts=self.starts)
        scenario = visited(problem, rng)
        of = f"of this design, on the {len(scenario[0])} runs of the fit"
        if tangent is not None:
            here = fitted(problem, tangent.design, scenario)
            if not here.better:
                return replace(tangent, notes=(*tangent.notes, f"{here}, {of}"))
        begun = {} if tangent is None else {"design": np.asarray(tangent.design)}
        words = "saturated LQR of the secant over the visited states"
        law = DesignLaw(words, lambda problem, p: fitted(problem, p, scenario).controller)
        found = search(lambda v: LoopCost(problem, law, scenarios), starts=1, **begun)
        if tangent is not None and not found.objective > tangent.objective and np.isfinite(tangent.objective):
            found = tangent
        return replace(found, notes=(*found.notes, f"{fitted(problem, found.design, scenario)}, {of}"))

    def _cost_from(
        self, problem: CoDesignProblem, rng: np.random.Generator, progress: bool
    ) -> Callable[[Array], DesignCost]:
        """Cost of a search that starts at a unit-box point."""
        runs = self.runs or RUNS[self.inner]
        if self.inner == "riccati":
            return lambda v: RiccatiCost(problem)
        if self.inner == "lqg":
            from ccdtools.co_design.methods.lqg_cost import LqgCost

            return lambda v: LqgCost(problem)
        if self.inner == "trajectory":  # what few ask for is loaded where it is asked for
            from ccdtools.co_design.methods.open_loop import drawn
            from ccdtools.co_design.methods.trajectory_cost import TrajectoryCost

            given = drawn(problem, runs, rng)
            return lambda v: TrajectoryCost(problem, given, problem.design.settled(v), self.control)
        scenarios = scenario_tensors(problem, fewer_runs(runs, problem.steps, problem.model), rng)
        if self.inner == "gain":
            from ccdtools.co_design.methods.gain_cost import gain_cost

            return lambda v: gain_cost(problem, v, scenarios)
        if self.inner == "rl":
            from ccdtools.co_design.imitation import first_policy
            from ccdtools.co_design.methods.learned_cost import LearnedCost

            known = replace(problem, measurement=None)  # a policy of the state, as LQR is
            agent = self.agent
            if agent is None:
                agent = first_policy(known, known.design.centre, rng, progress=progress).agent
            return lambda v: LearnedCost(known, agent, scenarios, rng, self.by)
        law = LQR if self.inner == "lqr" else mpc_law(self.horizon, nonlinear=self.inner == "nmpc")
        return lambda v: LoopCost(problem, law, scenarios)
