"""The paper's design gradient, and every design gradient beside finite differences."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.checks import as_count, as_generator, as_instance, as_number
from ccdtools.co_design.agents import check_agent
from ccdtools.co_design.design_gradients import Differences, inside, pathwise_by_run, standard_error
from ccdtools.co_design.differentiable_model import observe, scenario_tensors, to_design
from ccdtools.co_design.environment import DesignEnv
from ccdtools.co_design.episodes import episode_at, fewer_runs
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
    step: float | None = None,
    ppo: PPOConfig | None = None,
) -> GradientCheck:
    """Every design gradient beside finite differences, on the same scenarios.

    Parameters
    ----------
    design : (np,) array_like
        Where to compare, in physical units; closer than `step` to a bound, the comparison is made at that distance.
    runs : int
        Scenarios of 100 steps; of longer ones fewer are taken.
    step : float, optional
        Step of the central differences in the unit box; by default 0.01, or less where the return bends more.

    Raises
    ------
    InputError
        If an argument is of the wrong kind or out of range.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    check_agent(problem, agent)
    as_generator("rng", rng)
    as_count("runs", runs)
    if step is not None:
        as_number("step", step, expected="a number between 0 and 0.5, or None", low=0.0, high=0.5, strict=True)
    design = problem.design.check_one(design)
    v = torch.tensor(problem.design.to_unit(design), dtype=torch.float32)
    scenarios = scenario_tensors(problem, fewer_runs(runs, problem.steps), rng)
    differences = Differences(problem, agent, scenarios)
    step = differences.step(v) if step is None else step
    v = inside(v, step)
    by_difference = differences.about(v, step)
    pathwise = pathwise_by_run(problem, agent, v, scenarios)
    network = network_input_gradient(problem, agent, v, rng=rng, runs=len(pathwise), config=ppo or PPOConfig())
    with torch.no_grad():
        scale = episode_at(problem, agent, v, scenarios).total.mean().abs().item()
    return GradientCheck(
        tuple(problem.design.names), by_difference.mean(0).numpy(), pathwise.mean(0).numpy(), network.double().numpy(),
        standard_error(by_difference).numpy(), standard_error(pathwise).numpy(),
        standard_error(pathwise - by_difference).numpy(), scale,
    )  # fmt: skip


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
