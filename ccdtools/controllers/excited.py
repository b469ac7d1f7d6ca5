"""Controllers with a little noise on their inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ccdtools.arrays import Array
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.signals import Around, needs_of


@dataclass(frozen=True, eq=False, repr=False)
class Excited(Around):
    """Another controller's inputs plus a signal (T, nu), within limits."""

    passed_on: ClassVar[tuple[str, ...]] = ("horizon", "design", "reset", "loop")
    controller: Controller
    signal: Array
    lower: Array
    upper: Array

    @property
    def needs(self) -> frozenset[str]:
        """Signals that the other needs, and the time."""
        return needs_of(self.controller) | {"time"}

    def __call__(self, x: Array, *, time: int = 0, **signals: Any) -> Array:
        """Excited inputs (n, nu) or (nu,)."""
        known = {"time": time} if "time" in needs_of(self.controller) else {}
        inputs = np.asarray(self.controller(x, **known, **signals))
        return np.asarray(np.clip(inputs + self.signal[time], self.lower, self.upper))
