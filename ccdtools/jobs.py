"""The same computation for many things, in one process or in several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from ccdtools.checks import as_count, shown
from ccdtools.exceptions import InputError
from ccdtools.progress import bar


def as_jobs(value: Any) -> int:
    """A number of processes: at least one, or −1 for as many as there are cores."""
    if isinstance(value, int) and not isinstance(value, bool) and value == -1:
        return -1
    try:
        return as_count("jobs", value)
    except InputError:
        raise InputError("jobs", shown(value), "a number of processes, or -1 for all cores") from None


def in_processes(
    function: Callable[[Any], Any], items: Sequence[Any], *, jobs: int, label: str, progress: bool = False
) -> list[Any]:
    """The values of a function at all items, in their order.

    Parameters
    ----------
    function : callable
        What it needs is sent to the processes by joblib, if `jobs` is not 1.
    items : sequence
    jobs : int
        Processes; −1 for all cores.
    label : str
        Of the bar.
    progress : bool
    """
    if jobs == 1 or len(items) < 2:
        return [function(item) for item in bar(items, label=label, total=len(items), progress=progress)]
    from joblib import Parallel, delayed

    found = Parallel(n_jobs=jobs, return_as="generator")(delayed(function)(item) for item in items)
    return list(bar(found, label=label, total=len(items), progress=progress))
