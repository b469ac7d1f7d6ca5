"""How the numbers that people mean changed between two controllers, each with its interval."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.comparison.metrics import Metrics, metrics_of
from ccdtools.exceptions import InputError
from ccdtools.statistics import PairedDifference, paired_difference
from ccdtools.trajectory import Trajectory

MATTERS = 0.005  # Part of a metric's size below which a change of it does not matter [-].
BATCHES = 20  # Stretches that one long run is cut into, each of which counts as a run [-].
MOST_RUNS = 200  # Runs that the interval of a change is built from [-].


@dataclass(frozen=True)
class MetricChange:
    """One metric under two controllers that met the same disturbances.

    Attributes
    ----------
    name : str
        With its unit, as the metrics of the study name it.
    before, after : float
        Over all runs that neither controller lost.
    change : PairedDifference
        After minus before, with the 95 % interval over runs, or over stretches of the only one.
    word : {"better", "worse", "same", "open"}
        Better and worse: the interval excludes zero and the change is at least 0.5 % of `before`. Same: the interval
        lies within ± 0.5 % of it.
    """

    name: str
    before: float
    after: float
    change: PairedDifference
    word: str

    @property
    def relative(self) -> tuple[float, float, float] | None:
        """The change and its interval as parts of `before`; None where that is zero."""
        if not self.before:
            return None
        mean, low, high = (value / abs(self.before) for value in (self.change.mean, *self.change.ci95))
        return mean, low, high


def metric_changes(metrics: Metrics, before: Trajectory, after: Trajectory) -> tuple[MetricChange, ...]:
    """The change of every metric between two sets of runs on the same disturbances.

    Smaller is better, but for the names in ``metrics.larger_is_better``, where the function has such an attribute.

    Parameters
    ----------
    metrics : function
        `Trajectory` → mapping of names to numbers, such as a `Ride`.
    before, after : Trajectory
        As many runs of as many steps; those that either lost are left out.

    Raises
    ------
    InputError
        If the runs do not pair, or the metrics are no mapping of names to numbers.
    """
    if before.inputs.shape[:2] != after.inputs.shape[:2]:
        sizes = f"{before.inputs.shape[:2]} and {after.inputs.shape[:2]} (runs, steps)"
        raise InputError("before, after", sizes, "as many runs of as many steps")
    kept = np.flatnonzero(~(before.diverged | after.diverged))
    if not len(kept):
        return ()
    pair = [_part(run, kept, slice(None)) for run in (before, after)]
    whole = [metrics_of(metrics, run) for run in pair]
    units = [list(zip(*(metrics_of(metrics, unit).values() for unit in _units(run)))) for run in pair]
    larger = frozenset(getattr(metrics, "larger_is_better", ()))
    return tuple(
        _change(name, whole[0][name], whole[1][name], np.array(first), np.array(second), name in larger)
        for name, first, second in zip(whole[0], *units, strict=True)
    )


def _change(name: str, before: float, after: float, first: Array, second: Array, larger: bool) -> MetricChange:
    """The change of one metric, from its value on all runs and on each."""
    spread = paired_difference(second, first)
    change = after - before
    low, high = (change + end - spread.mean for end in spread.ci95)
    floor = MATTERS * abs(before)
    word = "open"
    if -floor <= low and high <= floor:
        word = "same"
    elif abs(change) >= floor and (low > 0 or high < 0):
        word = "better" if (change > 0) == larger else "worse"
    return MetricChange(name, before, after, PairedDifference(change, (low, high)), word)


def _units(run: Trajectory) -> Iterator[Trajectory]:
    """Single runs, or consecutive stretches of the only one."""
    runs, steps = run.inputs.shape[:2]
    if runs > 1:
        for i in range(min(runs, MOST_RUNS)):
            yield _part(run, slice(i, i + 1), slice(None))
        return
    edges = np.linspace(0, steps, min(BATCHES, steps) + 1).astype(int)
    for start, end in pairwise(edges):
        yield _part(run, slice(None), slice(start, end))


def _part(run: Trajectory, runs: Any, steps: slice) -> Trajectory:
    """Some of the runs, over some of the steps."""
    start, end, _ = steps.indices(run.inputs.shape[1])
    return replace(
        run, states=run.states[runs, start : end + 1], inputs=run.inputs[runs, start:end],
        disturbances=run.disturbances[runs, start:end], diverged_at=run.diverged_at[runs],
    )  # fmt: skip
