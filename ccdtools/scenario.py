"""Scenarios: the common conditions of a comparison."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import ArrayField, Immutable
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.signals import Reference
from ccdtools.estimation.measurement import Measurement, Sensor
from ccdtools.exceptions import InputError
from ccdtools.plants.models import as_simulable
from ccdtools.simulation import as_output, as_reference, matched_runs, simulate
from ccdtools.trajectory import Trajectory
from ccdtools_ground.door import as_count, as_floats


@dataclass(frozen=True, eq=False, repr=False)
class Scenario(Immutable):
    """Plant with initial states and disturbances, the same for every controller.

    Parameters
    ----------
    plant : Plant, LinearModel or TwinPlant
    x0 : (nx,) or (n, nx) array_like
        Initial states, one per run.
    disturbance : (T, nw) or (n, T, nw) array_like
        Its length is that of the runs.
    reference : Reference or (nx,) or (T, nx) array_like, optional
        What tracking controllers follow.
    output : Measurement, or (ny, nx) array_like, Plant, or callable, optional
        What is measured, for controllers that need it, see `simulate`. Its noise is drawn once, from `seed`: every
        controller meets the same one, run by run.
    seed : int, optional
        Required by random noise of the measurement.

    Raises
    ------
    InputError
        If the shapes disagree with each other or with the plant, or a seed is missing.
    """

    plant: Any
    x0: ArrayField
    disturbance: ArrayField
    reference: Reference | ArrayField = None
    output: Any = None
    seed: int | None = None

    def __post_init__(self) -> None:
        plant = as_simulable(self.plant)
        w = as_floats("disturbance", self.disturbance)
        steps = w.shape[-2] if w.ndim > 1 else len(np.atleast_1d(w))
        x0, w = matched_runs(plant, self.x0, self.disturbance, max(steps, 1))
        output = self._measured(as_output(plant, self.output), *w.shape[:2])
        self._set(plant=plant, x0=x0, disturbance=w, reference=as_reference(plant, self.reference), output=output)

    def _measured(self, output: Measurement | None, runs: int, steps: int) -> Measurement | None:
        """Measurement with its noise drawn for all runs."""
        seed = None if self.seed is None else as_count("seed", self.seed, least=0)
        if output is None:
            return output
        if output.random and seed is None:
            raise InputError("seed", "nothing", "a whole number, from which the noise of the measurement is drawn")
        return output.drawn(runs, steps, np.random.default_rng(seed))

    def __repr__(self) -> str:
        return f"Scenario({type(self.plant).__name__}, {len(self.x0)} runs of {self.steps} steps)"

    @property
    def steps(self) -> int:
        """Length of the runs."""
        return int(self.disturbance.shape[1])

    def sensor(self, p: ArrayLike = ()) -> Sensor | None:
        """Sensor of the first run, at a design (np,)."""
        if self.output is None:
            return None
        first: Measurement = self.output.first(1, self.steps)
        return first.sensor(self.plant, np.asarray(p, dtype=float), 1, self.steps, None)

    def first(self, runs: int, steps: int | None = None) -> Scenario:
        """Scenario of the first `runs` runs and `steps` steps."""
        return self.part(slice(as_count("runs", runs)), steps)

    def part(self, runs: slice, steps: int | None = None) -> Scenario:
        """Scenario of some of its runs and the first `steps` steps."""
        length = self.steps if steps is None else as_count("steps", steps)
        output = None if self.output is None else self.output.part(runs, length)
        return Scenario(self.plant, self.x0[runs], self.disturbance[runs, :length], self.reference, output, self.seed)

    def run(
        self, controller: Controller, *, design: ArrayLike | None = None, limit: ArrayLike | None = None,
        progress: bool = False,
    ) -> Trajectory:  # fmt: skip
        """Closed-loop trajectories under a controller; see `simulate`."""
        return simulate(
            self.plant, controller, x0=self.x0, steps=self.steps, disturbance=self.disturbance, design=design,
            limit=limit, reference=self.reference, output=self.output, progress=progress,
        )  # fmt: skip
