"""Generations of a problem with sensors: deployed, fitted to outputs, redesigned."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t

from ccdtools.arrays import Array
from ccdtools.checks import as_count, as_generator, as_instance
from ccdtools.co_design.closed_loop import closed_loop_returns
from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.controllers import Controller
from ccdtools.estimation.measurement import Measurement
from ccdtools.exceptions import InputError
from ccdtools.plants.plant import Plant
from ccdtools.scenario import Scenario
from ccdtools.statistics import PairedDifference, paired_difference
from ccdtools.studies.budgets import REAL_RUNS
from ccdtools.studies.real_plant import RealPlant
from ccdtools.trajectory import Trajectory
from ccdtools.twin.deployment import deploy
from ccdtools.twin.output_fit import FitStatus, OutputFit, fit_outputs
from ccdtools.twin.replay import updated_problem


@dataclass(frozen=True, eq=False, repr=False)
class SensorGeneration:
    """Generation on sensors, and what it gained.

    Attributes
    ----------
    design : (np,) array
    controller : callable
        Of outputs, as deployed.
    fit : OutputFit or None
        What all former logs told; None of the first generation.
    predicted, gain : PairedDifference or None
        Return of the redesign above what was deployed before: on the updated model, and on fresh common runs of the
        real plant. None of the first generation; without a prediction where the fit told too little for a redesign.
    accepted : bool
        Whether the redesign was deployed; else what was deployed before stays.
    log : Trajectory
        Of the deployment, with its outputs.
    """

    design: Array
    controller: Controller
    fit: OutputFit | None
    predicted: PairedDifference | None
    gain: PairedDifference | None
    accepted: bool
    log: Trajectory

    def __str__(self) -> str:
        """Decision and gain in a sentence."""
        if self.fit is None:
            return f"first design {np.round(self.design, 4)}"
        if self.predicted is None:
            return f"no redesign: {self.fit.advice}"
        promised = "predicted {:+.4g} [{:.4g}, {:.4g}]".format(self.predicted.mean, *self.predicted.ci95)
        if not self.accepted or self.gain is None:
            return f"redesign refused: {promised}"
        measured = "{:+.4g} [{:.4g}, {:.4g}]".format(self.gain.mean, *self.gain.ci95)
        return f"redesign {np.round(self.design, 4)}: {promised}, on the real plant {measured}"


def generations_on_sensors(
    problem: CoDesignProblem, real: RealPlant, *, method: Any = "nested", generations: int = 2,
    design: ArrayLike | None = None, plant: Plant | None = None, fit_noise: bool = False, draws: int = 20,
    rng: np.random.Generator,
) -> tuple[SensorGeneration, ...]:  # fmt: skip
    """Generations of a problem with sensors, on a real plant.

    Each is deployed and its outputs logged. The plant that all logs tell (`fit_outputs`) is designed for again, and the
    redesign deployed if a gain is predicted whose interval lies above 0.

    Parameters
    ----------
    problem : CoDesignProblem
        With a `measurement`.
    real : RealPlant
        Its outputs are measured where the problem's are those of a Plant and it has some.
    method : str or Method
        Of `codesign`, such as ``Nested("lqg")``; it designs every generation.
    generations : int
    design : (np,) array_like, optional
        Where the first search starts, as of `codesign`.
    plant, fit_noise
        Of `fit_outputs`.
    draws : int
        Plants drawn from what is known of the parameters, at least 2, for the interval of a prediction.
    rng : numpy.random.Generator

    Returns
    -------
    tuple of SensorGeneration

    Raises
    ------
    InputError
        As `fit_outputs`, `codesign` and `deploy`; also without a measurement.

    Examples
    --------
    >>> for one in generations_on_sensors(problem, real, method=Nested("lqg"), rng=rng):  # doctest: +SKIP
    ...     print(one)
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_instance("real", real, RealPlant, "a RealPlant")
    as_generator("rng", rng)
    as_count("draws", draws, least=2)
    if problem.measurement is None:
        raise InputError("problem", "one without sensors", "CoDesignProblem(measurement=…); a Study sees the states")
    runs = max(REAL_RUNS * problem.steps // real.steps, 2)
    where = _RealLoop(problem, real, real.disturbance.sample(runs, real.steps, rng), int(rng.integers(2**31)))
    first = codesign(problem, method=method, design=design, rng=rng)
    found = [where.deployed(first, rng)]
    for _ in range(1, as_count("generations", generations)):
        before = found[-1]
        fit = fit_outputs(problem, [one.log for one in found], plant=plant, fit_noise=fit_noise)
        if fit.status not in (FitStatus.SOLVED, FitStatus.AT_BOUND):
            found.append(where.deployed(before, rng, fit))
            continue
        again = codesign(updated_problem(problem, fit), method=method, design=before.design, rng=rng)
        predicted = _predicted(problem, fit, again, before, draws, rng)
        better = predicted.ci95[0] > 0
        gain = where.gain(again, before) if better else None
        found.append(where.deployed(again if better else before, rng, fit, predicted, gain))
    return tuple(found)


def _predicted(
    problem: CoDesignProblem, fit: OutputFit, one: Any, other: Any, draws: int, rng: np.random.Generator
) -> PairedDifference:  # fmt: skip
    """Return of one above the other's on the plant of a fit.

    Its interval has the runs in it and what is not known of the parameters: the spread over plants drawn from the fit.
    It has no end where one loses more runs than the other.
    """
    seed = int(rng.integers(2**31))

    def gains(updated: CoDesignProblem, runs: int | None) -> Array:
        """Gains of runs, the same on all plants; none where one loses more."""
        after, before = (
            closed_loop_returns(updated, of.controller, of.design, np.random.default_rng(seed), runs=runs)
            for of in (one, other)
        )
        return (after.values - before.values)[~(after.lost | before.lost) & (after.lost_share <= before.lost_share)]

    drawn = [gains(updated, REAL_RUNS // draws) for updated in fit.drawn(problem, draws, rng)]
    whole = gains(updated_problem(problem, fit), None)
    if not len(whole) or not all(map(len, drawn)):
        return PairedDifference(float("nan"), (-np.inf, np.inf))
    found = paired_difference(whole, np.zeros(len(whole)))
    spread = float(np.std([part.mean() for part in drawn], ddof=1))
    half = np.hypot((found.ci95[1] - found.ci95[0]) / 2, t.ppf(0.975, draws - 1) * spread)
    return PairedDifference(found.mean, (found.mean - half, found.mean + half))


@dataclass(frozen=True, eq=False)
class _RealLoop:
    """Real plant behind the sensors of a problem, and the disturbance of common runs."""

    problem: CoDesignProblem
    real: RealPlant
    disturbance: Array
    seed: int

    @property
    def sensors(self) -> Measurement:
        """Sensors of the problem, on the outputs of the real plant if they are a plant's."""
        own: Measurement = self.problem.measurement
        plant = self.real.plant
        seen = isinstance(own.output, Plant) and isinstance(plant, Plant) and plant.ny > 0
        return replace(own, output=plant) if seen else own

    def deployed(
        self, of: Any, rng: np.random.Generator, fit: OutputFit | None = None,
        predicted: PairedDifference | None = None, gain: PairedDifference | None = None,
    ) -> SensorGeneration:  # fmt: skip
        """Generation with its log, of a result or of what was deployed before."""
        real = self.real
        w = real.disturbance.sample(real.runs, real.steps, rng)
        log = deploy(
            real.plant, of.controller, of.design, w, x0=real.x0, limit=self.problem.limit, output=self.sensors, rng=rng
        )
        accepted = fit is None or gain is not None
        return SensorGeneration(of.design, of.controller, fit, predicted, gain, accepted, log)

    def gain(self, one: Any, other: Any) -> PairedDifference:
        """Return of one above the other's on common runs that neither loses."""
        scenario = Scenario(self.real.plant, self.real.x0, self.disturbance, output=self.sensors, seed=self.seed)
        runs = [scenario.run(of.controller, design=of.design, limit=self.problem.limit) for of in (one, other)]
        kept = ~(runs[0].diverged | runs[1].diverged)
        after, before = (run.returns(self.problem.objective)[kept] for run in runs)
        return paired_difference(after, before)
