"""A learned policy as a controller: NumPy in, NumPy out, saved without pickle."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, ArrayField, Immutable
from ccdtools.checks import as_floats, as_generator, as_instance, as_vector, finite, writable_path
from ccdtools.design_limits import DesignLimits
from ccdtools.exceptions import InputError
from learning import checkpoint
from learning.exceptions import CheckpointError
from learning.networks import ActorCritic, FeedForward

EDGE = 1.05  # designs may lie this far out, in half-widths of the range that the agent was made for
STD_RANGE = (-7.0, 1.0)  # of the logarithm of the exploration, as in `ActorCritic.std`


@dataclass(frozen=True, eq=False, repr=False)
class LearnedPolicy(Immutable):
    """u = π(x, p) at one design: the mean action, or a sample of the policy if `rng` is given.

    Of an agent made for input limits U(p), the inputs lie within those of the design.

    Parameters
    ----------
    agent : ActorCritic
        It is copied: a later training of the agent is not seen.
    design : (np,) array_like
        Within the range of designs that the agent was made for.
    rng : numpy.random.Generator, optional
        Samples actions instead of taking the mean.

    Raises
    ------
    InputError
        If `agent` is none, or `design` has the wrong size, is not finite or lies outside that range.
    """

    agent: ActorCritic
    design: ArrayField
    rng: np.random.Generator | None = None
    _forward: _Forward = field(init=False)

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        as_instance("agent", self.agent, ActorCritic, "an ActorCritic", "fit_actor_critic makes one.")
        if self.rng is not None:
            as_generator("rng", self.rng)
        set_(self, "design", as_vector("design", self.design))
        set_(self, "agent", copy.deepcopy(self.agent))
        set_(self, "_forward", _Forward.of(self.agent))
        self._check_design()
        set_(self, "_forward", self._forward.at(self.agent, self.design))

    def _check_design(self) -> None:
        """Raise an `InputError` if the design is not one that the agent was made for."""
        size = len(self.design)
        most = len(self._forward.offset) - 1
        if size > most:
            raise InputError(
                "design", f"{size} values", f"at most {most}: the agent observes {most + 1} numbers, (x, p)"
            )
        first = most + 1 - size  # the observation is (x, p)
        offset = self._forward.offset[first:]
        scale = self._forward.scale[first:]
        outside = np.abs(self.design - offset) > EDGE * scale
        if outside.any():
            i = int(np.argmax(outside))
            box = f"one in [{offset[i] - scale[i]:g}, {offset[i] + scale[i]:g}], which the agent was made for"
            raise InputError("design", f"{self.design[i]:g} as parameter {i + 1}", box)

    def __repr__(self) -> str:
        kind = "mean" if self.rng is None else "sampled"
        return f"LearnedPolicy({self.nx} states, {self.nu} inputs, {kind} action, design {self.design.tolist()})"

    def __call__(self, x: ArrayLike) -> Array:
        """Inputs (n, nu) or (nu,), within the bounds."""
        x = as_floats("x", x)
        if x.shape[-1:] != (self.nx,):
            raise InputError("x", f"shape {x.shape}", f"({self.nx},) or (n, {self.nx})")
        finite("x", x)
        p = np.broadcast_to(self.design, (*x.shape[:-1], len(self.design)))
        return self._forward.action(np.concatenate([x, p], axis=-1), self.rng)

    def sampled(self, rng: np.random.Generator) -> LearnedPolicy:
        """The stochastic policy, drawing from `rng`."""
        return LearnedPolicy(self.agent, self.design, as_generator("rng", rng))

    def save(self, path: str | Path, **notes: str) -> None:
        """Write the networks, the design and any notes to one safetensors file; read back with `load_policy`.

        Raises
        ------
        InputError
            If the folder does not exist, or a note is no text.
        """
        for name, note in notes.items():
            as_instance(name, note, str, "a note in text")
        checkpoint.save(writable_path("path", path), self.agent, {"design": self.design.tolist(), "notes": notes})

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self._forward.offset) - len(self.design)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self._forward.action_offset)


def load_policy(path: str | Path) -> LearnedPolicy:
    """The policy saved in a file.

    Raises
    ------
    InputError
        If `path` is no path.
    CheckpointError
        If the file is not a saved policy.
    """
    as_instance("path", path, (str, Path), "the path of a saved policy")
    agent, extra = checkpoint.load(path, action_limits=DesignLimits.from_dict)
    if not isinstance(agent, ActorCritic) or "design" not in extra:
        raise CheckpointError(path, f"a {type(agent).__name__} without a design", "a saved policy")
    return LearnedPolicy(agent, extra["design"])


@dataclass(frozen=True, eq=False)
class _Network:
    """A `FeedForward` in float64 arrays: an order of magnitude less overhead on single states."""

    layers: tuple[tuple[Array, Array], ...]
    skip: Array | None

    @classmethod
    def of(cls, network: FeedForward) -> _Network:
        """The weights of a torch network, copied."""
        layers = tuple(
            (_array(layer.weight).T.copy(), _array(layer.bias)) for layer in (*network.linear_layers(), network.head)
        )
        return cls(layers, None if network.skip is None else _array(network.skip.weight).T.copy())

    def __call__(self, z: Array) -> Array:
        """Outputs (..., n_out) of normalised inputs (..., n_in)."""
        h = z
        for W, b in self.layers[:-1]:
            h = np.tanh(h @ W + b)
        W, b = self.layers[-1]
        out = h @ W + b
        return out if self.skip is None else out + z @ self.skip


@dataclass(frozen=True, eq=False)
class _Forward:
    """An actor in float64 arrays: its normalisation, its mean and its exploration."""

    offset: Array
    scale: Array
    action_offset: Array
    action_scale: Array
    mean: _Network
    std: _Network | None
    log_std: Array

    @classmethod
    def of(cls, agent: ActorCritic) -> _Forward:
        """The actor of an agent, copied."""
        return cls(
            _array(agent.observation_offset), _array(agent.observation_scale), _array(agent.action_offset),
            _array(agent.action_scale), _Network.of(agent.mean_network),
            None if agent.std_network is None else _Network.of(agent.std_network), _array(agent.log_std),
        )  # fmt: skip

    def at(self, agent: ActorCritic, design: Array) -> _Forward:
        """With the range that the actions of the agent have at a design (np,)."""
        if agent.action_limits is None:
            return self
        lower, upper = agent.action_limits.bounds(design[-agent.action_limits.entries :])
        return replace(self, action_offset=(lower + upper) / 2, action_scale=(upper - lower) / 2)

    def action(self, observations: Array, rng: np.random.Generator | None) -> Array:
        """Actions (..., nu) in the units of the plant: the mean ones, or samples from `rng`."""
        z = (observations - self.offset) / self.scale
        latent = self.mean(z)
        if rng is not None:
            log_std = self.log_std if self.std is None else np.clip(self.std(z), *STD_RANGE)
            latent = latent + np.exp(log_std) * rng.standard_normal(latent.shape)
        return self.action_offset + self.action_scale * np.clip(latent, -1.0, 1.0)


def _array(tensor) -> Array:
    """A copy of a tensor in float64."""
    return tensor.detach().double().numpy().copy()
