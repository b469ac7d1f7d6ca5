"""Closed-loop cost of a law, with its slope by the design.

With limits it is searched again while they are priced.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.differentiable_model import ScenarioTensors, Stepper, in_double, to_design
from ccdtools.co_design.episodes import Episode, simulated
from ccdtools.co_design.limits import StateLimitPenalty
from ccdtools.co_design.methods.design_cost import DesignCost, HistoryRow
from ccdtools.co_design.methods.laws import DesignLaw, LQRLaw
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.risk_intervals import of_kept_runs
from ccdtools.co_design.task import LimitPenalty
from ccdtools.co_design.tolerances import COST_STEP
from ccdtools.controllers.controllers import Controller
from mpc import NotStabilisableError


@dataclass(eq=False)
class LoopCost(DesignCost):
    """Cost (minus mean return) of a law on fixed scenarios, over the unit box.

    Parameters
    ----------
    problem : CoDesignProblem
        Its discrepancy, risk and limits are honoured.
    law : DesignLaw
    scenarios : tensors (n, nx) and (n, T, nw)
    penalty : LimitPenalty, optional
        What leaving the limits costs.
    """

    problem: CoDesignProblem
    law: DesignLaw
    scenarios: ScenarioTensors
    penalty: LimitPenalty | None = None
    rows: list[HistoryRow] = field(default_factory=list)  # of the history: one for every evaluation
    evaluations: int = 0  # closed loops on all scenarios, those of differences included

    def __post_init__(self) -> None:
        self.problem = in_double(self.problem)
        x0, w = self.scenarios
        self.scenarios = x0.double(), w.double()
        self.slope_is_expensive = not self.law.differentiable  # differences of whole closed loops

    @property
    def words(self) -> str:
        """Description of the cost in words."""
        return f"{self.law.words} in closed loop on {len(self.scenarios[0])} scenarios"

    def __call__(self, v: Array) -> tuple[float, Array]:
        """Cost and slope (np,) at a point (np,); infinite without a gain."""
        if self.slope_is_expensive:
            return self.value(v), self.slope(v)
        point = torch.tensor(v, dtype=torch.float64, requires_grad=True)
        cost = self._cost(point, v)
        if cost is None or not cost.requires_grad:
            return np.inf if cost is None else float(cost), np.zeros(len(v))
        (slope,) = torch.autograd.grad(cost, point)
        return float(cost.detach()), slope.numpy()

    @torch.no_grad()
    def value(self, v: Array, *, remember: bool = True) -> float:
        """Cost alone."""
        cost = self._cost(torch.tensor(v, dtype=torch.float64), v if remember else None)
        return np.inf if cost is None else float(cost)

    def slope(self, v: Array) -> Array:
        """Slopes (np,) by differences of whole closed loops."""
        return np.asarray(self._differences(v, lambda at: np.array([self.value(at, remember=False)]), 1)[0])

    def _differences(self, v: Array, values: Callable[[Array], Array], count: int) -> Array:
        """Slopes (count, np) of values (count,), central or one-sided at a bound."""
        slopes = np.zeros((count, len(v)))
        for i in np.flatnonzero(self.problem.design.allowed.free):
            ends = []
            for side in (COST_STEP, -COST_STEP):
                at = v.copy()
                at[i] = np.clip(v[i] + side, 0.0, 1.0)
                ends.append((at[i], values(at)))
            (high, above), (low, below) = ends
            slopes[:, i] = (above - below) / (high - low)
        return slopes

    def _cost(self, point: Tensor, v: Array | None) -> Tensor | None:
        """Cost at a point, None without a gain; `v` adds a history row."""
        self.evaluations += 1
        try:
            seen = self._episode(point)
        except NotStabilisableError:  # any other error is a mistake in what was stated
            return None
        values = self.problem.risk.values(seen.total)
        if v is not None:
            self._remember(v, seen)
        cost: Tensor = -values.mean()
        if self.penalty is not None and self.penalty.active and not bool(seen.diverged.any()):
            cost = cost + self.penalty.cost(seen, point)
        return cost

    def updated(self, penalty: StateLimitPenalty, v: Array) -> tuple[Episode, StateLimitPenalty]:
        """Episodes at a point, and the penalty afterwards."""
        seen = self.seen(v)
        if bool(seen.diverged.any()):
            return seen, penalty
        x0, w = self.scenarios
        return seen, penalty.updated(seen, torch.tensor(v, dtype=torch.float32), (x0.float(), w.float()))

    @torch.no_grad()
    def seen(self, v: Array) -> Episode:
        """Episodes of the law at a point, with limit violations."""
        return self._episode(torch.tensor(v, dtype=torch.float64), depths=True)

    def _episode(self, v: Tensor, *, depths: bool = False) -> Episode:
        """Episodes at a unit-box point."""
        p = to_design(self.problem, v)
        law = self.law.law(self.problem, p)
        watched = depths or (self.penalty is not None and self.penalty.active)
        return simulated(Stepper.at(self.problem, p), law, self.scenarios, depths=watched)

    def _remember(self, v: Array, seen: Episode) -> None:
        """Add a row to the history."""
        mean, std, lost = of_kept_runs(self.problem.risk, seen.total.detach().numpy(), seen.diverged.numpy())
        count = len(self.rows) + 1
        samples = self.scenarios[1].shape[0] * self.scenarios[1].shape[1]
        design = self.problem.design.from_unit(v)
        self.rows.append((count, count * samples, design, mean, std, lost))

    def worth_a_start(self, v: Array) -> bool:
        """Whether saturated LQR, which is cheap, loses no run at a point."""
        if not self.slope_is_expensive:
            return True
        try:
            return not bool(LoopCost(self.problem, LQRLaw(), self.scenarios).seen(v).diverged.any())
        except NotStabilisableError:
            return False

    def controller(self, p: Array) -> Controller:
        """Law at a design, for use."""
        return self.law.controller(self.problem, p)
