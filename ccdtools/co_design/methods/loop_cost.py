"""Closed-loop cost of a law within its limits, with its slope by the design.

The search over designs is repeated while leaving the limits is cheap.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.budgets import ROUNDS_AT_ONE_DESIGN, ROUNDS_WITHOUT_GAIN
from ccdtools.co_design.design_controllers import LQR, DesignLaw
from ccdtools.co_design.design_search import DesignCost, DesignPoint, descend
from ccdtools.co_design.differentiable_model import Episode, Law, ScenarioTensors, Stepper, in_double, simulated
from ccdtools.co_design.limits import LimitsOutcome, StateLimitPenalty
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.risk import of_kept_runs
from ccdtools.co_design.tolerances import NEGLIGIBLE_GAIN, PRICE_GROWTH, USED_SHARE
from ccdtools.controllers.controllers import Controller
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.tolerances import EXACT
from mpc import NotStabilisableError


@dataclass(eq=False)
class LoopCost(DesignCost):
    """Cost (minus mean return) of a law on fixed scenarios, over the unit box.

    The problem's discrepancy, risk and limits are honoured.
    """

    law: DesignLaw
    scenarios: ScenarioTensors  # (n, nx) and (n, T, nw)
    # what leaving the limits costs; `within_limits` raises it until they are kept, where they have a tolerance
    penalty: StateLimitPenalty | None = None
    searched: DesignSpace | None = None  # the design with the parameters of the law behind it, where it has any
    evaluations: int = 0  # closed loops on all scenarios, those of differences included

    def __post_init__(self) -> None:
        self.problem = in_double(self.problem)
        x0, w = self.scenarios
        self.scenarios = x0.double(), w.double()

    @property
    def space(self) -> DesignSpace:
        """What a search moves: the design, then any parameters of the law."""
        return self.searched or self.problem.design

    @property
    def words(self) -> str:
        """Description of the cost in words."""
        return f"{self.law.words} in closed loop on {len(self.scenarios[0])} scenarios"

    def __call__(self, v: Array) -> tuple[float, Callable[[], Array]]:
        """Cost at a point (np,), and its slope (np,): exact, or by differences of whole closed loops."""
        exact = self.law.exact is not None
        point = torch.tensor(v, dtype=torch.float64, requires_grad=exact)
        self.evaluations += 1
        try:
            with torch.set_grad_enabled(exact):
                at = self._at(point)
                law = self._law(self.problem, at)
                seen = simulated(Stepper.at(self.problem, self._design(at)), law, self.scenarios, depths=self._priced)
                cost = self._cost(seen, self._design(point))
        except NotStabilisableError:  # any other error is a mistake in what was stated
            return np.inf, lambda: np.zeros(len(v))
        found = of_kept_runs(self.problem.risk, seen.total.detach().numpy(), seen.diverged.numpy())
        p = self.problem.design.from_unit(self._design(v))
        self.remember(p, *found, samples=math.prod(self.scenarios[1].shape[:2]))
        if not exact:
            return float(cost), lambda: self.differences(v, self._value_at, 1)[0]
        if not cost.requires_grad:
            return float(cost), lambda: np.zeros(len(v))
        return float(cost.detach()), lambda: torch.autograd.grad(cost, point)[0].numpy()

    @torch.no_grad()
    def _value_at(self, v: Array) -> Array:
        """Cost alone (1,), not in the history."""
        self.evaluations += 1
        try:
            return np.array([float(self._cost(self.seen(v), self._design(torch.tensor(v))))])
        except NotStabilisableError:
            return np.array([np.inf])

    @property
    def _priced(self) -> bool:
        """Whether leaving the limits costs anything now."""
        return self.penalty is not None and self.penalty.active

    def _cost(self, seen: Episode, point: Tensor) -> Tensor:
        """Cost of episodes at a point, with that of leaving the limits."""
        cost: Tensor = -self.problem.risk.values(seen.total).mean()
        if self.penalty is not None and self._priced and not bool(seen.diverged.any()):
            cost = cost + self.penalty.cost(seen, point)
        return cost

    def measured(self, v: Array) -> tuple[float, float]:
        """Cost and limit violation at a point, without slope; the tolerance of the limits follows."""
        try:
            if self.penalty is None:
                return self.plain(self.seen(v)), 0.0
            seen, self.penalty = self.updated(self.penalty, v)
        except NotStabilisableError:
            return np.inf, 0.0
        return self.plain(seen), self.penalty.violation(seen)

    def limits(self, v: Array) -> LimitsOutcome | None:
        """Violation of the limits at a point, whose tolerance is extrapolated on the way; None without a price."""
        if self.penalty is None:
            return None
        seen, penalty = self.updated(StateLimitPenalty(self.problem), v)
        return penalty.outcome(seen)

    def updated(self, penalty: StateLimitPenalty, v: Array) -> tuple[Episode, StateLimitPenalty]:
        """Episodes at a point, and the penalty afterwards."""
        seen = self.seen(v)
        if bool(seen.diverged.any()):
            return seen, penalty
        x0, w = self.scenarios
        at = self._design(torch.tensor(v, dtype=torch.float32))
        return seen, penalty.updated(seen, at, (x0.float(), w.float()))

    @torch.no_grad()
    def seen(self, v: Array) -> Episode:
        """Episodes of the law at a point, with limit violations."""
        at = self._at(torch.tensor(v, dtype=torch.float64))
        law = self._law(self.problem, at)
        return simulated(Stepper.at(self.problem, self._design(at)), law, self.scenarios, depths=True)

    def _design(self, v: Any) -> Any:
        """Entries (np,) of the design in a point, an array or a tensor."""
        return v[: self.problem.design.dim]

    def _at(self, v: Tensor) -> Tensor:
        """Entries of a point of the unit box, as they are."""
        lower = v.new_tensor(self.space.lower.tolist())
        return lower + v * (v.new_tensor(self.space.upper.tolist()) - lower)

    @property
    def _law(self) -> Callable[[CoDesignProblem, Tensor], Law]:
        """Problem and point (np + parameters,) → law, differentiable where it can be."""
        return self.law.exact or self.law.on_line

    def plain(self, seen: Episode) -> float:
        """Cost of episodes, whatever they do to the limits."""
        return float(-self.problem.risk.values(seen.total).mean())

    def first_point(self, v: Array) -> tuple[Array, float]:
        """Point to search from, the parameters of the law in the middle of their ranges, and its cost."""
        first = np.r_[v, np.full(self.space.dim - len(v), 0.5)]
        return first, self(first)[0]

    def worth_a_start(self, v: Array) -> bool:
        """Whether saturated LQR, which is cheap, loses no run at a point."""
        if self.law.exact is not None:
            return True
        try:
            return not bool(LoopCost(self.problem, LQR, self.scenarios).seen(v).diverged.any())
        except NotStabilisableError:
            return False

    def controller(self, p: Array) -> Controller:
        """Law at a design, for use."""
        return self.law.controller(self.problem, p)

    def within_limits(self, found: DesignPoint, evaluations: int) -> DesignPoint:
        """Best point of repeated searches at rising prices, from where one ended without a price."""
        if self.problem.limit_tolerance == "off" or not np.isfinite(found.cost):
            return found
        unpriced = found
        penalty = StateLimitPenalty(self.problem)
        ends: list[DesignPoint] = []
        for _ in range(30):  # rounds of the multipliers
            seen, penalty = self.updated(penalty, found.v)
            if bool(seen.diverged.any()):
                break
            violation = penalty.violation(seen)
            ends.append(replace(found, cost=self.plain(seen), violation=violation, penalty=penalty))
            enough = violation <= 0 and (self.penalty is None or found.spent)
            if not penalty.active or enough or _settled(ends):
                break
            self.penalty = penalty.dearer(PRICE_GROWTH) if violation > 0 and self.penalty is not None else penalty
            penalty = self.penalty
            found = descend(
                self, self.space, found.v, size=found.size, constant=found.constant, evaluations=evaluations
            )
        if not ends:
            return unpriced
        best = min(ends, key=lambda end: end.order)
        broken = [end for end in ends if end.violation > 0 and end.cost < best.cost]
        if best.violation > 0 or not broken:
            return best
        return self.nearer(best, min(broken, key=lambda end: end.violation).v)

    def nearer(self, best: DesignPoint, broken: Array) -> DesignPoint:
        """Cheapest design within limits, on the way from `best` to a point outside.

        Prices aim a little within the limits, so that something of the way is left.
        """
        begin = best.v
        assert best.penalty is not None
        near, far = 0.0, 1.0
        for _ in range(8):
            share = (near + far) / 2
            v = begin + share * (broken - begin)
            self.evaluations += 1
            try:
                seen = self.seen(v)
            except NotStabilisableError:
                far = share
                continue
            plain = self.plain(seen)
            penalty = replace(best.penalty, v=self._design(torch.tensor(v, dtype=torch.float32)))
            impossible = bool(seen.diverged.any()) or self.space.allowed.violation(v) > EXACT
            if impossible or penalty.violation(seen) > 0 or plain >= best.cost:
                far = share
            else:
                near = share
                best = replace(best, v=v, cost=plain, penalty=penalty)
        return best

    def examined(self, found: DesignPoint) -> DesignPoint:
        """Best point with its limits; those priced and used up count as constraints."""
        if found.penalty is None:
            return found
        outcome = found.penalty.outcome(self.seen(found.v))
        if not found.penalty.active:
            return replace(found, limits=outcome)
        slope, *violations = self.differences(found.v, self._cost_and_violations, 3)
        named = zip(("mean violation of the limits", "peak violation of the limits"), violations)
        measures = (outcome.achieved, outcome.errors, outcome.tolerance, outcome.multipliers)
        used = zip(*(measure.values() for measure in measures))
        active = [price > 0 and value + error >= USED_SHARE * most for value, error, most, price in used]
        held = dict(one for one, is_so in zip(named, active) if is_so)
        return replace(found, limits=outcome, slope=slope, active=held)

    def _cost_and_violations(self, v: Array) -> Array:
        """Cost without penalty, and mean and peak violation, (3,)."""
        seen = self.seen(v)
        return np.array([self.plain(seen), float(seen.depth.mean()), float(seen.peak.mean())])


def _settled(ends: list[DesignPoint]) -> bool:
    """Whether further rounds of prices would change nothing."""
    kept = [end.violation <= 0 for end in ends]
    if any(kept):
        costs = np.minimum.accumulate([end.cost if keeps else np.inf for end, keeps in zip(ends, kept)])
        n = ROUNDS_WITHOUT_GAIN
        return len(ends) > n and bool(costs[-1 - n] - costs[-1] <= n * NEGLIGIBLE_GAIN * ends[-1].size)
    last = [end.v for end in ends[-ROUNDS_AT_ONE_DESIGN:]]
    return len(last) == ROUNDS_AT_ONE_DESIGN and all(np.array_equal(v, last[0]) for v in last)
