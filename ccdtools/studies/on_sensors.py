"""Study whose loops see sensors alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from ccdtools.arrays import ArrayField
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.risk import MEAN
from ccdtools.estimation.measurement import Measurement
from ccdtools.exceptions import InputError
from ccdtools.studies.price import ACCEPTED_LOSS, DEFAULT_PRICE
from ccdtools.studies.study import Study
from ccdtools_ground.door import as_count, as_vector, shown

LQG = "LQG"  # a baseline of every run
UNREAD = ("model_runs", "real_steps", "held_out_runs", "held_out_steps", "drift", "online", "quantile")  # settings


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class OnSensors(Study):
    """Study whose loops see sensors alone.

    Its generations go by fits, see `fitted_generations`: a policy learned on the state of the model is deployed behind
    the filter of the model, outputs and inputs are logged, `unknown` is fitted to them, and what the fit changes, first
    the filter and then policy and design, is tried on the real plant, in the mean of its returns: in as many runs of
    each drive as `StudyConfig.real_runs` says, 120 at most, a fifth of that in the quick form, and in as many fresh
    ones at the end, beside laws of the field.

    Attributes
    ----------
    noise : (ny,) array
        Standard deviations of the sensors, which measure the outputs of the plant, or of the real one.

    Raises
    ------
    InputError
        As of a `Study` and `fitted_generations`; if nothing is `unknown`, the plants' outputs differ, or something is
        stated that such a run does not use: a real plant that wears, a filter of inputs, prices of redesigns.
    """

    options_taken: ClassVar[tuple[str, ...]] = (
        "seed", "quick", "p0", "generations", "expert", "method", "design_gradient", "sets", "sets_time_limit",
    )  # fmt: skip
    runs_so: ClassVar[str] = "whose generations go by fits"
    noise: ArrayField

    def __post_init__(self) -> None:
        self._set(noise=as_vector("noise", self.noise, self.plant.ny, of="one per output"))
        if (np.asarray(self.noise) <= 0).any():
            raise InputError("noise", shown(self.noise), "standard deviations above 0")
        super().__post_init__()
        if self.unknown is None:
            raise InputError("unknown", "nothing", "a plant whose unknown entries the outputs can tell")
        if getattr(self.real.plant, "ny", 0) != self.plant.ny:
            raise InputError("real.plant", "one with other outputs", f"the {self.plant.ny} of the model")
        if LQG in self.laws:
            raise InputError("laws", f"the name {LQG!r}", "another: it is a baseline of every such run")
        plain = {
            "filter": (self.filter, "none"), "redesign_cost": (self.redesign_cost, None),
            "redesign_price": (self.redesign_price, DEFAULT_PRICE), "accept_loss": (self.accept_loss, ACCEPTED_LOSS),
            "risk": (self.risk, MEAN), "quantile_weight": (self.quantile_weight, None),
        }  # fmt: skip
        plain |= {f"settings[{name!r}]": (self.settings.get(name), None) for name in UNREAD}
        for name, (got, usual) in plain.items():
            if got != usual:
                raise InputError(name, shown(got), f"{usual!r}: a run {self.runs_so} uses no other")
        as_count("settings['real_runs']", self.settings.get("real_runs", 2), least=2)
        from ccdtools.studies.by_fit import FittedLoop  # learning is loaded where it is asked for

        FittedLoop(self.sensed, self.real, self.unknown)

    @cached_property
    def sensed(self) -> CoDesignProblem:
        """Co-design problem on the nominal model and its sensors."""
        return replace(self.problem(), measurement=Measurement(self.plant, noise=self.noise))
