"""PPO's part in a co-design: episodes of the sampled policy, an update from them, and the paper's design gradient."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.co_design.environment import DesignEnv
from ccdtools.co_design.episodes import fewer_runs
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.reinforcement.gradients import loss_gradient
from learning.networks import ActorCritic
from learning.ppo import PPO, prepare
from learning.rollout import Rollout, collect


class PPOPart:
    """An agent, the episodes it learns from, and its optimisers, which live as long as the training.

    Attributes
    ----------
    env_steps : int
        Steps of the sampled policy so far.
    """

    def __init__(
        self, problem: CoDesignProblem, agent: ActorCritic, p: Tensor, rng: np.random.Generator, config: CoDesignConfig
    ) -> None:
        self.problem = problem
        self.agent = agent
        self.config = config.ppo
        self.optimisers = PPO(agent, config.ppo)
        self.generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
        self.env = DesignEnv(problem, p, runs=fewer_runs(config.runs, problem.steps), rng=rng)
        self.env_steps = 0

    def collect(self, p: Tensor) -> Rollout:
        """Whole episodes of the sampled policy at design `p`."""
        self.env.move(p)
        self.env_steps += self.env.runs * self.problem.steps
        return collect(self.env, self.agent, steps=self.problem.steps, generator=self.generator)

    def network_input_gradient(self, rollout: Rollout, v: Tensor) -> Tensor:
        """The paper's design gradient (np,), from the loss before the update."""
        return loss_gradient(self.problem, self.agent, v, prepare(self.agent, rollout, self.config), self.config)

    def update(self, rollout: Rollout, *, factor: float, actor: bool) -> None:
        """One update of critic and, if asked, actor, at a part of their first rates."""
        for optimiser, rate in (
            (self.optimisers.actor_optimiser, self.config.learning_rate),
            (self.optimisers.critic_optimiser, self.config.value_rate),
        ):
            for group in optimiser.param_groups:
                group["lr"] = rate * factor
        self.optimisers.update(rollout, generator=self.generator, actor=actor)
