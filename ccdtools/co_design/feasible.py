"""Feasible designs of a start: constraints, fixed entries and whole numbers hold.

A climb is led around the constraints by the nearest feasible point: the return of a point is that of the nearest
feasible one, less a little for the distance. Every design that is evaluated is then feasible, along an active
constraint the climb is one of fewer parameters, and away from all of them nothing is changed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.optimize import linprog
from torch import Tensor

from ccdtools.arrays import Array, Mask
from ccdtools.co_design.design_gradients import Differences, Slope
from ccdtools.co_design.tolerances import ACTIVE, PULL, SIGNIFICANT, SLOPE_AHEAD
from ccdtools.plants.allowed_designs import AllowedDesigns, held
from ccdtools.plants.design_constraints import UnitConstraints
from ccdtools.plants.design_space import DesignSpace


@dataclass(eq=False)
class DesignRegion:
    """Unit-box points that one start may take."""

    space: DesignSpace
    last: Array  # (np,): the feasible point that was found last; at first the start
    free: Any = field(init=False)

    def __post_init__(self) -> None:
        self.free = self.space.allowed.free

    @property
    def bounded(self) -> bool:
        """Whether constraints hold the design."""
        return self.space.constraints is not None

    @property
    def whole_box(self) -> bool:
        """Whether only bounds hold the design."""
        return bool(self.free.all()) and not self.bounded

    def masked(self, gradient: Tensor) -> Tensor:
        """Gradient (np,) along the moving entries alone."""
        return gradient if self.free.all() else gradient * torch.as_tensor(self.free, dtype=gradient.dtype)

    def nearest(self, v: Array) -> Array | None:
        """Nearest feasible point (np,) with held entries kept, None if not found."""
        found = self.space.allowed.near_with(np.where(self.free, np.clip(v, 0.0, 1.0), self.last), [self.last])
        self.last = self.last if found is None else found
        return found

    def step(self, v: Array, gradient: Array, length: float) -> Array:
        """Part (np,) of an ascent direction that a feasible step can follow."""
        size = float(np.linalg.norm(gradient))
        if not self.bounded or size == 0:
            return gradient
        reached = self.nearest(v + length / size * gradient)
        return gradient if reached is None else (reached - v) * size / length

    def extended(self, v: Array, u: Array, gradient: Array) -> tuple[float, Array]:
        """Addition at `v` to the cost at feasible `u`, and the gradient (np,) of both.

        Added are ½ `PULL` of the squared distance, and the rise of the cost from `u` to `v` where it rises: where
        better designs lie within the constraints, a climb goes back from their edge as steeply as it falls there.
        """
        gradient = np.where(self.free, gradient, 0.0)
        away = np.where(self.free, v - u, 0.0)
        if self.space.allowed.limits is None or not away.any():
            return 0.0, gradient
        along = self.space.allowed.pulled_back(np.where(self.free, v, u), u, gradient, self.free)
        distance = float(away @ away)
        rise = max(0.0, float(gradient @ away))
        return rise + 0.5 * PULL * distance, along + (rise / distance + PULL) * away

    def settled(self, v: Tensor) -> Array:
        """Feasible design (np,) of a point in single precision.

        Its whole numbers are exact.
        """
        point = v.detach().double().numpy()
        exact = self.space.allowed.rounded(point)
        found = self.space.allowed.near_with(exact, [self.last])
        return self.space.settled(exact if found is None else found)


@dataclass(frozen=True, eq=False)
class FeasibleSlope(Slope):
    """Slope projected on the directions that cross no active edge."""

    # rise of the return along its slope over the best feasible step of the distance ahead, the constraints taken as
    # straight, and its standard error
    ahead: float
    ahead_error: float
    # slopes straight across each active edge, of constraints and box, which add up to what the projection took away
    edges: Array  # (k,)
    edges_error: Array  # (k,)

    @classmethod
    def within(cls, by_run: Array, point: Array, allowed: AllowedDesigns, moving: Mask) -> FeasibleSlope:
        """Slope from every run's slopes (n, np) of the entries that move or are held by a bound, at a point."""
        limits, side = allowed.limits, allowed.sides(point)
        assert limits is not None
        b = by_run.mean(axis=0)
        far = best_step(limits, point, b, allowed.free)
        outward, distances = limits.edges(point)
        normals = np.vstack([outward[distances <= ACTIVE], np.diag(side)[moving & (side != 0)]]) * moving
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
        prices = held(normals, b)
        holding = normals[prices > 0]
        across = np.linalg.pinv(holding) if len(holding) else np.zeros((len(point), 0))
        rest = by_run - by_run @ across @ holding
        level = np.zeros(len(point))
        return cls(
            b - prices @ normals, _error(rest), np.ones(len(point)), level, level, float(b @ far),
            float(_error(by_run @ far[:, None])[0]), prices[prices > 0], _error(by_run @ across),
        )  # fmt: skip

    def promises(self, gain: float) -> bool:
        """True if a significant slope that falls to zero ahead brings the gain."""
        return bool(self.ahead > SIGNIFICANT * self.ahead_error and self.ahead / 2 > gain)

    def rises_across_bounds(self, gain: float) -> bool:
        """True if a wider box or looser constraint brings such a gain."""
        return bool(((self.edges > SIGNIFICANT * self.edges_error) & (self.edges * SLOPE_AHEAD / 2 > gain)).any())


def measured_slope(differences: Differences, v: Tensor, region: DesignRegion) -> Slope:
    """Slope at a unit-box point, where the region has room.

    Whole numbers have none: their slope counts where it points across a bound.
    """
    by_run = differences.about(v, differences.step(v))
    allowed = region.space.allowed
    point = allowed.rounded(v.double().numpy())
    side = allowed.sides(point)
    moving = region.free | (side * by_run.mean(0).numpy() > 0)
    by_run = by_run * torch.as_tensor(moving)
    if allowed.limits is None:
        return Slope.of(by_run, torch.as_tensor(np.where(side == 0, point, (side + 1) / 2)))
    found = region.nearest(point)
    return FeasibleSlope.within(by_run.numpy(), point if found is None else found, allowed, moving)


def best_step(limits: UnitConstraints, point: Array, slope: Array, free: Any) -> Array:
    """Feasible step (np,) within the distance ahead that rises most."""
    low = np.where(free, np.maximum(-SLOPE_AHEAD, -point), 0.0)
    high = np.where(free, np.minimum(SLOPE_AHEAD, 1.0 - point), 0.0)
    size = max(float(np.abs(slope).max()), np.finfo(float).tiny)
    normals, distances = limits.edges(point)
    near = np.isfinite(distances)
    found = linprog(
        -slope / size, A_ub=normals[near], b_ub=np.maximum(distances[near], 0.0), bounds=list(zip(low, high))
    )
    return np.asarray(found.x) if found.x is not None else np.zeros(len(point))


def _error(by_run: Array) -> Array:
    """Standard errors (k,) of means over (n, k); infinite for one run."""
    if len(by_run) < 2:
        return np.full(by_run.shape[1], np.inf)
    return np.asarray(by_run.std(axis=0, ddof=1) / np.sqrt(len(by_run)))
