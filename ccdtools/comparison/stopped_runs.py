"""Runs of a scenario of which some stopped with an error."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ccdtools.arrays import Array, Mask
from ccdtools.scenario import Scenario
from ccdtools.trajectory import Trajectory


class Runs(NamedTuple):
    """Runs of a scenario: those that stopped stand at their start, as lost ones."""

    run: Trajectory
    stopped: Mask  # (n,)
    times: Array  # (k,): of single calls of the controller [s]
    why: str = ""  # the first one stopped


def stopped_runs(scenario: Scenario, p: Array, why: str) -> Runs:
    """Runs of a scenario none of which came to its end."""
    n, steps, _ = scenario.disturbance.shape
    states = np.repeat(scenario.x0[:, None], steps + 1, axis=1)
    inputs = np.zeros((n, steps, scenario.plant.nu))
    run = Trajectory(states, inputs, scenario.disturbance, np.zeros(n, dtype=int), p, scenario.plant.dt)
    return Runs(run, np.ones(n, dtype=bool), np.zeros(0), why)


def joined(one: Runs, other: Runs) -> Runs:
    """Runs of two parts of a scenario, one after the other."""
    parts = (one.run, other.run)
    heard = next((part.outputs for part in parts if part.outputs is not None), None)
    unheard = None if heard is None else [np.full((len(part.states), *heard.shape[1:]), np.nan) for part in parts]
    run = Trajectory(
        np.concatenate([part.states for part in parts]),
        np.concatenate([part.inputs for part in parts]),
        np.concatenate([part.disturbances for part in parts]),
        np.concatenate([part.diverged_at for part in parts]),
        one.run.design,
        one.run.dt,
        None if unheard is None else np.concatenate(
            [nothing if part.outputs is None else part.outputs for part, nothing in zip(parts, unheard)]
        ),
        one.run.names or other.run.names,
    )  # fmt: skip
    times = one.times if len(one.times) else other.times
    return Runs(run, np.concatenate([one.stopped, other.stopped]), times, one.why or other.why)
