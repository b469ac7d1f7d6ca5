"""Numbers of the user's own that a comparison shows beside the returns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from ccdtools.checks import as_mapping, shown
from ccdtools.exceptions import InputError
from ccdtools.trajectory import Trajectory

Metrics: TypeAlias = Callable[[Trajectory], Mapping[str, float]]

EXPECTED = "a function that takes a Trajectory and returns a mapping of names to numbers"
TRIED = 3  # steps of a run at rest that metrics are tried on


def as_metrics(metrics: Any, *, argument: str = "metrics") -> Metrics | None:
    """A function of a trajectory, or None."""
    if metrics is None or (callable(metrics) and not isinstance(metrics, type)):
        return metrics
    raise InputError(argument, shown(metrics), f"{EXPECTED}, or None")


def try_metrics(metrics: Metrics, plant: Any) -> None:
    """Raise unless the metrics of a short run of a plant at rest are named numbers: a study asks for them at its end.

    Raises
    ------
    InputError
        If they are none, or the function stops with an error.
    """
    rest = np.zeros((1, TRIED + 1, plant.nx)), np.zeros((1, TRIED, plant.nu)), np.zeros((1, TRIED, plant.nw))
    run = Trajectory(*rest, np.array([-1]), np.zeros(plant.design.dim), plant.dt)
    try:
        metrics_of(metrics, run)
    except InputError as error:
        if error.argument == "metrics":
            raise
        raise InputError("metrics", f"a function that stops with {error}".rstrip("."), EXPECTED) from error
    except Exception as error:
        got = f"a function that stops with {type(error).__name__}: {' '.join(str(error).split())}"
        raise InputError("metrics", got, EXPECTED) from error


def metrics_of(metrics: Metrics, run: Trajectory) -> dict[str, float]:
    """The metrics of the runs that did not diverge; NaN where all did.

    Raises
    ------
    InputError
        If they are no mapping of names to numbers.
    """
    lost = bool(run.diverged.all())
    found = as_mapping("metrics", metrics(run if lost else _kept(run)), EXPECTED)
    for name, value in found.items():
        if not name.strip() or len(name.splitlines()) > 1:
            raise InputError("metrics", f"the name {shown(name)}", "names of one line")
        if isinstance(value, bool | str) or np.ndim(value) != 0 or not np.isreal(value):
            raise InputError("metrics", f"{shown(value)} for {name}", "a number each")
    return {name: float("nan") if lost else float(value) for name, value in found.items()}


def _kept(run: Trajectory) -> Trajectory:
    """The runs that did not diverge."""
    kept = ~run.diverged
    if kept.all():
        return run
    names = ("states", "inputs", "disturbances", "diverged_at")
    return replace(run, **{name: getattr(run, name)[kept] for name in names})
