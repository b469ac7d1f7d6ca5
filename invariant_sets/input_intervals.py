"""Admissible intervals of a single input at many states.

Everything is vectorised over the states, in units in which a violation of one is "the extent of the set away".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from invariant_sets.tolerances import UNMOVED

Array = np.ndarray


@dataclass(frozen=True)
class Intervals:
    """Rows slope·v <= room at k states, with lower <= v <= upper.

    Attributes
    ----------
    slope, room : (k, m) arrays
        Rows at each state; finite.
    lower, upper : float or (k,) array
        Bounds of the input.
    """

    slope: Array
    room: Array
    lower: float | Array
    upper: float | Array

    def nearest(self, wanted: Array) -> tuple[Array, Array]:
        """Inputs (k,) nearest to `wanted` (k,), and their worst violations.

        Where no input meets all rows, the one with the least violation, and nearest to the wanted one among those.
        """
        low, high = self._at_level(np.zeros(len(self.room)))
        level = np.zeros(len(self.room))
        empty = np.flatnonzero(low > high)
        if len(empty):
            ends = [np.broadcast_to(end, len(self.room))[empty] for end in (self.lower, self.upper)]
            stuck = Intervals(self.slope[empty], self.room[empty], *ends)
            level[empty] = stuck._least_level()
            low, high = self._at_level(level)
        middle = np.clip((low + high) / 2, self.lower, self.upper)
        crossed = low > high
        low = np.where(crossed, middle, low)
        high = np.where(crossed, middle, high)
        v = np.clip(np.clip(wanted, low, high), self.lower, self.upper)
        return v, self.violation(v)

    def violation(self, v: Array) -> Array:
        """Violation of the worst row by each input; negative inside."""
        worst: Array = (self.slope * v[:, None] - self.room).max(axis=1, initial=-np.inf)
        return worst

    def _at_level(self, level: Array) -> tuple[Array, Array]:
        """Ends of {v : slope v <= room + level}, lower above upper if empty."""
        room = self.room + level[:, None]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            bound = room / self.slope
        high = np.where(self.slope > UNMOVED, bound, np.inf).min(axis=1, initial=np.inf)
        low = np.where(self.slope < -UNMOVED, bound, -np.inf).max(axis=1, initial=-np.inf)
        return np.maximum(low, self.lower), np.minimum(high, self.upper)

    def _least_level(self) -> Array:
        """Least violation of the moving rows by some input, by bisection."""
        middle = np.reshape(np.asarray(self.lower + self.upper) / 2, (-1, 1))
        moving = np.where(np.abs(self.slope) > UNMOVED, self.slope * middle - self.room, -np.inf)
        top: Array = np.maximum(moving.max(axis=1, initial=0.0), 0.0)
        bottom = np.zeros(len(top))
        for _ in range(110):  # from the largest double that is used down to rounding
            middle = (bottom + top) / 2
            low, high = self._at_level(middle)
            fits = low <= high
            top = np.where(fits, middle, top)
            bottom = np.where(fits, bottom, middle)
        return top
