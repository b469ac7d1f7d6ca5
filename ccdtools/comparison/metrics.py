"""User-defined metrics beside the returns, and their changes between controllers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np

from ccdtools.arrays import Array
from ccdtools.evidence.percent import word_of_change
from ccdtools.exceptions import CCDError, InputError
from ccdtools.statistics import PairedDifference, paired_difference
from ccdtools.tolerances import NOT_WORSE
from ccdtools.trajectory import Trajectory
from ccdtools_ground.door import as_mapping, shown
from ccdtools_ground.user_functions import stopped

Metrics: TypeAlias = Callable[[Trajectory], Mapping[str, float]]

EXPECTED = "a function that takes a Trajectory and returns a mapping of names to numbers"


def as_metrics(metrics: Any) -> Metrics | None:
    """Function of a trajectory, or None."""
    if metrics is None or (callable(metrics) and not isinstance(metrics, type)):
        return metrics
    raise InputError("metrics", shown(metrics), f"{EXPECTED}, or None")


def try_metrics(metrics: Metrics, plant: Any) -> None:
    """Raise unless the metrics of a plant at rest are named numbers.

    Raises
    ------
    InputError
        If they are none, or the function stops with an error.
    """
    rest = np.zeros((1, 4, plant.nx)), np.zeros((1, 3, plant.nu)), np.zeros((1, 3, plant.nw))  # three steps
    run = Trajectory(*rest, np.array([-1]), np.zeros(plant.design.dim), plant.dt)
    try:
        metrics_of(metrics, run)
    except InputError as error:
        if error.argument == "metrics":
            raise
        raise InputError("metrics", f"a function that stops with {error}".rstrip("."), EXPECTED) from error


def metrics_of(metrics: Metrics, run: Trajectory) -> dict[str, float]:
    """Metrics of the undiverged runs; NaN if all diverged.

    Raises
    ------
    InputError
        If they are no mapping of names to numbers, or the function stops with an error.
    """
    lost = bool(run.diverged.all())
    try:
        given = metrics(run if lost else _part(run, ~run.diverged, slice(None)))
    except CCDError:
        raise
    except Exception as error:
        raise stopped("metrics", metrics, error, EXPECTED) from error
    found = as_mapping("metrics", given, EXPECTED)
    for name, value in found.items():
        if not name.strip() or len(name.splitlines()) > 1:
            raise InputError("metrics", f"the name {shown(name)}", "names of one line")
        if isinstance(value, bool | str) or np.ndim(value) != 0 or not np.isreal(value):
            raise InputError("metrics", f"{shown(value)} for {name}", "a number each")
    return {name: float("nan") if lost else float(value) for name, value in found.items()}


@dataclass(frozen=True)
class MetricChange:
    """One metric under two controllers on the same disturbances.

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


def metric_changes(metrics: Metrics, before: Trajectory, after: Trajectory) -> tuple[MetricChange, ...]:
    """Change of every metric between runs on the same disturbances.

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
        If the runs do not pair, the metrics are no mapping of names to numbers, or `larger_is_better` names others.
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
    if unknown := larger - whole[0].keys():
        got = f"{', '.join(sorted(unknown))}, which the metrics do not name"
        raise InputError("larger_is_better", got, f"names among {', '.join(whole[0])}")
    return tuple(
        _change(name, whole[0][name], whole[1][name], np.array(first), np.array(second), name in larger)
        for name, first, second in zip(whole[0], *units, strict=True)
    )


def _change(name: str, before: float, after: float, first: Array, second: Array, larger: bool) -> MetricChange:
    spread = paired_difference(second, first)
    change = after - before
    low, high = (change + end - spread.mean for end in spread.ci95)
    better, worse = ("more", "less") if larger else ("less", "more")
    word = word_of_change(change, low, high, NOT_WORSE * abs(before))
    said = {better: "better", worse: "worse"}.get(word, word)
    return MetricChange(name, before, after, PairedDifference(change, (low, high)), said)


def _units(run: Trajectory) -> Iterator[Trajectory]:
    """Single runs, or consecutive stretches of the only one."""
    runs, steps = run.inputs.shape[:2]
    if runs > 1:
        for i in range(min(runs, 200)):  # enough for an interval
            yield _part(run, slice(i, i + 1), slice(None))
        return
    edges = np.linspace(0, steps, min(20, steps) + 1).astype(int)  # each of 20 stretches counts as a run
    for start, end in pairwise(edges):
        yield _part(run, slice(None), slice(start, end))


def _part(run: Trajectory, runs: Any, steps: slice) -> Trajectory:
    start, end, _ = steps.indices(run.inputs.shape[1])
    return replace(
        run, states=run.states[runs, start : end + 1], inputs=run.inputs[runs, start:end],
        disturbances=run.disturbances[runs, start:end], diverged_at=run.diverged_at[runs],
        outputs=None if run.outputs is None else run.outputs[runs, start:end],
    )  # fmt: skip
