"""Best design by a cost of the design, from several starts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.landscape import valleys
from ccdtools.co_design.methods.descent import Descent
from ccdtools.co_design.methods.design_cost import DesignCost, End
from ccdtools.co_design.methods.holding import OTHERS, active_set_at, confirmed, start_points
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult, Valley
from ccdtools.co_design.status import CoDesignStatus
from ccdtools.co_design.tolerances import LEVEL_SLOPE, SAME_PLACE
from ccdtools.progress import bar


@dataclass(frozen=True)
class SearchBudget:
    """Budget of a search: name, number of starts, evaluations of each."""

    name: str
    starts: int
    evaluations: int


def searched(
    budget: SearchBudget, problem: CoDesignProblem, cost_from: Callable[[Array], DesignCost], design: Array,
    rng: np.random.Generator, *, progress: bool = False,
) -> CoDesignResult:  # fmt: skip
    """Best design from a feasible one (np,) and other valleys.

    Parameters
    ----------
    budget : SearchBudget
    problem : CoDesignProblem
    cost_from : callable
        Point (np,) of the unit box that a search starts from → `DesignCost`.
    design : (np,) array
    rng : numpy.random.Generator
        Draws the landscape.

    Raises
    ------
    InputError
        If there is no controller at any start.
    """
    space = problem.design
    found = valleys(problem, design, rng=rng) if budget.starts > 1 else ()
    points = start_points(space, design, found, budget.starts)
    starts = [(cost_from(v), v) for v in points]
    if len(starts) > 1:
        starts = [(cost, v) for cost, v in starts if cost.worth_a_start(v)] or starts
    ends = []
    with bar(label=budget.name, total=len(starts), progress=progress) as shown:
        for cost, v in starts:
            ends.append(_from(budget, problem, cost, v))
            shown.update()
    best = min(ends, key=lambda end: end.order)
    evaluations = sum({id(end.cost): end.cost.evaluations for end in ends}.values())
    if not np.isfinite(best.found.cost):
        result = best.cost.without_design(budget.name, points[0])
        return replace(result, evaluations=evaluations, valleys=found)
    result = _result(budget.name, problem, best, evaluations)
    if space.integer and budget.starts == 1:
        status = CoDesignStatus.BUDGET_SPENT if result.status.settled else result.status
        result = replace(result, status=status, notes=(*result.notes, OTHERS))
    return replace(result, valleys=_with_ends(problem, found, [v for _, v in starts], ends))


def _from(budget: SearchBudget, problem: CoDesignProblem, cost: DesignCost, v: Array) -> End:
    """Search from one start."""
    v, first = cost.first_point(v)
    if not np.isfinite(first):
        return End(cost, Descent(v, np.inf, np.zeros(len(v))), 1.0)
    return cost.least(v, size=_size(problem, first, v), evaluations=budget.evaluations)


def _size(problem: CoDesignProblem, value: float, v: Array) -> float:
    """Size of the return at a start, without design cost."""
    size = float(problem.made_by_control(-value, problem.design.from_unit(v)))
    return size if np.isfinite(size) and size > 0 else 1.0


def _result(name: str, problem: CoDesignProblem, best: End, evaluations: int) -> CoDesignResult:
    """Result of the best end."""
    space = problem.design
    best = best.cost.examined(best)
    design = space.check_feasible(space.settled(best.found.v))
    held = active_set_at(space, best.found.v, best.found.slope, best.active)
    rest = held.rest / _size(problem, best.found.cost, best.found.v)
    history = best.cost.history()  # before the status looks at designs beside
    return CoDesignResult(
        design=design, controller=best.cost.controller(design), method=name,
        status=_status(problem, best, rest, bool(held.multipliers)), objective=-best.found.cost,
        criterion=f"return of {best.cost.words}", active_bounds=space.active_bounds(design),
        active_constraints=space.active_constraints(design), multipliers=held.multipliers, slope=rest,
        evaluations=evaluations, history=history, limits=best.limits,
    )  # fmt: skip


def _status(problem: CoDesignProblem, best: End, rest: float, held: bool) -> CoDesignStatus:
    """Status of a search, whatever its closed loop does."""
    if not rest <= LEVEL_SLOPE:  # of a cost that is never twice the same differences would say nothing
        agree = not best.cost.repeatable or confirmed(best.cost, problem.design, best.found.v, size=best.size)
        return CoDesignStatus.BUDGET_SPENT if agree else CoDesignStatus.GRADIENT_UNTRUSTED
    return CoDesignStatus.AT_BOUND if held else CoDesignStatus.CONVERGED


def _with_ends(
    problem: CoDesignProblem, found: tuple[Valley, ...], points: list[Array], ends: list[End]
) -> tuple[Valley, ...]:
    """Valleys, each with the end of its search."""
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
