"""Environment of PPO in a co-design, and its design gradient."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ccdtools.checks import as_count, as_generator, as_instance
from ccdtools.co_design.differentiable_model import Stepper, observe, scenario_tensors, to_design
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.design_limits import DesignLimits
from learning.networks import ActorCritic, NetworkConfig
from learning.ppo import Batch, PPOConfig, ppo_losses, prepare
from learning.rollout import collect


class EpisodeEnv:
    """Episodes of a problem that step together, for `learning.train`.

    Observations are (x, p), actions u, each (runs, ·) tensors. Episodes end together at the problem's time limit:
    truncated, or terminated where the objective has a terminal cost. One that diverges terminates and restarts from its
    own initial state.

    Parameters
    ----------
    problem : CoDesignProblem
    design : (np,) array_like or tensor
        May be moved between rollouts with `move`.
    runs : int
    rng : numpy.random.Generator
        Draws fresh scenarios at each reset.

    Attributes
    ----------
    given : int
        Number of the last entries of observations that are given, those of the design.

    Raises
    ------
    InputError
        If an argument is of another kind, or the design is not allowed.

    Examples
    --------
    >>> env = EpisodeEnv(problem, design, rng=np.random.default_rng(0))
    >>> trained = train(env, env.agent(), iterations=100, steps=problem.steps, generator=torch.Generator())
    >>> policy = LearnedPolicy(trained.agent, design)
    """

    def __init__(
        self, problem: CoDesignProblem, design: ArrayLike | Tensor, *, runs: int = 32, rng: np.random.Generator
    ) -> None:
        self.problem = as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
        self.runs = as_count("runs", runs)
        self.given = problem.design.dim
        self._rng = as_generator("rng", rng)
        if not isinstance(design, Tensor):
            design = torch.tensor(problem.design.check_feasible(design), dtype=torch.float32)
        self.move(design)

    def agent(self, *, config: NetworkConfig | None = None, seed: int = 0) -> ActorCritic:
        """Untrained agent for this problem, at any of its designs."""
        low, high = self.problem.observation_bounds
        bounds = self.problem.action_bounds
        limits = bounds if isinstance(bounds, DesignLimits) else None
        lower, upper = limits.box if limits is not None else self.problem.input_bounds
        return ActorCritic(low, high, lower, upper, config=config, seed=seed, action_limits=limits)

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
