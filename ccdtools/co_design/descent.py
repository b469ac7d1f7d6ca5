"""Local search over designs along exact slopes, within constraints.

References
----------
Kraft, "A software package for sequential quadratic programming", DFVLR-FB 88-28, 1988 (SLSQP, in SciPy).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.optimize import minimize

from ccdtools.arrays import Array
from ccdtools.co_design.tolerances import AT_BOUND, COMPRESS_ABOVE, GAINED, INSIDE_EDGES, LOST_COST
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.tolerances import EXACT

Cost = Callable[[Array], tuple[float, Callable[[], Array]]]
"""Point (np,) of the unit box → cost, and a function that returns its slope (np,); infinite where there is none."""


class SpentError(Exception):
    """Raised when no evaluation is left, or more of them are of no use."""


@dataclass(frozen=True, eq=False)
class Descent:
    """End of a local search."""

    v: Array  # (np,): the best feasible point of the unit box that was evaluated
    cost: float
    slope: Array  # (np,): of the cost there, per unit-box length
    spent: bool = False  # whether the evaluations ran out


def compressed(relative: float) -> float:
    """Relative cost, logarithmic beyond `COMPRESS_ABOVE`."""
    high = relative > COMPRESS_ABOVE
    return COMPRESS_ABOVE * (1 + float(np.log(relative / COMPRESS_ABOVE))) if high else float(relative)


def descend(cost: Cost, space: DesignSpace, v: Array, *, size: float, evaluations: int) -> Descent:
    """Least cost found from a feasible unit-box point.

    Fixed entries and whole numbers are held.

    Parameters
    ----------
    cost : Cost
        Its slope is asked for only where the search takes a step from.
    v : (np,) array
    size : float
        Of costs: what gains are compared with.
    evaluations : int
        At most.
    """
    limits = space.allowed.limits
    free = space.allowed.free
    watched = _Watched(cost, space, v, size, evaluations)
    constraints = [] if limits is None else [{
        "type": "ineq", "fun": lambda z: -limits.values(watched.point(z)) - INSIDE_EDGES,
        "jac": lambda z: -limits.jacobian(watched.point(z))[:, free],
    }]  # fmt: skip
    if not free.any():
        watched.value(v[free])
        return watched.ended()
    with suppress(SpentError):
        for _ in range(3):  # searches follow one another while they gain
            before = watched.best.cost
            minimize(watched.value, watched.best.v[free], jac=watched.slope, method="SLSQP",
                     bounds=[(0.0, 1.0)] * int(free.sum()), constraints=constraints,
                     options={"maxiter": evaluations, "ftol": 1e-10})  # fmt: skip
            if not watched.best.cost < before - GAINED * size:
                break
    return watched.ended()


@dataclass(frozen=True, eq=False)
class _Looked:
    """Evaluated point of the unit box."""

    v: Array
    cost: float
    slope: Callable[[], Array]


class _Watched:
    """Relative cost of free entries z that remembers its last and its best point."""

    def __init__(self, cost: Cost, space: DesignSpace, v: Array, size: float, evaluations: int) -> None:
        self._cost = cost
        self._space = space
        self._size = size
        self._left = evaluations
        self._spent = False
        self._start = self._last = self.best = _Looked(v, np.inf, lambda: np.zeros(len(v)))

    def point(self, z: Array) -> Array:
        """Whole point with the free entries `z`."""
        v = self._start.v.copy()
        v[self._space.allowed.free] = np.where(z < AT_BOUND, 0.0, np.where(z > 1 - AT_BOUND, 1.0, z))
        return v

    def value(self, z: Array) -> float:
        """Cost, beyond `COMPRESS_ABOVE` its logarithm.

        Raises
        ------
        SpentError
            If that would be an evaluation too many.
        """
        v = self.point(z)
        if self._last is self._start or not np.array_equal(v, self._last.v):
            if not self._left:
                self._spent = True
                raise SpentError
            self._left -= 1
            cost, slope = self._cost(v)
            self._last = _Looked(v, cost, cache(slope))
            if cost < self.best.cost and self._space.allowed.violation(v) <= EXACT:
                self.best = self._last
        relative = self._last.cost / self._size
        return compressed(relative) if np.isfinite(relative) else LOST_COST

    def slope(self, z: Array) -> Array:
        """Slope of the cost by free entries, zero where there is none."""
        self.value(z)
        relative = self._last.cost / self._size
        if not np.isfinite(relative):
            return np.zeros(len(z))
        own = self._last.slope()[self._space.allowed.free] / self._size
        own = own * (COMPRESS_ABOVE / relative if relative > COMPRESS_ABOVE else 1.0)
        return own if np.isfinite(own).all() else np.zeros(len(z))

    def ended(self) -> Descent:
        """Best point, with its slope."""
        return Descent(self.best.v, self.best.cost, self.best.slope(), self._spent)
