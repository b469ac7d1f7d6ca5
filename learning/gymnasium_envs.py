"""Environments of Gymnasium as one that PPO can train in."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from itertools import zip_longest
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccdtools_ground.door import as_count, as_number, brief
from learning.budgets import TRIED_STEPS
from learning.exceptions import InputError
from learning.networks import ActorCritic, NetworkConfig
from learning.tolerances import WIDEST

Array = np.ndarray


class GymnasiumEnvs:
    """Environments of Gymnasium that step together in this process.

    Parameters
    ----------
    make : str or callable
        Name for `gymnasium.make`, or a function without arguments that makes one environment. Observations and
        actions are boxes (n,); bounds of actions must be finite.
    runs : int
        Number of environments.
    seed : int
        The first resets have the seeds seed, seed + 1, and so on.

    Raises
    ------
    InputError
        If `make` makes no environment with such spaces.
    """

    def __init__(self, make: str | Callable[[], Any], *, runs: int = 4, seed: int = 0) -> None:
        as_count("runs", runs)
        as_count("seed", seed, least=0)
        self.envs = [_made(make) for _ in range(runs)]
        self.seed = seed
        if len({id(env.unwrapped) for env in self.envs}) < runs:
            raise InputError("make", "one environment again and again", "a new one at every call")
        spaces = [(_box(env, "observation_space"), _box(env, "action_space")) for env in self.envs]
        if any(pair != spaces[0] for pair in spaces):
            raise InputError("make", "environments of several spaces", "the same spaces at every call")
        observations, actions = spaces[0]
        self._lower, self._upper = actions.low, actions.high
        if not (np.isfinite(self._lower) & np.isfinite(self._upper)).all():
            raise InputError("make", f"actions from {self._lower} to {self._upper}", "finite bounds of the actions")
        self._range = np.asarray(observations.low, float), np.asarray(observations.high, float)
        self._type = observations.dtype
        tried = zip_longest(*(self._tried() for _ in range(2)), fillvalue="an end")
        for k, (first, again) in enumerate(tried):
            if first != again:
                got = f"{first} and {again} as reward and observation {k} steps after two resets with seed {seed}"
                raise InputError("make", brief(got, 200), "the same numbers")

    def agent(self, *, config: NetworkConfig | None = None, seed: int = 0) -> ActorCritic:
        """Untrained agent for these observations and actions.

        Observations without bounds are taken for numbers of about one, until the first are seen.
        """
        lower, upper = self._range
        known = np.isfinite(lower) & np.isfinite(upper) & (upper > lower) & (upper - lower < WIDEST)
        lower, upper = np.where(known, lower, -1.0), np.where(known, upper, 1.0)
        return ActorCritic(lower, upper, self._lower, self._upper, config=config, seed=seed)

    def reset(self) -> Tensor:
        """Fresh observations (runs, n_obs), from the seeds."""
        return torch.stack([self._seen(env.reset(seed=self.seed + i)[0]) for i, env in enumerate(self.envs)])

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Next observation, successor, reward, terminated and truncated, see `VectorEnv`."""
        if actions.shape != (len(self.envs), len(self._lower)):
            raise InputError("actions", f"shape {tuple(actions.shape)}", f"({len(self.envs)}, {len(self._lower)})")
        following, successors, rewards, terminated, truncated = [], [], [], [], []
        for env, action in zip(self.envs, actions.double().numpy()):
            rounded = action.astype(self._lower.dtype)  # can be beyond a bound
            successor, reward, over, cut = self._stepped(env, np.clip(rounded, self._lower, self._upper))
            successors.append(successor)
            following.append(self._seen(env.reset()[0]) if over or cut else successor)
            rewards.append(reward)
            terminated.append(over)
            truncated.append(cut and not over)
        flags = torch.tensor(terminated), torch.tensor(truncated)
        return torch.stack(following), torch.stack(successors), torch.tensor(rewards, dtype=torch.float32), *flags

    def state(self) -> bytes:
        """Environments where they stand, for `restore`."""
        if any("EzPickle" in (base.__name__ for base in type(env.unwrapped).__mro__) for env in self.envs):
            expected = "one that pickle keeps where it stands: this one is made anew and could not go on exactly"
            raise InputError("env", repr(self.envs[0].unwrapped)[:60], expected)
        try:
            return pickle.dumps(self.envs)
        except (AttributeError, TypeError, pickle.PicklingError) as error:
            raise InputError("env", str(error), "environments that pickle can keep") from None

    def restore(self, state: bytes) -> None:
        """Go on from a `state`.

        Raises
        ------
        InputError
            If its environments are others, as far as their number and spaces tell.
        """
        envs = pickle.loads(state)
        own, kept = ([(env.observation_space, env.action_space) for env in some] for some in (self.envs, envs))
        if own != kept:
            raise InputError("state", f"{len(kept)} environments of {kept[0]}", f"{len(own)} of {own[0]}")
        self.envs = envs

    def _tried(self) -> list[list[float]]:
        """Rewards and observations, 1 + n_obs numbers a step, of a few steps of the first environment."""
        env = self.envs[0]
        rows = [[0.0, *self._seen(env.reset(seed=self.seed)[0]).tolist()]]
        for share in np.linspace(0.25, 0.75, TRIED_STEPS):
            action = self._lower + share * (self._upper - self._lower)
            observation, reward, over, cut = self._stepped(env, action.astype(self._lower.dtype))
            rows.append([reward, *observation.tolist()])
            if over or cut:
                break
        return rows

    def _stepped(self, env: Any, action: Array) -> tuple[Tensor, float, bool, bool]:
        """Observation, reward, terminated and truncated of a step."""
        result = env.step(action)
        if not isinstance(result, tuple) or len(result) != 5:
            raise InputError("env", f"{brief(repr(result))} of a step", "what Gymnasium states: five values")
        observation, reward, over, cut, _ = result
        return self._seen(observation), as_number("env", reward, expected="finite rewards"), bool(over), bool(cut)

    def _seen(self, observation: Any) -> Tensor:
        """Observation (n_obs,) as a tensor, if it is of the kind that the space states."""
        row = np.array(observation)
        n = len(self._range[0])
        if row.shape != (n,) or row.dtype != self._type or not np.isfinite(row).all():
            got = f"an observation of shape {row.shape}, {row.dtype}, {row}"
            raise InputError("env", got, f"finite ones of shape ({n},), {self._type}, as its space states")
        return torch.from_numpy(row.astype(np.float32))


def _made(make: Any) -> Any:
    """Environment of a name or function."""
    if isinstance(make, str):
        try:
            import gymnasium
        except ImportError:
            raise InputError("make", repr(make), "Gymnasium installed: pip install ccdtools[gymnasium]") from None
        try:
            return gymnasium.make(make)
        except gymnasium.error.Error as error:
            raise InputError("make", repr(make), f"a registered environment ({error})") from None
    env = make() if callable(make) else None
    if not all(hasattr(env, name) for name in ("reset", "step", "observation_space", "action_space")):
        raise InputError("make", repr(make)[:60], "the name of an environment, or a function that makes one")
    return env


def _box(env: Any, name: str) -> Any:
    """Space of an environment, which must be a box (n,)."""
    space = getattr(env, name)
    whole = name == "action_space" and not np.issubdtype(space.dtype, np.floating)
    if not hasattr(space, "low") or len(space.shape) != 1 or whole:
        cure = "For discrete actions use Stable-Baselines3." if name == "action_space" else "Flatten it by a wrapper."
        raise InputError("make", f"the {name} {space}", "a box of shape (n,)" + (" of float" if whole else ""), cure)
    return space
