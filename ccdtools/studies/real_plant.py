"""The real plant and how it is driven."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccdtools.arrays import ArrayField, Immutable
from ccdtools.disturbances.combinations import is_recorded
from ccdtools.disturbances.disturbance import Disturbance, Recorded
from ccdtools.exceptions import InputError
from ccdtools.plants.models import Simulable, as_simulable
from ccdtools.plants.plant import Plant
from ccdtools.studies.tolerances import MINIMUM_LOG
from ccdtools_ground.door import as_count, as_flag, as_instance, as_mapping, as_vector, has_method, shown


@dataclass(frozen=True, eq=False, repr=False)
class RealPlant(Immutable):
    """The real plant and how it is driven.

    Attributes
    ----------
    plant : Plant, SampledModel, BlackBox or anything else that `simulate` takes
        Nonlinear or linear, with the states, inputs and design of the model. A `Plant` takes `substeps` Runge–Kutta
        steps a sample, a model of one that `discretise` has made takes its own.
    disturbance : Disturbance
    x0 : (nx,) array
        Start of every run.
    runs : int
        Runs logged in a deployment.
    steps : int
        Length of a run.
    held_out : mapping of str to Disturbance, optional
        Disturbances by name that no deployment meets: fresh draws of each are driven at the end, beside the deployment,
        and by `fitted_generations` where a redesign is tried.
        By default `disturbance` drawn afresh, if a deployment is one run of it and it is no recording; of several runs
        the comparison on the real plant is fresh already.
    road : bool
        Whether the one disturbance is the vertical velocity of the road under a wheel [m/s]. Then the command line may
        replace it by a recorded or a generated drive (``--road``, ``--speed``, ``--driver``), and not otherwise.
    later : sequence of RealPlant
        What the second, third, … generation meets, by wear or in other surroundings; the last one stays. The loop is
        not told: with `drift` of `StudyConfig` a deployment in which nothing was redesigned tells it, and what was
        logged before is left out from there on.

    Raises
    ------
    InputError
        If a field is of another kind or size, or a deployment would log fewer than 500 samples.
    """

    plant: Simulable
    disturbance: Disturbance
    x0: ArrayField
    runs: int
    steps: int
    held_out: Mapping[str, Disturbance] | None = None
    road: bool = False
    later: tuple[RealPlant, ...] = ()

    def __post_init__(self) -> None:
        self._set(plant=as_simulable(self.plant, "real.plant"))
        if isinstance(self.plant, Plant) and not self.plant.linear:
            self._set(plant=self.plant.for_many_runs)
        self._set(x0=as_vector("real.x0", self.x0, self.plant.nx, of="one per state"))
        self._set(runs=as_count("real.runs", self.runs))
        self._set(steps=as_count("real.steps", self.steps))
        if self.runs * self.steps < MINIMUM_LOG:
            got = f"{self.runs} of {self.steps} steps"
            raise InputError("real.runs", got, f"at least {MINIMUM_LOG} samples to learn the discrepancy from")
        check_disturbance("real.disturbance", self.disturbance, self.plant)
        recorded = len(self.disturbance.signal) if isinstance(self.disturbance, Recorded) else self.steps
        if self.runs * recorded < MINIMUM_LOG:
            expected = f"at least {MINIMUM_LOG} to learn the discrepancy from"
            raise InputError("real.disturbance", f"{self.runs * recorded} samples", expected)
        if as_flag("real.road", self.road) and self.plant.nw != 1:
            raise InputError("real.road", f"True of {self.plant.nw} disturbances", "one, the road under one wheel")
        if self.held_out is not None:
            named = as_mapping("real.held_out", self.held_out, "a mapping of names to disturbances")
            for name, disturbance in named.items():
                if not isinstance(name, str) or not name.strip() or len(name.splitlines()) > 1:
                    raise InputError("real.held_out", shown(name), "names of one line")
                check_disturbance(f"real.held_out[{name!r}]", disturbance, self.plant)
            self._set(held_out=named)
        self._check_later()

    def _check_later(self) -> None:
        if not isinstance(self.later, list | tuple):
            raise InputError("real.later", shown(self.later), "a sequence of RealPlant")
        for one in self.later:
            as_instance("real.later", one, RealPlant, "a sequence of RealPlant")
            if one.later:
                raise InputError("real.later", "one with a `later` of its own", "all in one sequence")
            for name in ("runs", "steps"):
                if getattr(one, name) != getattr(self, name):
                    raise InputError("real.later", f"{getattr(one, name)} {name}", f"{getattr(self, name)}, as before")
        self._set(later=tuple(self.later))

    def each(self, **changes: Any) -> RealPlant:
        """This plant, and what comes later, with changes."""
        return replace(self, **changes, later=tuple(replace(one, **changes) for one in self.later))

    def met_by(self, generation: int) -> RealPlant:
        """Real plant that a generation meets, from 1 on."""
        return (self, *self.later)[min(generation - 1, len(self.later))]

    @property
    def fresh(self) -> dict[str, Disturbance]:
        """Held-out disturbances by name; empty if none can be drawn afresh."""
        if self.held_out is not None:
            return dict(self.held_out)
        return {} if self.runs > 1 or is_recorded(self.disturbance) else {"fresh draws": self.disturbance}

    def __repr__(self) -> str:
        return f"RealPlant({self.plant!r}, {self.runs} runs of {self.steps} steps)"


def check_disturbance(argument: str, disturbance: Disturbance, plant: Simulable, steps: int = 2) -> None:
    """Raise unless samples have the plant's channels."""
    has_method(argument, disturbance, "sample", "an object with sample(runs, steps, rng)")
    try:
        drawn = np.asarray(disturbance.sample(1, steps, np.random.default_rng(0)))
    except InputError as error:
        raise InputError(f"{argument}: {error.argument}", error.got, error.expected, error.cure) from None
    except Exception as error:
        stops = f"stops with {type(error).__name__}: {error}"
        reason = f"a {type(disturbance).__name__} whose sample(1, {steps}, rng) {stops}"
        raise InputError(argument, " ".join(reason.split()), f"samples of shape (1, {steps}, {plant.nw})") from error
    if drawn.shape != (1, steps, plant.nw):
        got = f"samples of shape {drawn.shape}"
        if drawn.ndim == 3:
            got = f"{drawn.shape[2]} channel{'' if drawn.shape[2] == 1 else 's'}"
        raise InputError(argument, got, f"{plant.nw}, one per disturbance of the plant")
    if drawn.dtype.kind not in "iuf" or not np.isfinite(drawn).all():
        raise InputError(argument, "a sample that is not a finite number", "finite samples")
