"""Generations by fits of the plant to what was logged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t

from ccdtools.arrays import Array
from ccdtools.co_design.closed_loop import closed_loop_returns
from ccdtools.co_design.codesign import as_method, codesign
from ccdtools.co_design.methods.learned import Learned
from ccdtools.co_design.output_filter import estimator_at, memory_at
from ccdtools.co_design.problem import CoDesignProblem, FixedStart
from ccdtools.controllers.observed import Observed
from ccdtools.disturbances.disturbance import Disturbance
from ccdtools.evidence.evidence import Violation
from ccdtools.exceptions import InputError
from ccdtools.plants.plant import Plant
from ccdtools.scenario import Scenario
from ccdtools.statistics import PairedDifference, paired_difference
from ccdtools.studies.budgets import REAL_RUNS
from ccdtools.studies.real_plant import RealPlant, check_disturbance
from ccdtools.trajectory import Trajectory
from ccdtools.twin.identified import IdentifiedChange, check_changeable, identified_change, identified_lqr
from ccdtools.twin.limits_kept import violation
from ccdtools.twin.plant_fit import FitStatus, PlantFit, fit_plant
from ccdtools.twin.unknown_plant import stated_plant
from ccdtools_ground.door import as_choice, as_count, as_generator, as_instance, shown
from ccdtools_ground.outcome import Outcome
from mpc import NotStabilisableError


class DeploymentStatus(Outcome):
    """Outcome of a deployment; the value is the advice."""

    LOGGED = "Logged: runs were kept, and tell the next generation."
    LOST = (
        "Every run diverged, so the log tells nothing and no generation follows. Begin with a design and a law that "
        "the real plant bears (design=, method=), state what is uncertain, or log shorter runs from nearer to rest."
    )


@dataclass(frozen=True, eq=False, repr=False)
class FittedGeneration:
    """Generation, and what it gained.

    Attributes
    ----------
    design : (np,) array
    controller : callable
        As deployed; of outputs where the problem has sensors.
    log : Trajectory
        Of the deployment, with its outputs.
    fit : PlantFit, IdentifiedChange or None
        What former logs told; None of the first generation.
    predicted, gain : PairedDifference or None
        Return of the redesign above what was deployed before: on the plant of the fit, with what is not known of it in
        the interval, but how an `IdentifiedChange` depends on the design; and on fresh common runs of the real plant,
        None where no redesign was tried there.
    accepted : bool
        Whether what was designed for the fit, or at first, is in service.
    moved : bool
        Whether that has another design than what was in service before.
    update : PairedDifference or None
        Measured gain at the former design of LQR by the logs, or of the former law behind the filter of the plant that
        they tell where the problem has sensors; where that is what is deployed.
    violation : Violation or None
        Limits that a redesign left further on the real plant than the tolerance, and than what was in service.
    elsewhere : dict of str to PairedDifference
        Gain of a redesign on the held-out drives of the real plant.
    beside : dict of str to PairedDifference
        Gain of a redesign above the update that is deployed in its place, on drives where it is less beyond chance.
    lost : (int, int)
        Runs that a redesign, and what was in service, lost where it was tried.
    agent : ActorCritic or None
        Networks of a learned policy.
    """

    design: Array
    controller: Any
    log: Trajectory
    fit: PlantFit | IdentifiedChange | None = None
    predicted: PairedDifference | None = None
    gain: PairedDifference | None = None
    accepted: bool = True
    update: PairedDifference | None = None
    violation: Violation | None = None
    elsewhere: Mapping[str, PairedDifference] = field(default_factory=dict)
    beside: Mapping[str, PairedDifference] = field(default_factory=dict)
    lost: tuple[int, int] = (0, 0)
    agent: Any = None
    moved: bool = True

    @property
    def status(self) -> DeploymentStatus:
        """Whether the deployment kept a run."""
        return DeploymentStatus.LOST if self.log.diverged.all() else DeploymentStatus.LOGGED

    def __str__(self) -> str:
        """Decision and gain in a sentence."""
        lost = [self.status.advice] if self.status is DeploymentStatus.LOST else []
        if self.fit is None:
            return ". ".join([f"first design {np.round(self.design, 4)}", *lost])
        place = np.round(self.design, 4) if self.accepted else "taken back" if self.gain else "refused"
        what = "redesign" if self.moved else "law designed anew at the same design"
        said = f"{what} {place}" if self.predicted else "no redesign"
        update = "LQR by the logs measured" if self.log.outputs is None else "filter of the fit measured"
        words = {
            "predicted": self.predicted, "measured": self.gain, "": self.violation, update: self.update,
            **{f"on {name}": gain for name, gain in self.elsewhere.items()},
            **{f"beside that update {name}": gain for name, gain in self.beside.items()},
        }  # fmt: skip
        gains = [
            str(one) if isinstance(one, Violation) else f"{name} {one.mean:+.4g} [{one.ci95[0]:.4g}, {one.ci95[1]:.4g}]"
            for name, one in words.items() if one
        ]  # fmt: skip
        if self.lost[0] > self.lost[1]:
            gains.append(f"{self.lost[0]} runs lost, {self.lost[1]} before")
        told = [self.fit.advice] if isinstance(self.fit, PlantFit) and _doubtful(self.fit) else []
        return ". ".join([", ".join([said, *gains]), *told, *lost])


def fitted_generations(
    problem: CoDesignProblem, real: RealPlant, *, method: Any = "nested", generations: int = 2,
    design: ArrayLike | None = None, plant: Plant | None = None, noise: str = "fitted", draws: int = 20,
    trial_runs: int | None = None, rng: np.random.Generator,
) -> tuple[FittedGeneration, ...]:  # fmt: skip
    """Generations of a problem on a real plant.

    Each is deployed, and its outputs logged, or its states where the problem has no sensors. The plant that all logs
    tell (`fit_plant`), or where nothing unknown is stated and all states are seen what the last log tells by least
    squares (`identified_change`), is designed for again, a learned policy from the one in service on. The redesign is
    tried on the real plant if a gain is predicted whose interval lies above 0. It stays in service if, on the drives of
    deployments and on each that is held out (`RealPlant.held_out`), it breaks no limit and is no worse beyond chance,
    nor loses more runs: than what was deployed before, and than an update of it. A recording leaves nothing to chance.
    Where states are logged that update is LQR of the affine model that they tell at the former design
    (`identified_lqr`), where outputs are the former law behind the filter of the plant that they tell, if it is better
    as deployed beyond chance, no worse elsewhere, and breaks no limit. A redesign for a fit that is not SOLVED must be
    better so, too. A policy that is learned on the state (`Learned(history=0)`) is judged there by `codesign`,
    and behind its filter by the real plant alone.

    Where a deployment loses all of its runs its `status` is LOST, and it is the last.

    Parameters
    ----------
    problem : CoDesignProblem
    real : RealPlant
        Its own outputs are measured where the problem's are those of a Plant.
    method : str or Method
        Of every `codesign`, such as ``Nested("lqg")``.
    design : (np,) array_like, optional
        Where the first search starts.
    plant, noise
        Of `fit_plant`.
    draws : int
        Plants drawn from what is known of the parameters, for the interval of a prediction.
    trial_runs : int, optional
        Runs of each drive of the real plant in which something new is tried, and of its prediction; by default so many
        as 500 episodes.

    Raises
    ------
    InputError
        As `fit_plant`, `codesign` and `deploy`; or if runs start where the filter of the sensors takes another start
        for known.

    Examples
    --------
    >>> for one in fitted_generations(problem, real, method=Nested("lqg"), rng=rng):  # doctest: +SKIP
    ...     print(one)
    """
    loop = FittedLoop(problem, real, plant, noise, draws, trial_runs)
    as_count("generations", generations)
    as_generator("rng", rng)
    by = as_method(method)
    found = [loop.first(by, design, rng)]
    while len(found) < generations and found[-1].status is DeploymentStatus.LOGGED:
        found.append(loop.following(by, found, rng))
    return tuple(found)


@dataclass(frozen=True)
class FittedLoop:
    """Generations on a real plant, one after the other; fields as of `fitted_generations`."""

    problem: CoDesignProblem
    real: RealPlant
    plant: Plant | None = None
    noise: str = "fitted"
    draws: int = 20
    trial_runs: int | None = None

    def __post_init__(self) -> None:
        as_instance("problem", self.problem, CoDesignProblem, "a CoDesignProblem")
        as_instance("real", self.real, RealPlant, "a RealPlant")
        if self.real.later:
            raise InputError("real.later", shown(self.real.later), "(): generations by fits meet one real plant")
        as_count("draws", self.draws, least=2)
        if self.trial_runs is not None:
            as_count("trial_runs", self.trial_runs, least=2)
        as_choice("noise", self.noise, ("fitted", "known"))
        if self.plant is not None:
            stated_plant(self.problem, self.plant)
        elif self.problem.measurement is None:
            check_changeable(self.problem)
        start = self.problem.scenarios if self.problem.measurement is not None else None
        if isinstance(start, FixedStart) and not np.array_equal(self.real.x0, start.x0):
            expected = f"{shown(start.x0)}, the start that the filter knows"
            cure = "State where it may start: RandomStarts(Gaussian(…), disturbance)."
            raise InputError("real.x0", shown(self.real.x0), expected, cure)
        others = {f"real.held_out[{name!r}]": drive for name, drive in (self.real.held_out or {}).items()}
        for name, drive in ({"real.disturbance": self.real.disturbance} | others).items():
            check_disturbance(name, drive, self.real.plant, self.real.steps)

    @property
    def sensors(self) -> Any:
        """Sensors of the real plant; None where states are seen."""
        own, plant = self.problem.measurement, self.real.plant
        if isinstance(getattr(own, "output", None), Plant) and isinstance(plant, Plant) and plant.ny:
            return replace(own, output=plant)
        return own

    def first(self, by: Any, design: ArrayLike | None, rng: np.random.Generator) -> FittedGeneration:
        """First design and its log."""
        return self._logged(_designed(self.problem, by, design, rng), rng)

    def following(self, by: Any, found: Sequence[FittedGeneration], rng: np.random.Generator) -> FittedGeneration:
        """Generation after those so far."""
        before = found[-1]
        fit: PlantFit | IdentifiedChange
        if self.plant is None and self.sensors is None:
            fit = identified_change(self.problem, before.log)  # affine, which is right where the loop is now
        else:
            fit = fit_plant(self.problem, [one.log for one in found], plant=self.plant, noise=self.noise)
        again: Any = None
        predicted = updated = None
        moved = True
        if not isinstance(fit, PlantFit) or fit.status is not FitStatus.UNSOLVED:
            updated = fit.likeliest(self.problem) if isinstance(fit, PlantFit) else fit.updated(self.problem)
            going_on: Any = by.following(before.agent) if hasattr(by, "following") else by
            again = _designed(updated, going_on, before.design, rng)
            predicted = self._predicted(fit, updated, again, before, rng)
            moved = not np.array_equal(again.design, before.design)
            again = again if predicted.ci95[0] > 0 else None
        told = _by_logs(self.problem, found, updated)
        deployed, measured = before, dict[str, Any]()
        if told is not None or again is not None:
            deployed, measured = self.trial(before, told, again, int(rng.integers(2**31)), _doubtful(fit))
        told_by = {"fit": fit, "predicted": predicted, "accepted": deployed is again, "moved": moved}
        return self._logged(deployed, rng, **told_by, **measured)

    def _logged(self, one: Any, rng: np.random.Generator, **told: Any) -> FittedGeneration:
        """Generation of what is deployed."""
        log = self.run(one, self.scenario(self.real.runs, int(rng.integers(2**31)), self.real.disturbance))
        return FittedGeneration(one.design, one.controller, log, agent=getattr(one, "agent", None), **told)

    def scenario(self, runs: int, seed: int, drive: Disturbance) -> Scenario:
        """So many runs of a drive, the same by the same seed."""
        rng = np.random.default_rng(seed)
        w = drive.sample(runs, self.real.steps, rng)
        return Scenario(self.real.plant, self.real.x0, w, output=self.sensors, seed=int(rng.integers(2**31)))

    def run(self, one: Any, scenario: Scenario) -> Trajectory:
        """Log of a design and its controller."""
        return scenario.run(one.controller, design=one.design, limit=self.problem.limit)

    def gain(self, after: Trajectory, before: Trajectory) -> PairedDifference:
        """Gain on common runs that neither loses; NaN where there are none."""
        kept = ~(after.diverged | before.diverged)
        return paired_difference(*(run.returns(self.problem.objective)[kept] for run in (after, before)))

    def _predicted(
        self, fit: PlantFit | IdentifiedChange, updated: CoDesignProblem, one: Any, other: Any, rng: np.random.Generator
    ) -> PairedDifference:  # fmt: skip
        """Gain of one over another on a fit's plant.

        Its interval has the spread over plants drawn from the fit in it, and no end where one loses more runs.
        """
        seed = int(rng.integers(2**31))

        def gains(on: CoDesignProblem, runs: int | None) -> Array:
            """Gains on common runs; none where one loses more."""
            after, before = (
                closed_loop_returns(on, of.controller, of.design, np.random.default_rng(seed), runs=runs)
                for of in (one, other)
            )
            return (after.values - before.values)[~(after.lost | before.lost) & (after.lost_share <= before.lost_share)]

        few = max((self.trial_runs or REAL_RUNS) // self.draws, 2)
        drawn = [gains(each, few) for each in fit.drawn(self.problem, self.draws, rng)]
        whole = gains(updated, self.trial_runs)
        if not len(whole) or not all(map(len, drawn)):
            return PairedDifference(float("nan"), (-np.inf, np.inf))
        found = paired_difference(whole, np.zeros(len(whole)))
        spread = float(np.std([part.mean() for part in drawn], ddof=1))
        half = np.hypot((found.ci95[1] - found.ci95[0]) / 2, t.ppf(0.975, self.draws - 1) * spread)
        return PairedDifference(found.mean, (found.mean - half, found.mean + half))

    def trial(
        self, before: FittedGeneration, told: Any, again: Any, seed: int, doubtful: bool
    ) -> tuple[Any, dict[str, Any]]:  # fmt: skip
        """What is deployed, and measured gains by attribute of a generation."""
        runs = self.trial_runs or max(REAL_RUNS * self.problem.steps // self.real.steps, 2)
        own = self.real.disturbance
        others = {name: drive for name, drive in (self.real.held_out or {}).items() if drive is not own}
        scenarios = [self.scenario(runs, seed, drive) for drive in (own, *others.values())]

        def driven(one: Any) -> list[Trajectory]:
            """Runs on every distribution."""
            return [self.run(one, scenario) for scenario in scenarios]

        def better(logs: list[Trajectory], beyond_chance: bool) -> bool:
            """Whether runs are no worse than the best so far, or better as deployed."""
            ends = np.array([self.gain(*pair).ci95 for pair in zip(logs, best)])
            saved = np.array([int(now.diverged.sum()) - int(after.diverged.sum()) for after, now in zip(logs, best)])
            ends[saved > 0] = np.where(np.isnan(ends), np.inf, ends)[saved > 0]  # nothing to compare but what it saves
            return bool((saved >= 0).all() and (ends[:, 1] >= 0).all() and (ends[0, 0] > 0 or not beyond_chance))

        def left(logs: list[Trajectory]) -> Violation | None:
            """Limits that runs leave further than what is in service."""
            found = (violation(self.problem, *each, self.problem.model) for each in zip(scenarios, logs, old))
            return next((one for one in found if one), None)

        old = best = driven(before)
        deployed, measured = before, dict[str, Any]()
        if told is not None and better(logs := driven(told), beyond_chance=True) and not left(logs):
            deployed, best, measured = told, logs, {"update": self.gain(logs[0], old[0])}
        if again is not None:
            logs = driven(again)
            gain, *elsewhere = (self.gain(*pair) for pair in zip(logs, old))
            lost = tuple(sum(int(log.diverged.sum()) for log in some) for some in (logs, old))
            tried = {"gain": gain, "elsewhere": dict(zip(others, elsewhere)), "violation": left(logs), "lost": lost}
            if better(logs, beyond_chance=doubtful) and not tried["violation"]:
                return again, tried
            if deployed is told:
                gains = {name: self.gain(*pair) for name, pair in zip(("as deployed", *others), zip(logs, best))}
                tried["beside"] = {name: one for name, one in gains.items() if one.ci95[1] < 0}
            measured |= tried
        return deployed, measured


def _doubtful(fit: PlantFit | IdentifiedChange) -> bool:
    """Whether a fit may mistake something."""
    return isinstance(fit, PlantFit) and fit.status is not FitStatus.SOLVED


def _designed(problem: CoDesignProblem, by: Any, design: ArrayLike | None, rng: np.random.Generator) -> Any:
    """Co-design; a policy learned on the state is judged there, and behind its filter by the real plant."""
    if problem.measurement is None or not isinstance(by, Learned) or by.history != 0:
        return codesign(problem, method=by, design=design, rng=rng)
    found: Any = codesign(replace(problem, measurement=None), method=by, design=design, rng=rng)
    return replace(found, memory=memory_at(problem, found.design, None))


def _by_logs(
    problem: CoDesignProblem, found: Sequence[FittedGeneration], updated: CoDesignProblem | None
) -> FittedGeneration | None:  # fmt: skip
    """What is deployed, with LQR or a filter by the logs; None without one."""
    deployed = found[-1]
    if updated is not None and isinstance(deployed.controller, Observed):
        estimator = estimator_at(updated, deployed.design)
        return replace(deployed, controller=Observed(deployed.controller.controller, estimator))
    logs = [one.log for one in found if np.array_equal(one.design, deployed.design)]  # none is carried to another
    if problem.measurement is None:
        with suppress(NotStabilisableError):
            return replace(deployed, controller=identified_lqr(problem, deployed.design, logs))
    return None
