"""A learned policy as a controller: NumPy in, NumPy out, saved without pickle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, ArrayField
from ccdtools.exceptions import InputError
from learning import checkpoint
from learning.exceptions import CheckpointError
from learning.networks import ActorCritic, FeedForward


@dataclass(frozen=True, eq=False)
class LearnedPolicy:
    """u = π(x, p) at one design: the mean action, or a sample of the policy if `rng` is given.

    Parameters
    ----------
    agent : ActorCritic
        Its networks are read once, at the first call; a later training of the agent is not seen.
    design : (np,) array_like
    rng : numpy.random.Generator, optional
        Samples actions instead of taking the mean.
    """

    agent: ActorCritic
    design: ArrayField
    rng: np.random.Generator | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "design", np.array(self.design, dtype=float).reshape(-1))

    def __call__(self, x: ArrayLike) -> Array:
        """Inputs (n, nu) or (nu,), within the bounds."""
        x = np.asarray(x, dtype=float)
        if x.shape[-1:] != (self._nx,):
            raise InputError(f"x: got shape {x.shape}, expected ({self._nx},) or (n, {self._nx}).")
        if not np.isfinite(x).all():
            raise InputError("x: got a value that is not finite, expected finite states.")
        p = np.broadcast_to(self.design, (*x.shape[:-1], len(self.design)))
        z = (np.concatenate([x, p], axis=-1) - self._offset) / self._scale
        latent = self._mean(z)
        if self.rng is not None:
            latent = latent + np.exp(self._log_std(z)) * self.rng.standard_normal(latent.shape)
        return self._action_offset + self._action_scale * np.clip(latent, -1.0, 1.0)

    def sampled(self, rng: np.random.Generator) -> LearnedPolicy:
        """The stochastic policy, drawing from `rng`."""
        return LearnedPolicy(self.agent, self.design, rng)

    def save(self, path: str | Path, **notes: str) -> None:
        """Write the networks, the design and any notes to one safetensors file; read back with `load_policy`."""
        checkpoint.save(path, self.agent, {"design": self.design.tolist(), "notes": notes})

    @property
    def _nx(self) -> int:
        return len(self._offset) - len(self.design)

    @cached_property
    def _offset(self) -> Array:
        return self.agent.observation_offset.double().numpy().copy()

    @cached_property
    def _scale(self) -> Array:
        return self.agent.observation_scale.double().numpy().copy()

    @cached_property
    def _action_offset(self) -> Array:
        return self.agent.action_offset.double().numpy().copy()

    @cached_property
    def _action_scale(self) -> Array:
        return self.agent.action_scale.double().numpy().copy()

    @cached_property
    def _mean(self) -> Callable[[Array], Array]:
        return _in_numpy(self.agent.mean_network)

    @cached_property
    def _log_std(self) -> Callable[[Array], Array]:
        if self.agent.std_network is None:
            constant = self.agent.log_std.detach().double().numpy().copy()
            return lambda z: constant
        network = _in_numpy(self.agent.std_network)
        return lambda z: np.clip(network(z), -7.0, 1.0)


def load_policy(path: str | Path) -> LearnedPolicy:
    """The policy saved in a file.

    Raises
    ------
    CheckpointError
        If the file is not a saved policy.
    """
    agent, extra = checkpoint.load(path)
    if not isinstance(agent, ActorCritic) or "design" not in extra:
        raise CheckpointError(path, f"a {type(agent).__name__} without a design", "a saved policy")
    return LearnedPolicy(agent, extra["design"])


def _in_numpy(network: FeedForward) -> Callable[[Array], Array]:
    """The same function on float64 arrays: an order of magnitude less overhead on single states."""
    layers = [
        (layer.weight.detach().double().numpy().T.copy(), layer.bias.detach().double().numpy().copy())
        for layer in (*network.linear_layers(), network.head)
    ]
    skip = None if network.skip is None else network.skip.weight.detach().double().numpy().T.copy()

    def forward(z: Array) -> Array:
        h = z
        for W, b in layers[:-1]:
            h = np.tanh(h @ W + b)
        W, b = layers[-1]
        out = h @ W + b
        return out if skip is None else out + z @ skip

    return forward
