"""Local search over designs along exact slopes, within constraints.

References
----------
Kraft, "A software package for sequential quadratic programming", DFVLR-FB 88-28, 1988 (SLSQP, in SciPy).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize

from ccdtools.arrays import Array
from ccdtools.co_design.tolerances import AT_BOUND, COMPRESS_ABOVE, GAINED, LOST_COST
from ccdtools.plants.tolerances import EXACT

if TYPE_CHECKING:
    from ccdtools.co_design.limits import LimitsOutcome, StateLimitPenalty
    from ccdtools.plants.design_space import DesignSpace

Cost = Callable[[Array], tuple[float, Callable[[], Array]]]
"""Point (np,) of the unit box → cost, and a function that returns its slope (np,); infinite where there is none."""


@dataclass(frozen=True, eq=False)
class DesignPoint:
    """Best feasible point of the unit box that a search has found."""

    v: Array  # (np,)
    cost: float
    slope: Array  # (np,): of the cost, per unit-box length
    size: float = 1.0  # part of the return that control makes: what gains are compared with
    spent: bool = False  # whether the evaluations ran out
    violation: float = 0.0  # excess over the tolerance of the limits
    penalty: StateLimitPenalty | None = None  # what leaving the limits cost
    limits: LimitsOutcome | None = None
    active: Mapping[str, Array] = field(default_factory=dict)  # slopes (np,) of violations of active limits

    @property
    def order(self) -> tuple[float, float]:
        """Violation, then cost; the best point has least."""
        return (self.violation, self.cost)


class SpentError(Exception):
    """Raised when no evaluation is left, or more of them are of no use."""


def descend(cost: Cost, space: DesignSpace, v: Array, *, size: float, evaluations: int) -> DesignPoint:
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
        "type": "ineq", "fun": lambda z: -limits.values(watched.point(z)) - EXACT,
        "jac": lambda z: -limits.jacobian(watched.point(z))[:, free],
    }]  # fmt: skip
    if not free.any():
        watched.value(v[free])
        return watched.ended()
    with suppress(SpentError):
        for _ in range(3):  # searches follow one another while they gain
            begin, before, _ = watched.best
            minimize(watched.value, begin[free], jac=watched.slope, method="SLSQP",
                     bounds=[(0.0, 1.0)] * int(free.sum()), constraints=constraints,
                     options={"maxiter": evaluations, "ftol": 1e-10})  # fmt: skip
            if not watched.best[1] < before - GAINED * size:
                break
    return watched.ended()


class _Watched:
    """Relative cost of free entries z that remembers its last and its best point, with cost and slope."""

    def __init__(self, cost: Cost, space: DesignSpace, v: Array, size: float, evaluations: int) -> None:
        self._cost = cost
        self._allowed = space.allowed
        self._size = size
        self._left = evaluations
        self._spent = False
        self._last: tuple[Array, float, Callable[[], Array]] = (np.full(len(v), np.nan), np.inf, lambda: v)
        self.best: tuple[Array, float, Callable[[], Array]] = (v, np.inf, lambda: np.zeros(len(v)))

    def point(self, z: Array) -> Array:
        """Whole point with the free entries `z`."""
        v = self.best[0].copy()
        v[self._allowed.free] = np.where(z < AT_BOUND, 0.0, np.where(z > 1 - AT_BOUND, 1.0, z))
        return v

    def value(self, z: Array) -> float:
        """Cost, beyond `COMPRESS_ABOVE` its logarithm.

        Raises
        ------
        SpentError
            If that would be an evaluation too many.
        """
        v = self.point(z)
        if not np.array_equal(v, self._last[0]):
            if not self._left:
                self._spent = True
                raise SpentError
            self._left -= 1
            cost, slope = self._cost(v)
            self._last = (v, cost, cache(slope))
            if cost < self.best[1] and self._allowed.violation(v) <= EXACT:
                self.best = self._last
        relative = self._last[1] / self._size
        return compressed(relative) if np.isfinite(relative) else LOST_COST

    def slope(self, z: Array) -> Array:
        """Slope of the cost by free entries, zero where there is none."""
        self.value(z)
        relative = self._last[1] / self._size
        if not np.isfinite(relative):
            return np.zeros(len(z))
        own = self._last[2]()[self._allowed.free] / self._size
        own = own * (COMPRESS_ABOVE / relative if relative > COMPRESS_ABOVE else 1.0)
        return own if np.isfinite(own).all() else np.zeros(len(z))

    def ended(self) -> DesignPoint:
        """Best point, with its slope."""
        v, cost, slope = self.best
        return DesignPoint(v, cost, slope(), self._size, self._spent)


def compressed(relative: float) -> float:
    """Relative cost, logarithmic beyond `COMPRESS_ABOVE`."""
    high = relative > COMPRESS_ABOVE
    return COMPRESS_ABOVE * (1 + float(np.log(relative / COMPRESS_ABOVE))) if high else float(relative)
