"""Rollouts of a stochastic policy in a batched environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ccdtools_ground.door import as_count
from learning.checks import check_instance
from learning.exceptions import InputError
from learning.networks import ActorCritic


class VectorEnv(Protocol):
    """Environments that step together; finished ones restart.

    Observations are (n, n_obs), actions (n, nu) in the units of the plant.
    """

    def reset(self) -> Tensor:
        """Fresh observations."""
        ...

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Result of a step: (next observation, successor before any restart, reward, terminated, truncated)."""
        ...


@dataclass(frozen=True, eq=False)
class Rollout:
    """Experience, time first."""

    observations: Tensor  # (T, n, n_obs)
    successors: Tensor  # (T, n, n_obs): what each step led to, before any restart
    latents: Tensor  # (T, n, nu): unclipped latent actions, as sampled
    log_probs: Tensor  # (T, n): of the latents under the policy that sampled them
    rewards: Tensor  # (T, n)
    # a terminal state has no future; a truncated one has, and is bootstrapped
    terminated: Tensor  # (T, n) bool
    truncated: Tensor  # (T, n) bool


@torch.no_grad()
def collect(env: VectorEnv, agent: ActorCritic, *, steps: int, generator: torch.Generator) -> Rollout:
    """Rollout of `steps` steps of the sampled policy, from a reset.

    Raises
    ------
    InputError
        If an argument is of another kind.
    """
    if not all(callable(getattr(env, name, None)) for name in ("reset", "step")):
        raise InputError("env", repr(env)[:60], "an environment with reset() and step(actions)")
    check_instance(agent, "agent", ActorCritic)
    as_count("steps", steps)
    check_instance(generator, "generator", torch.Generator)
    columns: list[tuple[Tensor, ...]] = []
    observation = env.reset()
    for _ in range(steps):
        distribution = agent.distribution(observation)
        noise = torch.randn(distribution.mean.shape, generator=generator)
        latent = distribution.mean + distribution.stddev * noise
        log_prob = distribution.log_prob(latent).sum(-1)
        following, successor, reward, terminated, truncated = env.step(agent.action(latent, observation))
        columns.append((observation, successor, latent, log_prob, reward, terminated, truncated))
        observation = following
    return Rollout(*(torch.stack(column) for column in zip(*columns)))
