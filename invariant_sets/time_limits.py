"""Deadlines, and the expected cost of convex hulls.

References
----------
Buchta, Müller, Tichy (1985), Stochastical approximation of convex bodies, Mathematische Annalen 271: facets of the hull
of random points on a sphere, from which the cost of a hull is estimated.
McMullen (1970), The maximum numbers of faces of a convex polytope, Mathematika 17.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

from ccdtools_ground.door import as_number
from invariant_sets.budgets import MOST_HULL_FACETS, SECONDS_PER_FACET
from invariant_sets.exceptions import InvariantSetsError


class LimitReached(InvariantSetsError):
    """Cap that a computation met, on rows or facets if no other; it becomes a status."""


class TimeLimitReached(LimitReached):
    """Time limit reached, or due before the next step ends."""


@dataclass(frozen=True)
class Deadline:
    """Moment at which a computation has to end."""

    end: float = math.inf  # on the clock of `time.perf_counter` [s]; inf if there is no limit

    @classmethod
    def after(cls, time_limit: Any) -> Deadline:
        """Deadline so many seconds from now; None is no limit. Raises `InputError` unless they are above 0."""
        if time_limit is None or (isinstance(time_limit, float) and time_limit == math.inf):
            return cls()
        expected = "a number of seconds above 0, or None for no limit"
        return cls(time.perf_counter() + as_number("time_limit", time_limit, expected=expected, low=0.0, strict=True))

    @property
    def left(self) -> float:
        """Seconds left; negative once the deadline has passed."""
        return self.end - time.perf_counter()

    @property
    def passed(self) -> bool:
        """Whether no time is left."""
        return self.left <= 0.0

    def part(self, share: float) -> Deadline:
        """Deadline at which this share of the time left is gone."""
        left = self.left
        return self if left == math.inf else Deadline(self.end - (1.0 - share) * max(left, 0.0))

    def check(self) -> None:
        """Raise `TimeLimitReached` if the deadline has passed."""
        if self.passed:
            raise TimeLimitReached("the time limit has passed")

    def check_hull(self, points: int, dim: int) -> None:
        """Raise `LimitReached` for a hull too large for time or memory."""
        facets = hull_facets(points, dim)
        if facets > MOST_HULL_FACETS:
            raise LimitReached(f"a hull of {points} points in {dim} dimensions has about {facets:.0e} facets")
        if facets * SECONDS_PER_FACET > self.left:
            raise TimeLimitReached(f"a hull of {points} points in {dim} dimensions takes longer than is left")


NO_DEADLINE = Deadline()


def hull_facets(points: int, dim: int) -> float:
    """Expected number of facets of a hull, at most McMullen's bound."""
    if points <= dim or dim < 2:
        return float(points)
    half = dim // 2
    most = math.comb(points - dim + half, half) + math.comb(points - half - 1, dim - half - 1)
    per_point = (1.0, 1.0, 1.0, 2.0, 7.0, 30.0, 170.0, 1000.0, 6000.0)  # by dimension, of points on a sphere
    beyond = max(0, dim - len(per_point) + 1)
    return min(float(most), points * per_point[dim - beyond] * 7.0**beyond)
