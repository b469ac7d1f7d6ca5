"""Behaviour cloning of a policy and its value."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from tqdm import trange

from ccdtools_ground.door import as_count, as_floats, as_generator
from learning.checks import as_bounds, check_instance, check_number, spread
from learning.exceptions import InputError
from learning.networks import ActionLimits, ActorCritic, NetworkConfig, scaled
from learning.tolerances import LEAK, ROUNDING
from learning.vector_adam import VectorAdam, falling

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CloningConfig:
    """Duration and rates of cloning.

    Attributes
    ----------
    steps : int
        Gradient steps.
    batch : int
        Samples per step.
    learning_rate : float
        Adam's first rate; it falls to zero along a cosine.
    """

    steps: int = 3000
    batch: int = 1024
    learning_rate: float = 4e-3

    def __post_init__(self) -> None:
        as_count("steps", self.steps)
        as_count("batch", self.batch)
        check_number(self.learning_rate, "learning_rate")


def fit_actor_critic(
    inputs: ArrayLike,
    actions: ArrayLike,
    values: ArrayLike,
    *,
    action_bounds: tuple[ArrayLike, ArrayLike] | ActionLimits,
    input_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    rng: np.random.Generator,
    network: NetworkConfig | None = None,
    config: CloningConfig | None = None,
    progress: bool = False,
) -> ActorCritic:
    """Return an actor and a critic fitted to an expert's data.

    Parameters
    ----------
    inputs : (n, n_obs) array_like
        Observations.
    actions : (n, nu) array_like
        The expert's actions, within `action_bounds`.
    values : (n,) array_like
        Discounted returns of the expert (negative for costs); NaN where unknown, but not everywhere.
    action_bounds : (lower, upper), each (nu,), or ActionLimits
        The range of the policy; `ActionLimits` where it depends on the last observations, as U(p) does.
    input_bounds : (lower, upper), each (n_obs,), optional
        Range for the normalisation; that of the data by default.
    rng : numpy.random.Generator
    network, config : optional
        Shapes and rates.

    Returns
    -------
    ActorCritic

    Raises
    ------
    InputError
        On empty, mismatched or non-finite data, values of which none is known, bounds of another size, or a
        configuration of another kind.
    """
    config = check_instance(CloningConfig() if config is None else config, "config", CloningConfig)
    shape = check_instance(NetworkConfig() if network is None else network, "network", NetworkConfig)
    rng = as_generator("rng", rng)
    x, u, v = _checked(inputs, actions, values)
    lower, upper = _range(x) if input_bounds is None else as_bounds(input_bounds, "input_bounds", x.shape[1])
    limits: Any = action_bounds if hasattr(action_bounds, "as_dict") else None
    least, largest = as_bounds(action_bounds if limits is None else limits.box, "action_bounds", u.shape[1])
    seed = int(rng.integers(2**31))
    agent = ActorCritic(lower, upper, least, largest, config=shape, seed=seed, imitates=True, action_limits=limits)
    known = np.isfinite(v)
    agent.value_offset.fill_(float(np.median(v[known])))
    agent.value_scale.fill_(float(spread(v[known])))
    X, U, V = (torch.tensor(a, dtype=torch.float32) for a in (x, u, np.nan_to_num(v)))
    K = torch.tensor(known)
    middle, half = (part.expand_as(U) for part in agent.action_range(X))
    Z = agent.normalise(X)

    def loss(i: torch.Tensor) -> torch.Tensor:
        """Mean loss of these samples."""
        z, width = Z[i], half[i]
        error = (scaled(agent.mean_network(z), (middle[i], width), leak=LEAK) - U[i]) / width
        found = agent.value_offset + agent.value_scale * agent.value_network(z).squeeze(-1)
        value_error = ((found - V[i]) if known.all() else (found - V[i])[K[i]]) / agent.value_scale
        value_loss = torch.nn.functional.smooth_l1_loss(value_error, torch.zeros_like(value_error), reduction="sum")
        return error.square().sum(-1).mean() + value_loss / len(i)

    drawn = (
        torch.from_numpy(rng.integers(0, len(X), min(config.batch, len(X))))
        for _ in trange(config.steps, desc="cloning", disable=not progress, leave=False)
    )
    parameters = [*agent.mean_network.parameters(), *agent.value_network.parameters()]
    _descend(parameters, (loss(i) for i in drawn), config.learning_rate, config.steps)
    return agent


def fit_further(
    agent: ActorCritic, inputs: ArrayLike, actions: ArrayLike, rng: np.random.Generator, *,
    steps: int = 1500, batch: int = 2048, rate: float = 2e-3,
) -> ActorCritic:  # fmt: skip
    """Copy of an agent whose actor is fitted on, to actions of an expert or of its own.

    Parameters
    ----------
    inputs : (n, n_obs) array_like
        Observations.
    actions : (n, nu) array_like
        Within the range of the policy.
    steps, batch, rate
        Gradient steps, samples of each, and Adam's first rate, which falls to zero along a cosine.
    """
    X, U = (torch.as_tensor(a, dtype=torch.float32) for a in (inputs, actions))
    agent = copy.deepcopy(agent)
    middle, half = (part.expand_as(U) for part in agent.action_range(X))
    Z = agent.normalise(X)

    def loss(i: torch.Tensor) -> torch.Tensor:
        """Mean loss of these samples."""
        error = (scaled(agent.mean_network(Z[i]), (middle[i], half[i]), leak=LEAK) - U[i]) / half[i]
        return error.square().sum(-1).mean()

    drawn = (torch.from_numpy(rng.integers(0, len(X), min(batch, len(X)))) for _ in range(steps))
    _descend([*agent.mean_network.parameters()], (loss(i) for i in drawn), rate, steps)
    return agent


def _descend(parameters: list[torch.nn.Parameter], losses: Iterable[torch.Tensor], rate: float, steps: int) -> None:
    """Adam on losses, each asked for after the step before, at a rate that falls to zero along a cosine."""
    adam = VectorAdam(parameters, rate, fused=False)
    with adam.held():
        for k, loss in enumerate(losses):
            adam.rate = falling(rate, k, steps)
            adam.step(torch.autograd.grad(loss, adam.parameters))


def _checked(inputs: ArrayLike, actions: ArrayLike, values: ArrayLike) -> tuple[Array, Array, Array]:
    """Return the expert's data as float arrays of matching lengths."""
    x = as_floats("inputs", inputs)
    u = as_floats("actions", actions)
    v = as_floats("values", values).reshape(-1)
    if x.ndim != 2 or u.ndim != 2 or not len(x) == len(u) == len(v) or len(x) == 0:
        shapes = f"shapes {x.shape}, {u.shape}, {v.shape}"
        raise InputError("inputs, actions, values", shapes, "(n, n_obs), (n, nu), (n,)")
    if not (np.isfinite(x).all() and np.isfinite(u).all()):
        raise InputError("inputs, actions", "values that are not finite", "finite samples")
    if not np.isfinite(v).any():
        cure = "Every run of the expert was lost, or pass zeros to imitate its actions alone."
        raise InputError("values", f"{len(v)} of which none is finite", "at least one known return", cure)
    return x, u, v


def _range(x: Array) -> tuple[Array, Array]:
    """Return the bounds (lower, upper) of the samples, widened by one if constant."""
    lower = x.min(axis=0)
    upper = x.max(axis=0)
    flat = upper - lower <= ROUNDING * np.maximum(np.abs(lower), np.abs(upper))
    return np.where(flat, lower - 1, lower), np.where(flat, upper + 1, upper)
