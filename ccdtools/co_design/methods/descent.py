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
from ccdtools.co_design.climb import compressed
from ccdtools.co_design.tolerances import AT_BOUND, COMPRESS_ABOVE, GAINED, INSIDE_EDGES, LOST_COST
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.tolerances import EXACT

Cost = Callable[[Array], tuple[float, Callable[[], Array]]]
"""Point (np,) of the unit box → cost, and a function that returns its slope (np,); infinite where there is none."""


class _SpentError(Exception):
    """Raised when no evaluation is left."""


@dataclass(frozen=True, eq=False)
class Descent:
    """End of a local search."""

    v: Array  # (np,): the best feasible point of the unit box that was evaluated
    cost: float
    slope: Array  # (np,): of the cost there, per unit-box length
    spent: bool = False  # whether the evaluations ran out


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
    watched = _Watched(cost, space, v, evaluations)
    if not free.any():
        watched.at(v[free])
        return watched.ended()
    constraints = [] if limits is None else [{
        "type": "ineq", "fun": lambda z: -limits.values(watched.point(z)) - INSIDE_EDGES,
        "jac": lambda z: -limits.jacobian(watched.point(z))[:, free],
    }]  # fmt: skip

    def value(z: Array) -> float:
        """Relative cost, beyond `COMPRESS_ABOVE` its logarithm."""
        relative = watched.at(z).cost / size
        return compressed(relative) if np.isfinite(relative) else LOST_COST

    def slope(z: Array) -> Array:
        """Slope of the relative cost by free entries."""
        here = watched.at(z)
        relative = here.cost / size
        own = here.slope()[free] if np.isfinite(relative) else np.full(len(z), np.nan)
        if not np.isfinite(own).all():
            return np.zeros(len(z))
        return np.asarray(own / size * (COMPRESS_ABOVE / relative if relative > COMPRESS_ABOVE else 1.0))

    with suppress(_SpentError):
        for _ in range(3):  # searches follow one another while they gain
            before = watched.best.cost
            minimize(value, watched.best.v[free], jac=slope, method="SLSQP", bounds=[(0.0, 1.0)] * int(free.sum()),
                     constraints=constraints, options={"maxiter": evaluations, "ftol": 1e-10})  # fmt: skip
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
    """Cost of free entries z that remembers its last and its best point."""

    def __init__(self, cost: Cost, space: DesignSpace, v: Array, evaluations: int) -> None:
        self._cost = cost
        self._space = space
        self._start = v
        self._left = evaluations
        self._last: _Looked | None = None
        self._spent = False
        self.best = _Looked(v, np.inf, lambda: np.zeros(len(v)))

    def point(self, z: Array) -> Array:
        """Whole point with the free entries `z`."""
        v = self._start.copy()
        v[self._space.allowed.free] = np.where(z < AT_BOUND, 0.0, np.where(z > 1 - AT_BOUND, 1.0, z))
        return v

    def at(self, z: Array) -> _Looked:
        """Evaluation at free entries.

        Raises
        ------
        _SpentError
            If that would be an evaluation too many.
        """
        v = self.point(z)
        if self._last is not None and np.array_equal(v, self._last.v):
            return self._last
        if not self._left:
            self._spent = True
            raise _SpentError
        self._left -= 1
        value, slope = self._cost(v)
        self._last = _Looked(v, value, cache(slope))
        if value < self.best.cost and self._space.allowed.violation(v) <= EXACT:
            self.best = self._last
        return self._last

    def ended(self) -> Descent:
        """Best point, with its slope."""
        return Descent(self.best.v, self.best.cost, self.best.slope(), self._spent)
