"""A co-design problem at one design, as a batched environment for reinforcement learning."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ccdtools.co_design.differentiable_model import Stepper, observe, scenario_tensors
from ccdtools.co_design.problem import CoDesignProblem


class DesignEnv:
    """`runs` episodes side by side; observations are (x, p), actions u in the units of the plant.

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
        """Change the design; takes effect at the next reset."""
        self._step = Stepper.at(self.problem, p.detach())

    def reset(self) -> Tensor:
        """Fresh scenarios; observations (runs, nx + np)."""
        self._x0, self._w = scenario_tensors(self.problem, self.runs, self._rng)
        self._x = self._x0
        self._e = self._step.without_error(self._x0)
        self._k = 0
        return observe(self._x, self._step.p)

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """(observation to act on next, successor, reward, terminated, truncated); see `learning.VectorEnv`."""
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
