"""Quantile regression with a network whose levels cannot cross.

References
----------
Koenker and Bassett, "Regression quantiles", Econometrica 46(1), 1978 (the pinball loss);
Romano, Patterson and Candès, "Conformalized quantile regression", NeurIPS 2019 (the calibration);
Rüschendorf, "On the distributional transform, Sklar's theorem, and the empirical copula process", JSPI 139, 2009.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn
from tqdm import trange

from ccdtools_ground.door import as_count, as_floats, as_generator
from learning.checks import as_lengths, as_samples, as_sizes, check_instance, check_number, spread
from learning.conformal import Conformal, samples_needed
from learning.exceptions import InputError
from learning.networks import FeedForward
from learning.vector_adam import VectorAdam, falling

Array = NDArray[np.float64]


@dataclass(frozen=True)
class QuantileConfig:
    """Shape and schedule of the fit.

    Attributes
    ----------
    levels : tuple of float
        Odd in number, increasing, the median in the middle.
    hidden : tuple of int
        Neurons per hidden layer.
    steps, batch : int
        Gradient steps and samples per step.
    learning_rate : float
        Adam's first rate; it falls to zero along a cosine.
    weight_decay : float
        Of AdamW.
    calibration : float
        Last fraction of every training stretch, which calibrates the outer levels and trains nothing; as much of the
        rest picks the best iterate. At 0 levels stay as fitted.
    """

    levels: tuple[float, ...] = (0.1, 0.5, 0.9)
    hidden: tuple[int, ...] = (32, 32)
    steps: int = 600
    batch: int = 512
    learning_rate: float = 3e-3
    weight_decay: float = 0.03
    calibration: float = 0.2

    def __post_init__(self) -> None:
        levels = as_floats("levels", self.levels)
        odd = levels.ndim == 1 and len(levels) % 2 == 1
        if not odd or not (np.diff(levels) > 0).all() or not 0 < levels[0] <= levels[-1] < 1:
            raise InputError("levels", self.levels, "an odd number of increasing levels in (0, 1)")
        if levels[len(levels) // 2] != 0.5:
            raise InputError("levels", f"{levels[len(levels) // 2]:g} in the middle", "the median 0.5")
        object.__setattr__(self, "hidden", as_sizes(self.hidden, "hidden"))
        for name in ("steps", "batch"):
            as_count(name, getattr(self, name))
        check_number(self.learning_rate, "learning_rate")
        check_number(self.weight_decay, "weight_decay", closed=True)
        check_number(self.calibration, "calibration", 0.0, 0.9, closed=True)


class QuantileNetwork(nn.Module):
    """Quantiles (..., levels, m) of m outputs given inputs (..., d), increasing by construction.

    The median is one head, the gaps between neighbouring levels are positive. Inputs are clipped to the range
    of the training data: outside it the discrepancy is constant, not extrapolated.

    Every fitted sample has a position among its quantiles: 0 at the lowest level, 1 at the next, linear between them
    and beyond. Joint draws take the positions of one sample for all outputs, which is the empirical copula.
    """

    input_offset: Tensor
    input_scale: Tensor
    input_lower: Tensor
    input_upper: Tensor
    output_offset: Tensor
    output_scale: Tensor
    calibration: Tensor
    positions: Tensor  # (samples, outputs); those of the median before a fit

    def __init__(
        self, inputs: int, outputs: int, levels: Sequence[float], hidden: Sequence[int], *, seed: int = 0,
        samples: int = 1,
    ) -> None:  # fmt: skip
        super().__init__()
        self.levels = tuple(levels)
        self.hidden = tuple(hidden)
        self.outputs = outputs
        units = {  # in which a number may have more digits than the weights
            "input_offset": torch.zeros(inputs), "input_scale": torch.ones(inputs),
            "input_lower": torch.full((inputs,), -torch.inf), "input_upper": torch.full((inputs,), torch.inf),
            "output_offset": torch.zeros(outputs), "output_scale": torch.ones(outputs),
        }  # fmt: skip
        for name, value in units.items():
            self.register_buffer(name, value.double())
        self.register_buffer("calibration", torch.ones(len(self.levels) - 1, outputs))
        self.register_buffer("positions", torch.full((samples, outputs), float(len(self.levels) // 2)))
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.median_network = FeedForward(inputs, outputs, hidden, skip=True)
            gaps = outputs * (len(self.levels) - 1)
            self.gap_network = FeedForward(inputs, gaps, hidden, skip=False) if gaps else None

    def forward(self, inputs: Tensor) -> Tensor:
        """Quantiles (..., levels, m), lowest level first, in the units of the targets."""
        z = self._standard(inputs)
        median: Tensor = self.median_network(z).unsqueeze(-2)
        if self.gap_network is None:
            return (self.output_offset + self.output_scale * median).to(inputs.dtype)
        gaps = nn.functional.softplus(self.gap_network(z)).unflatten(-1, (len(self.levels) - 1, self.outputs))
        gaps = self.calibration * gaps
        middle = len(self.levels) // 2
        below = -gaps[..., :middle, :].flip(-2).cumsum(-2).flip(-2)
        above = gaps[..., middle:, :].cumsum(-2)
        spread = torch.cat([below, torch.zeros_like(median), above], dim=-2)
        return (self.output_offset + self.output_scale * (median + spread)).to(inputs.dtype)

    def medians(self) -> Callable[[Tensor], Tensor]:
        """Function to the median (n, m) alone of rows (n, d), for many steps; no slope by the weights."""
        nothing = torch.zeros_like(self.input_offset, dtype=self.positions.dtype)
        layers = self.median_network.at(nothing[:0], nothing, torch.ones_like(nothing)).of(Tensor.detach)
        offset, scale = self.output_offset, self.output_scale

        def median(inputs: Tensor) -> Tensor:
            """Median of each row."""
            out: Tensor = layers(self._standard(inputs), torch.tanh, lambda x, W, b: torch.addmm(b, x, W))
            return (offset + scale * out).to(inputs.dtype)

        return median

    def clipped(self, inputs: Tensor) -> Tensor:
        """Inputs within the range of the training data."""
        return torch.clamp(inputs, self.input_lower, self.input_upper)

    def _standard(self, inputs: Tensor) -> Tensor:
        """Clipped inputs in units of their own."""
        return ((self.clipped(inputs) - self.input_offset) / self.input_scale).to(self.positions.dtype)

    def draw(self, quantiles: Tensor, uniform: Tensor) -> Tensor:
        """Joint draws (..., m) among quantiles (..., levels, m), which they are differentiable in.

        The first of the uniform numbers (..., ·) in [0, 1] picks the sample whose positions they have. A network of one
        level has none.
        """
        samples = len(self.positions)
        at = self.positions[(uniform[..., 0] * samples).long().clamp(max=samples - 1)].to(quantiles.dtype)
        below = at.floor().clamp(0, len(self.levels) - 2)
        low, high = (quantiles.gather(-2, k.long().unsqueeze(-2)).squeeze(-2) for k in (below, below + 1))
        return low + (at - below) * (high - low)

    def predict(self, inputs: ArrayLike) -> Array:
        """Quantiles (..., levels, m) of inputs (..., d), in float64.

        Raises
        ------
        InputError
            If the inputs are not numbers, or not d in a row.
        """
        x = as_floats("inputs", inputs)
        if x.shape[-1:] != (len(self.input_offset),):
            raise InputError("inputs", f"shape {x.shape}", f"(..., {len(self.input_offset)}), as in the fit")
        with torch.no_grad():
            return np.asarray(self(torch.tensor(x)).numpy())

    def shape(self) -> dict[str, Any]:
        """Sizes for `from_shape`."""
        return {
            "inputs": len(self.input_offset), "outputs": self.outputs,
            "levels": list(self.levels), "hidden": list(self.hidden), "samples": len(self.positions),
        }  # fmt: skip

    @classmethod
    def from_shape(cls, shape: dict[str, Any]) -> QuantileNetwork:
        """Untrained network of a given `shape()`."""
        return cls(**shape)


def pinball(targets: Any, quantiles: Any, levels: Sequence[float]) -> Any:
    """Mean pinball loss (m,) of quantiles (n, levels, m) against targets (n, m)."""
    error = targets[:, None, :] - quantiles
    q = np.asarray(levels, dtype=float)[None, :, None]
    if isinstance(error, Tensor):
        tau = torch.tensor(q, dtype=error.dtype)
        return torch.maximum(tau * error, (tau - 1) * error).mean(dim=(0, 1))
    return np.maximum(q * error, (q - 1) * error).mean(axis=(0, 1))


def fit_quantiles(
    inputs: ArrayLike,
    targets: ArrayLike,
    *,
    stretches: Sequence[int] | None = None,
    rng: np.random.Generator,
    config: QuantileConfig | None = None,
    progress: bool = False,
) -> QuantileNetwork:
    """Fit a network of the conditional quantiles of `targets` given `inputs`.

    Parameters
    ----------
    inputs : (n, d) array_like
        In time order.
    targets : (n, m) or (n,) array_like
    stretches : sequence of int, optional
        Lengths of the contiguous stretches that make up the n samples; one stretch by default. The last part
        of each trains nothing and calibrates the outer levels: a time series is never split at random.
    rng : numpy.random.Generator
        No number in its place: each fit of a loop would begin with the same weights.
    config : QuantileConfig, optional

    Raises
    ------
    InputError
        On mismatched, too few (under 20) or non-finite samples, or where too few calibrate the outer levels: at least
        level / (1 − level) of each side, so some 45 for 0.1 and 0.9 with a fifth of them.
    """
    config = check_instance(QuantileConfig() if config is None else config, "config", QuantileConfig)
    rng = as_generator("rng", rng)
    x, y = as_samples(inputs, targets)
    lengths = as_lengths(stretches, "stretches", len(x))
    held, picking = _split(lengths, config)
    network = QuantileNetwork(x.shape[1], y.shape[1], config.levels, config.hidden, seed=int(rng.integers(2**31)))
    _set_scales(network, x, y)
    train = ~held & ~picking
    _descend(network, (x[train], y[train]), (x[picking], y[picking]), config, rng, progress)
    if held.any():
        _calibrate(network, x[held], y[held])
    if len(network.levels) > 1:
        network.positions = torch.tensor(_positions(network.predict(x), y), dtype=torch.float32)
    return network.eval()


def _split(lengths: Sequence[int], config: QuantileConfig) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return masks of the samples that calibrate and of those that pick the iterate."""
    fraction = config.calibration
    alone = len(config.levels) == 1  # a median is not calibrated
    kept = _shares(lengths, 0.0 if alone else fraction)
    picking = _shares([n - k for n, k in zip(lengths, kept)], fraction)
    needed = samples_needed(max(config.levels[-1], 1 - config.levels[0]))
    if fraction > 0 and not alone and sum(kept) < needed:
        got = f"{sum(lengths)} samples, of which {sum(kept)} calibrate the levels {config.levels}"
        more = f"at least {needed}: some {int(np.ceil(needed / fraction))} samples"
        raise InputError("inputs, targets", got, more, "A larger `calibration` takes fewer, 0 leaves levels as fitted.")
    after = [np.arange(n, 0, -1) for n in lengths]  # samples from each to the end of its stretch
    held = np.concatenate([left <= k for left, k in zip(after, kept)])
    last = np.concatenate([left <= k + m for left, k, m in zip(after, kept, picking)])
    return held, last & ~held


def _shares(lengths: Sequence[int], fraction: float) -> list[int]:
    """Return a fraction of each length, rounded so that short ones together give it too."""
    return [int(share) for share in np.diff(np.round(fraction * np.cumsum([0, *lengths])))]


def _set_scales(network: QuantileNetwork, x: Array, y: Array) -> None:
    """Write location, spread and range of the data into the network."""
    for name, value in (
        ("input_offset", x.mean(axis=0)),
        ("input_scale", spread(x)),
        ("input_lower", x.min(axis=0)),
        ("input_upper", x.max(axis=0)),
        ("output_offset", y.mean(axis=0)),
        ("output_scale", spread(y)),
    ):
        getattr(network, name).copy_(torch.tensor(value))


def _descend(network: QuantileNetwork, train: tuple[Array, Array], validation: tuple[Array, Array],
             config: QuantileConfig, rng: np.random.Generator, progress: bool) -> None:  # fmt: skip
    """Minimise the pinball loss by Adam; keep the best validated weights."""
    (X, Y), (Xv, Yv) = (list(map(torch.tensor, pair)) for pair in (train, validation))
    adam = VectorAdam(list(network.parameters()), config.learning_rate, decay=config.weight_decay)
    best = np.inf
    kept = None
    with adam.held():
        for step in trange(1, config.steps + 1, desc="quantiles", disable=not progress, leave=False):
            i = torch.from_numpy(rng.integers(0, len(X), min(config.batch, len(X))))
            loss = (pinball(Y[i], network(X[i]), config.levels) / network.output_scale).sum()
            adam.rate = falling(config.learning_rate, step - 1, config.steps)
            adam.step(torch.autograd.grad(loss, adam.parameters), limit=1.0)
            if len(Xv) and (step % 50 == 0 or step == config.steps):
                with torch.no_grad():
                    score = (pinball(Yv, network(Xv), config.levels) / network.output_scale).sum().item()
                if score < best:
                    best = score
                    kept = {name: value.clone() for name, value in network.state_dict().items()}
    if kept is not None:
        network.load_state_dict(kept)


def _calibrate(network: QuantileNetwork, x: Array, y: Array) -> None:
    """Stretch each gap, which stays positive, until its outer level is held on unseen samples."""
    quantiles = network.predict(x)
    middle = len(network.levels) // 2
    least = float(np.finfo(np.float32).eps)
    for side in (1, -1):
        inner = quantiles[:, middle]
        for k in range(middle + side, len(network.levels) if side > 0 else -1, side):
            gap = quantiles[:, k] - quantiles[:, k - side]
            ratio = (y - inner) / np.where(gap == 0, np.finfo(float).eps, gap)
            level = network.levels[k] if side > 0 else 1 - network.levels[k]
            factor = np.array([max(Conformal.fit(column, level).factor, least) for column in ratio.T])
            network.calibration[min(k, k - side)] = torch.tensor(factor, dtype=torch.float32)
            inner = inner + factor * gap


def _positions(quantiles: Array, targets: Array) -> Array:
    """Return the positions of targets (n, m) among quantiles (n, levels, m): k at level k."""
    k = np.clip((targets[:, None] >= quantiles).sum(axis=1) - 1, 0, quantiles.shape[1] - 2)[:, None]
    low, high = (np.take_along_axis(quantiles, i, axis=1)[:, 0] for i in (k, k + 1))
    return np.asarray(k[:, 0] + (targets - low) / np.maximum(high - low, np.finfo(np.float32).tiny))
