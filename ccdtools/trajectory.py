"""Trajectories of a simulation or a deployment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccdtools.arrays import Array, ArrayField, Immutable, Indices
from ccdtools.co_design.objective import Objective, as_objective
from ccdtools.exceptions import InputError
from ccdtools.table import data_frame
from ccdtools_ground.door import as_array


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Immutable):
    """Closed-loop runs, with read-only arrays.

    Attributes
    ----------
    states : (n, T + 1, nx) array
    inputs : (n, T, nu) array
        Inputs as applied.
    disturbances : (n, T, nw) array
    diverged_at : (n,) int array
        First step after which a run had left `limit`, or −1. Such a run is stopped there: its later states
        repeat the last one and its later inputs are zero.
    design : (np,) array
    dt : float
        Sampling time [s].
    outputs : (n, T, ny) array, optional
        What sensors told, where the controller listened.
    names : tuple of str
        Of states, then inputs, for pictures; x1, …, u1, … by default.
    times : (T + 1,) array, optional
        Of the samples as a recorder told them [s], which must be dt apart.

    Raises
    ------
    InputError
        If the arrays are not of such shapes, or hold no step, or the clock jumps.
    """

    states: Array
    inputs: Array
    disturbances: Array
    diverged_at: Indices
    design: Array
    dt: float
    outputs: ArrayField = None
    names: tuple[str, ...] = ()
    times: ArrayField = None

    def __post_init__(self) -> None:
        super().__post_init__()
        n, steps = self.inputs.shape[:2] if self.inputs.ndim == 3 else (-1, -1)
        shapes = (self.states.shape[:2], self.disturbances.shape[:2], self.diverged_at.shape)
        if shapes != ((n, steps + 1), (n, steps), (n,)) or self.states.ndim != 3 or self.disturbances.ndim != 3:
            got = f"shapes {self.states.shape}, {self.inputs.shape}, {self.disturbances.shape}"
            raise InputError("states, inputs, disturbances", got, "(n, T + 1, nx), (n, T, nu) and (n, T, nw)")
        if steps < 1:
            raise InputError("inputs", "runs of 0 steps", "at least one step")
        if self.times is not None:
            self._set(times=as_array("times", self.times, (steps + 1,)))
        check_clock("times", self.times, self.dt)

    def __repr__(self) -> str:
        n, steps, nu = self.inputs.shape
        sizes = f"{n} runs of {steps} steps, {self.states.shape[2]} states, {nu} inputs"
        return f"Trajectory({sizes}, dt = {self.dt:g} s, {int(self.diverged.sum())} diverged)"

    @property
    def diverged(self) -> NDArray[np.bool_]:
        """Diverged runs (n,): those that left the divergence limit."""
        return self.diverged_at >= 0

    @property
    def time(self) -> Array:
        """Sample times [s], (T + 1,)."""
        return self.dt * np.arange(self.states.shape[1], dtype=float)

    def plot(self, figure: Any = None) -> Any:
        """Plot states and inputs over time as a matplotlib Figure, at most 50 runs."""
        from ccdtools.plotting import plot_trajectory

        return plot_trajectory(self, figure)

    def to_frame(self) -> Any:
        """`pandas.DataFrame` of a row per run and sample; NaN after the end.

        Raises
        ------
        ImportError
            If pandas is not installed.
        """
        n, samples, _ = self.states.shape
        columns = {"run": np.repeat(np.arange(n), samples), "time": np.tile(self.time, n)}
        for letter, values in (("x", self.states), ("u", self.inputs), ("w", self.disturbances)):
            ended = np.full((n, samples - values.shape[1], values.shape[2]), np.nan)
            rows = np.concatenate([values, ended], axis=1).reshape(n * samples, -1)
            columns |= {f"{letter}{i + 1}": column for i, column in enumerate(rows.T)}
        return data_frame(columns, "Trajectory.to_frame", "take the arrays: time, states, inputs, disturbances")

    def rewards(self, objective: Objective) -> Array:
        """Rewards (n, T), without control cost after a run was stopped.

        The last one has what the end of the run adds, if it came to its end, and each its part of the cost of the
        design.
        """
        as_objective("objective", objective)
        objective.check(self.states.shape[2], self.inputs.shape[2], len(self.design))
        with np.errstate(over="ignore", invalid="ignore"):  # a lost run may cost more than a number holds
            rewards = objective.rewards(self.states[:, 1:], self.inputs, self.states[:, :-1], self.design)
            final = objective.final_rewards(self.states[:, -1], self.design)
        if final is not None:
            rewards[:, -1] += np.where(self.diverged, 0.0, final)
        steps = np.arange(rewards.shape[1])
        over = self.diverged[:, None] & (steps > self.diverged_at[:, None])
        return np.asarray(np.where(over, 0.0, rewards) - objective.cost_of_design(self.design, len(steps)) / len(steps))

    def returns(self, objective: Objective) -> Array:
        """Undiscounted returns (n,), less the cost of the design; see `diverged`."""
        return np.asarray(self.rewards(objective).sum(axis=1))

    def size_of(self, value: float, objective: Objective) -> float:
        """Size of a return of such runs, without the design cost."""
        return float(objective.made_by_control(value, self.design, self.inputs.shape[1]))


def check_clock(argument: str, times: Array | None, dt: float, cure: str = "") -> None:
    """Raise where samples of a recorder [s] are not dt apart."""
    steps = np.diff([] if times is None else times)
    wrong = np.flatnonzero(~np.isclose(steps, dt, rtol=0.01, atol=0.0))
    if len(wrong):
        got = f"{steps[wrong[0]]:g} s from sample {wrong[0]} to the next"
        raise InputError(argument, got, f"dt = {dt:g} s", f"Cut the log there. {cure}".rstrip())
