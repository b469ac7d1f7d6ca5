"""Error of a numerical step over limits and designs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import qmc

from ccdtools.arrays import Array, Immutable
from ccdtools.plants.budgets import ERROR_POINTS
from ccdtools.plants.tolerances import AROUND_WORST, SAFETY

Step = Callable[[Any, Any, Any, Any], Any]


@dataclass(frozen=True, eq=False)
class Region(Immutable):
    """Region of an error: bounds of states, inputs, disturbances and designs."""

    lower: Array  # (nx + nu + nw + np,)
    upper: Array  # (nx + nu + nw + np,)
    sizes: tuple[int, int, int, int]  # nx, nu, nw and np
    # bounds of x and u that a design narrows, if any; `bounds(p)` gives them at designs (m, np)
    of_design: tuple[Any, Any] = (None, None)  # (DesignLimits, DesignLimits)

    @classmethod
    def of(cls, *boxes: tuple[Array, Array], of_design: tuple[Any, Any] = (None, None)) -> Region:
        """Region from the bounds of x, u, w and p."""
        lower, upper = (np.concatenate([box[side] for box in boxes]) for side in (0, 1))
        return cls(lower, upper, tuple(len(box[0]) for box in boxes), of_design)  # type: ignore[arg-type]

    @property
    def boxes(self) -> list[tuple[Array, Array]]:
        """Bounds (lower, upper) of x, u, w and p."""
        edges = np.cumsum(self.sizes)[:-1]
        return list(zip(np.split(self.lower, edges), np.split(self.upper, edges)))

    @property
    def extent(self) -> Array:
        """Half the range of each state, (nx,)."""
        nx = self.sizes[0]
        return np.asarray(0.5 * (self.upper - self.lower)[:nx])

    @property
    def centre(self) -> Array:
        """State in the middle, (nx,)."""
        nx = self.sizes[0]
        return np.asarray(0.5 * (self.upper + self.lower)[:nx])

    def parts(self, v: Array) -> tuple[Array, ...]:
        """States, inputs, disturbances and designs (n, ·) of unit-box points (n, ·)."""
        v = np.clip(v, 0.0, 1.0)
        z = self.lower + v * (self.upper - self.lower)
        edges = np.cumsum(self.sizes)[:-1]
        found = np.split(z, edges, axis=1)
        for i, (own, limits) in enumerate(zip(np.split(v, edges, axis=1), self.of_design)):
            if limits is not None:
                low, high = limits.bounds(found[3])
                found[i] = low + own * (high - low)
        return tuple(found)


@dataclass(frozen=True, eq=False)
class IntegrationError(Immutable):
    """Largest error of a step.

    Attributes
    ----------
    bound : (nx,) array
        Largest error of a sample in each state, in its unit: three times the largest difference found between the step
        and one of half the length.
    relative : float
        The largest of them, relative to half the range of its state.
    x, u, w, p : arrays
        Where the largest relative difference was found.
    """

    bound: Array
    relative: float
    x: Array
    u: Array
    w: Array
    p: Array


def measured_error(step: Step, finer: Step, region: Region, *, enough: float = np.inf) -> IntegrationError:
    """Largest difference of two steps found over a region.

    Parameters
    ----------
    step, finer : callable
        (x, u, w, p) → x⁺ on batches; the second of half the length.
    enough : float
        The search ends with a round in which a larger relative error was found.
    """
    rng = np.random.default_rng(0)
    dim = len(region.lower)
    spread = qmc.Sobol(dim, rng=rng).random(ERROR_POINTS)
    corners = np.round(spread[: ERROR_POINTS // 4])
    points = np.vstack([corners, np.full((1, dim), 0.5)])
    known = points[:0]
    values = np.zeros((0, region.sizes[0]))
    for k in range(4):
        known = np.vstack([known, points])
        values = np.vstack([values, _differences(step, finer, region, points)])
        relative = (values / region.extent).max(axis=1)
        if SAFETY * relative.max() > enough:
            break
        around = rng.choice(known[np.argsort(relative)[-16:]], ERROR_POINTS // 2)
        points = np.clip(around + AROUND_WORST**k * rng.uniform(-1, 1, around.shape), 0.0, 1.0) if k else spread
    bound = SAFETY * values.max(axis=0)
    place = region.parts(known[[int(np.argmax(relative))]])
    return IntegrationError(bound, float((bound / region.extent).max()), *(part[0] for part in place))


def _differences(step: Step, finer: Step, region: Region, points: Array) -> Array:
    """|x⁺ − x⁺ of the finer step| (n, nx); infinite where either is not finite."""
    parts = region.parts(points)
    with np.errstate(all="ignore"):
        difference = np.abs(step(*parts) - finer(*parts))
    return np.where(np.isfinite(difference), difference, np.inf)
