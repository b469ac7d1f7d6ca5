"""Costs of the design alone, with their slopes: of a law in closed loop, and of a policy trained anew at every design.

By the envelope theorem the slope of the best policy's cost is that of the cost with the policy held.

References
----------
Tsai, Karkaria, Chen and Chen, "Digital twin-enabled multi-generation control co-design with deep reinforcement
learning" (the bi-level framework); Milgrom and Segal, Econometrica 70(2), 2002 (envelope theorem).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.co_design.differentiable_model import ScenarioTensors, Stepper, in_double, to_design
from ccdtools.co_design.episodes import Episode, episode_at, simulated
from ccdtools.co_design.limits import StateLimitPenalty
from ccdtools.co_design.methods.laws import DesignLaw
from ccdtools.co_design.methods.learned import Learned
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import History
from ccdtools.co_design.risk_intervals import of_kept_runs
from ccdtools.co_design.task import LimitPenalty
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.learned import LearnedPolicy
from learning.networks import ActorCritic
from mpc import NotStabilisableError

STEP = 1e-4  # of the unit box: of differences
ITERATIONS = 40  # of the policy at every design


@dataclass(eq=False)
class LoopCost:
    """Minus the mean return of a law at points of the unit box, all on the same scenarios.

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
    rows: list[tuple] = field(default_factory=list)  # of the history: one for every evaluation
    evaluations: int = 0  # closed loops on all scenarios, those of differences included

    def __post_init__(self) -> None:
        self.problem = in_double(self.problem)
        x0, w = self.scenarios
        self.scenarios = x0.double(), w.double()

    @property
    def words(self) -> str:
        """What it is."""
        return f"{self.law.words} in closed loop on {len(self.scenarios[0])} scenarios"

    def __call__(self, v: Array) -> tuple[float, Array]:
        """Cost and its slope (np,) at a point (np,); infinite where the law has no gain there."""
        if self.apart:
            return self.value(v), self.slope(v)
        point = torch.tensor(v, dtype=torch.float64, requires_grad=True)
        cost = self._cost(point, v)
        if cost is None or not cost.requires_grad:
            return np.inf if cost is None else float(cost), np.zeros(len(v))
        (slope,) = torch.autograd.grad(cost, point)
        return float(cost.detach()), slope.numpy()

    @property
    def apart(self) -> bool:
        """Whether slopes are differences of whole closed loops."""
        return not self.law.differentiable

    @torch.no_grad()
    def value(self, v: Array, *, remember: bool = True) -> float:
        """The cost alone."""
        cost = self._cost(torch.tensor(v, dtype=torch.float64), v if remember else None)
        return np.inf if cost is None else float(cost)

    def slope(self, v: Array) -> Array:
        """Slopes (np,) of the closed loops themselves: central, at a bound one-sided."""
        slope = np.zeros(len(v))
        for i in np.flatnonzero(self.problem.design.allowed.free):
            ends = []
            for side in (STEP, -STEP):
                at = v.copy()
                at[i] = np.clip(v[i] + side, 0.0, 1.0)
                ends.append((at[i], self.value(at, remember=False)))
            (high, above), (low, below) = ends
            slope[i] = (above - below) / (high - low)
        return slope

    def slopes(self, v: Array) -> tuple[Array, dict[str, Array]]:
        """Slopes (np,) of the cost without its penalty, and of the mean and the peak violation of the limits."""
        slopes = np.zeros((3, len(v)))
        for i in np.flatnonzero(self.problem.design.allowed.free):
            ends = []
            for side in (STEP, -STEP):
                at = v.copy()
                at[i] = np.clip(v[i] + side, 0.0, 1.0)
                seen = self.seen(at)
                cost = -self.problem.risk.values(seen.total).mean()
                ends.append((at[i], np.array([float(cost), float(seen.depth.mean()), float(seen.peak.mean())])))
            (high, above), (low, below) = ends
            slopes[:, i] = (above - below) / (high - low)
        return slopes[0], dict(zip(("mean violation of the limits", "peak violation of the limits"), slopes[1:]))

    def _cost(self, point: Tensor, v: Array | None) -> Tensor | None:
        """The cost at a point; None where the law has no gain there. A point `v` is a row of the history."""
        self.evaluations += 1
        try:
            seen = self._episode(point)
        except NotStabilisableError:  # any other error is a mistake in what was stated
            return None
        values = self.problem.risk.values(seen.total)
        if v is not None:
            self._remember(v, seen)
        cost = -values.mean()
        if self.penalty is not None and self.penalty.active and not bool(seen.diverged.any()):
            cost = cost + self.penalty.cost(seen, point)
        return cost

    def updated(self, penalty: StateLimitPenalty, v: Array) -> tuple[Episode, StateLimitPenalty]:
        """Episodes at a point, and the penalty after them."""
        seen = self.seen(v)
        if bool(seen.diverged.any()):
            return seen, penalty
        x0, w = self.scenarios
        return seen, penalty.updated(seen, torch.tensor(v, dtype=torch.float32), (x0.float(), w.float()))

    @torch.no_grad()
    def seen(self, v: Array) -> Episode:
        """Its episodes at a point, with what leaves the limits."""
        return self._episode(torch.tensor(v, dtype=torch.float64), depths=True)

    def _episode(self, v: Tensor, *, depths: bool = False) -> Episode:
        """Episodes at a point of the unit box."""
        p = to_design(self.problem, v)
        law = self.law.law(self.problem, p)
        watched = depths or (self.penalty is not None and self.penalty.active)
        return simulated(Stepper.at(self.problem, p), law, self.scenarios, depths=watched)

    def _remember(self, v: Array, seen: Episode) -> None:
        """Another row of the history."""
        mean, std, lost = of_kept_runs(self.problem.risk, seen.total.detach().numpy(), seen.diverged.numpy())
        count = len(self.rows) + 1
        samples = self.scenarios[1].shape[0] * self.scenarios[1].shape[1]
        design = self.problem.design.from_unit(v)
        self.rows.append((count, count * samples, design, mean, std, lost))

    def controller(self, p: Array) -> Controller:
        """The law at a design, for use."""
        return self.law.controller(self.problem, p)

    def history(self) -> History:
        """All evaluations so far."""
        return History(*(np.array(column) for column in zip(*self.rows)))


@dataclass(eq=False)
class LearnedCost:
    """Minus the mean return of the policy of each design, trained from that of the design before.

    Parameters
    ----------
    problem : CoDesignProblem
    agent : ActorCritic
        Warm start.
    scenarios : tensors (n, nx) and (n, T, nw)
    rng : numpy.random.Generator
    by : {"pathwise", "ppo", "pathwise+ppo"}
        What moves the policy.
    """

    problem: CoDesignProblem
    agent: ActorCritic
    scenarios: ScenarioTensors
    rng: np.random.Generator
    by: str = "pathwise"
    rows: list[tuple] = field(default_factory=list)
    _trained: list[tuple[Array, ActorCritic]] = field(default_factory=list)

    @property
    def words(self) -> str:
        """What it is."""
        return f"a policy trained by {self.by} at every design, on {len(self.scenarios[0])} scenarios"

    def __call__(self, v: Array) -> tuple[float, Array]:
        """Cost and its slope (np,) at a point (np,) of the unit box."""
        p = self.problem.design.from_unit(v)
        config = CoDesignConfig(iterations=ITERATIONS, design_rate=0.0, starts=1)
        inner = Learned(by=self.by, agent=self.agent, config=config)
        self.agent = inner.run(replace(self.problem, limit_tolerance="off"), p, self.rng).agent
        self._trained.append((p, self.agent))
        point = torch.tensor(v, dtype=torch.float32, requires_grad=True)
        seen = episode_at(self.problem, self.agent, point, self.scenarios)
        cost = -self.problem.risk.values(seen.total).mean()
        (slope,) = torch.autograd.grad(cost, point)
        count = len(self.rows) + 1
        lost = float(seen.diverged.double().mean())
        self.rows.append((count, count * ITERATIONS, p, -cost.item(), 0.0, lost))
        return cost.item(), slope.double().numpy()

    @property
    def evaluations(self) -> int:
        """How many there were."""
        return len(self.rows)

    def controller(self, p: Array) -> Controller:
        """The policy that was trained nearest to a design, at that design."""
        space = self.problem.design
        away = [float(np.abs(space.to_unit(at) - space.to_unit(p)).max()) for at, _ in self._trained]
        return LearnedPolicy(self._trained[int(np.argmin(away))][1], p)

    def history(self) -> History:
        """All evaluations so far."""
        return History(*(np.array(column) for column in zip(*self.rows)))
