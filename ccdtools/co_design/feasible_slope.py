"""How the mean return rises with the design within constraints, and across them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linprog
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.design_gradients import AHEAD, SIGNIFICANT, Differences, Slope
from ccdtools.co_design.feasible import DesignRegion
from ccdtools.plants.design_constraints import UnitConstraints, held

ACTIVE = 1e-3  # of the unit box: an edge that is closer holds the design


@dataclass(frozen=True, eq=False)
class FeasibleSlope(Slope):
    """The slope that the constraints leave: projected on the directions that cross no active edge.

    Attributes
    ----------
    ahead, ahead_error : float
        Rise of the return along its slope over the best feasible step of the distance ahead, the constraints taken as
        straight, and its standard error.
    edges, edges_error : (k,) arrays
        Slopes straight across each active edge, of constraints and box, which add up to what the projection took away.
    """

    ahead: float
    ahead_error: float
    edges: Array
    edges_error: Array

    @classmethod
    def within(cls, by_run: Array, point: Array, limits: UnitConstraints, free: Any) -> FeasibleSlope:
        """From the slopes of every run (n, np) at a point of the unit box."""
        b = by_run.mean(axis=0)
        far = best_step(limits, point, b, free)
        outward, distances = limits.edges(point)
        eye = np.eye(len(point))
        normals = np.vstack([outward[distances <= ACTIVE], -eye[free & (point <= 0)], eye[free & (point >= 1)]]) * free
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
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
        """Whether a slope beyond chance, falling to zero over the distance ahead, brings such a gain."""
        return bool(self.ahead > SIGNIFICANT * self.ahead_error and self.ahead / 2 > gain)

    def rises_across_bounds(self, gain: float) -> bool:
        """Whether a wider box, or a constraint that asks for less, brings such a gain."""
        return bool(((self.edges > SIGNIFICANT * self.edges_error) & (self.edges * AHEAD / 2 > gain)).any())


def measured_slope(differences: Differences, v: Tensor, region: DesignRegion) -> Slope:
    """The slope at a point of the unit box, as far as the region of a start has room."""
    if region.whole_box:
        return Slope.measured(differences, v)
    by_run = region.masked(differences.about(v, differences.step(v)))
    limits = region.space.allowed.limits
    if limits is None:
        return Slope.of(by_run, v)
    point = v.double().numpy()
    found = region.nearest(point)
    return FeasibleSlope.within(by_run.numpy(), point if found is None else found, limits, region.free)


def best_step(limits: UnitConstraints, point: Array, slope: Array, free: Any) -> Array:
    """The step (np,) of at most the distance ahead in every entry, within straight constraints, that rises most."""
    low = np.where(free, np.maximum(-AHEAD, -point), 0.0)
    high = np.where(free, np.minimum(AHEAD, 1.0 - point), 0.0)
    size = max(float(np.abs(slope).max()), 1e-300)
    normals, distances = limits.edges(point)
    near = np.isfinite(distances)
    found = linprog(
        -slope / size, A_ub=normals[near], b_ub=np.maximum(distances[near], 0.0), bounds=list(zip(low, high))
    )
    return np.asarray(found.x) if found.x is not None else np.zeros(len(point))


def _error(by_run: Array) -> Array:
    """Standard errors of the means over the runs (n, k), (k,); infinite for a single run."""
    if len(by_run) < 2:
        return np.full(by_run.shape[1], np.inf)
    return np.asarray(by_run.std(axis=0, ddof=1) / np.sqrt(len(by_run)))
