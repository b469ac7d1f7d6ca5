"""Cost, with slope, of a policy trained at every design.

By the envelope theorem the slope of the best policy's cost is that of the cost with the policy held.

References
----------
Tsai, Karkaria, Chen and Chen, "Digital twin-enabled multi-generation control co-design with deep reinforcement
learning" (the bi-level framework); Milgrom and Segal, Econometrica 70(2), 2002 (envelope theorem).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from ccdtools.arrays import Array
from ccdtools.co_design.budgets import POLICY_ITERATIONS
from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.co_design.design_search import DesignCost
from ccdtools.co_design.differentiable_model import ScenarioTensors, episode_at
from ccdtools.co_design.methods.learned import Learned
from ccdtools.controllers.controllers import Controller
from ccdtools.controllers.learned import LearnedPolicy
from learning.networks import ActorCritic


@dataclass(eq=False)
class LearnedCost(DesignCost):
    """Cost (minus mean return) of a policy trained from the last design's."""

    agent: ActorCritic  # warm start
    scenarios: ScenarioTensors  # (n, nx) and (n, T, nw)
    rng: np.random.Generator
    by: str = "pathwise"  # "pathwise", "ppo" or "pathwise+ppo": what moves the policy
    _trained: list[tuple[Array, ActorCritic]] = field(default_factory=list)
    repeatable = False

    @property
    def words(self) -> str:
        """Description of the cost in words."""
        return f"a policy trained by {self.by} at every design, on {len(self.scenarios[0])} scenarios"

    def __call__(self, v: Array) -> tuple[float, Callable[[], Array]]:
        """Cost and slope (np,) at a unit-box point (np,)."""
        p = self.problem.design.from_unit(v)
        config = CoDesignConfig(iterations=POLICY_ITERATIONS, design_rate=0.0, starts=1)
        inner = Learned(by=self.by, agent=self.agent, config=config)
        self.agent = inner.run(replace(self.problem, limit_tolerance="off"), p, self.rng).agent
        self._trained.append((p, self.agent))
        point = torch.tensor(v, dtype=torch.float32, requires_grad=True)
        seen = episode_at(self.problem, self.agent, point, self.scenarios)
        cost = -self.problem.risk.values(seen.total).mean()
        lost = float(seen.diverged.double().mean())
        self.remember(p, -cost.item(), lost=lost, samples=POLICY_ITERATIONS)
        return cost.item(), lambda: torch.autograd.grad(cost, point)[0].double().numpy()

    def controller(self, p: Array) -> Controller:
        """Policy trained nearest to a design, at that design."""
        space = self.problem.design
        away = [float(np.abs(space.to_unit(at) - space.to_unit(p)).max()) for at, _ in self._trained]
        return LearnedPolicy(self._trained[int(np.argmin(away))][1], p)
