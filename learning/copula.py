"""Joint draws from conditional quantiles, with correlated outputs.

Every sample is seen by its *position* among the conditional quantiles: 0 at the lowest level, 1 at the next, …, linear
between them and beyond. The positions of a data set have a distribution of their own, which says what happens between
the levels and beyond the outer ones. It is kept for several widths of the levels, because the tails beyond wide ones
are often shorter in proportion. Its normal scores are correlated between the outputs.

Quantiles are fitted to ranks, and a simulation lives on moments: a mean that is off by a hundredth of the noise, but
always in the direction of a slow state, changes the spread of that state by a tenth. The draws are therefore shifted by
what a linear regression finds in the samples less the mean of their draws, and they stay in
the subspace that the samples fill: outside it, a simulation amplifies what the network says where it has seen nothing.

References
----------
Joe, "Dependence Modeling with Copulas", CRC Press 2014 (Gaussian copula of normal scores).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtri
from torch import Tensor, nn

from learning.quantile import QuantileNetwork
from learning.tolerances import UNIFORM_MARGIN

Array = NDArray[np.float64]


class InnovationCopula(nn.Module):
    """Map from independent uniform draws to joint draws around conditional quantiles.

    Buffers
    -------
    probabilities (K,), positions (B, K, m), widths (B, m)
        Margins: the position below which a share of the samples lies, per output, at each of B logarithms of the
        distance between the outer levels; linear between the knots and between the widths.
    centre (d,), slope (d, m), shift (m,)
        What is added to the quantiles before a draw: slopeᵀ (inputs − centre) + shift.
    origin (m,), subspace (m, m)
        A draw y becomes origin + subspace (y − origin): the identity but for directions that the samples hardly fill.
    factor (m, m)
        Scores z = factor ε of independent ones.
    """

    probabilities: Tensor
    positions: Tensor
    widths: Tensor
    centre: Tensor
    slope: Tensor
    shift: Tensor
    origin: Tensor
    subspace: Tensor
    factor: Tensor

    def __init__(self, inputs: int, outputs: int, *, knots: int, widths: int) -> None:
        super().__init__()
        self.inputs = inputs
        self.outputs = outputs
        self.register_buffer("probabilities", torch.linspace(0, 1, knots))
        self.register_buffer("positions", torch.zeros(widths, knots, outputs))
        self.register_buffer("widths", torch.arange(widths).float()[:, None].repeat(1, outputs))
        self.register_buffer("centre", torch.zeros(inputs))
        self.register_buffer("slope", torch.zeros(inputs, outputs))
        self.register_buffer("shift", torch.zeros(outputs))
        self.register_buffer("origin", torch.zeros(outputs))
        self.register_buffer("subspace", torch.eye(outputs))
        self.register_buffer("factor", torch.eye(outputs))

    @classmethod
    def independent(cls, network: QuantileNetwork) -> InnovationCopula:
        """Copula of independent outputs, with margins linear between a network's levels."""
        levels = np.array(network.levels)
        edges = np.r_[0.0, levels, 1.0]
        positions = np.asarray(np.interp(edges, levels, np.arange(len(levels))))
        if len(levels) > 1:
            positions[0] = -levels[0] / (levels[1] - levels[0])
            positions[-1] += (1 - levels[-1]) / (levels[-1] - levels[-2])
        copula = cls(len(network.input_offset), network.outputs, knots=len(edges), widths=1)
        copula.probabilities.copy_(torch.tensor(edges))
        copula.positions.copy_(torch.tensor(positions)[None, :, None].expand(1, -1, network.outputs))
        return copula

    def draw(self, quantiles: Tensor, inputs: Tensor, uniform: Tensor) -> Tensor:
        """Draws (n, m), differentiable in all but the noise.

        Parameters
        ----------
        quantiles : (n, levels, m) tensor
            Of the network that the copula was fitted to, at `inputs`.
        inputs : (n, d) tensor
            Within the range that the network clips them to.
        uniform : (n, m) tensor
            Independent, uniform in [0, 1].
        """
        shocks = torch.special.ndtri(uniform.clamp(UNIFORM_MARGIN, 1 - UNIFORM_MARGIN))
        scores = shocks @ self.factor.T.to(shocks.dtype)
        drawn = self.at(self.shifted(quantiles, inputs), torch.special.ndtr(scores))
        origin = self.origin.to(drawn.dtype)
        return origin + (drawn - origin) @ self.subspace.T.to(drawn.dtype)

    def shifted(self, quantiles: Tensor, inputs: Tensor) -> Tensor:
        """Quantiles (n, levels, m) at inputs (n, d), shifted to the right mean."""
        moved = (inputs - self.centre.to(inputs.dtype)) @ self.slope.to(inputs.dtype) + self.shift.to(inputs.dtype)
        return quantiles + moved.unsqueeze(-2)

    def at(self, quantiles: Tensor, share: Tensor) -> Tensor:
        """Values (n, m) below which shares (n, m) of the draws lie."""
        position = self._positions(share, log_width(quantiles))
        below = position.floor().clamp(0, quantiles.shape[-2] - 2)
        low, high = (quantiles.gather(-2, i.long().unsqueeze(-2)).squeeze(-2) for i in (below, below + 1))
        return low + (position - below) * (high - low)

    def mean(self, quantiles: Tensor) -> Tensor:
        """Means (n, m) of the draws, by quadrature."""
        furthest = torch.special.ndtri(self.probabilities[-1].double()).item()
        edges = torch.special.ndtr(torch.linspace(-furthest, furthest, 65, dtype=torch.float64))
        mass = torch.diff(edges) / (edges[-1] - edges[0])
        shares = ((edges[1:] + edges[:-1]) / 2).to(quantiles.dtype)
        like = quantiles[..., 0, :]
        return sum((m.item() * self.at(quantiles, torch.full_like(like, s)) for m, s in zip(mass, shares)), 0 * like)

    def _positions(self, share: Tensor, width: Tensor) -> Tensor:
        """Margins at shares and log widths (n, m), constant beyond the knots."""
        knots = self.probabilities.to(share.dtype)
        k = torch.searchsorted(knots, share.contiguous()).clamp(1, len(knots) - 1)
        weight = ((share - knots[k - 1]) / (knots[k] - knots[k - 1])).clamp(0, 1)
        below, above, part = self._between(width)
        low, high = (
            (1 - weight) * self._table(b, k - 1, width) + weight * self._table(b, k, width) for b in (below, above)
        )
        return low + part * (high - low)

    def _between(self, width: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Indices of the widths next to log widths (n, m), and the share between."""
        centres = self.widths.to(width.dtype)
        above = (width.unsqueeze(-2) > centres).sum(-2).clamp(max=len(centres) - 1)
        below = (above - 1).clamp(min=0)
        low, high = (centres.gather(0, i.reshape(-1, self.outputs)).reshape(width.shape) for i in (below, above))
        part = (width - low) / torch.where(high > low, high - low, 1.0)
        return below, above, part.clamp(0, 1)

    def _table(self, width: Tensor, knot: Tensor, like: Tensor) -> Tensor:
        """Entries (n, m) of the margins at indices of widths and knots (n, m)."""
        output = torch.arange(self.outputs)
        entry = (width * self.positions.shape[1] + knot) * self.outputs + output
        return self.positions.reshape(-1)[entry].to(like.dtype)

    def scores(self, quantiles: Array, targets: Array) -> Array:
        """Normal scores (n, m) of targets (n, m) among their quantiles (n, levels, m)."""
        width = log_width(torch.tensor(quantiles))
        at = torch.tensor(positions(quantiles, targets))
        knots = self.probabilities.double()
        low = torch.zeros_like(at)
        high = torch.ones_like(at)
        for _ in range(30):
            middle = (low + high) / 2
            beyond = self._positions(middle, width) < at
            low = torch.where(beyond, middle, low)
            high = torch.where(beyond, high, middle)
        edge = knots[:2].mean().item(), knots[-2:].mean().item()
        return np.asarray(ndtri(np.clip(((low + high) / 2).numpy(), *edge)))

    def shape(self) -> dict[str, Any]:
        """Sizes for `from_shape`."""
        widths, knots, outputs = self.positions.shape
        return {"inputs": self.inputs, "outputs": outputs, "knots": knots, "widths": widths}

    @classmethod
    def from_shape(cls, shape: dict[str, Any]) -> InnovationCopula:
        """Copula of a given `shape()`, not yet fitted."""
        return cls(**shape)


def positions(quantiles: Array, targets: Array) -> Array:
    """Positions of targets (n, m) among quantiles (n, levels, m): k at level k."""
    last = quantiles.shape[1] - 2
    k = np.clip((targets[:, None] >= quantiles).sum(axis=1) - 1, 0, last)[:, None]
    low, high = (np.take_along_axis(quantiles, i, axis=1)[:, 0] for i in (k, k + 1))
    return np.asarray(k[:, 0] + (targets - low) / np.maximum(high - low, np.finfo(np.float32).tiny))


def log_width(quantiles: Tensor) -> Tensor:
    """Return the log distance (n, m) of the outer levels of quantiles (n, levels, m)."""
    return (quantiles[..., -1, :] - quantiles[..., 0, :]).clamp(min=torch.finfo(torch.float32).tiny).log()
