"""Best design by a cost, from several starts.

References
----------
Kraft, "A software package for sequential quadratic programming", DFVLR-FB 88-28, 1988 (SLSQP, in SciPy).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize

from ccdtools.arrays import Array
from ccdtools.co_design.landscape import start_points, valleys
from ccdtools.co_design.result import CoDesignResult, CoDesignStatus, History, HistoryRow, Valley
from ccdtools.co_design.tolerances import (
    AGREEING,
    AT_BOUND,
    COMPRESS_ABOVE,
    COST_STEP,
    GAINED,
    LEVEL_SLOPE,
    LOST_COST,
    SAME_PLACE,
)
from ccdtools.exceptions import InputError
from ccdtools.plants.tolerances import EXACT
from ccdtools.progress import at, bar

if TYPE_CHECKING:
    from ccdtools.co_design.limits import LimitsOutcome, StateLimitPenalty
    from ccdtools.co_design.problem import CoDesignProblem
    from ccdtools.controllers.controllers import Controller
    from ccdtools.plants.design_space import DesignSpace

OTHERS = "other whole numbers were never looked at: raise starts"

Cost = Callable[[Array], tuple[float, Callable[[], Array]]]
"""Point (np,) of the unit box → cost, and a function that returns its slope (np,); infinite where there is none."""


@dataclass(frozen=True, eq=False)
class DesignPoint:
    """Best feasible point of the unit box that a search has found."""

    v: Array  # (np,)
    cost: float
    slope: Array  # (np,): of the cost, per unit-box length
    size: float = 1.0  # part of the return that control makes: what gains are compared with
    constant: float = 0.0  # the rest of the first cost
    spent: bool = False  # whether the evaluations ran out
    violation: float = 0.0  # excess over the tolerance of the limits
    penalty: StateLimitPenalty | None = None  # what leaving the limits cost
    limits: LimitsOutcome | None = None
    active: Mapping[str, Array] = field(default_factory=dict)  # slopes (np,) of violations of active limits

    @property
    def order(self) -> tuple[float, float]:
        """Violation, then cost; the best point has least."""
        return (self.violation, self.cost)


@dataclass(eq=False)
class DesignCost(ABC):
    """Cost (minus a return) over the unit box, with slope and controller.

    Attributes
    ----------
    problem : CoDesignProblem
    rows : list
        Row of the history for every evaluation.
    repeatable : bool
        Whether the same point has the same cost again.
    """

    problem: CoDesignProblem
    rows: list[HistoryRow] = field(default_factory=list, init=False)
    repeatable = True

    @property
    def space(self) -> DesignSpace:
        """What a search moves: the design, then any parameters of the controller."""
        return self.problem.design

    @property
    @abstractmethod
    def words(self) -> str:
        """Name of the cost in tables."""

    @abstractmethod
    def __call__(self, v: Array) -> tuple[float, Callable[[], Array]]:
        """Cost at a point (np,), and a function for its slope (np,); infinite without a controller."""

    @abstractmethod
    def controller(self, p: Array) -> Controller:
        """Controller of a design, with any parameters behind it, for use."""

    @property
    def evaluations(self) -> int:
        """Number of evaluations."""
        return len(self.rows)

    def remember(self, p: Array, value: float, std: float = 0.0, lost: float = 0.0, *, samples: int = 1) -> None:
        """Add a row to the history: return and spread at a design (np,), and share of lost runs."""
        count = len(self.rows) + 1
        at(f"evaluation {count}")
        self.rows.append((count, count * samples, p, value, std, lost))

    def differences(self, v: Array, values: Callable[[Array], Array], count: int) -> Array:
        """Slopes (count, np) of values (count,), central or one-sided at a bound."""
        slopes = np.zeros((count, len(v)))
        allowed = self.space.allowed
        side = allowed.sides(v)
        for i in np.flatnonzero(allowed.free | (allowed.whole & (side != 0))):
            ends = []
            for move in (0.0, -side[i] / allowed.width[i]) if allowed.whole[i] else (COST_STEP, -COST_STEP):
                moved = v.copy()
                moved[i] = np.clip(v[i] + move, 0.0, 1.0)
                ends.append((moved[i], values(moved)))
            (high, above), (low, below) = ends
            slopes[:, i] = (above - below) / (high - low)
        held = allowed.whole & ~np.isfinite(slopes)  # a neighbour without a controller
        return np.where(held, 0.0, slopes)

    def measured(self, v: Array) -> tuple[float, float]:
        """Cost at a point without slope or history, and violation of the limits."""
        return self(v)[0], 0.0

    def limits(self, v: Array) -> LimitsOutcome | None:
        """Violation of the limits at a point that `measured` has found, if they were priced."""
        return None

    def worth_a_start(self, v: Array) -> bool:
        """True if a cheap evaluation allows a search from a point."""
        return True

    def first_point(self, v: Array) -> tuple[Array, float]:
        """Point to search from, and its cost."""
        return v, self(v)[0]

    def within_limits(self, found: DesignPoint, evaluations: int) -> DesignPoint:
        """Best point whose closed loop keeps the limits, from one found without them."""
        return found

    def examined(self, found: DesignPoint) -> DesignPoint:
        """Best point with its limits, once known."""
        return found

    def without_design(self, name: str, v: Array) -> CoDesignResult:
        """Explanation where no start has a cost."""
        space = self.problem.design
        got = f"{space.describe(space.settled(v))} to start from, where there is nothing to search by: {self.words}"
        cure = "Start from a design that can be stabilised and whose runs keep the limits, or check the weights."
        raise InputError("design", got, "a design with a controller", cure)


def best_design(
    problem: CoDesignProblem, cost_from: Callable[[Array], DesignCost], design: Array, rng: np.random.Generator, *,
    name: str, starts: int, evaluations: int, progress: bool = False,
) -> CoDesignResult:  # fmt: skip
    """Best design by a cost, from a feasible one (np,) and other valleys.

    Parameters
    ----------
    problem : CoDesignProblem
    cost_from : callable
        Point (np,) of the unit box that a search starts from → `DesignCost`.
    design : (np,) array
    rng : numpy.random.Generator
        Draws the landscape.
    name : str
        Of the method, in tables.
    starts, evaluations : int
        Starts at most, and evaluations of each.
    progress : bool

    Raises
    ------
    InputError
        If there is no controller at any start.
    """
    space = problem.design
    found = valleys(problem, design, rng=rng) if starts > 1 else ()
    points = start_points(space, design, found, starts)
    begun = [(cost_from(v), v) for v in points]
    if len(begun) > 1:
        begun = [(cost, v) for cost, v in begun if cost.worth_a_start(v)] or begun
    ends = []
    with bar(label=name, total=len(begun), progress=progress) as shown:
        for cost, v in begun:
            first, value = cost.first_point(v)
            end = DesignPoint(first, np.inf, np.zeros(len(first)))
            if np.isfinite(value):
                size = _size(problem, value, first)
                end = descend(cost, cost.space, first, size=size, constant=value - size, evaluations=evaluations)
                end = cost.within_limits(end, evaluations)
            ends.append(end)
            shown.update()
    cost, best = min(((cost, end) for (cost, _), end in zip(begun, ends)), key=lambda pair: pair[1].order)
    count = sum({id(cost): cost.evaluations for cost, _ in begun}.values())
    if not np.isfinite(best.cost):
        return replace(cost.without_design(name, points[0]), evaluations=count, valleys=found)
    result = _result(problem, cost, best)
    if space.integer and starts == 1:
        status = CoDesignStatus.BUDGET_SPENT if result.status.settled else result.status
        result = replace(result, status=status, notes=(*result.notes, OTHERS))
    ended = tuple(_with_end(space, valley, [v for _, v in begun], ends) for valley in found)
    return replace(result, method=name, evaluations=count, valleys=ended)


def _size(problem: CoDesignProblem, value: float, v: Array) -> float:
    """Size of the return at a point, without design cost."""
    size = float(problem.made_by_control(-value, problem.design.from_unit(v[: problem.design.dim])))
    return size if np.isfinite(size) and size > 0 else 1.0


def _result(problem: CoDesignProblem, cost: DesignCost, best: DesignPoint) -> CoDesignResult:
    """Result of the best end."""
    space = cost.space
    best = cost.examined(best)
    found = space.check_feasible(space.settled(best.v))
    multipliers, rest = active_set_at(space, best.v, best.slope, best.active)
    rest /= _size(problem, best.cost, best.v)
    return CoDesignResult(
        design=found[: problem.design.dim], controller=cost.controller(found), history=History.of(cost.rows),
        objective=-best.cost, status=status_of(cost, space, best, rest, bool(multipliers)), slope=rest,
        multipliers=multipliers,
        criterion=f"return of {cost.words}", limits=best.limits,
    )  # fmt: skip


def status_of(cost: DesignCost, space: DesignSpace, best: DesignPoint, rest: float, held: bool) -> CoDesignStatus:
    """Status of a search, whatever its closed loop does."""
    if not rest <= LEVEL_SLOPE:  # of a cost that is never twice the same differences would say nothing
        agree = not cost.repeatable or confirmed(cost, space, best.v, size=best.size)
        return CoDesignStatus.BUDGET_SPENT if agree else CoDesignStatus.GRADIENT_UNTRUSTED
    return CoDesignStatus.AT_BOUND if held else CoDesignStatus.CONVERGED


def _with_end(space: DesignSpace, valley: Valley, points: list[Array], ends: list[DesignPoint]) -> Valley:
    """Valley with the end of the best search from it."""
    v = space.to_unit(valley.design)
    begun = [end for point, end in zip(points, ends) if np.abs(v - point).max() <= SAME_PLACE]
    if not begun:
        return valley
    first = min(begun, key=lambda end: end.order)
    return replace(valley, found=space.settled(first.v[: space.dim]), found_return=-first.cost)


def active_set_at(
    space: DesignSpace, v: Array, slope: Array, violations: Mapping[str, Array]
) -> tuple[dict[str, float], float]:
    """Prices of active bounds and constraints at a point with this slope (np,), and the slope left.

    A price is by how much the return would rise per unit of a bound or constraint; the slope along the directions that
    are left is per unit-box length, NaN where the slope is unknown. Active limits of the closed loop are constraints,
    too: by name, the slopes (np,) of their violations. A whole number is held where it is, but for a bound that the
    return rises across.
    """
    if not np.isfinite(slope).all():
        return {}, float("nan")
    allowed = space.allowed
    free = allowed.free | (allowed.whole & (allowed.sides(v) * slope < 0))
    further, constraints, bounds, rest = allowed.prices(v, -slope, free, tuple(violations.values()))
    prices = dict(zip(violations, further))
    if allowed.limits is not None:
        steepness = allowed.limits.steepness(v, free)
        per_unit = np.divide(constraints, steepness, out=np.zeros(len(constraints)), where=steepness > 0)
        prices |= zip(space.constraint_names, per_unit)
    prices |= zip(space.names, np.abs(bounds) / allowed.width)
    return {name: float(price) for name, price in prices.items() if price > 0}, float(np.linalg.norm(rest))


def confirmed(cost: Cost, space: DesignSpace, v: Array, *, size: float) -> bool:
    """True if differences confirm the slope along a random free direction."""
    free = space.allowed.free
    if not free.any():
        return True
    direction = np.where(free, np.random.default_rng(0).standard_normal(len(v)), 0.0)
    direction /= np.abs(direction).max()
    centre = np.where(free, np.clip(v, COST_STEP, 1 - COST_STEP), v)
    ahead, behind = (cost(centre + side * COST_STEP * direction)[0] for side in (1, -1))
    about = cost(centre)[1]()
    shown = (ahead - behind) / (2 * COST_STEP)
    return bool(np.isfinite(shown) and abs(shown - about @ direction) <= AGREEING * abs(shown) + LEVEL_SLOPE * size)


class SpentError(Exception):
    """Raised when no evaluation is left, or more of them are of no use."""


def descend(
    cost: Cost, space: DesignSpace, v: Array, *, size: float, evaluations: int, constant: float = 0.0
) -> DesignPoint:
    """Least cost found from a feasible unit-box point.

    Fixed entries and whole numbers are held.

    Parameters
    ----------
    cost : Cost
        Its slope is asked for only where the search takes a step from.
    v : (np,) array
    size : float
        Of costs: what gains are compared with.
    evaluations : int
        At most.
    constant : float
        What control does not make of costs.
    """
    limits = space.allowed.limits
    free = space.allowed.free
    watched = _Watched(cost, space, v, size, constant, evaluations)
    constraints = [] if limits is None else [{
        "type": "ineq", "fun": lambda z: -limits.values(watched.point(z)) - EXACT,
        "jac": lambda z: -limits.jacobian(watched.point(z))[:, free],
    }]  # fmt: skip
    if not free.any():
        watched.value(v[free])
        return watched.ended()
    with suppress(SpentError):
        for _ in range(3):  # searches follow one another while they gain
            begin, before, _ = watched.best
            minimize(watched.value, begin[free], jac=watched.slope, method="SLSQP",
                     bounds=[(0.0, 1.0)] * int(free.sum()), constraints=constraints,
                     options={"maxiter": evaluations, "ftol": 1e-10})  # fmt: skip
            if not watched.best[1] < before - GAINED * size:
                break
    return watched.ended()


class _Watched:
    """Relative cost of free entries z that remembers its last and its best point, with cost and slope."""

    def __init__(
        self, cost: Cost, space: DesignSpace, v: Array, size: float, constant: float, evaluations: int
    ) -> None:
        self._cost = cost
        self._allowed = space.allowed
        self._size = size
        self._left = evaluations
        self._spent = False
        self._constant = constant
        self._last: tuple[Array, float, Callable[[], Array]] = (np.full(len(v), np.nan), np.inf, lambda: v)
        self.best: tuple[Array, float, Callable[[], Array]] = (v, np.inf, lambda: np.zeros(len(v)))

    def point(self, z: Array) -> Array:
        """Whole point with the free entries `z`."""
        v = self.best[0].copy()
        v[self._allowed.free] = np.where(z < AT_BOUND, 0.0, np.where(z > 1 - AT_BOUND, 1.0, z))
        return v

    def value(self, z: Array) -> float:
        """Cost, beyond `COMPRESS_ABOVE` its logarithm.

        Raises
        ------
        SpentError
            If that would be an evaluation too many.
        """
        v = self.point(z)
        if not np.array_equal(v, self._last[0]):
            if not self._left:
                self._spent = True
                raise SpentError
            self._left -= 1
            cost, slope = self._cost(v)
            self._last = (v, cost, cache(slope))
            if cost < self.best[1] and self._allowed.violation(v) <= EXACT:
                self.best = self._last
        return compressed(self._relative) if np.isfinite(self._relative) else LOST_COST

    def slope(self, z: Array) -> Array:
        """Slope of the cost by free entries, zero where there is none."""
        self.value(z)
        relative = self._relative
        if not np.isfinite(relative):
            return np.zeros(len(z))
        own = self._last[2]()[self._allowed.free] / self._size
        own = own * (COMPRESS_ABOVE / relative if relative > COMPRESS_ABOVE else 1.0)
        return own if np.isfinite(own).all() else np.zeros(len(z))

    @property
    def _relative(self) -> float:
        """Last cost without the constant, by the size."""
        return (self._last[1] - self._constant) / self._size

    def ended(self) -> DesignPoint:
        """Best point, with its slope."""
        v, cost, slope = self.best
        return DesignPoint(v, cost, slope(), self._size, self._constant, self._spent)


def compressed(relative: float) -> float:
    """Relative cost, logarithmic beyond `COMPRESS_ABOVE`."""
    high = relative > COMPRESS_ABOVE
    return COMPRESS_ABOVE * (1 + float(np.log(relative / COMPRESS_ABOVE))) if high else float(relative)
