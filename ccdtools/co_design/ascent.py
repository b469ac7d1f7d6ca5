"""One co-design from one start: policy and design climb together, block by block, while it pays."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from ccdtools.arrays import Array
from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.co_design.differentiable_model import scenario_tensors, to_design
from ccdtools.co_design.episodes import Episode, episode_at, fewer_runs
from ccdtools.co_design.limits import LimitsOutcome
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.reinforcement.ppo import PPOPart
from ccdtools.co_design.result import History
from learning.networks import ActorCritic
from learning.ppo import decay_exploration

Scenarios = tuple[Tensor, Tensor]


class LimitPenalty(Protocol):
    """What keeps a co-design within its state limits: a cost whose multipliers grow while they are not kept."""

    def cost(self, episode: Episode) -> Tensor:
        """What leaving X costs, (n,) in the units of the return; differentiable, zero within the tolerance."""
        ...

    def violation(self, episode: Episode) -> float:
        """By how much the tolerance is exceeded; 0 where it is kept."""
        ...

    @property
    def active(self) -> bool:
        """Whether leaving X costs anything at present."""
        ...

    def updated(self, episode: Episode, v: Tensor, scenarios: Scenarios) -> LimitPenalty:
        """The penalty of the next block, after the episodes of an evaluation at the point `v` of the unit box."""
        ...

    def outcome(self, episode: Episode) -> LimitsOutcome:
        """How the iterate of these episodes keeps the limits."""
        ...


@dataclass(frozen=True, eq=False)
class Task:
    """What is optimised, and how.

    Attributes
    ----------
    problem, judge : CoDesignProblem
        What the gradients come from, and what iterates are scored on.
    method : {"pathwise", "ppo", "pathwise+ppo"}
    config : CoDesignConfig
    limits : LimitPenalty or None
    """

    problem: CoDesignProblem
    judge: CoDesignProblem
    method: str
    config: CoDesignConfig
    limits: LimitPenalty | None = None

    @property
    def pathwise(self) -> bool:
        """Whether the policy follows its gradient through the model."""
        return "pathwise" in self.method and self.config.policy_rate > 0

    @property
    def ppo(self) -> bool:
        """Whether the policy follows PPO."""
        return "ppo" in self.method

    @property
    def moving(self) -> bool:
        """Whether the design moves."""
        return self.config.design_rate > 0


@dataclass(frozen=True, eq=False)
class Iterate:
    """A design and its policy, with what the fixed scenarios say of them.

    Attributes
    ----------
    returns : (n,) array
        Of every evaluation run; a diverged one with its whole, huge cost.
    violation : float
        By how much the tolerance of the state limits is exceeded.
    limits : LimitsOutcome or None
        How it keeps them.
    """

    v: Tensor
    agent: ActorCritic
    returns: Array
    violation: float
    limits: LimitsOutcome | None = None

    @property
    def score(self) -> float:
        """Mean return over the evaluation runs."""
        return float(self.returns.mean())

    def beats(self, other: Iterate) -> bool:
        """Whether it is preferred: limits kept before limits broken, then by its violation or its return."""
        if self.violation > 0 or other.violation > 0:
            return self.violation < other.violation
        return self.score > other.score


class Ascent:
    """The moving parts of one co-design; the agent handed over is trained in place."""

    def __init__(self, task: Task, agent: ActorCritic, design: Array, rng: np.random.Generator) -> None:
        config = task.config
        self.task = task
        self.agent = agent
        self.rng = rng
        self.limits = task.limits
        self.v = torch.tensor(task.problem.design.to_unit(design), dtype=torch.float32).requires_grad_(True)
        self.ppo = PPOPart(task.problem, agent, self._p(), rng, config)
        self.first_std = agent.log_std.exp().mean().item()
        self.design_optimiser = torch.optim.Adam([self.v], lr=config.design_rate or 1.0, betas=(0.8, 0.9))
        self.policy_optimiser = torch.optim.Adam(agent.mean_network.parameters(), lr=config.policy_rate or 1.0)
        self.evaluation = scenario_tensors(task.judge, fewer_runs(config.evaluation_runs, task.judge.steps), rng)
        self.model_steps = 0
        self.rows: list[tuple] = []
        self.best = self._evaluated(0)

    def run(self, bar: tqdm) -> Iterate:
        """All iterations; the best iterate that was evaluated."""
        config = self.task.config
        for k in range(config.iterations):
            self.iterate(k)
            bar.update()
            if (k + 1) % config.evaluate_every == 0 or k + 1 == config.iterations:
                iterate = self._evaluated(k + 1)
                self.best = iterate if iterate.beats(self.best) else self.best
        return self.best

    def _evaluated(self, iteration: int) -> Iterate:
        """The present iterate on the fixed scenarios, with a row of the history."""
        with torch.no_grad():
            seen = episode_at(
                self.task.judge, self.agent, self.v.detach(), self.evaluation, depths=self.limits is not None
            )
        kept = seen.total[~seen.diverged]
        mean = kept.mean().item() if len(kept) else float("nan")
        std = kept.std().item() if len(kept) > 1 else 0.0
        lost = seen.diverged.double().mean().item()
        self.rows.append((iteration, self.model_steps + self.ppo.env_steps, self._design(), mean, std, lost))
        violation = 0.0
        outcome = None
        if self.limits is not None:
            self.limits = self.limits.updated(seen, self.v.detach(), self.evaluation)
            violation = self.limits.violation(seen)
            outcome = self.limits.outcome(seen)
        return Iterate(self.v.detach().clone(), copy.deepcopy(self.agent), seen.total.numpy(), violation, outcome)

    def iterate(self, k: int) -> None:
        """One step of the policy and one of the design."""
        task = self.task
        config = task.config
        factor = 1.0 if config.constant_rates else 0.5 * (1 + np.cos(np.pi * k / config.iterations))
        decay_exploration(self.agent, self.first_std, config.ppo.final_std, k / max(config.iterations - 1, 1))
        by_network_input = task.moving and config.design_gradient == "network_input"
        gradient: Tensor | None = None
        if task.ppo or by_network_input:
            rollout = self.ppo.collect(self._p())
            if by_network_input:
                gradient = self.ppo.network_input_gradient(rollout, self.v)
            if task.ppo:
                self.ppo.update(rollout, factor=factor, actor=k >= config.ppo.critic_only)
        if task.pathwise or (task.moving and not by_network_input):
            through_model = self._follow_model(factor)
            gradient = through_model if gradient is None else gradient
        if task.moving and gradient is not None:
            self._move_design(gradient, factor)

    def _follow_model(self, factor: float) -> Tensor:
        """The design's gradient of the relative return through the dynamics; the policy takes a step on its own."""
        task = self.task
        limits = self.limits if self.limits is not None and self.limits.active else None
        scenarios = scenario_tensors(task.problem, fewer_runs(task.config.pathwise_runs, task.problem.steps), self.rng)
        self.model_steps += scenarios[1].shape[0] * scenarios[1].shape[1]
        seen = episode_at(task.problem, self.agent, self.v, scenarios, depths=limits is not None)
        cost = -seen.total.mean()
        size = cost.detach().abs()  # relative, so that a lost run's 1e8 today does not drown tomorrow's steps
        if limits is not None:
            cost = cost + limits.cost(seen).mean()
        parameters = list(self.agent.mean_network.parameters()) if task.pathwise else []
        *gradients, design_gradient = torch.autograd.grad(cost / size, [*parameters, self.v])
        for parameter, gradient in zip(parameters, gradients):
            parameter.grad = gradient
        if parameters and torch.nn.utils.clip_grad_norm_(parameters, 1.0).isfinite():
            _set_rate(self.policy_optimiser, task.config.policy_rate * factor)
            self.policy_optimiser.step()
        return -design_gradient

    def _move_design(self, gradient: Tensor, factor: float) -> None:
        """Adam in the unit box on the clipped gradient, then back into the bounds."""
        norm = gradient.norm()
        if not norm.isfinite():
            return
        self.v.grad = -gradient / norm.clamp(min=1.0)
        _set_rate(self.design_optimiser, self.task.config.design_rate * factor)
        self.design_optimiser.step()
        with torch.no_grad():
            self.v.clamp_(0.0, 1.0)

    def _p(self) -> Tensor:
        """The present design (np,), without its gradient."""
        return to_design(self.task.problem, self.v.detach())

    def _design(self) -> Array:
        """The present design (np,), in physical units."""
        return self.task.problem.design.from_unit(self.v.detach().double().numpy())

    def history(self) -> History:
        """The evaluations so far."""
        return History(*(np.array(column) for column in zip(*self.rows)))


def _set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of every group of an optimiser."""
    for group in optimiser.param_groups:
        group["lr"] = rate
