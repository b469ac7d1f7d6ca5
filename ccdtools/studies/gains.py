"""Sources of a gain in return: design, policy, updates or redesign."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ccdtools.arrays import Array
from ccdtools.controllers.controllers import Controller
from ccdtools.exceptions import InputError
from ccdtools.statistics import PairedDifference, change_of_level

SOURCES = ("start", "design", "policy", "updates", "redesign")


@dataclass(frozen=True, eq=False)
class Step:
    """Controller at its design, and the source of the change to it."""

    source: str
    controller: Controller
    design: Array
    key: bytes


@dataclass(frozen=True)
class Gains:
    """Gains in return by source, on the same runs.

    Attributes
    ----------
    start : float
        Mean return at the first step.
    design, policy, updates, redesign : PairedDifference
        What each source has changed, with the interval at the level of these runs (`change_of_level`): divided by
        |start| it is that of a part of the first return. The means add up to `total`.
    total : PairedDifference
        Last step minus first.
    """

    start: float
    design: PairedDifference
    policy: PairedDifference
    updates: PairedDifference
    redesign: PairedDifference
    total: PairedDifference


def gains_by_source(sources: Sequence[str], rewards: Sequence[Array], *, runs: int | None = None) -> Gains:
    """Gains from the first to the last of several controllers.

    Parameters
    ----------
    sources : sequence of str
        What the change to each of them is due to: "start" for the first, then "design", "policy", "updates" or
        "redesign", each as often as it occurs.
    rewards : sequence of (n, T) arrays
        Of each of them.
    runs : int, optional
        Runs that were begun, where some have been left out; see `summarise_returns`.

    Raises
    ------
    InputError
        If the sources are others, or not as many as the rewards.
    """
    if not sources or sources[0] != SOURCES[0] or not set(sources[1:]) <= set(SOURCES[1:]):
        raise InputError("sources", list(sources), f"{SOURCES[0]!r}, then any of {', '.join(SOURCES[1:])}")
    if len(sources) != len(rewards):
        raise InputError("rewards", f"{len(rewards)}", f"{len(sources)}, one per source")
    first = rewards[0]
    nothing = np.zeros_like(first)
    changes = [after - before for before, after in pairwise(rewards)]
    parts = {
        name: change_of_level(sum((c for s, c in zip(sources[1:], changes, strict=True) if s == name), nothing),
                              first, runs=runs)
        for name in SOURCES[1:]
    }  # fmt: skip
    start = float(first.sum(axis=1).mean()) if len(first) else float("nan")
    return Gains(start, **parts, total=change_of_level(rewards[-1] - first, first, runs=runs))
