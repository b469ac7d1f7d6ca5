"""Choice of each design's set: X_fea(p), LQR's region, or X.

The budget is one of work, which every machine counts alike: steps of the recursion times the square of the facets, as
each facet of a step is held against all others. A time limit is stated as the seconds that such work takes on a usual
processor, or less; only far beyond it is the clock looked at, and that is said.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import ABORT, FEWEST_DESIGNS, SET_WORK
from ccdtools.progress import counted
from invariant_sets import ParametricSet, Polytope
from invariant_sets.results import Status

SETS = ("auto", "lqr", "none")
LATE = ", by the clock: another machine may get further"
USABLE = (Status.CONVERGED, Status.EMPTY)


@dataclass(frozen=True)
class SetBudget:
    """Budget of sets, and whether bars are shown.

    Attributes
    ----------
    option : {"auto", "lqr", "none"}
    time_limit : float or None
        For all sets, as work of a usual processor [s].
    progress : bool
        Show progress bars.
    """

    option: str
    time_limit: float | None
    progress: bool = False

    @property
    def seconds(self) -> float:
        """Time limit [s], infinite if there is none."""
        return np.inf if self.time_limit is None else self.time_limit


@dataclass(frozen=True)
class SetCounts:
    """Numbers of designs with each kind of set, with reason.

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
        """Plain values for results.json, without times."""
        return {"option": self.option, "X_fea": self.feasible, "lqr": self.lqr, "X": self.limits,
                "reason": self.reason, "text": str(self)}  # fmt: skip

    def __str__(self) -> str:
        name = "X_fea(p) of the linearisation" if self.local else "X_fea(p)"
        named = {name: self.feasible, "the region that saturated LQR keeps": self.lqr, "X": self.limits}
        parts = [f"{which} of {count} designs" for which, count in named.items() if count]
        checked = f"; {self.leaving:.1%} of its sampled states leave it in a step of the model itself"
        left = checked if self.local and self.feasible else ""
        return ", ".join(parts) + (f": {self.reason}" if self.reason else "") + left


def affordable_designs(
    problem: CoDesignProblem, sets: ParametricSet, samples: int, budget: SetBudget
) -> tuple[int, str]:
    """Number of designs with a set within the budget, with any reason.

    It is `samples` if every candidate can have its own.
    """
    work = []
    for design in problem.design.spread()[::-1][: min(5, samples)]:  # sets that show how much work one is
        result = sets.result(design)
        if result.status not in USABLE:
            late = LATE if result.status is Status.TIME_LIMIT else ""
            return 0, f"X_fea(p) was not found: {result.status.name}{late}"
        work.append(max(result.iterations, 1) * max(len(result.set.b), 1) ** 2)
    number = min(float(samples), budget.seconds * SET_WORK / float(np.mean(work)))
    if number < min(FEWEST_DESIGNS, samples):
        return 0, f"X_fea(p) of {FEWEST_DESIGNS} designs is more work than allowed"
    return int(number), ""


def found_sets(sets: ParametricSet, designs: Array, budget: SetBudget) -> tuple[list[Polytope | None], SetCounts]:
    """X_fea of each design (n, np), None where it fails, with counts."""
    begun = time.thread_time()
    unique, index = np.unique(designs, axis=0, return_inverse=True)
    order = np.unique(index.ravel(), return_index=True)[1].argsort()  # as they come
    known: dict[int, Polytope | None] = {}
    aborted = False
    for i in counted(order, "X_fea(p)", total=len(order), progress=budget.progress):
        aborted = aborted or time.thread_time() - begun > ABORT * budget.seconds
        result = None if aborted else sets.result(unique[i])
        aborted = aborted or (result is not None and result.status is Status.TIME_LIMIT)
        known[int(i)] = result.set if result is not None and result.status in USABLE else None
    found = sum(one is not None for one in known.values())
    seconds = time.thread_time() - begun
    reason = "" if found == len(known) else "X_fea(p) was not found within its facets"
    if aborted:
        reason = f"aborted after {seconds:.3g} s of processor time{LATE}"
    counts = SetCounts(budget.option, found, len(known) - found, 0, reason, seconds)
    return [known[int(i)] for i in index.ravel()], counts


def limited(sets: ParametricSet, budget: SetBudget) -> ParametricSet:
    """Family with facets limited by the budget, and a late time limit."""
    if not np.isfinite(budget.seconds):
        return sets
    facets = max(min(sets.max_facets, int(8 * budget.seconds)), 1)  # 8 for every second of the limit
    return replace(sets, max_facets=facets, time_limit=budget.seconds)
