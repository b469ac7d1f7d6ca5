"""A mean cost on fixed scenarios as a smooth function of one vector: the weights of a policy, and a design."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.feasible import DesignRegion

UNIT_OF_Z = 0.03  # unit of z: how far the first step of a climb goes at most, in weights and in the unit box
PER_UNIT = UNIT_OF_Z**-2  # unit of the value: where there are bounds, a first step is no longer than the gradient
TALL = 2.0  # relative cost from which on it counts by its logarithm: into lost runs it grows by 1e7 within one step
STEEPEST = 1e3  # relative gradients are clipped here
LOST = 1e9 * PER_UNIT  # value where the cost is not finite


class SampleAverage:
    """Relative cost and its gradient at a vector z (m,); the weights and the design are set to it.

    Parameters
    ----------
    cost : callable
        Mean cost of policy and design as they stand, a tensor that is differentiable in both.
    weights : list of tensors
        Of the policy; empty where it stays.
    v : (np,) tensor or None
        The point of the unit box; None where the design stays.
    scale : float
        What costs are divided by.
    slope : callable, optional
        The design's gradient of the mean return, in the place of the one through the model.
    region : DesignRegion, optional
        What the design has to keep: it is set to the nearest point of it.

    Attributes
    ----------
    first : (m,) array
        Where weights and design are at first, in units of `UNIT_OF_Z`: a quasi-Newton method begins with a step of
        length one.
    bounds : list of pairs
        The unit box for the design, nothing for the weights.
    """

    def __init__(
        self, cost: Callable[[], Tensor], *, weights: list[Tensor], v: Tensor | None, scale: float,
        slope: Callable[[], Tensor] | None = None, region: DesignRegion | None = None,
    ) -> None:  # fmt: skip
        self._cost = cost
        self._weights = weights
        self._moving = v is not None
        self._scale = scale
        self._slope = slope
        self._region = region if self._moving else None
        self._place: Array = np.zeros(0)  # of the design, where there is a region
        self._parts = weights if v is None else [*weights, v]
        self.first: Array = torch.cat([part.detach().ravel() for part in self._parts]).double().numpy() / UNIT_OF_Z
        designs = 0 if v is None else len(v)
        free: list[tuple[float | None, float | None]] = [(None, None)] * (len(self.first) - designs)
        self.bounds = free + [(0.0, 1.0 / UNIT_OF_Z)] * designs

    def put(self, z: Array) -> bool:
        """Let policy and design be those of `z`, the design as near as it may be; whether there is such a place."""
        values = torch.tensor(UNIT_OF_Z * z, dtype=torch.float32).split([part.numel() for part in self._parts])
        found = None if self._region is None else self._region.nearest(self._raw(z))
        with torch.no_grad():
            for part, value in zip(self._parts, values):
                part.copy_(value.reshape(part.shape))
            if self._region is not None:
                self._place = self._region.last if found is None else found
                self._parts[-1].copy_(torch.tensor(self._place))
        return self._region is None or found is not None

    def _raw(self, z: Array) -> Array:
        """The point of the unit box in `z`, (np,)."""
        return np.asarray(UNIT_OF_Z * z[-len(self._parts[-1]) :])

    def __call__(self, z: Array) -> tuple[float, Array]:
        """Cost, beyond `TALL` its logarithm, and the clipped gradient (m,); `LOST` and level where it is not finite."""
        if not self.put(z):
            return LOST, np.zeros_like(z)
        cost = self._cost()
        gradients = [gradient.double().ravel() for gradient in torch.autograd.grad(cost, self._parts)]
        if self._moving and self._slope is not None:
            gradients[-1] = -self._slope()
        gradient: Array = torch.cat(gradients).numpy() / self._scale
        value = cost.item() / self._scale
        if value > TALL:
            gradient /= value / TALL
            value = TALL * (1.0 + np.log(value / TALL))
        if self._region is not None:
            at = slice(-len(self._place), None)
            added, gradient[at] = self._region.extended(self._raw(z), self._place, gradient[at])
            value += added
        length = float(np.linalg.norm(gradient))
        if not (np.isfinite(value) and np.isfinite(length)):
            return LOST, np.zeros_like(gradient)
        clipped = gradient * min(1.0, STEEPEST / max(length, STEEPEST))
        return PER_UNIT * value, PER_UNIT * UNIT_OF_Z * clipped
