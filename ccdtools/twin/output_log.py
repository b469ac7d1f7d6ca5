"""Logged outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ccdtools.arrays import ArrayField, Immutable
from ccdtools.co_design.measured import kalman_filter
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.exceptions import InputError
from ccdtools.plants.plant import Plant
from ccdtools.trajectory import Trajectory, check_clock
from ccdtools.twin.residuals import warn_of_outside
from ccdtools.twin.stuck_sensors import warn_of_stuck
from ccdtools_ground.door import as_array, as_finite, as_floats, shown


@dataclass(frozen=True, eq=False)
class OutputLog(Immutable):
    """Logged outputs and inputs of several runs.

    A `Trajectory` of a loop with sensors is one, too.

    Parameters
    ----------
    outputs : (n, T, ny) array_like
        NaN where a sensor told nothing; of one run also (T, ny).
    inputs : (n, T, nu) array_like
        As applied from each sample to the next.
    design : (np,) array_like
    times : (T,) array_like, optional
        Of the samples [s]: where they are given the clock is held against the sampling time of the model.
    """

    outputs: ArrayField
    inputs: ArrayField
    design: ArrayField
    times: ArrayField = None

    def __post_init__(self) -> None:
        for name in ("outputs", "inputs"):
            rows = as_floats(name, getattr(self, name))
            self._set(**{name: rows[None] if rows.ndim == 2 else rows})
        if self.outputs.ndim != 3 or np.isinf(self.outputs).any():
            raise InputError("outputs", f"shape {self.outputs.shape}", "(n, T, ny), NaN in gaps and else finite")
        n, steps = self.outputs.shape[:2]
        if self.inputs.ndim != 3 or self.inputs.shape[:2] != (n, steps):
            raise InputError("inputs", f"shape {self.inputs.shape}", f"({n}, {steps}, nu), as many as outputs")
        as_finite("inputs", self.inputs)
        if self.times is not None:
            self._set(times=as_array("times", self.times, (steps,)))


def as_output_log(argument: str, log: Any, problem: CoDesignProblem) -> OutputLog:
    """Log of the problem's sizes, without runs that diverged."""
    outputs = log.outputs if isinstance(log, OutputLog | Trajectory) else None
    if outputs is None:
        expected = "a Trajectory with outputs, as of deploy(…, output=problem.measurement), or an OutputLog"
        raise InputError(argument, shown(log), expected)
    kept = ~np.asarray(getattr(log, "diverged", np.zeros(len(outputs), dtype=bool)))
    if not kept.any():
        raise InputError(argument, f"{len(kept)} runs that all diverged", "at least one that did not")
    p = problem.design.check_one(log.design, argument=f"{argument}.design")
    found = OutputLog(outputs[kept], log.inputs[kept], p)
    if isinstance(log, OutputLog):
        check_clock(f"{argument}.times", log.times, problem.model.dt, "Or put NaN where samples are missing.")
    elif not np.isclose(log.dt, problem.model.dt):
        raise InputError(argument, f"dt = {log.dt:g} s", f"dt = {problem.model.dt:g} s of the model")
    stated = problem.measurement.output
    sizes = (found.outputs.shape[2], found.inputs.shape[2])
    asked = (stated.ny if isinstance(stated, Plant) else len(stated), problem.model.nu)
    if sizes != asked:
        raise InputError(argument, f"{sizes[0]} outputs and {sizes[1]} inputs", f"{asked[0]} and {asked[1]}")
    warn_of_outside("inputs", "U", problem.input_limits(p), found.inputs)
    names = output_names(problem)
    warn_of_stuck(argument, found.outputs, found.inputs, names, lambda: np.sqrt(np.diag(kalman_filter(problem, p).V)))
    return found


def output_names(problem: CoDesignProblem) -> Sequence[str]:
    """Names of the outputs that sensors measure."""
    stated: Any = problem.measurement
    plant = isinstance(stated.output, Plant)
    return stated.output.output_names if plant else [f"y{j + 1}" for j in range(len(stated.output))]
