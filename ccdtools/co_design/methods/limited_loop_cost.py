"""Closed-loop cost of a law within its limits.

The search over designs is repeated while leaving the limits is cheap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from ccdtools.arrays import Array
from ccdtools.co_design.differentiable_model import ScenarioTensors
from ccdtools.co_design.limits import StateLimitPenalty
from ccdtools.co_design.methods.descent import descend
from ccdtools.co_design.methods.design_cost import End
from ccdtools.co_design.methods.laws import DesignLaw
from ccdtools.co_design.methods.loop_cost import LoopCost
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import (
    NEGLIGIBLE_GAIN,
    PRICE_GROWTH,
    ROUNDS_AT_ONE_DESIGN,
    ROUNDS_WITHOUT_GAIN,
    USED_SHARE,
)
from ccdtools.plants.tolerances import EXACT
from mpc import NotStabilisableError


@dataclass(frozen=True, eq=False)
class LimitedEnd(End):
    """End of a search with prices on limits."""

    penalty: StateLimitPenalty | None = None


class LimitedLoopCost(LoopCost):
    """Cost in closed loop, for the cheapest design within limits."""

    def least(self, v: Array, *, size: float, evaluations: int) -> End:
        """End of repeated searches, from where one ended without a price."""
        cost: LimitedLoopCost = self
        found = descend(cost, self.problem.design, v, size=size, evaluations=evaluations)
        penalty = StateLimitPenalty(self.problem)
        ends: list[LimitedEnd] = []
        for _ in range(30 if np.isfinite(found.cost) else 0):  # rounds of the multipliers
            seen, penalty = cost.updated(penalty, found.v)
            if bool(seen.diverged.any()):
                break
            plain = float(-self.problem.risk.values(seen.total).mean())
            violation = penalty.violation(seen)
            ends.append(LimitedEnd(cost, replace(found, cost=plain), size, violation, penalty=penalty))
            unpriced = cost.penalty is None
            enough = violation <= 0 and (unpriced or found.spent)
            if not penalty.active or enough or _settled(ends):
                break
            if not unpriced and violation > 0:
                penalty = penalty.dearer(PRICE_GROWTH)
            cost = LimitedLoopCost(self.problem, self.law, self.scenarios, penalty, cost.rows, cost.evaluations)
            found = descend(cost, self.problem.design, found.v, size=size, evaluations=evaluations)
        if not ends:
            return End(cost, found, size)
        best = replace(min(ends, key=lambda end: end.order), cost=cost)
        broken = [end for end in ends if end.violation > 0 and end.found.cost < best.found.cost]
        if best.violation > 0 or not broken:
            return best
        return cost.nearer(best, min(broken, key=lambda end: end.violation))

    def nearer(self, best: LimitedEnd, broken: LimitedEnd) -> LimitedEnd:
        """Cheapest design within limits, on the way from `best` to `broken`.

        Prices aim a little within the limits, so that something of the way is left.
        """
        begin = best.found.v
        assert best.penalty is not None
        near, far = 0.0, 1.0
        for _ in range(8):
            share = (near + far) / 2
            v = begin + share * (broken.found.v - begin)
            self.evaluations += 1
            try:
                seen = self.seen(v)
            except NotStabilisableError:
                far = share
                continue
            plain = float(-self.problem.risk.values(seen.total).mean())
            penalty = replace(best.penalty, v=torch.tensor(v, dtype=torch.float32))
            impossible = bool(seen.diverged.any()) or self.problem.design.allowed.violation(v) > EXACT
            if impossible or penalty.violation(seen) > 0 or plain >= best.found.cost:
                far = share
            else:
                near = share
                best = replace(best, found=replace(best.found, v=v, cost=plain), penalty=penalty)
        return best

    def examined(self, end: End) -> End:
        """End with its limits; those priced and used up count as constraints."""
        if not isinstance(end, LimitedEnd) or end.penalty is None:
            return end
        v = end.found.v
        outcome = end.penalty.outcome(self.seen(v))
        if not end.penalty.active:
            return replace(end, limits=outcome)
        slope, *violations = self._differences(v, self._cost_and_violations, 3)
        named = zip(("mean violation of the limits", "peak violation of the limits"), violations)
        measures = (outcome.achieved, outcome.errors, outcome.tolerance, outcome.multipliers)
        used = zip(*(measure.values() for measure in measures))
        active = [price > 0 and value + error >= USED_SHARE * most for value, error, most, price in used]
        return replace(end, limits=outcome, found=replace(end.found, slope=slope),
                       active=dict(one for one, is_so in zip(named, active) if is_so))  # fmt: skip

    def _cost_and_violations(self, v: Array) -> Array:
        """Cost without penalty, and mean and peak violation, (3,)."""
        seen = self.seen(v)
        cost = -self.problem.risk.values(seen.total).mean()
        return np.array([float(cost), float(seen.depth.mean()), float(seen.peak.mean())])


def loop_cost(problem: CoDesignProblem, law: DesignLaw, scenarios: ScenarioTensors) -> LoopCost:
    """Closed-loop cost of a law, within limits that have a tolerance."""
    return (LoopCost if problem.limit_tolerance == "off" else LimitedLoopCost)(problem, law, scenarios)


def _settled(ends: list[LimitedEnd]) -> bool:
    """Whether further rounds of prices would change nothing."""
    kept = [end.violation <= 0 for end in ends]
    if any(kept):
        costs = np.minimum.accumulate([end.found.cost if keeps else np.inf for end, keeps in zip(ends, kept)])
        n = ROUNDS_WITHOUT_GAIN
        return len(ends) > n and bool(costs[-1 - n] - costs[-1] <= n * NEGLIGIBLE_GAIN * ends[-1].size)
    last = [end.found.v for end in ends[-ROUNDS_AT_ONE_DESIGN:]]
    return len(last) == ROUNDS_AT_ONE_DESIGN and all(np.array_equal(v, last[0]) for v in last)
