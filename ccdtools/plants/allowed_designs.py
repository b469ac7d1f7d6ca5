"""Allowed points of the unit box of designs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
from scipy.stats import qmc

from ccdtools.arrays import Array
from ccdtools.plants.design_constraints import UnitConstraints
from ccdtools.plants.nearest_design import allowed_point, nearest, nearest_whole
from ccdtools.plants.tolerances import ALLOWED_STARTS, BOX_SAMPLES, EXACT, MAX_CORNERS, TRIED_COMBINATIONS


@dataclass(frozen=True, eq=False)
class AllowedDesigns:
    """The allowed points of a unit box.

    Attributes
    ----------
    lower, upper : (np,) arrays
        Of the box, in the units of the design.
    whole : (np,) array of bool
        Entries that are whole numbers.
    function : casadi.Function or None
        p → g(p) ≤ 0.
    """

    lower: Array
    upper: Array
    whole: Any
    function: ca.Function | None

    @cached_property
    def width(self) -> Array:
        """Range of each entry (np,), or one where fixed."""
        width = self.upper - self.lower
        return np.where(width > 0, width, 1.0)

    @cached_property
    def free(self) -> Any:
        """Entries that are neither fixed nor whole numbers, (np,) of bool."""
        return self._moving & ~self.whole

    @property
    def _moving(self) -> Any:
        """Entries that are not fixed, (np,) of bool."""
        return self.upper > self.lower

    @cached_property
    def limits(self) -> UnitConstraints | None:
        """The constraints over the unit box."""
        if self.function is None:
            return None
        return UnitConstraints(self.function, self.lower, self.upper, self._samples)

    @cached_property
    def _samples(self) -> Array:
        """Points (n, np): the centre, a Sobol sequence, corners of ten entries."""
        moving = np.flatnonzero(self._moving)
        points = np.zeros((1 + BOX_SAMPLES, len(self.lower)))
        if not len(moving):
            return points[:1]
        points[:, moving] = 0.5
        points[1:, moving] = qmc.Sobol(len(moving), rng=np.random.default_rng(0)).random(BOX_SAMPLES)
        corners = np.tile(points[0], (2 ** min(len(moving), MAX_CORNERS), 1))
        corners[:, moving[:MAX_CORNERS]] = list(product((0.0, 1.0), repeat=min(len(moving), MAX_CORNERS)))
        return np.vstack([points, corners])

    def where_not_finite(self) -> Array | None:
        """Unit-box point where a constraint is not finite; None without one."""
        if self.limits is None or not self.limits.not_finite.any():
            return None
        return np.asarray(self._samples[int(np.argmax(self.limits.not_finite))])

    def rounded(self, v: Array) -> Array:
        """Points (..., np) with whole-number entries rounded."""
        if not self.whole.any():
            return v
        numbers = np.clip(np.round(self.lower + v * self.width), np.ceil(self.lower - 1e-9),
                          np.floor(self.upper + 1e-9))  # fmt: skip
        return np.where(self.whole, (numbers - self.lower) / self.width, v)

    def violation(self, v: Array) -> Any:
        """Largest violation at points (n, np) or at one (np,)."""
        return np.zeros(v.shape[:-1]) if self.limits is None else self.limits.violation(v)

    @cached_property
    def known(self) -> Array:
        """Allowed points (n, np) to search from; empty if none is found."""
        samples = self.rounded(self._samples)
        inside: Array = samples[self.violation(samples) <= EXACT]
        if len(inside):
            return inside[:64]  # kept to search from
        return np.asarray(self.least_violated[None][self.violation(self.least_violated[None]) <= EXACT])

    @cached_property
    def least_violated(self) -> Array:
        """Point (np,) of least violation found from the samples."""
        assert self.limits is not None
        samples = self.rounded(self._samples)
        samples = samples[np.argsort(self.violation(samples), kind="stable")]
        tried = [*samples[:ALLOWED_STARTS], *samples[ALLOWED_STARTS :: max(1, len(samples) // ALLOWED_STARTS)]]
        if self.whole.any():
            between = allowed_point(self.limits, samples[0], self._moving)[0]
            for centre in (between, samples[0]):
                tried += list(self._by_whole_numbers(centre)[:TRIED_COMBINATIONS])
        least, violation = samples[0], np.inf
        for start in tried:
            u, broken = allowed_point(self.limits, start, self.free)
            if broken < violation:
                least, violation = u, broken
            if violation <= EXACT:
                break
        return np.asarray(least)

    def _by_whole_numbers(self, v: Array) -> Array:
        """Copies (n, np) of `v` with other whole numbers, nearest first."""
        lower, upper, width = (part[self.whole] for part in (self.lower, self.upper, self.width))
        numbers = nearest_whole(lower + v[self.whole] * width, lower, upper, width)
        points = np.tile(v, (len(numbers), 1))
        points[:, self.whole] = (numbers - lower) / width
        return points

    def combinations(self) -> Array:
        """Combinations (n, np) of whole numbers in the unit box; others 0."""
        first = np.zeros(len(self.lower))
        return self._by_whole_numbers(self.rounded(first))

    def near(self, v: Array) -> Array | None:
        """Nearest allowed point to `v` (np,); None if none is found.

        Whole numbers are tried from the nearest on; where none of these is allowed, from the ones about the nearest
        point that keeps the constraints with numbers in between, and then those of the known points.
        """
        if not self.whole.any():
            return self.near_with(v, thorough=True)
        best = self._of_whole_numbers(v, v)
        known = sorted(self.known, key=lambda one: _apart(one, v))[:ALLOWED_STARTS]
        if best is None and self.limits is not None:
            between = nearest(self.limits, v, free=self._moving, starts=known, thorough=True)
            best = None if between is None else self._of_whole_numbers(between, v)
        return known[0] if best is None and known else best

    def _of_whole_numbers(self, centre: Array, v: Array) -> Array | None:
        """Nearest allowed point to `v` with whole numbers about `centre`."""
        best: Array | None = None
        for held in self._by_whole_numbers(centre)[:TRIED_COMBINATIONS]:
            if best is not None and _apart(held, centre) >= _apart(best, centre):
                break
            found = self.near_with(np.where(self.whole, held, v), thorough=True)
            if found is not None and (best is None or _apart(found, v) < _apart(best, v)):
                best = found
        return best

    def near_with(self, v: Array, starts: Sequence[Array] = (), *, thorough: bool = False) -> Array | None:
        """Nearest allowed point to `v` (np,), fixed entries unchanged; None without one.

        Its whole numbers are those of `v`.

        Searches begin at `v`, at `starts` and at known points: see `nearest`.
        """
        if self.limits is None or self.limits.violation(v) <= EXACT:
            return v
        same = self.known[(np.abs(self.known - v) <= 1e-9)[:, ~self.free].all(axis=1)]
        known = sorted(same, key=lambda one: _apart(one, v))[:ALLOWED_STARTS]
        return nearest(self.limits, v, free=self.free, starts=[*starts, *known], thorough=thorough)


def _apart(u: Array, v: Array) -> float:
    """Distance of two points of the unit box."""
    return float(np.linalg.norm(u - v))
