"""Search without slopes, by CMA-ES or Bayesian optimisation.

References
----------
Hansen, "The CMA evolution strategy: a tutorial", arXiv:1604.00772, 2016 (the package cma); Akiba et al., "Optuna", KDD
2019, with its Gaussian process sampler (the package optuna).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np
from tqdm import tqdm

from ccdtools.arrays import Array
from ccdtools.co_design.budgets import SIZE_EVALUATIONS
from ccdtools.co_design.design_controllers import LQR, controller_of, mpc_law
from ccdtools.co_design.design_search import DesignCost
from ccdtools.co_design.differentiable_model import fewer_runs, scenario_tensors
from ccdtools.co_design.limits import StateLimitPenalty
from ccdtools.co_design.methods.feasible_cost import Evaluation, FeasibleCost
from ccdtools.co_design.methods.loop_cost import LoopCost
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult, CoDesignStatus, History
from ccdtools.co_design.tolerances import CMA_SETTLED
from ccdtools.controllers.controllers import Controller
from ccdtools.exceptions import InputError, SimulatorError
from ccdtools.progress import bar
from ccdtools_ground.door import as_choice, as_count, shown

LIBRARIES = {"cma": "cma", "bayesian": "optuna"}
BUDGET = {"cma": 300, "bayesian": 60}  # Evaluations, by library.
RUNS = {"lqr": 256, "mpc": 32}  # Scenarios of 100 steps, by controller.


@dataclass(frozen=True)
class Search:
    """Search by values alone, with a maintained library.

    Attributes
    ----------
    library : {"cma", "bayesian"}
        CMA-ES, or Bayesian optimisation with a Gaussian process; both are in the extra `ccdtools[search]`.
    of : {"lqr", "mpc"} or callable
        What is looked at: the closed loop of saturated LQR or of MPC of each design on fixed scenarios; or any function
        of a design (np,) that returns its return, such as a measurement.
    evaluations : int, optional
        By default 300 of CMA-ES, 60 of Bayesian optimisation.
    runs : int, optional
        Scenarios of 100 steps: by default 256 of LQR, 32 of MPC.
    """

    designs_only: ClassVar[bool] = True  # what controls follows from the design

    library: str = "cma"
    of: str | Callable[[Array], float] = "lqr"
    evaluations: int | None = None
    runs: int | None = None

    def __post_init__(self) -> None:
        as_choice("library", self.library, tuple(LIBRARIES))
        if not callable(self.of):
            as_choice("of", self.of, tuple(RUNS))
        for name in ("evaluations", "runs"):
            if getattr(self, name) is not None:
                as_count(name, getattr(self, name))

    @property
    def name(self) -> str:
        """Name of the method in tables."""
        return {"cma": "CMA-ES", "bayesian": "Bayesian search"}[self.library]

    def run(
        self, problem: CoDesignProblem, design: Array, rng: np.random.Generator, *, progress: bool = False
    ) -> CoDesignResult:
        """Best design and its controller, from a feasible design (np,)."""
        package = LIBRARIES[self.library]
        if find_spec(package) is None:
            raise InputError("method", f"a search by {package}, which is not installed", "the extra ccdtools[search]",
                             f"pip install {package}")  # fmt: skip
        cost = self._cost(problem, rng)
        box = FeasibleCost(cost, problem.design.to_unit(design))
        budget = self.evaluations or BUDGET[self.library]
        with bar(label=self.name, total=budget, progress=progress) as shown_bar:
            box.begin(budget, rng)
            shown_bar.update(len(box.cost.rows))
            ask = _cma if self.library == "cma" else _bayesian
            settled = ask(box, budget, rng, shown_bar)
        return self._result(box, settled)

    def _cost(self, problem: CoDesignProblem, rng: np.random.Generator) -> DesignCost:
        """What is looked at: a closed loop, with a penalty where limits have a tolerance, or a given function."""
        if not isinstance(self.of, str):
            return GivenCost(problem, self.of)
        runs = fewer_runs(self.runs or RUNS[self.of], problem.steps)
        law = LQR if self.of == "lqr" else mpc_law()
        penalty = None if problem.limit_tolerance == "off" else StateLimitPenalty(problem)
        return LoopCost(problem, law, scenario_tensors(problem, runs, rng), penalty)

    def _result(self, box: FeasibleCost, settled: bool) -> CoDesignResult:
        """Best evaluation."""
        cost = box.cost
        space = box.space
        if not np.isfinite(box.best[1]):
            last = getattr(cost, "last_error", None)
            got = f"{self.of!r}, which has no return at any of {len(cost.rows)} designs"
            got += "" if last is None else f"; at the last {last}"
            cure = "LQR and MPC here are those of the tangent at rest; nested LQR tries the secant, too."
            raise InputError("of", got, "a return at some design", cure)
        design = space.settled(box.best_v)
        status = CoDesignStatus.BUDGET_SPENT
        if settled:
            held = space.active_bounds(design) or space.active_constraints(design)
            status = CoDesignStatus.AT_BOUND if held else CoDesignStatus.CONVERGED
        return CoDesignResult(
            design=design, controller=cost.controller(design), method=self.name, status=status,
            objective=-box.best[1], criterion=f"return of {cost.words}", evaluations=len(cost.rows),
            limits=cost.limits(box.best_v), history=History.of(cost.rows),
        )  # fmt: skip


@dataclass(eq=False)
class GivenCost(DesignCost):
    """Cost by a function of a design (np,) that returns its return."""

    of: Callable[[Array], Any]
    last_error: SimulatorError | None = None
    words = "the given function"

    def __call__(self, v: Array) -> tuple[float, Callable[[], Array]]:
        """Cost at a unit-box point, whose slope is not known."""
        try:
            value = self.of(self.problem.design.settled(v))
        except SimulatorError as error:
            self.last_error, value = error, -np.inf
        try:
            (number,) = map(float, np.ravel(value))
        except (TypeError, ValueError):
            raise InputError("of", shown(value), "a function of a design that returns one number") from None
        return -number, lambda: np.full(len(v), np.nan)

    def controller(self, p: Array) -> Controller:
        """LQR of a design, clipped to U."""
        return controller_of("lqr", self.problem, p)


def _cma(box: FeasibleCost, budget: int, rng: np.random.Generator, shown_bar: tqdm) -> bool:
    """Run CMA-ES, restarted at random while evaluations last; return convergence."""
    settled = False
    start = box.looks[-1][0]
    while len(box.cost.rows) < budget:
        before = len(box.cost.rows)
        settled = _one_strategy(box, start, budget - before, rng, shown_bar) or settled
        start = rng.random(len(start))
        if len(box.cost.rows) == before:  # nothing feasible was near: there is nothing to look at
            break
    return settled


def _one_strategy(box: FeasibleCost, first: Array, budget: int, rng: np.random.Generator, shown_bar: tqdm) -> bool:
    """Run CMA-ES once within a budget; return whether it converged."""
    import cma

    n = len(first)
    start = np.full(max(n, 2), 0.5)  # a covariance needs two entries: of one parameter the second idles, and costs
    start[:n] = first
    options = {
        "bounds": [0.0, 1.0], "seed": int(rng.integers(1, 2**31)), "verbose": -9, "tolx": CMA_SETTLED, "tolfun": 0.0,
        "tolfunhist": 0.0,
    }  # fmt: skip
    strategy = cma.CMAEvolutionStrategy(start, 0.25, options)  # first step in the unit box
    while not strategy.stop():
        points = strategy.ask()
        left, budget = budget, budget - len(points)
        if budget < 0:  # less than a generation is left: it is looked at, and nothing learned from it
            for z in points[:left]:
                box(np.asarray(z)[:n])
            shown_bar.update(left)
            return False
        idle = [float(np.sum((np.asarray(z)[n:] - 0.5) ** 2)) for z in points]
        strategy.tell(points, [box(np.asarray(z)[:n]) + box.size * away for z, away in zip(points, idle)])
        shown_bar.update(len(points))
    return True


def _bayesian(box: FeasibleCost, budget: int, rng: np.random.Generator, shown_bar: tqdm) -> bool:
    """Optimise with a Gaussian process, never known to converge."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="IProgress not found")  # its progress bar is not used
        import optuna

    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        sampler = optuna.samplers.GPSampler(seed=int(rng.integers(1, 2**31)), deterministic_objective=True)
    space = box.space
    ranges: dict[str, Any] = {
        name: optuna.distributions.IntDistribution(round(low), round(high)) if whole
        else optuna.distributions.FloatDistribution(0.0, 1.0)
        for name, low, high, whole, free in zip(space.names, *space.outermost, space.whole, box.free) if free
    }  # fmt: skip
    whole = space.whole[box.free]
    low, high = space.lower[box.free], space.upper[box.free]
    level = np.inf

    def known(look: Evaluation) -> Any:
        """Evaluation as a trial of Optuna."""
        least, most = (end[box.free] for end in space.outermost)
        asked = np.where(whole, np.clip(np.round(low + look[0] * (high - low)), least, most), look[0])
        params = {name: int(a) if w else float(a) for name, a, w in zip(ranges, asked, whole)}
        return optuna.trial.create_trial(params=params, distributions=ranges, value=min(box.merit(*look), level))

    def value(trial: Any) -> float:
        """Merit at the point of an Optuna trial."""
        shown_bar.update()
        asked = np.array([
            trial.suggest_int(name, of.low, of.high) if w else trial.suggest_float(name, 0.0, 1.0)
            for (name, of), w in zip(ranges.items(), whole)
        ])  # fmt: skip
        return min(box(np.where(whole, (asked - low) / (high - low), asked)), level)

    try:
        for until in range(min(SIZE_EVALUATIONS, budget), budget + SIZE_EVALUATIONS, SIZE_EVALUATIONS):
            # a process that follows the cliffs of lost runs sees nothing of the valleys: the worse half is one level
            enough = len(box.looks) >= SIZE_EVALUATIONS
            level = float(np.median([box.merit(*look) for look in box.looks])) if enough else np.inf
            study = optuna.create_study(sampler=sampler)
            study.add_trials([known(look) for look in box.looks])
            study.optimize(value, n_trials=max(min(until, budget) - len(box.looks), 0))
    finally:
        optuna.logging.set_verbosity(verbosity)
    return False
