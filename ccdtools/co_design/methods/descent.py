"""Local search over designs along exact slopes, within constraints.

References
----------
Kraft, "A software package for sequential quadratic programming", DFVLR-FB 88-28, 1988 (SLSQP, in SciPy).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import minimize

from ccdtools.arrays import Array
from ccdtools.co_design.feasible import DesignRegion
from ccdtools.co_design.tolerances import AT_BOUND, COMPRESS_ABOVE, GAINED, INSIDE_EDGES, LOST_COST
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.tolerances import EXACT

Cost = Callable[[Array], tuple[float, Array]]



class _SpentError(Exception):
    """Raised when no evaluation is left."""


@dataclass(eq=False)
class Descent:
    """End of a local search."""

    v: Array  # (np,): the best feasible point of the unit box that was evaluated
    cost: float
    slope: Array  # (np,): of the cost there, per unit-box length
    evaluations: int = 0
    # the points that were better than all before
    path: list[tuple[Array, float]] = field(default_factory=list)  # (v, cost)
    spent: bool = False  # whether the evaluations ran out


def value_of(cost: Any, v: Array) -> float:
    """Cost at a point, without its slope where that is expensive."""
    value: float = cost.value(v) if getattr(cost, "slope_is_expensive", False) else cost(v)[0]
    return value


def compressed(relative: float) -> float:
    """Relative cost, logarithmic beyond `COMPRESS_ABOVE`."""
    high = relative > COMPRESS_ABOVE
    return COMPRESS_ABOVE * (1 + float(np.log(relative / COMPRESS_ABOVE))) if high else float(relative)


def descend(cost: Cost, space: DesignSpace, v: Array, *, size: float, evaluations: int) -> Descent:
    """Least cost found from a feasible unit-box point.

    Fixed entries and whole numbers are held.

    Parameters
    ----------
    cost : callable
        Point (np,) of the unit box → cost and its slope (np,); infinite where there is none.
    v : (np,) array
    size : float
        Of costs: what gains are compared with.
    evaluations : int
        At most.
    """
    region = DesignRegion(space, v)
    limits = space.allowed.limits
    free = region.free
    if not free.any():
        value, slope = cost(v)
        return Descent(v, value, slope, 1, [(v, value)])
    watched = _Watched(cost, space, v, size, evaluations)
    found = watched.found
    constraints = [] if limits is None else [{
        "type": "ineq", "fun": lambda z: -limits.values(watched.at(z)) - INSIDE_EDGES,
        "jac": lambda z: -limits.jacobian(watched.at(z))[:, free],
    }]  # fmt: skip
    try:
        for _ in range(3):  # searches follow one another while they gain
            before = found.cost
            minimize(watched.value, found.v[free], jac=watched.slope, method="SLSQP",
                     bounds=[(0.0, 1.0)] * int(free.sum()), constraints=constraints,
                     options={"maxiter": evaluations, "ftol": 1e-10})  # fmt: skip
            if not found.cost < before - GAINED * size:
                break
    except _SpentError:
        pass
    watched.complete()
    return found


@dataclass(eq=False)
class _Point:
    """Evaluated point of the unit box, with its slope if asked for."""

    v: Array
    cost: float
    slope: Array | None


class _Watched:
    """Cost of free entries z; `found` keeps the best so far."""

    def __init__(self, cost: Cost, space: DesignSpace, v: Array, size: float, evaluations: int) -> None:
        self.cost = cost
        self.apart: Any = cost if getattr(cost, "slope_is_expensive", False) else None
        self.space = space
        self.start = v
        self.size = size
        self.evaluations = evaluations
        self.free = DesignRegion(space, v).free
        self.found = Descent(v, np.inf, np.zeros(len(v)))
        self._last: _Point | None = None
        self._best: _Point | None = None

    def at(self, z: Array) -> Array:
        """Whole point with the free entries `z`."""
        point = self.start.copy()
        point[self.free] = np.where(z < AT_BOUND, 0.0, np.where(z > 1 - AT_BOUND, 1.0, z))
        return point

    def value(self, z: Array) -> float:
        """Relative cost, beyond `COMPRESS_ABOVE` its logarithm."""
        point = self._point(z)
        relative = point.cost / self.size
        if not np.isfinite(relative) or (point.slope is not None and not np.isfinite(point.slope).all()):
            return LOST_COST
        return compressed(relative)

    def slope(self, z: Array) -> Array:
        """Slope of the relative cost by free entries."""
        point = self._point(z)
        relative = point.cost / self.size
        if not np.isfinite(relative):
            return np.zeros(len(z))
        slope = self._slope(point)[self.free]
        if not np.isfinite(slope).all():
            return np.zeros(len(z))
        return np.asarray(slope / self.size * (COMPRESS_ABOVE / relative if relative > COMPRESS_ABOVE else 1.0))

    def complete(self) -> None:
        """Have the slope at the best point."""
        if self._best is not None:
            self.found.slope = self._slope(self._best)

    def _slope(self, point: _Point) -> Array:
        """Slope at a point, computed at most once."""
        if point.slope is None:
            assert self.apart is not None
            point.slope = self.apart.slope(point.v)
        return point.slope

    def _point(self, z: Array) -> _Point:
        """Evaluation at a point; the last is remembered.

        Raises
        ------
        _SpentError
            If that would be an evaluation too many.
        """
        v = self.at(z)
        if self._last is not None and np.array_equal(v, self._last.v):
            return self._last
        found = self.found
        if found.evaluations >= self.evaluations:
            found.spent = True
            raise _SpentError
        point = _Point(v, *self.cost(v)) if self.apart is None else _Point(v, self.apart.value(v), None)
        found.evaluations += 1
        self._last = point
        if point.cost < found.cost and self.space.allowed.violation(v) <= EXACT:
            found.v, found.cost, self._best = v, point.cost, point
            found.path.append((v, point.cost))
        return point
