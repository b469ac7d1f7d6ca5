"""The same computation for many things, in one process or in several."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
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
    """The values of a function at all items, in their order; arguments as of `as_they_end`."""
    return list(as_they_end(function, items, jobs=jobs, label=label, progress=progress))


def as_they_end(
    function: Callable[[Any], Any],
    items: Sequence[Any],
    *,
    jobs: int,
    label: str,
    names: Sequence[str] = (),
    progress: bool = False,
) -> Iterator[Any]:
    """The values of a function at all items, in their order, each as soon as it is there.

    Parameters
    ----------
    function : callable
        What it needs is sent to the processes by joblib, if `jobs` is not 1.
    items : sequence
    jobs : int
        Processes; −1 for all cores.
    label : str
        Of the bar.
    names : sequence of str
        Of the items: in one process the bar says which one it is at.
    progress : bool
    """
    if jobs != 1 and len(items) > 1:
        from joblib import Parallel, delayed

        found = Parallel(n_jobs=jobs, return_as="generator")(delayed(function)(item) for item in items)
        yield from bar(found, label=label, total=len(items), progress=progress)
        return
    with bar(label=label, total=len(items), progress=progress) as shown_bar:
        for i, item in enumerate(items):
            if names:
                shown_bar.set_description(f"{label}, now {names[i]}")
            yield function(item)
            shown_bar.update()
