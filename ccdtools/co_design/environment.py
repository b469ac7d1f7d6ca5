"""Environment of PPO in a co-design, and its design gradient."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccdtools.co_design.differentiable_model import Stepper, observe, scenario_tensors, to_design
from ccdtools.co_design.problem import CoDesignProblem
from learning.networks import ActorCritic
from learning.ppo import Batch, PPOConfig, ppo_losses, prepare
from learning.rollout import collect


class EpisodeEnv:
    """Environment of `runs` episodes with observations (x, p) and actions u.

    Episodes end together at the problem's time limit: truncated, or terminated where the objective has a terminal cost.
    One that diverges terminates and restarts from its own initial state.

    Parameters
    ----------
    problem : CoDesignProblem
    p : (np,) tensor
        May be moved between rollouts with `move`.
    runs : int
    rng : numpy.random.Generator
        Draws fresh scenarios at each reset.
    """

    def __init__(self, problem: CoDesignProblem, p: Tensor, *, runs: int, rng: np.random.Generator) -> None:
        self.problem = problem
        self.runs = runs
        self._rng = rng
        self.move(p)

    def move(self, p: Tensor) -> None:
        """Change the design from the next reset on."""
        self._step = Stepper.at(self.problem, p.detach())

    def reset(self) -> Tensor:
        """Fresh scenarios; observations (runs, nx + np)."""
        self._x0, self._w = scenario_tensors(self.problem, self.runs, self._rng)
        self._x = self._x0
        self._e = torch.zeros_like(self._x0)
        self._k = 0
        return observe(self._x, self._step.p)

    def state(self) -> dict[str, Any]:
        """Episodes where they stand, for `restore`."""
        tensors = {name: getattr(self, name) for name in ("_x0", "_w", "_x", "_e")}
        return {"tensors": tensors, "k": self._k, "rng": self._rng.bit_generator.state}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`."""
        for name, tensor in state["tensors"].items():
            setattr(self, name, tensor)
        self._k = state["k"]
        self._rng.bit_generator.state = state["rng"]

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Next observation, successor, reward, terminated and truncated, see `learning.VectorEnv`."""
        x, e, reward = self._step(self._x, self._e, actions, self._w[:, self._k])
        terminated = self._step.left(x)
        self._k += 1
        truncated = torch.full_like(terminated, self._k >= self.problem.steps) & ~terminated
        final = self._step.final_rewards(x)
        if final is not None:  # what comes after the end is paid for: no value stands for it
            reward = reward + torch.where(truncated, final, 0.0)
            terminated, truncated = terminated | truncated, torch.zeros_like(truncated)
        successor = observe(x, self._step.p)
        if self._k >= self.problem.steps:
            return self.reset(), successor, reward, terminated, truncated
        restart = terminated[:, None]
        self._x = torch.where(restart, self._x0, x)
        self._e = torch.where(restart, 0.0, e)
        return observe(self._x, self._step.p), successor, reward, terminated, truncated


def network_input_gradient(
    problem: CoDesignProblem, agent: ActorCritic, v: Tensor, *, rng: np.random.Generator, runs: int, config: PPOConfig
) -> Tensor:
    """−∂/∂v (np,) of the PPO loss through design inputs, with constant states."""
    env = EpisodeEnv(problem, to_design(problem, v), runs=runs, rng=rng)
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    rollout = collect(env, agent, steps=problem.steps, generator=generator)
    return loss_gradient(problem, agent, v, prepare(agent, rollout, config), config)


def loss_gradient(problem: CoDesignProblem, agent: ActorCritic, v: Tensor, batch: Batch, config: PPOConfig) -> Tensor:
    """−∂/∂v of a batch's PPO loss, through its design columns."""
    v = v.detach().clone().requires_grad_(True)
    x = batch.observations[:, : problem.model.nx]
    losses = ppo_losses(agent, replace(batch, observations=observe(x, to_design(problem, v))), config)
    with torch.no_grad():  # the surrogate is that of one step, in standard deviations of the advantages
        size = problem.steps * ((batch.targets - agent.value(batch.observations)).std() + 1e-8)
    paid = problem.objective.cost_of_design(to_design(problem, v), problem.steps) / size
    (gradient,) = torch.autograd.grad(losses.surrogate + losses.value + paid, v)
    return -gradient
