"""Time limits that hold: a deadline that is handed down, and what a convex hull is expected to cost before it is begun.

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

from invariant_sets.exceptions import InputError, InvariantSetsError
from invariant_sets.tolerances import MOST_HULL_FACETS, SECONDS_PER_FACET


class LimitReached(InvariantSetsError):
    """A computation met a cap before its end. Caught inside the package and turned into a status."""


class TimeLimitReached(LimitReached):
    """The time limit came, or would come before the next step ends."""


class SizeLimitReached(LimitReached):
    """The next step would need more rows or facets than fit."""


@dataclass(frozen=True)
class Deadline:
    """The moment at which a computation has to end."""

    end: float = float("inf")  # on the clock of `time.perf_counter` [s]; inf if there is no limit

    @classmethod
    def after(cls, seconds: float | None) -> Deadline:
        """Return the deadline so many seconds from now; None is no limit."""
        return cls() if seconds is None else cls(time.perf_counter() + seconds)

    @property
    def left(self) -> float:
        """Seconds that are left; negative once it has passed."""
        return self.end - time.perf_counter()

    @property
    def passed(self) -> bool:
        """Whether no time is left."""
        return self.left <= 0.0

    def part(self, share: float) -> Deadline:
        """Return the deadline at which this share of the time left will have gone."""
        left = self.left
        return self if left == float("inf") else Deadline(self.end - (1.0 - share) * max(left, 0.0))

    def check(self) -> None:
        """Raise `TimeLimitReached` if the deadline has passed."""
        if self.passed:
            raise TimeLimitReached("the time limit has passed")

    def check_hull(self, points: int, dim: int) -> None:
        """Raise `LimitReached` if the hull of so many points would take longer than is left, or too much memory."""
        facets = hull_facets(points, dim)
        if facets > MOST_HULL_FACETS:
            raise SizeLimitReached(f"a hull of {points} points in {dim} dimensions has about {facets:.0e} facets")
        if facets * SECONDS_PER_FACET > self.left:
            raise TimeLimitReached(f"a hull of {points} points in {dim} dimensions takes longer than is left")


NO_DEADLINE = Deadline()


def hull_facets(points: int, dim: int) -> float:
    """Return the expected number of facets of the hull of so many points, at most what it can have (McMullen)."""
    if points <= dim or dim < 2:
        return float(points)
    half = dim // 2
    most = math.comb(points - dim + half, half) + math.comb(points - half - 1, dim - half - 1)
    per_point = (1.0, 1.0, 1.0, 2.0, 7.0, 30.0, 170.0, 1000.0, 6000.0)  # by dimension, of points on a sphere
    beyond = max(0, dim - len(per_point) + 1)
    return min(float(most), points * per_point[dim - beyond] * 7.0**beyond)


def check_time_limit(value: Any) -> float | None:
    """Return `time_limit` as seconds, None for no limit. Raise `InputError` unless it is a number above 0."""
    if value is None:
        return None
    try:
        seconds = float("nan") if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        seconds = float("nan")
    if not seconds > 0.0:
        raise InputError("time_limit", repr(value)[:60], "a number of seconds above 0, or None for no limit")
    return seconds
