"""Mean cost on fixed scenarios by weights and design, and its climb."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.design_search import SpentError, compressed
from ccdtools.co_design.feasible import DesignRegion
from ccdtools.co_design.tolerances import CLIMB_OPTIONS, COMPRESS_ABOVE, LOST_VALUE, PER_UNIT, STEEPEST, UNIT_OF_Z


class SampleAverage:
    """Relative cost and gradient at z (m,) of weights and design.

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
    reach : float
        How far every entry of z that is the design may go, in parts of the unit box.

    Attributes
    ----------
    first : (m,) array
        Where weights and design are at first, in units of `UNIT_OF_Z`: a quasi-Newton method begins with a step of
        length one.
    bounds : list of pairs
        What of the unit box the design may reach, nothing for the weights.
    """

    def __init__(
        self, cost: Callable[[], Tensor], *, weights: list[Tensor], v: Tensor | None, scale: float,
        slope: Callable[[], Tensor] | None = None, region: DesignRegion | None = None, reach: float = 1.0,
    ) -> None:  # fmt: skip
        self._cost = cost
        self._moving = v is not None
        self._scale = scale
        self._slope = slope
        self._region = region if self._moving else None
        self._place: Array = np.zeros(0)  # of the design, where there is a region
        self._parts = weights if v is None else [*weights, v]
        self.first: Array = torch.cat([part.detach().ravel() for part in self._parts]).double().numpy() / UNIT_OF_Z
        self._at = slice(len(self.first) - (0 if v is None else len(v)), None)  # of the design in z
        self.bounds: list[tuple[float | None, float | None]] = [(None, None)] * len(self.first)
        within = np.clip(UNIT_OF_Z * self.first[self._at] + [[-reach], [reach]], 0.0, 1.0) / UNIT_OF_Z
        self.bounds[self._at] = list(zip(*within.tolist()))

    def put(self, z: Array) -> bool:
        """Set policy and nearest feasible design to `z`; return whether one was found."""
        values = torch.tensor(UNIT_OF_Z * z, dtype=torch.float32).split([part.numel() for part in self._parts])
        found = None if self._region is None else self._region.nearest(UNIT_OF_Z * z[self._at])
        with torch.no_grad():
            for part, value in zip(self._parts, values):
                part.copy_(value.reshape(part.shape))
            if self._region is not None:
                self._place = self._region.last if found is None else found
                self._parts[-1].copy_(torch.tensor(self._place))
        return self._region is None or found is not None

    def __call__(self, z: Array) -> tuple[float, Array]:
        """Cost, logarithmic beyond `COMPRESS_ABOVE`, and the clipped gradient (m,).

        Where the cost is not finite, it is `LOST_VALUE` and level.
        """
        if not self.put(z):
            return LOST_VALUE, np.zeros_like(z)
        cost = self._cost()
        gradients = [gradient.double().ravel() for gradient in torch.autograd.grad(cost, self._parts)]
        if self._moving and self._slope is not None:
            gradients[-1] = -self._slope()
        gradient: Array = torch.cat(gradients).numpy() / self._scale
        value = cost.item() / self._scale
        if value > COMPRESS_ABOVE:
            gradient /= value / COMPRESS_ABOVE
        value = compressed(value)
        if self._region is not None:
            at = self._at
            added, gradient[at] = self._region.extended(UNIT_OF_Z * z[at], self._place, gradient[at])
            value += added
        length = float(np.linalg.norm(gradient))
        if not (np.isfinite(value) and np.isfinite(length)):
            return LOST_VALUE, np.zeros_like(gradient)
        clipped = gradient * min(1.0, STEEPEST / max(length, STEEPEST))
        return PER_UNIT * value, PER_UNIT * UNIT_OF_Z * clipped


def climb(average: SampleAverage, length: int, *, counted: Callable[[], bool], look: Callable[[], bool]) -> None:
    """Climb until level or spent, and set policy and design to the lowest point.

    Parameters
    ----------
    average : SampleAverage
    length : int
        Evaluations at most.
    counted : callable
        Called at every evaluation; whether the lowest point so far is to be looked at.
    look : callable
        Called with policy and design at the lowest point; whether the climb is to end there.
    """
    lowest, least = average.first, np.inf
    new = False  # whether the lowest point has not been looked at
    left = length

    def value(z: Array) -> tuple[float, Array]:
        """Relative cost and gradient (m,)."""
        nonlocal lowest, least, new, left
        if left == 0:
            raise SpentError
        left -= 1
        value, gradient = average(z)
        if value < least:
            new = new or bool(np.isfinite(least))
            lowest, least = z.copy(), value
        if counted() or left == 0:
            average.put(lowest)
            new = False
            if look():
                raise SpentError
        return value, gradient

    options = CLIMB_OPTIONS | {"maxfun": 10 * length, "maxiter": length}
    with np.errstate(all="ignore"), contextlib.suppress(SpentError):
        minimize(value, average.first, jac=True, method="L-BFGS-B", bounds=average.bounds, options=options)
    average.put(lowest)
    if new:
        look()
