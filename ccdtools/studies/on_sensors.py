"""Generations of a problem with sensors: deployed, fitted to outputs, redesigned."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

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
    design: ArrayLike | None = None, plant: Plant | None = None, fit_noise: bool = False, rng: np.random.Generator,
) -> tuple[SensorGeneration, ...]:  # fmt: skip
    """Generations of a problem with sensors, on a real plant.

    Each is deployed and its outputs logged. The plant that all logs tell (`fit_outputs`) is designed for again, and the
    redesign deployed if the updated model predicts a gain whose interval lies above 0.

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
        updated = updated_problem(problem, fit)
        again = codesign(updated, method=method, design=before.design, rng=rng)
        seed = int(rng.integers(2**31))
        after, now = (closed_loop_returns(updated, one.controller, one.design, np.random.default_rng(seed))
                      for one in (again, before))  # fmt: skip
        kept = ~(after.lost | now.lost)
        predicted = paired_difference(after.values[kept], now.values[kept])
        better = predicted.ci95[0] > 0 and after.lost_share <= now.lost_share
        gain = where.gain(again, before) if better else None
        found.append(where.deployed(again if better else before, rng, fit, predicted, gain))
    return tuple(found)


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
