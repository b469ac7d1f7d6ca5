"""Experiments: what was measured, and what is known of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ccdtools_ground.door import brief, frozen
from ccdtools_ground.user_functions import stopped
from mpc.checks import Array, Flags, as_array, as_floats
from mpc.exceptions import InputError
from mpc.tolerances import LEAST_INTERVAL


@dataclass(frozen=True, eq=False)
class Experiment:
    """Measured outputs over time, with inputs and the start.

    Parameters
    ----------
    times : (n,) array
        Rising [s]. The experiment begins at the first: with a row of NaN where nothing was measured there.
    outputs : (n, ny) array
        NaN where an output was not measured.
    inputs : (n, nu) array, or function of times (k,) → (k, nu), or (k,) of one input; optional
        A row of a table is held from its time to the next; an output sees what was held until then.
    start : (nx,) array, or bounds (lower, upper) as a tuple; optional
        Of the states at the first time; None or NaN where one is free, and estimated.
    guess : (n, nx) array, optional
        States to start from; what the outputs alone say of them by default.

    Raises
    ------
    InputError
        If times do not rise, sizes differ, nothing was measured, or inputs have gaps.
    """

    times: Any
    outputs: Any
    inputs: Any = None
    start: Any = None
    guess: Any = None

    def __post_init__(self) -> None:
        times, outputs = as_array("times", self.times, (None,)), as_floats("outputs", self.outputs)
        outputs = outputs[:, None] if outputs.ndim == 1 else outputs
        n = len(times)
        if n < 2 or (np.diff(times) <= 0).any():
            raise InputError("times", brief(str(times.tolist())), "at least two finite times that rise")
        if outputs.ndim != 2 or len(outputs) != n or not outputs.shape[1]:
            raise InputError("outputs", f"shape {outputs.shape}", f"({n}, ny), one row a time")
        if np.isinf(outputs).any():
            raise InputError("outputs", "infinite values", "finite ones, NaN where nothing was measured")
        if np.isnan(outputs).all():
            raise InputError("outputs", "nothing but NaN", "at least one measured value")
        set_ = object.__setattr__
        set_(self, "times", times)
        set_(self, "outputs", frozen(outputs))
        if self.inputs is not None and not callable(self.inputs):
            inputs = as_floats("inputs", self.inputs)
            inputs = inputs[:, None] if inputs.ndim == 1 else inputs
            if not np.isfinite(inputs).all():
                cure = "Fill gaps: what was applied is known, or state it as a function of time."
                raise InputError("inputs", "numbers that are not finite", "finite ones", cure)
            set_(self, "inputs", as_array("inputs", inputs, (n, "nu")))
        if self.guess is not None:
            set_(self, "guess", as_array("guess", self.guess, (n, None)))

    @property
    def measured(self) -> Flags:
        """Which of the outputs (n, ny) were measured."""
        return np.asarray(~np.isnan(self.outputs))

    @property
    def duration(self) -> float:
        """Time from the first to the last row [s]."""
        return float(self.times[-1] - self.times[0])

    @property
    def inputs_seen(self) -> Array:
        """Inputs (n, nu) that the outputs see."""
        return np.zeros((len(self.times), 0)) if self.signal is None else np.asarray(self.signal(self.times))

    @cached_property
    def signal(self) -> Callable[[Array], Array] | None:
        """Inputs as a function of time, a table's until its next row."""
        if self.inputs is None:
            return None
        times, table, stated = self.times, self.inputs, self.inputs

        def held(at: Array) -> Array:
            """Inputs (k, nu) at times (k,)."""
            rows = np.searchsorted(times, at - LEAST_INTERVAL * self.duration) - 1
            return np.asarray(table[np.clip(rows, 0, len(table) - 1)])

        def checked(at: Array) -> Array:
            """Inputs (k, nu) at times (k,), by a user's function."""
            try:
                values = stated(at)
            except Exception as error:  # the function is the user's: whatever it raises is told with what is expected
                raise stopped("inputs", stated, error, "a function of times (k,)") from error
            values = as_floats("inputs", values)
            return as_array("inputs", values[:, None] if values.shape == at.shape else values, (len(at), "nu"))

        return checked if callable(stated) else held


def as_experiments(value: Any) -> tuple[Experiment, ...]:
    """Experiments, at least one, with the same outputs."""
    given = (value,) if isinstance(value, Experiment) else value
    if not isinstance(given, list | tuple) or not given or not all(isinstance(one, Experiment) for one in given):
        raise InputError("experiments", brief(repr(value)), "an Experiment, or a list of them")
    for what, kept in (("outputs", [one.outputs for one in given]), ("inputs", [one.inputs_seen for one in given])):
        sizes = {table.shape[1] for table in kept}
        if len(sizes) > 1:
            raise InputError("experiments", f"{sorted(sizes)} {what}", f"as many {what} in each")
    return tuple(given)


def whitened(outputs: Array, covariance: Array) -> Array:
    """Rows [y, vec M] of outputs (n, ny), M y of unit noise.

    NaN has no part in M y; of outputs that were measured M is the inverse Cholesky factor of their own covariance.
    """
    n, ny = outputs.shape
    seen = ~np.isnan(outputs)
    own = np.where(seen[:, :, None] & seen[:, None, :], covariance, np.eye(ny))
    M = np.linalg.inv(np.linalg.cholesky(own)) * seen[:, :, None]
    return np.hstack([np.where(seen, outputs, 0.0), M.transpose(0, 2, 1).reshape(n, -1)])
