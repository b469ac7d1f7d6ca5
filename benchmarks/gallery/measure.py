"""One finished run measured: its policies driven again on common random numbers, beside the independent optimum."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.simulation import simulate
from ccdtools.studies import RunFolder, Study, load_study
from ccdtools.studies.stage_storage import Stage
from ccdtools.trajectory import Trajectory
from gallery.oracle.cost import linear_return, model_step, saturated_return, simulated
from gallery.oracle.receding_horizon import RecedingHorizon
from gallery.oracle.statement import Statement
from gallery.reference import CLIPPED, LIMITED, reference, statement

RUNS = 2000
CLIPPED_RUNS = 20_000
LIMITED_RUNS = 100
SEED = 20_262
NORMAL = 1.96
SAME_VALLEY = 0.05  # of the box
STUDIES = Path(__file__).resolve().parent / "studies"


@dataclass(frozen=True)
class Step:
    """A deployed generation less what was in service before it, on the real plant: paired, with its 95 % interval.

    `kept` is whether the loop left it in service.
    """

    difference: float
    low: float
    high: float
    kept: bool = True

    @property
    def verdict(self) -> str:
        """Worse, better or neither, beyond the interval."""
        if self.high < 0:
            return "worse"
        return "better" if self.low > 0 else "equal"


@dataclass(frozen=True)
class Measured:
    """What a run has reached.

    Attributes
    ----------
    design : dict
        Of the first co-design, by parameter.
    shortfall, shortfall_error : float
        Return of the first co-design below the independent optimum, and its standard error [% of the optimum].
    valley : int
        Number of the local optimum whose design is nearest, 0 for the best.
    status : str
        What the first co-design says of itself.
    names_best : bool
        Whether it names the best valley, wherever it ended.
    deployed : tuple of float
        Mean return on the real plant of what was deployed in each generation.
    steps : tuple of Step
        Of the later generations.
    at_the_end : Step or None
        What is in service after the last generation, less the first as it was left in service.
    designed : float
        Mean return on the real plant of the first co-design as it was designed: before any update while deployed.
    learned : Step or None
        What is in service after the last generation, less that: all that was gained by learning of the real plant.
    depth, mpc_depth : float
        Mean over runs of the deepest excursion from X [half-widths], of the first co-design and of MPC at its design.
    beside_mpc : float
        Return relative to that of MPC at the same design [%]; NaN where no limit binds.
    """

    design: dict[str, float]
    shortfall: float
    shortfall_error: float
    valley: int
    status: str
    names_best: bool
    deployed: tuple[float, ...]
    steps: tuple[Step, ...]
    depth: float
    mpc_depth: float
    beside_mpc: float
    at_the_end: Step | None = None
    designed: float = np.nan
    learned: Step | None = None

    @property
    def learned_percent(self) -> float:
        """What was gained since the first co-design as designed [% of its return]; NaN before anything was deployed."""
        return 100 * self.learned.difference / abs(self.designed) if self.learned is not None else np.nan


def measured(study_name: str, folder: Path) -> Measured:
    """The measurements of one finished run."""
    study = study_of(study_name)
    run = RunFolder(folder)
    generations = json.loads((folder / "results.json").read_text())["generations"]
    returns = [_deployed_returns(study, run, entry["generation"]) for entry in generations]
    first = run.read_stage("codesign-1")
    designed = _real_returns(study, first.networks["agent"], first.arrays["design"])
    service = returns[0]
    steps = []
    for entry, deployed in zip(generations[1:], returns[1:]):
        kept = entry["delivery"]["replaces"]
        steps.append(_step(deployed, service, kept))
        service = deployed if kept else service
    return replace(
        measured_first(study_name, first), deployed=tuple(float(r.mean()) for r in returns),
        steps=tuple(steps), at_the_end=_step(service, returns[0], True), designed=float(designed.mean()),
        learned=_step(service, designed, True),
    )  # fmt: skip


def measured_first(study_name: str, found: Stage) -> Measured:
    """The measurements of a first co-design alone."""
    study = study_of(study_name)
    policy = LearnedPolicy(found.networks["agent"], found.arrays["design"])
    shortfall, error = _shortfall(study_name, study, policy)
    on_model = _driven(study, policy, real=False, runs=LIMITED_RUNS)
    mpc_depth, beside = _mpc(study_name, study, policy, on_model) if study_name in LIMITED else (np.nan, np.nan)
    return Measured(
        design={name: float(value) for name, value in zip(study.plant.design.names, policy.design)},
        shortfall=shortfall, shortfall_error=error, valley=_valley(study_name, study, policy.design),
        status=status_of(found.values), names_best=_names_best_valley(study_name, study, found.values), deployed=(),
        steps=(), depth=_depth(study, on_model), mpc_depth=mpc_depth,
        beside_mpc=beside,
    )  # fmt: skip


def study_of(name: str) -> Study:
    """The study that a file of the gallery declares."""
    return load_study(STUDIES / f"{name}.py")


def status_of(values: dict[str, Any]) -> str:
    """What a co-design says of how it ended, from what its stage has kept; a dash where it says nothing."""
    return values.get("ended", {}).get("meaning", "–")


def _names_best_valley(name: str, study: Study, values: dict[str, Any]) -> bool:
    """Whether one of the local optima that a co-design names is the independent optimum."""
    unit = study.plant.design.to_unit
    best = unit(np.array(reference(name)["designs"][0]))
    named = [valley[key] for valley in values.get("ended", {}).get("valleys", ()) for key in ("design", "found")]
    return any(np.abs(unit(np.array(design)) - best).max() < SAME_VALLEY for design in named if design is not None)


def _driven(study: Study, policy: Any, *, real: bool, runs: int = RUNS) -> Trajectory:
    """Runs of a policy at its design, on common random numbers."""
    rng = np.random.default_rng(SEED)
    source = study.real if real else study
    steps = source.steps
    w = source.disturbance.sample(runs, steps, rng)
    plant = study.real.plant if real else study.model
    return simulate(
        plant, policy, x0=source.x0, steps=steps, disturbance=w, design=policy.design, limit=study.problem().limit
    )


class _At:
    """A controller together with the design it is for."""

    def __init__(self, controller: Any, design: Any) -> None:
        self.controller = controller
        self.design = design

    def __call__(self, x: Any) -> Any:
        """Inputs (n, nu)."""
        return self.controller(x)


def _shortfall(name: str, study: Study, policy: LearnedPolicy) -> tuple[float, float]:
    """Per cent below the optimum, and the standard error: exact return of LQR plus the paired difference to it."""
    s = statement(name)
    best = reference(name)["returns"][0]
    if name in CLIPPED:
        return _below_feedback(name, s, policy)
    own = _driven(study, policy, real=False).returns(study.objective)
    lqr = _At(saturated_lqr(study.problem(), policy.design), policy.design)
    difference = own - _driven(study, lqr, real=False).returns(study.objective)
    limited = name in LIMITED
    exact = saturated_return(s, policy.design, s.disturbance(20_000, 5)) if limited else linear_return(s, policy.design)
    scale = 100 / abs(best)
    error = difference.std(ddof=1) / np.sqrt(len(difference))
    return float(scale * (best - exact - difference.mean())), float(scale * error)


def _below_feedback(name: str, s: Statement, policy: LearnedPolicy) -> tuple[float, float]:
    """Per cent below the best clipped linear feedback under the same disturbances, and the standard error."""
    kept = reference(name)
    w = s.disturbance(CLIPPED_RUNS, SEED)
    K, offset = (np.array(kept["feedback"][key]) for key in ("K", "offset"))
    best = simulated(s, model_step(s, np.array(kept["designs"][0])), lambda x: offset - x @ K.T, w)[0]
    short = 100 * (best - simulated(s, model_step(s, policy.design), policy, w)[0]) / abs(best.mean())
    return float(short.mean()), float(short.std(ddof=1) / np.sqrt(len(short)))


def _valley(name: str, study: Study, design: Any) -> int:
    """Number of the nearest local optimum."""
    unit = study.plant.design.to_unit
    distances = [np.abs(unit(design) - unit(np.array(other))).max() for other in reference(name)["designs"]]
    return int(np.argmin(distances))


def _deployed_returns(study: Study, run: RunFolder, generation: int) -> Any:
    """Returns (n,) on the real plant of what a generation left in service."""
    stage = run.read_stage(f"deployment-{generation}")
    design = run.read_stage(f"codesign-{generation}").arrays["design"]
    return _real_returns(study, stage.networks["agent"], design)


def _real_returns(study: Study, agent: Any, design: Any) -> Any:
    """Returns (n,) of a policy at a design on the real plant."""
    return _driven(study, LearnedPolicy(agent, design), real=True).returns(study.objective)


def _step(after: Any, before: Any, kept: bool) -> Step:
    """The paired difference of returns (n,)."""
    difference = after - before
    half = NORMAL * difference.std(ddof=1) / np.sqrt(len(difference))
    return Step(float(difference.mean()), float(difference.mean() - half), float(difference.mean() + half), kept)


def _depth(study: Study, trajectory: Trajectory) -> float:
    """Mean over the runs of the deepest excursion from the box X, in half-widths of it."""
    lower, upper = study.X.bounding_box()
    half = (upper - lower) / 2
    x = trajectory.states[:, 1:]
    return float((np.maximum(x - upper, lower - x) / half).max(axis=(1, 2)).clip(min=0).mean())


def _mpc(name: str, study: Study, policy: LearnedPolicy, own: Trajectory) -> tuple[float, float]:
    """Depth of MPC at the design of a policy, and the policy's return relative to MPC's [%]."""
    mpc = _At(RecedingHorizon(statement(name), policy.design), policy.design)
    run = _driven(study, mpc, real=False, runs=LIMITED_RUNS)
    mine, theirs = (trajectory.returns(study.objective).mean() for trajectory in (own, run))
    return _depth(study, run), float(100 * (mine - theirs) / abs(theirs))
