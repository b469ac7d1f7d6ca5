"""Actor and critic networks, with normalisation inside."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from ccdtools_ground.door import as_floats
from learning.checks import as_sizes, check_instance, check_number
from learning.exceptions import InputError
from learning.tolerances import LEAST_PART, LEAST_SPREAD, LOG_STD


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of the networks.

    Attributes
    ----------
    hidden : tuple of int
        Neurons per hidden layer, tanh after each.
    skip : bool
        Adds a linear map from input to output, so that a linear law costs the hidden layers nothing.
    initial_std : float, optional
        Standard deviation of the exploration at first, in units of half the action range: by default 1, and 0.1 for a
        network that imitates an expert.
    std_network : bool
        Exploration from a network of its own (zero weights, constant bias at first) in place of one free number
        per action.
    """

    hidden: tuple[int, ...] = (64, 64)
    skip: bool = True
    initial_std: float | None = None
    std_network: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", as_sizes(self.hidden, "hidden"))
        if self.initial_std is not None:
            check_number(self.initial_std, "initial_std")


class ActionLimits(Protocol):
    """Action bounds that depend on the last entries of an observation."""

    @property
    def entries(self) -> int:
        """Number of the last entries that the bounds depend on."""
        ...

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Widest bounds, each (nu,)."""
        ...

    def bounds(self, p: Any) -> tuple[Any, Any]:
        """Bounds (..., nu) at entries (..., n), tensors or arrays; differentiable in tensors."""
        ...

    def as_dict(self) -> dict[str, Any]:
        """Limits as values that JSON can hold."""
        ...


@dataclass(frozen=True, eq=False)
class Layers:
    """Tanh network of affine maps x W + b, with an affine `skip`.

    They are tensors, arrays or matrices of CasADi, and so is what is passed through them.
    """

    maps: tuple[tuple[Any, Any], ...]
    skip: tuple[Any, Any] | None

    def of(self, convert: Callable[[Any], Any]) -> Layers:
        """Network with its numbers converted."""
        skip = None if self.skip is None else (convert(self.skip[0]), convert(self.skip[1]))
        return Layers(tuple((convert(W), convert(b)) for W, b in self.maps), skip)

    def __call__(self, x: Any, tanh: Callable[[Any], Any], affine: Callable[..., Any] | None = None) -> Any:
        """Outputs (..., m) of rows x (..., n); `affine` (x, W, b) replaces the product."""
        affine = affine or (lambda x, W, b: x @ W + b)
        *hidden, head = self.maps
        h = x
        for W, b in hidden:
            h = tanh(affine(h, W, b))
        out = affine(h, *head)
        return out if self.skip is None else affine(x, self.skip[0], out + self.skip[1])


class FeedForward(nn.Module):
    """Tanh network (..., n_in) → (..., n_out) with an optional linear skip."""

    def __init__(self, n_in: int, n_out: int, hidden: Sequence[int], *, skip: bool) -> None:
        super().__init__()
        sizes = [n_in, *hidden]
        layers: list[nn.Module] = []
        for a, b in pairwise(sizes):
            layers += [nn.Linear(a, b), nn.Tanh()]
        self.body = nn.Sequential(*layers)
        self.head = nn.Linear(sizes[-1], n_out)
        self.skip = nn.Linear(n_in, n_out, bias=False) if skip else None

    @property
    def affine(self) -> list[nn.Linear]:
        """Layers that tanh is between, the head last."""
        return [*[*self.body][::2], self.head]

    def at(self, p: Tensor, offset: Tensor, scale: Tensor) -> Layers:
        """Network in the first entries of raw observations, with last entries `p`.

        What does not change with the first entries is computed once: the part of the first layer that belongs to `p`
        (np,) or (n, np), and the normalisation by `offset` and `scale` (n_in,); in the precision of `p`.
        """
        offset, scale = offset.to(p.dtype), scale.to(p.dtype)
        n = len(offset) - p.shape[-1]
        given = (p - offset[n:]) / scale[n:]
        shift = offset[:n] / scale[:n]

        def entry(weight: Tensor) -> tuple[Tensor, Tensor]:
            """Map (n, m) from raw entries, and the term (m,) or (·, m) added."""
            own, of_given = weight.to(p.dtype).split([n, weight.shape[1] - n], dim=1)
            return (own / scale[:n]).T, given @ of_given.T - own @ shift

        first, *others = self.affine
        W, b = entry(first.weight)
        layers = [(W, b + first.bias), *((layer.weight.T, layer.bias) for layer in others)]
        return Layers(tuple(layers), None if self.skip is None else entry(self.skip.weight))

    @torch.no_grad()
    def rescale_inputs(self, shift: Tensor, ratio: Tensor) -> None:
        """Change inputs (n_in,) from z to (z − shift)/ratio, not the outputs."""
        first = self.affine[0]
        first.bias.add_(first.weight @ shift)
        first.weight.mul_(ratio)
        if self.skip is not None:
            self.head.bias.add_(self.skip.weight @ shift)
            self.skip.weight.mul_(ratio)

    def forward(self, inputs: Tensor) -> Tensor:
        """Outputs (..., n_out)."""
        *hidden, head = self.affine
        h = inputs
        for layer in hidden:  # not by calls of modules, which take as long as the products of a few runs
            h = torch.tanh(nn.functional.linear(h, layer.weight, layer.bias))
        out = nn.functional.linear(h, head.weight, head.bias)
        return out if self.skip is None else out + nn.functional.linear(inputs, self.skip.weight)


class ActorCritic(nn.Module):
    """Gaussian policy over a latent action, and value function, on raw observations.

    The latent action is 1 at the upper action bound and −1 at the lower one. It is clipped only on its way to
    the plant: probabilities belong to the unclipped latent, so that no density is lost at the bounds.

    Parameters
    ----------
    observation_lower, observation_upper : (n_obs,) array_like
        Range of the observations, mapped to [−1, 1] inside.
    action_lower, action_upper : (nu,) array_like
        Action bounds, finite, in the units of the plant.
    config : NetworkConfig
    seed : int
        For the initial weights.
    imitates : bool
        Whether the network is made to imitate an expert, and is refined from there; else it learns from scratch.
    action_limits : ActionLimits, optional
        Bounds that depend on the observation, in the place of these, which are then the widest of them.
    """

    observation_offset: Tensor
    observation_scale: Tensor
    action_offset: Tensor
    action_scale: Tensor
    observations_seen: Tensor
    value_offset: Tensor
    value_scale: Tensor

    def __init__(
        self,
        observation_lower: ArrayLike,
        observation_upper: ArrayLike,
        action_lower: ArrayLike,
        action_upper: ArrayLike,
        *,
        config: NetworkConfig | None = None,
        seed: int = 0,
        imitates: bool = False,
        action_limits: ActionLimits | None = None,
    ) -> None:
        super().__init__()
        self.imitates = imitates
        self.action_limits = action_limits
        self.config = check_instance(NetworkConfig() if config is None else config, "config", NetworkConfig)
        for name, low, high in (
            ("observation", observation_lower, observation_upper),
            ("action", action_lower, action_upper),
        ):
            low = as_floats(f"{name}_lower", low).reshape(-1)
            high = as_floats(f"{name}_upper", high).reshape(-1)
            if low.shape != high.shape or not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
                names = f"{name}_lower, {name}_upper"
                raise InputError(names, f"{low} and {high}", "finite lower < upper of one length")
            self.register_buffer(f"{name}_offset", torch.tensor((low + high) / 2, dtype=torch.float32))
            self.register_buffer(f"{name}_scale", torch.tensor((high - low) / 2, dtype=torch.float32))
        self.register_buffer("observations_seen", torch.zeros((), dtype=torch.float64))
        self.register_buffer("value_offset", torch.zeros(()))
        self.register_buffer("value_scale", torch.ones(()))
        n_obs = len(self.observation_offset)
        n_act = len(self.action_offset)
        c = self.config
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.mean_network = FeedForward(n_obs, n_act, c.hidden, skip=c.skip)
            self.value_network = FeedForward(n_obs, 1, c.hidden, skip=c.skip)
            self.std_network = FeedForward(n_obs, n_act, c.hidden, skip=False) if c.std_network else None
            if not imitates:
                first_weights(self.mean_network, 0.01)
                first_weights(self.value_network, 1.0)
        std = c.initial_std or (0.1 if imitates else 1.0)
        self.log_std = nn.Parameter(torch.full((n_act,), float(np.log(std))))
        if self.std_network is not None:
            self.log_std.requires_grad_(False)
            nn.init.zeros_(self.std_network.head.weight)
            nn.init.constant_(self.std_network.head.bias, float(np.log(std)))

    def normalise(self, observations: Tensor) -> Tensor:
        """Observations mapped to about [−1, 1]."""
        return (observations - self.observation_offset) / self.observation_scale

    @torch.no_grad()
    def see(
        self, observations: Tensor, *, given: int = 0, keep: bool | None = None, least: Tensor | float = 0.0
    ) -> None:  # fmt: skip
        """Normalise by mean and spread of all observations so far.

        `observations` (..., n_obs) are added to them. The ranges that the agent was made with serve until the first
        ones are seen; those of the last `given` entries stay. With `keep`, by default where the agent imitates, what it
        does stays, too: only the units of its first weights change. Nothing is divided by less than `least` (n_obs,).
        """
        x = observations.reshape(-1, len(self.observation_offset)).double()
        before = self.observations_seen.item()
        total = before + len(x)
        share = len(x) / total
        gap = x.mean(0) - self.observation_offset
        variance = (1 - share) * self.observation_scale.double().square() + share * x.var(0, correction=0)
        variance += (1 - share) * share * gap.square() if before else 0.0
        offset = (self.observation_offset + share * gap).float()
        rounding = (LEAST_PART * offset.abs()).clamp(min=LEAST_SPREAD)
        scale = torch.maximum(variance.sqrt(), rounding).float().clamp(min=torch.as_tensor(least, device=offset.device))
        first = len(offset) - given
        offset[first:], scale[first:] = self.observation_offset[first:], self.observation_scale[first:]
        if self.imitates if keep is None else keep:
            shift, ratio = (offset - self.observation_offset) / self.observation_scale, scale / self.observation_scale
            for network in (self.mean_network, self.value_network, self.std_network):
                if network is not None:
                    network.rescale_inputs(shift, ratio)
        self.observation_offset.copy_(offset)
        self.observation_scale.copy_(scale)
        self.observations_seen.fill_(total)

    @torch.no_grad()
    def rescale_values(self, offset: Tensor, scale: Tensor) -> None:
        """Change the unit of values, not the values (van Hasselt et al. 2016)."""
        ratio = self.value_scale / scale
        head = self.value_network.head
        head.weight.mul_(ratio)
        head.bias.mul_(ratio).add_((self.value_offset - offset) / scale)
        if self.value_network.skip is not None:
            self.value_network.skip.weight.mul_(ratio)
        self.value_offset.copy_(offset)
        self.value_scale.copy_(scale)

    def latent(self, observations: Tensor) -> Tensor:
        """Mean latent actions (..., nu), not clipped."""
        mean: Tensor = self.mean_network(self.normalise(observations))
        return mean

    def std(self, observations: Tensor) -> Tensor:
        """Standard deviation of the latent actions, broadcastable to (..., nu)."""
        if self.std_network is None:
            return self.log_std.exp()
        std: Tensor = self.std_network(self.normalise(observations)).clamp(*LOG_STD).exp()
        return std

    def action_range(self, observations: Tensor | None) -> tuple[Tensor, Tensor]:
        """Middle and half-width of the actions, (nu,), or (..., nu) by observations (..., n_obs).

        Of the observations only the last entries count, those that the limits are a function of.
        """
        if self.action_limits is None:
            return self.action_offset, self.action_scale
        if observations is None:
            raise InputError("observations", "nothing", "what the bounds of the actions depend on")
        lower, upper = self.action_limits.bounds(observations[..., -self.action_limits.entries :])
        return (lower + upper) / 2, (upper - lower) / 2

    def action(self, latent: Tensor, observations: Tensor | None = None, *, leak: float = 0.0) -> Tensor:
        """Actions in the units of the plant, from the clipped latent."""
        return scaled(latent, self.action_range(observations), leak=leak)

    def forward(self, observations: Tensor) -> Tensor:
        """Mean actions (..., nu) within bounds, in the units of the plant."""
        return self.action(self.latent(observations), observations)

    def value(self, observations: Tensor) -> Tensor:
        """Values (...,) in the units of the return."""
        values: Tensor = self.value_network(self.normalise(observations)).squeeze(-1)
        return self.value_offset + self.value_scale * values

    def distribution(self, observations: Tensor) -> torch.distributions.Normal:
        """Policy as a distribution over latent actions."""
        mean = self.latent(observations)
        return torch.distributions.Normal(mean, self.std(observations).expand_as(mean), validate_args=False)

    def actor_parameters(self) -> list[nn.Parameter]:
        """Weights of mean and exploration."""
        own = [*self.mean_network.parameters(), self.log_std]
        own += list(self.std_network.parameters()) if self.std_network is not None else []
        return [parameter for parameter in own if parameter.requires_grad]

    def __repr__(self) -> str:
        sizes = f"{len(self.observation_offset)} observations, {len(self.action_offset)} actions"
        return f"ActorCritic({sizes}, hidden layers {self.config.hidden})"

    def shape(self) -> dict[str, Any]:
        """Sizes and action limits for `from_shape`."""
        ranges = ((self.observation_offset, self.observation_scale), (self.action_offset, self.action_scale))
        bounds = [(middle + sign * half).tolist() for middle, half in ranges for sign in (-1, 1)]
        limits = {} if self.action_limits is None else {"action_limits": self.action_limits.as_dict()}
        return {"bounds": bounds, "config": asdict(self.config), "imitates": self.imitates, **limits}

    @classmethod
    def from_shape(cls, shape: dict[str, Any]) -> ActorCritic:
        """Untrained network of a given `shape()`, without action limits."""
        return cls(*shape["bounds"], config=NetworkConfig(**shape["config"]), imitates=shape["imitates"])


@torch.no_grad()
def first_weights(network: FeedForward, gain: float) -> None:
    """Set orthogonal weights, the last of size `gain` (Andrychowicz et al. 2021)."""
    for layer in network.affine[:-1]:
        nn.init.orthogonal_(layer.weight, 2**0.5)
        nn.init.zeros_(layer.bias)
    nn.init.orthogonal_(network.head.weight, gain)
    nn.init.zeros_(network.head.bias)
    if network.skip is not None:
        nn.init.zeros_(network.skip.weight)


def scaled(latent: Tensor, action_range: tuple[Tensor, Tensor], *, leak: float = 0.0) -> Tensor:
    """Latent actions clipped to [−1, 1] and scaled to actions."""
    clipped = latent.clamp(-1.0, 1.0)
    if leak:
        clipped = clipped + leak * (latent - clipped)
    middle, half = action_range
    return middle + half * clipped
