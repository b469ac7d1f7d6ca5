"""Proximal policy optimisation: advantages, loss and update.

References
----------
Schulman et al., "Proximal policy optimization algorithms", arXiv:1707.06347, 2017, eqs. (7) and (9);
Schulman et al., "High-dimensional continuous control using generalized advantage estimation",
arXiv:1506.02438, 2016, eq. (16); van Hasselt et al., "Learning values across many orders of magnitude",
arXiv:1602.07714, 2016, for the running unit of values.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ccdtools_ground.door import as_count
from learning.checks import check_instance, check_number
from learning.exceptions import InputError
from learning.networks import ActorCritic
from learning.rollout import Rollout
from learning.tolerances import LEAST_SPREAD, SCALE_MEMORY
from learning.vector_adam import VectorAdam


@dataclass(frozen=True, repr=False)
class PPOConfig:
    """Rates and limits of PPO, by default for learning from scratch.

    Attributes
    ----------
    gamma : float
        Discount; time limits are bootstrapped, so it must be below 1.
    lam, clip : float
        Trace decay λ of the advantages, and ε of the clipped surrogate.
    value_clip : float or None
        If given, values are clipped about their old ones, too, at this many value scales.
    passes, minibatch : int
        Passes over a rollout, and samples per gradient step.
    learning_rate, value_rate : float
        Adam's rates of actor and critic.
    final_rate : float
        Part of these rates that is left at the end of a training; they fall linearly.
    value_coefficient, entropy_coefficient : float
        Weights of the Smooth-L1 value loss (in units of the value scale), and of the policy's entropy in the objective.
    kl_limit : float
        The passes stop when the policy has moved this far (mean KL divergence); the last step may be beyond it.
    max_gradient : float
        Gradient norms are clipped here, before Adam.
    first_std : float or None
        If given, the exploration begins with this standard deviation, whatever the agent's own, unless it is a network.
    final_std : float or None
        If given, the exploration decays geometrically to this value during a training, unless it is a network.
    critic_only : int
        First iterations in which only the critic learns.
    running_scales : bool
        Whether observations and values are normalised by what has been seen of them, in scales that the agent keeps.
    """

    gamma: float = 0.99
    lam: float = 0.95
    clip: float = 0.2
    value_clip: float | None = None
    passes: int = 10
    minibatch: int = 256
    learning_rate: float = 1e-3
    value_rate: float = 1e-3
    final_rate: float = 0.1
    value_coefficient: float = 0.5
    entropy_coefficient: float = 0.0
    kl_limit: float = 0.05
    max_gradient: float = 0.5
    first_std: float | None = None
    final_std: float | None = None
    critic_only: int = 0
    running_scales: bool = True

    @classmethod
    def warm(cls, **changes: Any) -> PPOConfig:
        """Settings for a policy that imitates an expert, with changes.

        Its exploration and its scales come from the expert's data; the critic learns first, so that its errors do not
        spoil the policy.
        """
        warm = {"passes": 5, "minibatch": 4096, "value_rate": 2e-3, "kl_limit": 0.02, "max_gradient": 1.0}
        return cls(**{**warm, "critic_only": 5, "running_scales": False, **changes})

    def __repr__(self) -> str:
        values = {field.name: (getattr(self, field.name), field.default) for field in fields(self)}
        changed = [f"{name}={value!r}" for name, (value, default) in values.items() if value != default]
        return f"PPOConfig({', '.join(changed)})"

    def __post_init__(self) -> None:
        check_number(self.gamma, "gamma", 0, 1)  # below one, because time limits are bootstrapped
        check_number(self.lam, "lam", 0, 1, closed=True)
        check_number(self.final_rate, "final_rate", 0, 1, closed=True)
        check_number(self.clip, "clip", 0, 1)
        for name in ("passes", "minibatch"):
            as_count(name, getattr(self, name))
        as_count("critic_only", self.critic_only, least=0)
        for name in ("learning_rate", "value_rate", "value_coefficient", "entropy_coefficient"):
            check_number(getattr(self, name), name, closed=True)
        check_number(self.max_gradient, "max_gradient")
        if self.kl_limit != float("inf"):  # infinite: no limit
            check_number(self.kl_limit, "kl_limit", closed=True)
        for name in ("first_std", "final_std", "value_clip"):
            if getattr(self, name) is not None:
                check_number(getattr(self, name), name)


@dataclass(frozen=True, eq=False)
class Batch:
    """Rollout with advantages and value targets, flattened to (N, ...)."""

    observations: Tensor
    latents: Tensor
    log_probs: Tensor
    advantages: Tensor
    targets: Tensor
    values: Tensor


@dataclass(frozen=True)
class UpdateStatistics:
    """What one update did.

    Attributes
    ----------
    kl : float
        Mean KL divergence of the last pass from the policy that made the rollout.
    clip_fraction : float
        Part of the samples of the last pass whose ratio was outside 1 ± ε.
    explained_variance : float
        Of the value targets, by the critic before the update.
    entropy : float
        Of the policy, mean over the last pass [nat].
    gradient_norm : float
        Mean norm of the actor's gradient over the steps of all passes, before it is clipped; NaN without a step.
    passes : int
        Passes over the rollout until the KL limit.
    """

    kl: float
    clip_fraction: float
    explained_variance: float
    entropy: float
    gradient_norm: float
    passes: int


def gae(
    rewards: Tensor, values: Tensor, successor_values: Tensor, terminated: Tensor, truncated: Tensor, *, gamma: float,
    lam: float,
) -> Tensor:  # fmt: skip
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
    delta = rewards + gamma * successor_values.masked_fill(terminated, 0.0) - values
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
    advantages = ((raw - raw.mean()) / (raw.std(correction=0) + 1e-8)).clamp(-5.0, 5.0)
    seen, latents = rollout.observations.flatten(0, 1), rollout.latents.flatten(0, 1)
    rows = (rollout.log_probs, advantages, raw + values, values)
    return Batch(seen, latents, *(row.flatten() for row in rows))


@dataclass(frozen=True)
class Losses:
    """Terms of PPO's loss, and what they tell."""

    surrogate: Tensor
    value: Tensor
    entropy: Tensor
    kl: float
    clip_fraction: float


def ppo_losses(agent: ActorCritic, batch: Batch, config: PPOConfig) -> Losses:
    """Clipped surrogate loss, Smooth-L1 value loss, and entropy."""
    distribution = agent.distribution(batch.observations)
    log_ratio = distribution.log_prob(batch.latents).sum(-1) - batch.log_probs
    ratio = log_ratio.exp()
    limited = ratio.clamp(1 - config.clip, 1 + config.clip)
    surrogate = -torch.minimum(ratio * batch.advantages, limited * batch.advantages).mean()
    values = agent.value(batch.observations)
    value_loss = _value_loss(agent, values, batch.targets)
    if config.value_clip is not None:
        limit = config.value_clip * agent.value_scale
        near = batch.values + (values - batch.values).clamp(-limit, limit)
        value_loss = torch.maximum(value_loss, _value_loss(agent, near, batch.targets))
    with torch.no_grad():
        kl = ((ratio - 1) - log_ratio).mean().item()
        outside = ((ratio - 1).abs() > config.clip).float().mean().item()
    entropy = distribution.entropy().sum(-1).mean()
    return Losses(surrogate, config.value_coefficient * value_loss.mean(), entropy, kl, outside)


def _value_loss(agent: ActorCritic, values: Tensor, targets: Tensor) -> Tensor:
    """Smooth-L1 loss (n,) of values, in units of the value scale."""
    error = (values - targets) / agent.value_scale
    return nn.functional.smooth_l1_loss(error, torch.zeros_like(error), reduction="none")


class PPO:
    """Agent with its two optimisers.

    Parameters
    ----------
    agent : ActorCritic
        Trained in place, but for parameters that are frozen when it is given.
    config : PPOConfig
    given : int
        Number of the last entries of observations whose scales stay as they are: of a design, for instance, the range.
    """

    def __init__(self, agent: ActorCritic, config: PPOConfig, *, given: int = 0) -> None:
        self.given = given
        self.agent = check_instance(agent, "agent", ActorCritic)
        self.config = check_instance(config, "config", PPOConfig)
        self._actor = VectorAdam(agent.actor_parameters(), config.learning_rate)
        self._critic = VectorAdam(list(agent.value_network.parameters()), config.value_rate)
        self._rescaled = 0

    def set_rates(self, share: float) -> None:
        """Step at this share of the configured rates."""
        for part, rate in ((self._actor, self.config.learning_rate), (self._critic, self.config.value_rate)):
            part.rate = rate * share

    def state(self) -> dict[str, Any]:
        """Optimisers and counts, for `restore`."""
        optimisers = self._actor.state, self._critic.state
        return {"optimisers": copy.deepcopy(optimisers), "rescaled": self._rescaled}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`."""
        for part, optimiser in zip((self._actor, self._critic), state["optimisers"]):
            for name, value in part.state.items():
                value.copy_(optimiser[name])
        self._rescaled = state["rescaled"]

    def update(self, rollout: Rollout, *, generator: torch.Generator, actor: bool = True) -> UpdateStatistics:
        """One update on one rollout; `actor=False` trains the critic only."""
        check_instance(rollout, "rollout", Rollout)
        check_instance(generator, "generator", torch.Generator)
        agent, config = self.agent, self.config
        batch = prepare(agent, rollout, config)
        variance, residual = (e.var(correction=0).item() for e in (batch.targets, batch.targets - batch.values))
        if config.running_scales:
            self._rescale_values(batch.targets)
        with self._actor.held(), self._critic.held():
            *before, rows = self._passes(batch, generator, actor)
        if config.running_scales:
            agent.see(rollout.observations, given=self.given)
        kl, outside, entropy, _ = (float(mean) for mean in np.mean(rows, axis=0))
        norms = [norm for done in (*before, rows) for *_, norm in done if not np.isnan(norm)]
        explained = 1.0 - residual / variance if variance > 0 else float("nan")
        return UpdateStatistics(kl, outside, explained, entropy, float(np.mean(norms or [np.nan])), len(before) + 1)

    def _passes(self, batch: Batch, generator: torch.Generator, actor: bool) -> Iterator[list[tuple[float, ...]]]:
        """What each step of a pass did."""
        config = self.config
        for _ in range(config.passes):
            rows: list[tuple[float, ...]] = []
            order = torch.randperm(len(batch.targets), generator=generator).to(batch.targets.device)
            for part in _parts(batch, order, config.minibatch):
                losses = ppo_losses(self.agent, part, config)
                norm = self._step(losses, actor=actor and losses.kl < 1.5 * config.kl_limit)
                rows.append((losses.kl, losses.clip_fraction, losses.entropy.item(), norm))
            yield rows
            if actor and np.mean(rows, axis=0)[0] > config.kl_limit:
                return

    def _rescale_values(self, targets: Tensor) -> None:
        """Move the unit of values towards that of these targets."""
        self._rescaled += 1
        share = max(1.0 / self._rescaled, SCALE_MEMORY)
        mean, std = targets.mean(), targets.std(correction=0).clamp(min=LEAST_SPREAD)
        agent = self.agent
        agent.rescale_values(agent.value_offset.lerp(mean, share), agent.value_scale.lerp(std, share))

    def _step(self, losses: Losses, *, actor: bool) -> float:
        """Norm of the actor's gradient, after one clipped step; NaN if only the critic has made one."""
        of_actor = losses.surrogate - self.config.entropy_coefficient * losses.entropy
        loss = losses.value + of_actor if actor else losses.value
        critic = self._critic.parameters
        wanted = critic + self._actor.parameters * actor
        gradients = torch.autograd.grad(loss, wanted) if wanted else ()
        self._critic.step(gradients[: len(critic)], self.config.max_gradient)
        return self._actor.step(gradients[len(critic) :], self.config.max_gradient) if actor else float("nan")


def _parts(batch: Batch, order: Tensor, size: int) -> Iterator[Batch]:
    """Parts of a batch in some order."""
    columns = (getattr(batch, name)[order].split(size) for name in Batch.__dataclass_fields__)
    return (Batch(*part) for part in zip(*columns))
