"""Three estimates of how the return changes with the design, in the unit box."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.checks import as_count, as_generator, as_instance, as_positive
from ccdtools.co_design.agents import check_agent
from ccdtools.co_design.differentiable_model import observe, scenario_tensors, to_design
from ccdtools.co_design.environment import DesignEnv
from ccdtools.co_design.episodes import episode_at
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import GradientCheck
from learning.networks import ActorCritic
from learning.ppo import Batch, PPOConfig, ppo_loss, prepare
from learning.rollout import collect


def check_gradients(
    problem: CoDesignProblem,
    agent: ActorCritic,
    design: Array,
    *,
    rng: np.random.Generator,
    runs: int = 512,
    step: float = 1e-2,
    ppo: PPOConfig | None = None,
) -> GradientCheck:
    """Every design gradient beside finite differences, on the same scenarios.

    Parameters
    ----------
    design : (np,) array_like
        Where to compare, in physical units.
    runs : int
        Scenarios.
    step : float
        Step of the central differences in the unit box.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    check_agent(problem, agent)
    as_generator("rng", rng)
    as_count("runs", runs)
    as_positive("step", step)
    design = problem.design.check_one(design)
    v = torch.tensor(problem.design.to_unit(design), dtype=torch.float32)
    scenarios = scenario_tensors(problem, runs, rng)
    differences = finite_differences(problem, agent, v, scenarios, step)
    pathwise = pathwise_gradient(problem, agent, v, scenarios)[0]
    network = network_input_gradient(problem, agent, v, rng=rng, runs=runs, config=ppo or PPOConfig())
    return GradientCheck(tuple(problem.design.names), differences, pathwise.double().numpy(), network.double().numpy())


def finite_differences(
    problem: CoDesignProblem, agent: ActorCritic, v: Tensor, scenarios: tuple[Tensor, Tensor], step: float
) -> Array:
    """Central differences of the mean return in the unit box, (np,)."""
    differences = []
    for i in range(len(v)):
        ends = []
        for sign in (1, -1):
            moved = v.clone()
            moved[i] += sign * step
            with torch.no_grad():
                ends.append(episode_at(problem, agent, moved, scenarios).total.mean().item())
        differences.append((ends[0] - ends[1]) / (2 * step))
    return np.array(differences)


def pathwise_gradient(
    problem: CoDesignProblem, agent: ActorCritic, v: Tensor, scenarios: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """∂/∂v of the mean return through dynamics, policy and reward, (np,); and the mean return."""
    v = v.detach().clone().requires_grad_(True)
    mean = episode_at(problem, agent, v, scenarios).total.mean()
    (gradient,) = torch.autograd.grad(mean, v)
    return gradient, mean.detach()


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
    (gradient,) = torch.autograd.grad(surrogate + value_loss, v)
    return -gradient
