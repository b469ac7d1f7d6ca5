"""Rollouts of a stochastic policy in a batched environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from ccdtools_ground.door import as_count, brief
from ccdtools_ground.user_functions import at_step
from learning.checks import check_instance
from learning.exceptions import InputError
from learning.networks import ActorCritic


class VectorEnv(Protocol):
    """Environments that step together; finished ones restart.

    Observations are (n, n_obs), actions (n, nu) in the units of the plant, rewards (n,), all finite; ends are Boolean
    (n,). Tensors of actions lie where those of the observations do. A training that can be resumed needs two methods
    more: `state()` returns what `restore(state)` takes, in kinds that pickle knows. Where the last entries of an
    observation are not measured but given, as a design is, the attribute `given` is their number: scales leave them.
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


class Collector:
    """Environments whose rollouts go on where the last ended.

    Parameters
    ----------
    env : VectorEnv
        Reset once, now.
    agent : ActorCritic
    generator : torch.Generator
        Of the exploration, on the CPU, so that a draw is the same on every device.

    Attributes
    ----------
    ended : list of (float, float, int, bool, int)
        Return, discounted return, length, termination and last step of the episodes that have ended, in that order.
    steps : int
        Steps of each environment so far.
    ages : (n,) array of int
        Steps of the episodes that have not ended.
    """

    def __init__(self, env: VectorEnv, agent: ActorCritic, *, generator: torch.Generator, gamma: float = 1.0) -> None:
        if not all(callable(getattr(env, name, None)) for name in ("reset", "step")):
            raise InputError("env", repr(env)[:60], "an environment with reset() and step(actions)")
        self.env = env
        self.agent = check_instance(agent, "agent", ActorCritic)
        self.generator = check_instance(generator, "generator", torch.Generator)
        self.gamma = gamma
        self.ended: list[tuple[float, ...]] = []
        first = env.reset()
        n = len(first) if isinstance(first, Tensor) and first.ndim > 0 else 1
        self._observation = self._taken("observations", first, n, len(agent.observation_offset))
        self._sums = np.zeros((len(self._observation), 2))  # undiscounted, and discounted
        self.ages = np.zeros(len(self._observation), dtype=int)
        self.steps = 0

    @torch.no_grad()
    def rollout(self, steps: int) -> Rollout:
        """Next `steps` steps of the sampled policy.

        Raises
        ------
        InputError
            If the environment gives anything but what `VectorEnv` states, or stops with one: a `SimulatorError` then
            names the step.
        """
        as_count("steps", steps)
        agent = self.agent
        device = agent.log_std.device
        columns: list[tuple[Tensor, ...]] = []
        for _ in range(steps):
            observation = self._observation.to(device)
            policy = agent.distribution(observation)
            noise = torch.randn(policy.mean.shape, generator=self.generator).to(device)
            latent = policy.mean + policy.stddev * noise
            actions = agent.action(latent, observation).to(self._observation.device)
            try:
                taken = self._step(actions)
            except InputError as error:
                raise at_step(self.steps + len(columns), error) from error
            columns.append((observation, latent, policy.mean, policy.stddev, *taken))
        seen, latents, mean, std, *experience = (torch.stack(column).to(device) for column in zip(*columns))
        log_probs = torch.distributions.Normal(mean, std, validate_args=False).log_prob(latents).sum(-1)
        successors, *counted = experience
        self._count(*(column.cpu().numpy() for column in counted))
        rollout = Rollout(seen, successors, latents, log_probs, *counted)
        led_to = rollout.successors.masked_fill(rollout.terminated[..., None], 0.0)  # no value is asked of an end
        checked = {"observations": rollout.observations, "successors": led_to, "rewards": rollout.rewards}
        for name, column in checked.items():
            finite = column.isfinite().reshape(steps, -1).all(dim=1)
            if not finite.all():
                k = int(finite.logical_not().nonzero()[0])
                expected = "finite numbers of single precision"
                raise InputError("env", brief(f"the {name} {column[k].tolist()} at step {k} of a rollout"), expected)
        return rollout

    def _step(self, actions: Tensor) -> list[Tensor]:
        """Successor, reward, terminated and truncated of a step."""
        n, size = self._observation.shape
        following, successor, reward, *ends = self.env.step(actions)
        self._observation = self._taken("observations", following, n, size)
        numbers = [self._taken("successors", successor, n, size), self._taken("rewards", reward, n)]
        return numbers + [self._taken("ends of episodes", end, n, kind=torch.bool) for end in ends]

    def _taken(self, name: str, value: Any, *shape: int, kind: torch.dtype = torch.float32) -> Tensor:
        """A copy of what the environment gave, which may use its own again."""
        if not isinstance(value, Tensor):
            raise InputError("env", f"{name} of {type(value).__name__}", "a tensor, see VectorEnv and GymnasiumEnvs")
        if value.shape != shape or (value.dtype is torch.bool) != (kind is torch.bool):
            got = f"{name} of shape {tuple(value.shape)}, {value.dtype}"
            raise InputError("env", got, f"a tensor of shape {shape}, {kind}")
        return value.to(kind, copy=True)

    def state(self) -> dict[str, Any]:
        """Environments, returns and generator where they stand, for `restore`.

        Raises
        ------
        InputError
            If the environment has no methods `state` and `restore`.
        """
        if not all(callable(getattr(self.env, name, None)) for name in ("state", "restore")):
            expected = "methods state() and restore(state), without which no training can go on exactly"
            raise InputError("env", repr(self.env)[:60], expected)
        own = {"observation": self._observation, "ended": [*self.ended], "steps": self.steps}
        own |= {"sums": self._sums.copy(), "ages": self.ages.copy()}
        return {**own, "env": self.env.state(), "generator": self.generator.get_state()}  # type: ignore[attr-defined]

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`."""
        self.env.restore(state["env"])  # type: ignore[attr-defined]
        self._observation = state["observation"].to(self._observation.device)
        self.ended, self.steps = [*state["ended"]], state["steps"]
        self._sums, self.ages = state["sums"].copy(), state["ages"].copy()
        self.generator.set_state(state["generator"])

    def _count(self, rewards: np.ndarray, terminated: np.ndarray, truncated: np.ndarray) -> None:
        """Add steps (T, n) to the episodes."""
        over = terminated | truncated
        for t, reward in enumerate(rewards.astype(float)):
            self._sums += np.stack([reward, reward * self.gamma**self.ages], axis=1)
            self.ages += 1
            self.steps += 1
            for i in over[t].nonzero()[0]:
                self.ended.append((*self._sums[i].tolist(), int(self.ages[i]), bool(terminated[t, i]), self.steps))
                self._sums[i], self.ages[i] = 0.0, 0


def collect(env: VectorEnv, agent: ActorCritic, *, steps: int, generator: torch.Generator) -> Rollout:
    """Rollout of `steps` steps of the sampled policy, from a reset.

    Raises
    ------
    InputError
        If an argument is of another kind.
    """
    return Collector(env, agent, generator=generator).rollout(steps)
