"""Environments of Gymnasium as one that PPO can train in."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccdtools_ground.door import as_count
from learning.exceptions import InputError
from learning.networks import ActorCritic, NetworkConfig

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
        observations = _box(self.envs[0], "observation_space")
        actions = _box(self.envs[0], "action_space")
        self._lower, self._upper = actions.low, actions.high
        if not (np.isfinite(self._lower) & np.isfinite(self._upper)).all():
            raise InputError("make", f"actions from {self._lower} to {self._upper}", "finite bounds of the actions")
        self._range = np.asarray(observations.low, float), np.asarray(observations.high, float)
        self._type = observations.dtype
        first, again = (self.envs[0].reset(seed=seed)[0] for _ in range(2))
        if not np.array_equal(first, again):
            raise InputError("make", f"{first} and {again} after two resets with seed {seed}", "the same observation")

    def agent(self, *, config: NetworkConfig | None = None, seed: int = 0) -> ActorCritic:
        """Untrained agent for these observations and actions.

        Observations without bounds are taken for numbers of about one, until the first are seen.
        """
        lower, upper = self._range
        known = np.isfinite(lower) & np.isfinite(upper) & (upper - lower < 1e6)
        lower, upper = np.where(known, lower, -1.0), np.where(known, upper, 1.0)
        return ActorCritic(lower, upper, self._lower, self._upper, config=config, seed=seed)

    def reset(self) -> Tensor:
        """Fresh observations (runs, n_obs), from the seeds."""
        return self._tensor([env.reset(seed=self.seed + i)[0] for i, env in enumerate(self.envs)])

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Next observation, successor, reward, terminated and truncated, see `VectorEnv`."""
        following, successors, rewards, terminated, truncated = [], [], [], [], []
        for env, action in zip(self.envs, actions.double().numpy()):
            rounded = action.astype(self._lower.dtype)  # can be beyond a bound
            successor, reward, over, cut, _ = env.step(np.clip(rounded, self._lower, self._upper))
            successors.append(successor)
            following.append(env.reset()[0] if over or cut else successor)
            rewards.append(reward)
            terminated.append(bool(over))
            truncated.append(bool(cut and not over))
        if not np.isfinite(rewards).all():
            raise InputError("env", f"the rewards {rewards}", "finite rewards")
        flags = torch.tensor(terminated), torch.tensor(truncated)
        reward = torch.tensor(rewards, dtype=torch.float32)
        return self._tensor(following), self._tensor(successors), reward, *flags

    def state(self) -> bytes:
        """Environments where they stand, for `restore`."""
        if any("EzPickle" in (base.__name__ for base in type(env.unwrapped).__mro__) for env in self.envs):
            expected = "one that pickle keeps where it stands: this one is made anew and could not go on exactly"
            raise InputError("env", repr(self.envs[0].unwrapped)[:60], expected)
        return pickle.dumps(self.envs)

    def restore(self, state: bytes) -> None:
        """Go on from a `state`."""
        self.envs = pickle.loads(state)

    def _tensor(self, observations: Sequence[Any]) -> Tensor:
        """Observations as one tensor, of the shape that the space states."""
        rows = [np.asarray(observation) for observation in observations]
        n = len(self._range[0])
        for row in rows:
            if row.shape != (n,) or row.dtype != self._type or not np.isfinite(row).all():
                got = f"an observation of shape {row.shape}, {row.dtype}, {row}"
                raise InputError("env", got, f"finite ones of shape ({n},), {self._type}, as its space states")
        return torch.from_numpy(np.stack(rows).astype(np.float32))


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
    if not hasattr(space, "low") or len(space.shape) != 1:
        cure = "For discrete actions use Stable-Baselines3." if name == "action_space" else "Flatten it by a wrapper."
        raise InputError("make", f"the {name} {space}", "a box of shape (n,)", cure)
    return space
