"""Law of the state and a preview, on the original plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.signals import Around, as_controller, needs_of
from ccdtools.exceptions import InputError
from ccdtools.plants.preview import as_channels, previewed_state
from ccdtools_ground.door import as_count, as_floats

TAKEN = ("preview", "reference")  # signals of a horizon, of which a loop knows one


@dataclass(frozen=True, eq=False, repr=False)
class Previewing(Around):
    """Law of (x, w_k, …, w_{k+N−1}) on the plant without the register of `with_preview(model, N)`.

    It asks the loop for N samples of preview, and runs in `simulate`, `compare` and `deploy`. Beyond the end of a
    record its last sample is held.

    Parameters
    ----------
    controller : callable
        Of the augmented state (n, nx + N·channels): a gain, an MPC, a learned policy.
    steps : int
        N, as the model of the controller has it.
    channels : sequence of int, optional
        Which disturbances it sees, from 0; all by default.

    Raises
    ------
    InputError
        If an argument is of the wrong kind, or the controller itself needs a preview or a reference.

    Examples
    --------
    >>> run = simulate(plant, Previewing(result.policy, 10), x0=x0, steps=100, disturbance=w, design=result.design)
    """

    passed_on: ClassVar[tuple[str, ...]] = ("design", "reset", "agent", "loop")
    controller: Controller
    steps: int
    channels: Sequence[int] | None = None

    def __post_init__(self) -> None:
        self._set(controller=as_controller(self.controller))
        taken = sorted(needs_of(self.controller) & set(TAKEN))
        if taken:
            raise InputError("controller", f"one that needs {' and '.join(taken)} itself", "one of the state (x, w)")
        self._set(steps=as_count("steps", self.steps))
        if self.channels is not None:
            largest = max(map(int, self.channels), default=0)
            self._set(channels=as_channels(self.channels, largest + 1))

    def __repr__(self) -> str:
        return f"Previewing({self.controller!r}, {self.steps} samples ahead)"

    @property
    def needs(self) -> frozenset[str]:
        """Signals needed: a preview, and the controller's own."""
        return frozenset({"preview"}) | needs_of(self.controller)

    @property
    def horizon(self) -> int:
        """Number of samples of preview."""
        return self.steps

    def __call__(self, x: ArrayLike, *, w: ArrayLike, **signals: Any) -> Array:
        """Inputs (n, nu) for states (n, nx) and preview w (n, N, nw), or one run's."""
        states = as_floats("x", x)
        ahead = as_floats("w", w)
        if ahead.ndim != states.ndim + 1 or ahead.shape[-2] != self.steps:
            raise InputError("w", f"shape {ahead.shape}", f"({self.steps}, nw) for each state")
        if self.channels is not None and max(self.channels) >= ahead.shape[-1]:
            raise InputError("w", f"{ahead.shape[-1]} channels", f"more than {max(self.channels)}, as channels says")
        return np.asarray(self.controller(previewed_state(states, ahead, self.channels), **signals))
