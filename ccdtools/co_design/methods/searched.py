"""The best design by a cost of the design alone, searched from several starts, and what is to be said of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from ccdtools.arrays import Array
from ccdtools.co_design.landscape import valleys
from ccdtools.co_design.limits import StateLimitPenalty
from ccdtools.co_design.methods.descent import FEASIBLE, Descent, descend, value_of
from ccdtools.co_design.methods.holding import SAME_PLACE, Held, confirmed, held_by, start_points
from ccdtools.co_design.methods.loop_cost import LearnedCost, LoopCost
from ccdtools.co_design.methods.riccati_cost import RiccatiCost
from ccdtools.co_design.methods.simultaneous import OTHERS
from ccdtools.co_design.methods.trajectory_cost import TrajectoryCost
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult, History, Valley
from ccdtools.co_design.status import CoDesignStatus
from ccdtools.exceptions import InputError
from ccdtools.progress import bar
from mpc import NotStabilisableError

ROUNDS = 30  # of the multipliers of limits, at most;
QUIET = 2  # that gain nothing more among designs that keep the limits,
STILL = 6  # or that bring no other design where none keeps them, are enough
LITTLE = 1e-3  # of the return that control makes: a gain of a round without consequence
DEARER = 2.0  # times the price of limits, beside what it grows by anyway, where a round has not led within them
HALVINGS = 8  # of the way from a design that keeps the limits to one that does not
USED = 0.8  # of a tolerance, from which on a limit may hold a design: prices aim at nine tenths
LEVEL = 1e-3  # of the return that control makes, per length of the unit box: a slope without consequence
DesignCost = LearnedCost | LoopCost | RiccatiCost | TrajectoryCost  # what an outer search brings to its least


@dataclass(frozen=True)
class Plan:
    """How a search goes: what tables call it, how many starts, and evaluations of each at most."""

    name: str
    starts: int
    evaluations: int


@dataclass(frozen=True, eq=False)
class End:
    """Where the search from one start ended."""

    cost: DesignCost
    found: Descent
    size: float  # of the part of the return that control makes
    penalty: StateLimitPenalty | None = None  # of leaving the limits, where they are watched
    violation: float = 0.0  # by how much their tolerance is exceeded

    @property
    def order(self) -> tuple[float, float]:
        """What the best end is the least of."""
        return (self.violation, self.found.cost)


def searched(
    plan: Plan, problem: CoDesignProblem, cost_from: Callable[[Array], DesignCost], design: Array,
    rng: np.random.Generator, *, hopeful: Callable[[Array], bool] | None = None, progress: bool = False,
) -> CoDesignResult:  # fmt: skip
    """The best design found from a feasible design (np,) and other valleys.

    Parameters
    ----------
    plan : Plan
    problem : CoDesignProblem
    cost_from : callable
        Point (np,) of the unit box that a search starts from → `DesignCost`.
    design : (np,) array
    rng : numpy.random.Generator
        Draws the landscape.
    hopeful : callable, optional
        Whether a point is worth a start, for a cost that is dear: the others are left out where there is such a point.

    Raises
    ------
    InputError
        If there is no controller at any start.
    """
    space = problem.design
    found = valleys(problem, design, rng=rng) if plan.starts > 1 else ()
    points = start_points(space, design, found, plan.starts)
    if hopeful is not None and len(points) > 1:
        points = [v for v in points if hopeful(v)] or points
    ends = []
    with bar(label=plan.name, total=len(points), progress=progress) as shown:
        for v in points:
            ends.append(_from(plan, problem, cost_from(v), v))
            shown.update()
    best = min(ends, key=lambda end: end.order)
    evaluations = sum({id(end.cost): end.cost.evaluations for end in ends}.values())
    if isinstance(best.cost, TrajectoryCost) and not np.isfinite(best.found.cost):
        result = _without_trajectory(plan.name, problem, best.cost, points[0])
        return replace(result, evaluations=evaluations, valleys=found)
    if not np.isfinite(best.found.cost):
        got = f"{space.describe(design)} to start from, where there is nothing to search by: {best.cost.words}"
        cure = "Start from a design that can be stabilised and whose runs keep the limits, or check the weights."
        raise InputError("design", got, "a design with a controller", cure)
    result = _result(plan.name, problem, best, evaluations)
    if space.integer and plan.starts == 1:
        status = CoDesignStatus.BUDGET_SPENT if result.status.settled else result.status
        result = replace(result, status=status, notes=(*result.notes, OTHERS))
    return replace(result, valleys=_with_ends(problem, found, points, ends))


def _from(plan: Plan, problem: CoDesignProblem, cost: DesignCost, v: Array) -> End:
    """The search from one start; again and again while leaving the limits is priced too low."""
    first = value_of(cost, v)
    if isinstance(cost, TrajectoryCost) and not np.isfinite(first):
        v = cost.within_limits(v)
        if cost.failed is not None:
            return End(cost, Descent(v, np.inf, np.zeros(len(v))), 1.0)
        first = value_of(cost, v)
    size = _size(problem, first, v)
    found = descend(cost, problem.design, v, size=size, evaluations=plan.evaluations)
    if not isinstance(cost, LoopCost) or problem.limit_tolerance == "off" or not np.isfinite(found.cost):
        return End(cost, found, size)
    return _within_limits(plan, problem, cost, found, size)


def _within_limits(plan: Plan, problem: CoDesignProblem, cost: LoopCost, found: Descent, size: float) -> End:
    """The search again and again, while leaving the limits is priced too low; from where it ended without a price."""
    penalty = StateLimitPenalty(problem)
    ends: list[End] = []
    for _ in range(ROUNDS):
        seen, penalty = cost.updated(penalty, found.v)
        if bool(seen.diverged.any()):
            break
        plain = float(-problem.risk.values(seen.total).mean())
        ends.append(End(cost, replace(found, cost=plain), size, penalty, penalty.violation(seen)))
        unpriced = cost.penalty is None
        enough = ends[-1].violation <= 0 and (unpriced or found.spent)
        if not penalty.active or enough or _settled(ends):
            break
        if not unpriced and ends[-1].violation > 0:
            penalty = penalty.dearer(DEARER)
        cost = LoopCost(problem, cost.law, cost.scenarios, penalty, cost.rows, cost.evaluations)
        found = descend(cost, problem.design, found.v, size=size, evaluations=plan.evaluations)
    if not ends:
        return End(cost, found, size)
    best = replace(min(ends, key=lambda end: end.order), cost=cost)
    broken = [end for end in ends if end.violation > 0 and end.found.cost < best.found.cost]
    if best.violation > 0 or not broken:
        return best
    return _nearer(best, min(broken, key=lambda end: end.violation))


def _settled(ends: list[End]) -> bool:
    """Whether further rounds of prices are expected to change nothing."""
    kept = [end.violation <= 0 for end in ends]
    if any(kept):
        costs = np.minimum.accumulate([end.found.cost if keeps else np.inf for end, keeps in zip(ends, kept)])
        return len(ends) > QUIET and bool(costs[-1 - QUIET] - costs[-1] <= QUIET * LITTLE * ends[-1].size)
    last = [end.found.v for end in ends[-STILL:]]
    return len(last) == STILL and all(np.array_equal(v, last[0]) for v in last)


def _nearer(best: End, broken: End) -> End:
    """Of the designs on the way from one that keeps the limits to a cheaper one that does not, the cheapest that does.

    Prices aim a little within the limits, so that something of the way is left.
    """
    cost, begin = best.cost, best.found.v
    assert isinstance(cost, LoopCost)
    assert best.penalty is not None
    near, far = 0.0, 1.0
    for _ in range(HALVINGS):
        share = (near + far) / 2
        v = begin + share * (broken.found.v - begin)
        cost.evaluations += 1
        try:
            seen = cost.seen(v)
        except NotStabilisableError:
            far = share
            continue
        plain = float(-cost.problem.risk.values(seen.total).mean())
        penalty = replace(best.penalty, v=torch.tensor(v, dtype=torch.float32))
        impossible = bool(seen.diverged.any()) or cost.problem.design.allowed.violation(v) > FEASIBLE
        if impossible or penalty.violation(seen) > 0 or plain >= best.found.cost:
            far = share
        else:
            near = share
            best = replace(best, found=replace(best.found, v=v, cost=plain), penalty=penalty)
    return best


def _size(problem: CoDesignProblem, value: float, v: Array) -> float:
    """How large the return at a start is, without the cost of the design."""
    size = float(problem.made_by_control(-value, problem.design.from_unit(v)))
    return size if np.isfinite(size) and size > 0 else 1.0


def _result(name: str, problem: CoDesignProblem, best: End, evaluations: int) -> CoDesignResult:
    """The result of the best end."""
    space = problem.design
    design = space.check_feasible(space.settled(best.found.v))
    held = _held(problem, best)
    size = _size(problem, best.found.cost, best.found.v)
    outcome = None
    if best.penalty is not None and isinstance(best.cost, LoopCost):
        outcome = best.penalty.outcome(best.cost.seen(best.found.v))
    history = best.cost.history()  # before the status looks at designs beside
    return CoDesignResult(
        design=design, controller=best.cost.controller(design), method=name,
        status=_status(problem, best, held.rest / size, bool(held.multipliers)), objective=-best.found.cost,
        criterion=f"return of {best.cost.words}", active_bounds=space.active_bounds(design),
        active_constraints=space.active_constraints(design), multipliers=held.multipliers, slope=held.rest / size,
        evaluations=evaluations, history=history, limits=outcome,
    )  # fmt: skip


def _held(problem: CoDesignProblem, best: End) -> Held:
    """What holds the best end; limits that have a price and are used up are constraints, whatever the price came to."""
    v = best.found.v
    if best.penalty is None or not best.penalty.active or not isinstance(best.cost, LoopCost):
        return held_by(problem.design, v, best.found.slope)
    slope, violations = best.cost.slopes(v)
    outcome = best.penalty.outcome(best.cost.seen(v))
    measures = (outcome.achieved, outcome.errors, outcome.tolerance, outcome.multipliers)
    used = zip(*(measure.values() for measure in measures))
    active = [price > 0 and value + error >= USED * most for value, error, most, price in used]
    return held_by(problem.design, v, slope, dict(one for one, is_so in zip(violations.items(), active) if is_so))


def _without_trajectory(name: str, problem: CoDesignProblem, cost: TrajectoryCost, v: Array) -> CoDesignResult:
    """What there is to say where no design has trajectories within the limits: that, at the given one."""
    space = problem.design
    design = space.settled(v)
    row = (np.ones(1), np.ones(1), design[None], np.full(1, np.nan), np.zeros(1), np.zeros(1))
    return CoDesignResult(
        design=design, controller=cost.controller(design), method=name,
        status=CoDesignStatus.INFEASIBLE if cost.impossible else CoDesignStatus.BUDGET_SPENT,
        criterion=f"return of {cost.words}", active_bounds=space.active_bounds(design),
        active_constraints=space.active_constraints(design), history=History(*row), notes=cost.notes,
    )  # fmt: skip


def _status(problem: CoDesignProblem, best: End, rest: float, held: bool) -> CoDesignStatus:
    """How a search ended, whatever its closed loop does."""
    if not rest <= LEVEL:
        trained = isinstance(best.cost, LearnedCost)  # never twice to the same policy: differences would say nothing
        agree = trained or confirmed(best.cost, problem.design, best.found.v, size=best.size)
        return CoDesignStatus.BUDGET_SPENT if agree else CoDesignStatus.GRADIENT_UNTRUSTED
    return CoDesignStatus.AT_BOUND if held else CoDesignStatus.CONVERGED


def _with_ends(
    problem: CoDesignProblem, found: tuple[Valley, ...], points: list[Array], ends: list[End]
) -> tuple[Valley, ...]:
    """The valleys, with where the search that began on each of them ended."""
    space = problem.design
    named = []
    for valley in found:
        v = space.to_unit(valley.design)
        begun = [end for point, end in zip(points, ends) if np.abs(v - point).max() <= SAME_PLACE]
        if begun:
            first = min(begun, key=lambda end: end.order).found
            valley = replace(valley, found=space.settled(first.v), found_return=-first.cost)
        named.append(valley)
    return tuple(named)
