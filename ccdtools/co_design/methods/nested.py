"""Nested co-design: an outer search over the designs, and inside it the controller of each design.

References
----------
Fathy, Reyer, Papalambros and Ulsoy, "On the coupling between the plant and controller optimization problems", ACC
2001; Herber and Allison, "Nested and simultaneous solution strategies for general combined plant and control design
problems", Journal of Mechanical Design 141, 2019.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ccdtools.arrays import Array
from ccdtools.checks import as_choice, as_count
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.episodes import fewer_runs
from ccdtools.co_design.landscape import valleys
from ccdtools.co_design.limits import StateLimitPenalty
from ccdtools.co_design.methods.laws import DesignLaw, LQRLaw, MPCLaw, NonlinearMPCLaw
from ccdtools.co_design.methods.loop_cost import LoopCost
from ccdtools.co_design.methods.outer import Descent, confirmed, descend, held_by
from ccdtools.co_design.methods.starting import SAME_PLACE, start_points
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult, Valley
from ccdtools.co_design.status import CoDesignStatus
from ccdtools.co_design.task import LimitPenalty
from ccdtools.exceptions import InputError
from ccdtools.progress import bar

INNER = ("lqr", "mpc", "nmpc")
RUNS = {"lqr": 1000, "mpc": 32, "nmpc": 16}  # scenarios of 100 steps
STARTS = 3
ROUNDS = 30  # of the multipliers of limits
LEVEL = 1e-3  # of the return that control makes, per length of the unit box: a slope without consequence


@dataclass(frozen=True)
class Nested:
    """An outer search by SQP with exact slopes; inside, for every design, its own controller in closed loop.

    Attributes
    ----------
    inner : {"lqr", "mpc"}
        Saturated LQR by the Riccati equation; linear MPC.
    runs : int, optional
        Scenarios of 100 steps; of longer ones fewer are taken. By default 1000 of LQR, 32 of MPC.
    starts : int
        Designs to start from: the given one, and the best valleys of the landscape of saturated LQR.
    evaluations : int
        Of closed loops with their slopes, at most, of each start.
    horizon : int
        Steps of the MPC.
    """

    inner: str = "lqr"
    runs: int | None = None
    starts: int = STARTS
    evaluations: int = 100
    horizon: int = 20

    def __post_init__(self) -> None:
        as_choice("inner", self.inner, INNER)
        for name in ("starts", "evaluations", "horizon"):
            as_count(name, getattr(self, name))
        if self.runs is not None:
            as_count("runs", self.runs)

    @property
    def name(self) -> str:
        """What tables call it."""
        return f"nested {self.inner.upper()}"

    def run(
        self, problem: CoDesignProblem, design: Array, rng: np.random.Generator, *, progress: bool = False
    ) -> CoDesignResult:
        """The best design found from a feasible design (np,) and other valleys, with its controller."""
        law = self._law()
        scenarios = scenario_tensors(problem, fewer_runs(self.runs or RUNS[self.inner], problem.steps), rng)
        return searched(self, problem, law, scenarios, design, rng, progress=progress)

    def _law(self) -> DesignLaw:
        """The controllers of the designs."""
        if self.inner == "lqr":
            return LQRLaw()
        return MPCLaw(self.horizon) if self.inner == "mpc" else NonlinearMPCLaw(self.horizon)


def searched(
    method: Any, problem: CoDesignProblem, law: DesignLaw, scenarios: Any, design: Array, rng: np.random.Generator, *,
    progress: bool = False,
) -> CoDesignResult:  # fmt: skip
    """The best design of a law in closed loop, from the starts of a method."""
    found = valleys(problem, design, rng=rng) if method.starts > 1 else ()
    starts = start_points(problem.design, design, found, method.starts)
    ends: list[tuple[LoopCost, Descent, LimitPenalty | None]] = []
    with bar(label=method.name, total=len(starts), progress=progress) as shown:
        for v in starts:
            ends.append(_within_limits(problem, law, scenarios, v, method.evaluations))
            shown.update()
    cost, best, penalty = min(ends, key=_order)
    if not np.isfinite(best.cost):
        raise InputError(
            "design", problem.design.describe(design), f"a design that {law.words} can be built for",
            "Start from one that can be stabilised, or check the weights.",
        )  # fmt: skip
    evaluations = sum(len(one.rows) for one, *_ in ends)
    return result_of(method.name, cost, best, penalty, evaluations, _with_ends(problem, found, starts, ends))


def _within_limits(
    problem: CoDesignProblem, law: DesignLaw, scenarios: Any, v: Array, evaluations: int
) -> tuple[LoopCost, Descent, LimitPenalty | None]:
    """The search from one start, again and again while leaving the limits is priced too low."""
    penalty: LimitPenalty | None = None if problem.limit_tolerance == "off" else StateLimitPenalty(problem)
    cost = LoopCost(problem, law, scenarios)
    size = _size(problem, cost, v)
    found = descend(cost, problem.design, v, size=size, evaluations=evaluations)
    if penalty is None or not np.isfinite(found.cost):
        return cost, found, penalty
    best: tuple[float, float, Descent, LimitPenalty] | None = None
    for _ in range(ROUNDS):
        seen = cost.seen(found.v)
        if bool(seen.diverged.any()):
            return cost, found, penalty
        penalty = penalty.updated(seen, torch.tensor(found.v, dtype=torch.float32), cost.scenarios)
        plain = float(-problem.risk.values(seen.total).mean())
        tried = (penalty.violation(seen), plain, replace_cost(found, plain), penalty)
        best = tried if best is None or tried[:2] < best[:2] else best
        if not penalty.active or found.spent:
            break
        cost = LoopCost(problem, law, scenarios, penalty, cost.rows)
        found = descend(cost, problem.design, found.v, size=size, evaluations=evaluations)
    assert best is not None
    return cost, best[2], best[3]


def replace_cost(found: Descent, cost: float) -> Descent:
    """The same descent with the cost that its design has without the price of limits."""
    return Descent(found.v, cost, found.slope, found.evaluations, found.path, found.spent)


def _size(problem: CoDesignProblem, cost: LoopCost, v: Array) -> float:
    """How large the return at a start is, without the cost of the design."""
    value = cost(v)[0]
    size = float(problem.made_by_control(-value, problem.design.from_unit(v)))
    return size if np.isfinite(size) and size > 0 else 1.0


def _order(end: tuple[LoopCost, Descent, LimitPenalty | None]) -> tuple[float, float]:
    """What the best start is the least of: how far limits are left, then the cost."""
    cost, found, penalty = end
    violation = 0.0 if penalty is None or not np.isfinite(found.cost) else penalty.violation(cost.seen(found.v))
    return (violation, found.cost)


def result_of(
    method: str, cost: LoopCost, best: Descent, penalty: LimitPenalty | None, evaluations: int,
    found: tuple[Valley, ...],
) -> CoDesignResult:  # fmt: skip
    """The result of a search in closed loop."""
    problem = cost.problem
    space = problem.design
    design = space.settled(best.v)
    seen = cost.seen(best.v)
    held = held_by(space, best.v, best.slope)
    size = float(problem.made_by_control(best.cost, design)) or 1.0
    return CoDesignResult(
        design=design, controller=cost.law.controller(problem, design), method=method,
        status=_status(cost, best, penalty, held.rest / size, size),
        objective=-best.cost, criterion=f"return of {cost.words}", active_bounds=space.active_bounds(design),
        active_constraints=space.active_constraints(design), multipliers=held.multipliers, slope=held.rest / size,
        evaluations=evaluations, history=cost.history(), valleys=found,
        limits=None if penalty is None else penalty.outcome(seen),
    )  # fmt: skip


def _status(cost: LoopCost, best: Descent, penalty: LimitPenalty | None, rest: float, size: float) -> CoDesignStatus:
    """How a search ended."""
    seen = cost.seen(best.v)
    space = cost.problem.design
    if bool(seen.diverged.any()):
        return CoDesignStatus.DIVERGING
    if penalty is not None and penalty.violation(seen) > 0:
        return CoDesignStatus.LIMITS_BROKEN
    if rest > LEVEL:
        agree = confirmed(cost, space, best.v, best.slope, size=size)
        return CoDesignStatus.BUDGET_SPENT if agree else CoDesignStatus.GRADIENT_UNTRUSTED
    held = held_by(space, best.v, best.slope).multipliers
    return CoDesignStatus.AT_BOUND if held else CoDesignStatus.CONVERGED


def _with_ends(problem: CoDesignProblem, found: tuple[Valley, ...], starts: list[Array], ends: list[Any]) -> Any:
    """The valleys, with where the search that began on each of them ended."""
    named = []
    for valley in found:
        v = problem.design.to_unit(valley.design)
        begun = [end for start, end in zip(starts, ends) if np.abs(v - start).max() <= SAME_PLACE]
        if begun:
            descent = min(begun, key=_order)[1]
            valley = replace(valley, found=problem.design.settled(descent.v), found_return=-descent.cost)
        named.append(valley)
    return tuple(named)
