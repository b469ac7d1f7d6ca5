"""Environments of Gymnasium as one that PPO can train in."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Iterator
from itertools import takewhile
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from ccdtools_ground.door import as_count, as_number, as_positive, brief
from ccdtools_ground.own_process import OwnProcess
from ccdtools_ground.user_functions import in_words
from learning.budgets import TRIAL_TIME, TRIED_STEPS
from learning.exceptions import InputError, SimulatorError
from learning.networks import ActorCritic, NetworkConfig
from learning.tolerances import WIDEST

Array = np.ndarray
Answer = TypeVar("Answer")


class GymnasiumEnvs:
    """Environments of Gymnasium that step together in this process.

    To see that it does the same after the same seed, an episode of the first one is taken twice, or as much of it as
    takes a second.

    Parameters
    ----------
    make : str or callable
        Name for `gymnasium.make`, or a function without arguments that makes one environment. Observations and
        actions are boxes (n,); bounds of actions must be finite.
    runs : int
        Number of environments.
    seed : int
        The first resets have the seeds seed, seed + 1, and so on.
    step_limit : float, optional
        Longest time of a call [s], the first of which makes an environment. Each then runs in a process of its own.

    Raises
    ------
    InputError
        If `make` makes no environment with such spaces.
    SimulatorError
        If one stops, breaks its word, dies or takes longer in a step: which, and in which step since `reset`.
    """

    def __init__(
        self, make: str | Callable[[], Any], *, runs: int = 4, seed: int = 0, step_limit: float | None = None
    ) -> None:  # fmt: skip
        as_count("runs", runs)
        as_count("seed", seed, least=0)
        if step_limit is not None:
            as_positive("step_limit", step_limit, unit="s")
        self.seed = seed
        self.taken = 0
        self.envs: list[Any] = []
        for i in range(runs):
            apart = None if step_limit is None else self._answer(i, lambda: _Apart(make, step_limit))
            self.envs.append(apart or _made(make))
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
        end = time.monotonic() + TRIAL_TIME
        tried = [*takewhile(lambda row: self.taken <= TRIED_STEPS or time.monotonic() < end, self._trial())]
        self._first = tried[: TRIED_STEPS + 1]
        for k, (first, again) in enumerate(zip(tried, self._trial())):
            if first != again:
                got = f"reward and observation {k} steps after two resets with seed 0: {first or 'an end'} and "
                raise InputError("make", brief(f"{got}{again or 'an end'}", 200), "the same numbers")

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
        self.taken = 0
        return torch.from_numpy(np.stack([self._begun(i, seed=self.seed + i) for i in range(len(self.envs))]))

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Next observation, successor, reward, terminated and truncated, see `VectorEnv`."""
        if actions.shape != (len(self.envs), len(self._lower)):
            raise InputError("actions", f"shape {tuple(actions.shape)}", f"({len(self.envs)}, {len(self._lower)})")
        following, successors, rewards, terminated, truncated = [], [], [], [], []
        rounded = actions.double().numpy().astype(self._lower.dtype)  # can be beyond a bound
        for i, action in enumerate(np.clip(rounded, self._lower, self._upper)):
            successor, reward, over, cut = self._stepped(i, action)
            successors.append(successor)
            following.append(self._begun(i) if over or cut else successor)
            rewards.append(reward)
            terminated.append(over)
            truncated.append(cut and not over)
        self.taken += 1
        seen = torch.from_numpy(np.stack(following)), torch.from_numpy(np.stack(successors))
        return *seen, torch.tensor(rewards, dtype=torch.float32), torch.tensor(terminated), torch.tensor(truncated)

    def state(self) -> bytes:
        """Environments where they stand, for `restore`."""
        try:
            if isinstance(self.envs[0], _Apart):
                return pickle.dumps((self._first, [(*env.spaces, env.call("kept", None)) for env in self.envs]))
            for env in self.envs:
                _check_kept(env)
            return pickle.dumps((self._first, self.envs))
        except (AttributeError, TypeError, pickle.PicklingError) as error:
            raise InputError("env", str(error), "environments that pickle can keep") from None

    def restore(self, state: bytes) -> None:
        """Go on from a `state`.

        Raises
        ------
        InputError
            If its environments are others, as far as their number, spaces and first steps tell.
        """
        first, envs = pickle.loads(state)
        apart, kept_apart = isinstance(self.envs[0], _Apart), isinstance(envs[0], tuple)
        own = [(env.observation_space, env.action_space) for env in self.envs]
        kept = [env[:2] if kept_apart else (env.observation_space, env.action_space) for env in envs]
        if apart != kept_apart or own != kept:
            places = ["here", "in processes of their own"]
            got = f"{len(kept)} environments of {kept[0]}, kept {places[kept_apart]}"
            raise InputError("state", got, f"{len(own)} of {own[0]}, kept {places[apart]}")
        for k, (before, now) in enumerate(zip(first, self._first)):
            if len(before) != len(now) or not np.allclose(before, now, rtol=1e-4, atol=1e-6):
                got = f"environments with {before} as reward and observation {k} steps after a first reset"
                raise InputError("state", brief(got, 200), f"{now}")
        if apart:
            for env, (*_, one) in zip(self.envs, envs):
                env.call("kept", one)
        else:
            self.envs = envs
        self.taken = 0

    def _trial(self) -> Iterator[list[float]]:
        """Reward and observation, 1 + n_obs numbers, of every step of an episode; none of its end."""
        self.taken = 0
        rng = np.random.default_rng(0)
        yield [0.0, *self._begun(0, seed=0).tolist()]
        over = cut = False
        while not (over or cut):
            action = rng.uniform(self._lower, self._upper).astype(self._lower.dtype)
            observation, reward, over, cut = self._stepped(0, action)
            self.taken += 1
            yield [reward, *observation.tolist()]
        yield []

    def _begun(self, i: int, **seed: int) -> Array:
        """First observation of an environment."""
        return self._answer(i, lambda: self._seen(self.envs[i].reset(**seed)[0]))

    def _stepped(self, i: int, action: Array) -> tuple[Array, float, bool, bool]:
        """Observation, reward, terminated and truncated of a step."""
        return self._answer(i, lambda: self._read(self.envs[i].step(action)))

    def _answer(self, i: int, call: Callable[[], Answer]) -> Answer:
        """Result of a call; what stops in it is an error that names environment and step."""
        try:
            return call()
        except Exception as error:
            own = error if isinstance(error, InputError) else InputError("env", in_words(error)[0], "an answer")
            named = SimulatorError("env", f"{own.got} from environment {i}", own.expected, own.cure)
            named.step = self.taken
            raise named from error

    def _read(self, result: Any) -> tuple[Array, float, bool, bool]:
        """Observation, reward, terminated and truncated, as Gymnasium states them."""
        if not isinstance(result, tuple) or len(result) != 5:
            raise InputError("env", f"{brief(repr(result))} of a step", "what Gymnasium states: five values")
        observation, reward, over, cut, _ = result
        return (
            self._seen(observation),
            as_number("env", reward, expected="a finite number as reward"),
            bool(over),
            bool(cut),
        )

    def _seen(self, observation: Any) -> Array:
        """Observation (n_obs,), if it is of the kind that the space states."""
        row = np.array(observation)
        n = len(self._range[0])
        if row.shape != (n,) or row.dtype != self._type or not np.isfinite(row).all():
            got = f"an observation of shape {row.shape}, {row.dtype}, {row}"
            raise InputError("env", got, f"finite ones of shape ({n},), {self._type}, as its space states")
        return row.astype(np.float32)


class _Apart:
    """Environment in a process of its own."""

    def __init__(self, make: Any, limit: float) -> None:
        self.call = OwnProcess(_Held(make), limit, ("call", "given"))
        self.spaces = self.observation_space, self.action_space = self.call("spaces", None)
        self.unwrapped = self

    def reset(self, **seed: int) -> Any:
        """First observation."""
        return self.call("reset", seed)

    def step(self, action: Array) -> Any:
        """Result of a step."""
        return self.call("step", action)


class _Held:
    """Environment that answers calls, made at the first."""

    def __init__(self, make: Any) -> None:
        self.make = make
        self.env: Any = None

    def __call__(self, name: str, given: Any) -> Any:
        self.env = _made(self.make) if self.env is None else self.env
        if name == "kept":
            if given is None:
                from joblib import wrap_non_picklable_objects

                _check_kept(self.env)  # its class may be one that only the caller's file knows
                return pickle.dumps(wrap_non_picklable_objects(self.env, keep_wrapper=False))
            self.env = pickle.loads(given)
            return True
        if name == "spaces":
            return self.env.observation_space, self.env.action_space
        return self.env.reset(**given) if name == "reset" else self.env.step(given)


def _check_kept(env: Any) -> None:
    """Raise an `InputError` unless pickle keeps an environment where it stands."""
    if "EzPickle" in (base.__name__ for base in type(env.unwrapped).__mro__):
        expected = "one that pickle keeps where it stands: this one is made anew and could not go on exactly"
        raise InputError("env", repr(env.unwrapped)[:60], expected)


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
        discrete = name == "action_space" and (whole or not hasattr(space, "low"))
        cure = "For discrete actions use Stable-Baselines3." if discrete else "Flatten it by a wrapper."
        raise InputError("make", f"the {name} {space}", "a box of shape (n,)" + (" of float" if whole else ""), cure)
    return space
