"""Study of several uses, each with a design of its own, on sensors."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from ccdtools.arrays import ArrayField
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.disturbances.disturbance import Disturbance
from ccdtools.estimation.measurement import Measurement
from ccdtools.exceptions import InputError
from ccdtools.studies.real_plant import check_disturbance
from ccdtools.studies.study import Study
from ccdtools_ground.door import as_count, as_mapping, as_vector, shown

START = "start"  # the first design of a study, beside those of its uses


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SideBySide(Study):
    """Study of several uses, each with its own design and policy.

    A use may be a driver. Loops are closed on sensors alone. A run co-designs LQG and a policy of outputs for every
    use, then tries all designs in all uses on the real plant, under the disturbances that `real.held_out` has by the
    names of the uses.

    Attributes
    ----------
    uses : mapping of str to Disturbance
        What each design is made for.
    noise : (ny,) array
        Standard deviations of the sensors, which measure the outputs of the plant, or of the real one.
    history : int
        Last outputs and inputs that the policy sees.

    Raises
    ------
    InputError
        As of a `Study`; if a use has no held-out disturbance, there are no metrics, or the plants' outputs differ.
    """

    options_taken: ClassVar[tuple[str, ...]] = ("seed", "quick", "p0")
    runs_so: ClassVar[str] = "whose designs stand side by side"
    uses: Mapping[str, Disturbance]
    noise: ArrayField
    history: int = 8

    def __post_init__(self) -> None:
        uses = as_mapping("uses", self.uses, "a mapping of names to disturbances")
        if not uses:
            raise InputError("uses", "none", "at least one")
        for name, disturbance in uses.items():
            if name == START or not re.fullmatch(r"\w[\w .-]*", name):  # it names a folder, too
                raise InputError("uses", f"the name {shown(name)}", f"letters, digits, spaces and . _ -; not {START!r}")
            check_disturbance(f"uses[{name!r}]", disturbance, self.plant)
        self._set(uses=uses, history=as_count("history", self.history))
        self._set(noise=as_vector("noise", self.noise, self.plant.ny, of="one per output"))
        if (np.asarray(self.noise) <= 0).any():
            raise InputError("noise", shown(self.noise), "standard deviations above 0")
        super().__post_init__()
        if set(self.real.fresh) != set(uses):
            raise InputError("real.held_out", shown(list(self.real.fresh)), f"those of the uses: {', '.join(uses)}")
        if self.metrics is None or getattr(self.real.plant, "ny", 0) != self.plant.ny:
            raise InputError("metrics, real.plant", "no metrics, or other outputs", "both, with the model's outputs")

    @cached_property
    def problems(self) -> dict[str, CoDesignProblem]:
        """Co-design problem of every use, on the nominal model and its sensors."""
        own = self.problem()
        sensors = Measurement(self.plant, noise=self.noise)
        return {
            use: replace(own, scenarios=replace(self.scenarios, disturbance=disturbance), measurement=sensors)
            for use, disturbance in self.uses.items()
        }
