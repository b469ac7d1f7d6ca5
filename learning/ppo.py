"""Proximal policy optimisation: advantages, loss, update and training.

References
----------
Schulman et al., "Proximal policy optimization algorithms", arXiv:1707.06347, 2017, eqs. (7) and (9);
Schulman et al., "High-dimensional continuous control using generalized advantage estimation",
arXiv:1506.02438, 2016, eq. (16).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import trange

from ccdtools_ground.door import as_count
from learning.checks import check_instance, check_number
from learning.exceptions import InputError
from learning.networks import ActorCritic
from learning.rollout import Rollout, VectorEnv, collect


@dataclass(frozen=True)
class PPOConfig:
    """Rates and limits of PPO.

    Attributes
    ----------
    gamma : float
        Discount; time limits are bootstrapped, so it must be below 1.
    lam : float
        Trace decay λ of the advantages.
    clip : float
        ε of the clipped surrogate.
    passes : int
        Passes over a rollout.
    minibatch : int
        Samples per gradient step.
    learning_rate, value_rate : float
        Adam's rates of actor and critic.
    value_coefficient : float
        c_v: weight of the Smooth-L1 value loss (in units of the value scale).
    kl_limit : float
        The passes stop when the policy has moved this far (mean KL divergence).
    max_gradient : float
        Gradient norms are clipped here, before Adam.
    final_std : float or None
        If given, the exploration decays geometrically to this value during a training.
    critic_only : int
        First iterations in which only the critic learns.
    """

    gamma: float = 0.99
    lam: float = 0.95
    clip: float = 0.2
    passes: int = 5
    minibatch: int = 4096
    learning_rate: float = 1e-3
    value_rate: float = 2e-3
    value_coefficient: float = 0.5
    kl_limit: float = 0.02
    max_gradient: float = 1.0
    final_std: float | None = None
    critic_only: int = 5

    def __post_init__(self) -> None:
        check_number(self.gamma, "gamma", 0, 1)  # below one, because time limits are bootstrapped
        check_number(self.lam, "lam", 0, 1, closed=True)
        check_number(self.clip, "clip", 0, 1)
        for name in ("passes", "minibatch"):
            as_count(name, getattr(self, name))
        as_count("critic_only", self.critic_only, least=0)
        for name in ("learning_rate", "value_rate", "value_coefficient"):
            check_number(getattr(self, name), name, closed=True)
        check_number(self.max_gradient, "max_gradient")
        if self.kl_limit != float("inf"):  # infinite: no limit
            check_number(self.kl_limit, "kl_limit", closed=True)
        if self.final_std is not None:
            check_number(self.final_std, "final_std")


@dataclass(frozen=True, eq=False)
class Batch:
    """Rollout with advantages and value targets, flattened to (N, ...)."""

    observations: Tensor
    latents: Tensor
    log_probs: Tensor
    advantages: Tensor
    targets: Tensor


@dataclass(frozen=True)
class UpdateStatistics:
    """KL divergence, critic's explained variance and passes of an update."""

    kl: float
    explained_variance: float
    passes: int


def gae(
    rewards: Tensor,
    values: Tensor,
    successor_values: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    *,
    gamma: float,
    lam: float,
) -> Tensor:
    """Generalised advantages (T, n).

    A terminated step has no successor value; a truncated one keeps it. Both end the trace.

    Parameters
    ----------
    rewards, values, successor_values : (T, n) tensors
        V of the state acted in, and of the state led to (before any restart).
    terminated, truncated : (T, n) bool tensors
    gamma, lam : float
        From 0 to 1.

    Raises
    ------
    InputError
        If the shapes differ, or a number is out of range.
    """
    _check_experience(rewards, values=values, successor_values=successor_values, terminated=terminated,
                      truncated=truncated)  # fmt: skip
    gamma = check_number(gamma, "gamma", 0, 1, closed=True)
    lam = check_number(lam, "lam", 0, 1, closed=True)
    ended = terminated | truncated
    delta = rewards + gamma * successor_values * (~terminated) - values
    advantages = torch.zeros_like(rewards)
    trace = torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        trace = delta[t] + gamma * lam * trace * (~ended[t])
        advantages[t] = trace
    return advantages


def _check_experience(rewards: Tensor, **others: Tensor) -> None:
    """Raise an `InputError` unless all tensors fit the rewards."""
    check_instance(rewards, "rewards", Tensor)
    if rewards.ndim == 0 or rewards.numel() == 0:
        raise InputError("rewards", f"shape {tuple(rewards.shape)}", "(T, n), neither of them 0")
    for name, tensor in others.items():
        check_instance(tensor, name, Tensor)
        if tensor.shape != rewards.shape:
            raise InputError(name, f"shape {tuple(tensor.shape)}", f"{tuple(rewards.shape)}, that of the rewards")
        if name in ("terminated", "truncated") and tensor.dtype != torch.bool:
            raise InputError(name, f"values of type {tensor.dtype}", "torch.bool")


@torch.no_grad()
def prepare(agent: ActorCritic, rollout: Rollout, config: PPOConfig) -> Batch:
    """Value targets and advantages (normalised, limited to ±5) of a rollout."""
    values = agent.value(rollout.observations)
    successors = agent.value(rollout.successors)
    raw = gae(
        rollout.rewards, values, successors, rollout.terminated, rollout.truncated,
        gamma=config.gamma, lam=config.lam,
    )  # fmt: skip
    advantages = ((raw - raw.mean()) / (raw.std() + 1e-8)).clamp(-5.0, 5.0)
    return Batch(
        rollout.observations.flatten(0, 1),
        rollout.latents.flatten(0, 1),
        rollout.log_probs.flatten(),
        advantages.flatten(),
        (raw + values).flatten(),
    )


def ppo_loss(agent: ActorCritic, batch: Batch, config: PPOConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Clipped surrogate loss, Smooth-L1 value loss and KL divergence estimate."""
    log_probs = agent.distribution(batch.observations).log_prob(batch.latents).sum(-1)
    log_ratio = log_probs - batch.log_probs
    ratio = log_ratio.exp()
    limited = ratio.clamp(1 - config.clip, 1 + config.clip)
    surrogate = -torch.minimum(ratio * batch.advantages, limited * batch.advantages).mean()
    error = (agent.value(batch.observations) - batch.targets) / agent.value_scale
    value_loss = nn.functional.smooth_l1_loss(error, torch.zeros_like(error))
    kl = ((ratio - 1) - log_ratio).mean().detach()
    return surrogate, config.value_coefficient * value_loss, kl


class PPO:
    """Agent with its two optimisers.

    Parameters
    ----------
    agent : ActorCritic
        Trained in place.
    config : PPOConfig
    """

    def __init__(self, agent: ActorCritic, config: PPOConfig) -> None:
        self.agent = check_instance(agent, "agent", ActorCritic)
        self.config = check_instance(config, "config", PPOConfig)
        self.actor_optimiser = torch.optim.Adam(agent.actor_parameters(), lr=config.learning_rate)
        self.critic_optimiser = torch.optim.Adam(agent.value_network.parameters(), lr=config.value_rate)

    def update(self, rollout: Rollout, *, generator: torch.Generator, actor: bool = True) -> UpdateStatistics:
        """One update on one rollout; `actor=False` trains the critic only."""
        check_instance(rollout, "rollout", Rollout)
        check_instance(generator, "generator", torch.Generator)
        agent = self.agent
        config = self.config
        batch = prepare(agent, rollout, config)
        n = len(batch.targets)
        kl = 0.0
        passes = 0
        variance = batch.targets.var().item()
        with torch.no_grad():
            residual = (batch.targets - agent.value(batch.observations)).var().item()
        for _ in range(config.passes):
            divergences = []
            for i in torch.randperm(n, generator=generator).split(config.minibatch):
                part = Batch(*(getattr(batch, name)[i] for name in Batch.__dataclass_fields__))
                surrogate, value_loss, divergence = ppo_loss(agent, part, config)
                divergences.append(divergence.item())
                if actor and divergences[-1] < 1.5 * config.kl_limit:
                    self._step(self.actor_optimiser, surrogate, agent.actor_parameters())
                self._step(self.critic_optimiser, value_loss, list(agent.value_network.parameters()))
            kl = float(np.mean(divergences))
            passes += 1
            if actor and kl > config.kl_limit:
                break
        return UpdateStatistics(kl, 1.0 - residual / variance if variance > 0 else float("nan"), passes)

    def _step(self, optimiser: torch.optim.Optimizer, loss: Tensor, parameters: list[nn.Parameter]) -> None:
        """One step on a loss, its gradient clipped in norm."""
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, self.config.max_gradient)
        optimiser.step()


def decay_exploration(agent: ActorCritic, first: float, final: float | None, done: float) -> None:
    """Set the exploration geometrically between `first` and `final`, at `done` in [0, 1].

    Nothing is set where `final` is None, or where the exploration is a network of its own.
    """
    if final is not None and agent.std_network is None:
        with torch.no_grad():
            agent.log_std.fill_(float(np.log(first) + done * np.log(final / first)))


def train(
    env: VectorEnv,
    agent: ActorCritic,
    *,
    iterations: int,
    steps: int,
    config: PPOConfig | None = None,
    generator: torch.Generator,
    callback: Callable[[int, UpdateStatistics], None] | None = None,
    progress: bool = False,
) -> ActorCritic:
    """Train `agent` in place by PPO, with `iterations` rollouts of `steps` steps.

    The rates fall linearly to a tenth, the exploration geometrically to `config.final_std`.
    """
    config = check_instance(PPOConfig() if config is None else config, "config", PPOConfig)
    check_instance(agent, "agent", ActorCritic)
    as_count("iterations", iterations)
    as_count("steps", steps)
    ppo = PPO(agent, config)
    first_std = agent.log_std.exp().mean().item()
    for k in trange(iterations, desc="PPO", disable=not progress, leave=False):
        done = k / max(iterations - 1, 1)
        for optimiser, rate in ((ppo.actor_optimiser, config.learning_rate), (ppo.critic_optimiser, config.value_rate)):
            for group in optimiser.param_groups:
                group["lr"] = rate * (1 - 0.9 * done)
        decay_exploration(agent, first_std, config.final_std, done)
        rollout = collect(env, agent, steps=steps, generator=generator)
        statistics = ppo.update(rollout, generator=generator, actor=k >= config.critic_only)
        if callback is not None:
            callback(k, statistics)
    return agent
