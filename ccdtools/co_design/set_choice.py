"""Which set each design gets: X_fea(p) as far as the time goes, else the region of saturated LQR, else X.

The number of designs is chosen by the measured time of a few sets, on a coarse ladder. Time is that of this thread on
the processor, so that other programs do not change the choice. Where the first sets say that a set for every candidate
takes less than the limit, nothing depends on the clock.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.progress import Echo, counted
from invariant_sets import ParametricSet, Polytope
from invariant_sets.results import Status

SETS = ("auto", "lqr", "none")
LADDER = tuple(4**k for k in range(3, 12))  # numbers of designs that candidates share
ONE_SET = 1 / 16  # of the time limit: longest computation of one set
PROBES = 5  # sets that are computed to see how long one takes; the first is not counted, it loads what it needs
LONGER = (4, 16)  # times the limit of one set, where other programs took the processor
USABLE = (Status.CONVERGED, Status.EMPTY)


@dataclass(frozen=True)
class Effort:
    """How much may be spent on sets, and how to say so.

    Attributes
    ----------
    option : {"auto", "lqr", "none"}
    time_limit : float or None
        Processor time for all sets [s].
    progress : bool
        Show progress bars.
    echo : callable or None
        Takes a line of text where there is no bar.
    """

    option: str
    time_limit: float | None
    progress: bool = False
    echo: Echo | None = None

    @property
    def seconds(self) -> float:
        """The time limit, infinite if there is none [s]."""
        return np.inf if self.time_limit is None else self.time_limit


@dataclass(frozen=True)
class SetCounts:
    """How many designs got which set, and why.

    Attributes
    ----------
    option : str
        What was asked for.
    feasible, lqr, limits : int
        Designs with X_fea(p); with the region of saturated LQR; with X itself.
    reason : str
        Why not all have X_fea(p); empty if all have.
    seconds : float
        Processor time of the sets [s].
    local : bool
        Whether X_fea(p) is that of a linearisation: a plant that is not linear may leave it.
    leaving : float
        Fraction of the sampled states of such sets from which a step of the model itself, under the input that keeps
        its linearisation there, ends outside.
    """

    option: str
    feasible: int
    lqr: int
    limits: int
    reason: str = ""
    seconds: float = 0.0
    local: bool = False
    leaving: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """What results.json keeps: counts and reason, without what is measured in seconds."""
        return {"option": self.option, "X_fea": self.feasible, "lqr": self.lqr, "X": self.limits,
                "reason": self.reason, "text": str(self)}  # fmt: skip

    def __str__(self) -> str:
        name = "X_fea(p) of the linearisation" if self.local else "X_fea(p)"
        named = {name: self.feasible, "the region that saturated LQR keeps": self.lqr, "X": self.limits}
        parts = [f"{which} of {count} designs" for which, count in named.items() if count]
        checked = f"; {self.leaving:.1%} of its sampled states leave it in a step of the model itself"
        left = checked if self.local and self.feasible else ""
        return ", ".join(parts) + (f": {self.reason}" if self.reason else "") + left


def affordable_designs(problem: CoDesignProblem, sets: ParametricSet, samples: int, effort: Effort) -> tuple[int, str]:
    """How many designs can have a set in time, and if none can, why; `samples` if every candidate can have its own."""
    if not np.isfinite(effort.seconds):
        return samples, ""
    taken = []
    for design in problem.design.spread()[::-1][: min(PROBES, samples)]:
        begun = time.thread_time()
        S = _set_in_time(sets, design)
        taken.append(time.thread_time() - begun if S is not None else np.inf)
        if sum(taken) > effort.seconds / 4 or not np.isfinite(taken[-1]):
            break
    if not np.isfinite(taken[-1]):
        return 0, f"X_fea(p) was not found within {effort.seconds * ONE_SET:.3g} s"
    one = float(np.mean(taken[1:] or taken))
    if one * samples <= effort.seconds:
        return samples, ""
    possible = [number for number in LADDER if number * one <= effort.seconds / 2]
    return max(possible, default=0), "" if possible else f"X_fea(p) of {LADDER[0]} designs takes longer than allowed"


def sets_in_time(sets: ParametricSet, designs: Array, effort: Effort) -> tuple[list[Polytope | None], SetCounts]:
    """X_fea of each design (n, np), None where time or the recursion ended first, and what was counted."""
    begun = time.thread_time()
    unique, index = np.unique(designs, axis=0, return_inverse=True)
    order = np.unique(index.ravel(), return_index=True)[1].argsort()  # as they come
    known: dict[int, Polytope | None] = {}
    for i in counted(order, "X_fea(p)", total=len(order), progress=effort.progress, echo=effort.echo):
        late = time.thread_time() - begun > effort.seconds
        known[int(i)] = None if late else _set_in_time(sets, unique[i])
    found = sum(one is not None for one in known.values())
    seconds = time.thread_time() - begun
    reason = ""
    if found < len(known):
        late = seconds > effort.seconds
        reason = f"time limit of {effort.seconds:g} s reached" if late else "X_fea(p) was not found in time"
    counts = SetCounts(effort.option, found, len(known) - found, 0, reason, seconds)
    return [known[int(i)] for i in index.ravel()], counts


def _set_in_time(sets: ParametricSet, design: Array) -> Polytope | None:
    """X_fea of a design, None if it was not found within the time limit of the family.

    That limit is on the clock on the wall: where this thread had less than half of the processor, it is extended.
    """
    for longer in (1, *LONGER):
        family = sets if longer == 1 or sets.time_limit is None else replace(sets, time_limit=longer * sets.time_limit)
        wall = time.perf_counter()
        processor = time.thread_time()
        result = family.result(design)
        if result.status in USABLE:
            return result.set
        starved = time.thread_time() - processor < (time.perf_counter() - wall) / 2
        if not starved or result.status is not Status.TIME_LIMIT:
            break
    return None


def limited(sets: ParametricSet, effort: Effort) -> ParametricSet:
    """The family with a time limit for each set; one that has a shorter limit keeps it."""
    own = np.inf if sets.time_limit is None else sets.time_limit
    limit = min(own, effort.seconds * ONE_SET)
    return replace(sets, time_limit=limit) if limit < own else sets
