"""The paper's design gradient: through the inputs of the networks, the states taken as constants."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ccdtools.co_design.differentiable_model import observe, to_design
from ccdtools.co_design.environment import DesignEnv
from ccdtools.co_design.problem import CoDesignProblem
from learning.networks import ActorCritic
from learning.ppo import Batch, PPOConfig, ppo_loss, prepare
from learning.rollout import collect


def network_input_gradient(
    problem: CoDesignProblem,
    agent: ActorCritic,
    v: Tensor,
    *,
    rng: np.random.Generator,
    runs: int,
    config: PPOConfig,
) -> Tensor:
    """−∂/∂v of the PPO loss through the design inputs of policy and value network, states constant, (np,)."""
    env = DesignEnv(problem, to_design(problem, v), runs=runs, rng=rng)
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    rollout = collect(env, agent, steps=problem.steps, generator=generator)
    return loss_gradient(problem, agent, v, prepare(agent, rollout, config), config)


def loss_gradient(problem: CoDesignProblem, agent: ActorCritic, v: Tensor, batch: Batch, config: PPOConfig) -> Tensor:
    """−∂/∂v of the PPO loss on a batch, through the design columns of its observations."""
    v = v.detach().clone().requires_grad_(True)
    x = batch.observations[:, : problem.model.nx]
    moved = Batch(observe(x, to_design(problem, v)), batch.latents, batch.log_probs, batch.advantages, batch.targets)
    surrogate, value_loss, _ = ppo_loss(agent, moved, config)
    with torch.no_grad():  # the surrogate is that of one step, in standard deviations of the advantages
        size = problem.steps * ((batch.targets - agent.value(batch.observations)).std() + 1e-8)
    paid = problem.objective.cost_of_design(to_design(problem, v), problem.steps) / size
    (gradient,) = torch.autograd.grad(surrogate + value_loss + paid, v)
    return -gradient
