"""States and designs where the expert's closed loops start.

Candidates (x, p) fill X × design box by Latin hypercube sampling. Accepted are those whose state lies in the set of
their own design. Where these are few (the volume of a set shrinks with the number of states), the others are moved
along their ray from the rest: a state at the fraction ρ of its ray to the boundary of X goes to the fraction ρ of the
ray to the boundary of the set. A part of the loops begins where the episodes of the problem begin.

The set of a design is X_fea(p), the region of LQR, or X. The budget is one of work, which every machine counts alike:
steps of the recursion times the square of the facets, as each facet of a step is held against all others. A time limit
is stated as the seconds that such work takes on a usual processor, or less; only far beyond it is the clock looked at,
and that is said.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import qmc

from ccdtools.arrays import Array, Indices, Mask
from ccdtools.co_design.budgets import ABORT, CANDIDATES_PER_START, FEWEST_DESIGNS, SET_WORK
from ccdtools.co_design.lqr_regions import LQRRegions
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import ACCEPTED_SHARE
from ccdtools.design_limits import DesignLimits, Limits, bounds_at
from ccdtools.exceptions import InputError
from ccdtools.progress import counted
from invariant_sets import ParametricSet, Polytope
from invariant_sets.results import Status

SETS = ("auto", "lqr", "none")
LATE = ", by the clock: another machine may get further"
USABLE = (Status.CONVERGED, Status.EMPTY)


@dataclass(frozen=True)
class SetBudget:
    """Budget of sets, and whether bars are shown."""

    option: str  # "auto", "lqr" or "none"
    seconds: float = np.inf  # for all sets, as work of a usual processor [s]
    progress: bool = False


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


@dataclass(frozen=True, eq=False)
class Starts:
    """Starts of the expert's loops, with the set of each."""

    x: Array  # (n, nx): states; the accepted candidates first
    p: Array  # (n, np): their designs
    # X_fea of each design; None where it is not known: the region of LQR or X stands for it, and nothing is filtered
    sets: list[Polytope | None]
    regions: LQRRegions  # model and LQR of each design
    X: Limits
    by_region: bool  # whether a design without a set is limited to the region of LQR
    counts: SetCounts  # how many designs got which set
    candidates: int = 0  # how many of them are accepted candidates
    acceptance: float = 0.0  # fraction of the candidates that lay in their set

    @classmethod
    def of(
        cls, problem: CoDesignProblem, x: Array, p: Array, family: ParametricSet, budget: SetBudget, reason: str
    ) -> Starts:  # fmt: skip
        """Candidates (n, nx) and (n, np), without sets if a reason is given."""
        regions = LQRRegions.of(problem, p)
        by_region = budget.option != "none" and regions.rows is not None
        if budget.option == "auto" and not reason:
            sets, counts = found_sets(family, p, budget)
        else:
            sets = [None] * len(p)
            counts = SetCounts(budget.option, 0, len(np.unique(p, axis=0)), 0, reason or f'sets = "{budget.option}"')
        if not by_region:
            counts = replace(counts, lqr=0, limits=counts.lqr)
        return cls(x, p, sets, regions, problem.X, by_region, counts)

    def contains(self, x: Array, runs: Indices) -> Mask:
        """Whether x[i] lies in the set of runs[i], (k,)."""
        within = self.X.contains(x, self.p[runs]) if isinstance(self.X, DesignLimits) else self.X.contains(x)
        inside = within & self.may_begin(x, runs)
        unknown = np.array([self.sets[i] is None for i in runs], dtype=bool)
        if self.by_region:
            inside[unknown] &= self.regions.contains(x[unknown], runs[unknown])
        return np.asarray(inside)

    def may_begin(self, x0: Array, runs: Indices) -> Mask:
        """True if the expert can start at x0[i], within X_fea where known."""
        allowed = self.regions.stabilised[runs]
        for k in np.flatnonzero(allowed):
            own = self.sets[runs[k]]
            allowed[k] = own is None or own.contains(x0[k])
        return allowed

    def moved_in(self, x: Array, runs: Indices) -> Array:
        """States moved along rays into their sets, at fractions as in X.

        Where the set is flat or empty, it is the state itself.
        """
        rest = self.regions.rest[runs]
        fraction = np.minimum(self._gauges(x, rest, runs), 1.0)
        own = [self.sets[i] for i in runs]
        rays = zip(own, x[:, None], rest[:, None])
        reach = np.array([0.0 if S is None else 1 / _gauge(S, *ray)[0] for S, *ray in rays])
        unknown = np.array([S is None for S in own], dtype=bool)
        if self.by_region:
            reach[unknown] = self.regions.reach(x[unknown], runs[unknown])
        scale = np.where(reach > 0, np.minimum(fraction * reach, 1.0), 1.0)
        return np.asarray(rest + scale[:, None] * (x - rest))

    def _gauges(self, x: Array, rest: Array, runs: Indices) -> Array:
        """Least factors (k,) by which X about the rest holds states."""
        if not isinstance(self.X, DesignLimits):
            return _gauge(self.X, x, rest)
        away = x - rest
        lower, upper = self.X.bounds(self.p[runs])
        bound = np.where(away > 0, upper, lower) - rest
        parts = np.divide(away, bound, out=np.where(away == 0, 0.0, np.inf), where=bound != 0)
        return np.asarray(np.maximum(parts.max(axis=1), np.finfo(float).tiny))


def starts(
    problem: CoDesignProblem, family: ParametricSet, samples: int, distinct: int | None, budget: SetBudget,
    rng: np.random.Generator,
) -> Starts:  # fmt: skip
    """Accepted candidates, and starts of episodes.

    Raises
    ------
    InputError
        If no candidate lies in a set, and none can be moved into one.
    """
    nx = problem.model.nx
    reason = ""
    clock = time.thread_time()
    if budget.option == "auto" and distinct is None:
        distinct, reason = affordable_designs(problem, family, samples, budget)
    probing = time.thread_time() - clock
    shared = distinct or samples
    cube = qmc.LatinHypercube(nx + problem.design.dim, rng=rng).random(samples)
    p = problem.design.from_unit(cube[:, nx:])
    if shared < samples:
        p = problem.design.latin_hypercube(shared, rng)[np.arange(samples) % shared]
    lower, upper = bounds_at(problem.X, p)
    x = lower + cube[:, :nx] * (upper - lower)
    pool = Starts.of(problem, x, p, family, budget, reason)
    everyone = np.arange(samples)
    inside = pool.contains(x, everyone)
    acceptance = float(inside.mean())
    if acceptance < ACCEPTED_SHARE:
        outside = np.flatnonzero(~inside)
        x[outside] = pool.moved_in(x[outside], outside)
        inside[outside] = pool.contains(x[outside], outside)
    if not inside.any():
        where = {"auto": "X_fea(p)", "lqr": "the region that LQR keeps", "none": "X at a design with an LQR"}
        regulated = pool.regions.stabilised.any()
        got = f"{samples} candidates of which none lies in {where[budget.option if regulated else 'none']}"
        cure = "Take more samples, or check that X, U and the design bounds leave anything to control."
        if not regulated:
            cure = 'The input may do nothing at rest. `codesign` by "pathwise" or "ppo" learns without an LQR.'
        raise InputError("samples", got, "at least one", cure)
    first = everyone[: -(-samples // CANDIDATES_PER_START)]
    x0 = problem.scenarios.sample(len(first), 1, rng)[0]
    begun = pool.may_begin(x0, first)
    chosen = np.concatenate([everyone[inside], first[begun]])
    return replace(
        pool, x=np.concatenate([x[inside], x0[begun]]), p=p[chosen], sets=[pool.sets[i] for i in chosen],
        regions=pool.regions.of_runs(chosen), candidates=int(inside.sum()), acceptance=acceptance,
        counts=replace(pool.counts, seconds=pool.counts.seconds + probing),
    )  # fmt: skip


def _gauge(S: Polytope, x: Array, rest: Array) -> Array:
    """Least factors (k,) by which S about a rest holds states."""
    room = S.b - rest @ S.A.T
    inside = (room > 0).all(axis=1)
    if S.is_empty or len(S.b_eq) or not inside.any():
        return np.full(len(x), np.inf)
    parts = (x - rest) @ S.A.T / np.where(room > 0, room, 1.0)
    return np.where(inside, np.maximum(parts.max(axis=1), np.finfo(float).tiny), np.inf)


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
