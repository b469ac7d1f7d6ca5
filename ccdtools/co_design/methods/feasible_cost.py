"""Comparable values of a problem at any unit-box point."""

from __future__ import annotations

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.budgets import SIZE_EVALUATIONS
from ccdtools.co_design.design_search import DesignCost, compressed
from ccdtools.co_design.tolerances import BETTER_SHARE, DISTANCE_COST, LEAST_TOLERANCE, LOST_COST, VIOLATION_COST

Evaluation = tuple[Array, float, float, float]
"""Free entries z (n,), cost (infinite where there is none), squared distance of the feasible design looked at, and its
violation of the limits."""


class FeasibleCost:
    """Value of the nearest feasible design at any unit-box point.

    A little is taken off for the distance.
    """

    def __init__(self, cost: DesignCost, start: Array) -> None:
        self.cost = cost
        self.space = cost.problem.design
        self.start = self.space.allowed.rounded(start)
        self.free = self.space.free
        self.best: tuple[float, float] = (np.inf, np.inf)  # violation and cost
        self.best_v = self.start
        self.looks: list[Evaluation] = []

    @property
    def size(self) -> float:
        """Size of costs."""
        known = [abs(cost) for _, cost, *_ in self.looks if np.isfinite(cost) and cost != 0]
        return float(np.quantile(known[:SIZE_EVALUATIONS], BETTER_SHARE)) if known else 1.0

    def begin(self, budget: int, rng: np.random.Generator) -> None:
        """Evaluate the start, then random points until one has a value."""
        z = np.asarray(self.start[self.free])
        for _ in range(budget):
            self(z)
            if np.isfinite(self.best[1]):
                break
            z = rng.random(len(z))

    def __call__(self, z: Array) -> float:
        """Merit at free entries `z`, to be small."""
        self.looks.append(self._looked(z))
        return self.merit(*self.looks[-1])

    def merit(self, z: Array, cost: float, away: float = 0.0, violation: float = 0.0) -> float:
        """Merit of an evaluation at `z`, by the current size of costs."""
        size = self.size
        if not np.isfinite(cost):
            return LOST_COST * size
        beyond = VIOLATION_COST * violation / LEAST_TOLERANCE
        return float(size * (compressed(cost / size) + DISTANCE_COST * away + beyond))

    def _looked(self, z: Array) -> Evaluation:
        """Evaluate the nearest feasible design."""
        asked = self.start.copy()
        asked[self.free] = np.clip(z, 0.0, 1.0)
        allowed = self.space.allowed
        v = allowed.near(allowed.rounded(asked))
        if v is None:
            return z, np.inf, 0.0, 0.0
        cost, violation = self.cost.measured(v)
        self.cost.remember(self.space.settled(v), -cost)
        if not np.isfinite(cost):
            return z, np.inf, 0.0, 0.0
        if (violation, cost) < self.best:
            self.best, self.best_v = (violation, cost), v
        return z, cost, float(np.sum((asked - v) ** 2)), violation
