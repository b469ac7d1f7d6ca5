"""The recursion Ω ← Pre(Ω) ∩ Ω on arrays: how it cuts, how it stops, how it notices that a set is flat or empty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from invariant_sets import hulls as rep
from invariant_sets.exceptions import NumericalError
from invariant_sets.interior_form import FLAT, unit_rows
from invariant_sets.linear_programs import inscribed_ball, maximise_rows

Array = np.ndarray
Rows = tuple[Array, Array]
SMALL = 0.05
_ROUND = 200  # rows cut at a time
CUT = 1e-12  # a row that cuts less off a set of order one is noise


class Shape(Enum):
    """What is left of the set."""

    SOLID = "full-dimensional"
    FLAT = "of lower dimension"
    EMPTY = "empty"
    UNRESOLVED = "too intricate for double precision"


@dataclass(frozen=True)
class Region:
    """{F y <= g}, with its vertices V where bounded.

    Attributes
    ----------
    F, g : (m, n) and (m,) arrays
        Rows of unit norm.
    V : (k, n) array or None
        Vertices; None if unbounded.
    shape : Shape
        If not SOLID, V is not kept up to date.
    minimal : bool
        Whether the rows are known to be irredundant.
    """

    F: Array
    g: Array
    V: Array | None
    shape: Shape = Shape.SOLID
    minimal: bool = False

    def reach(self, rows: Array) -> Array:
        """Return the support of the region along each row, (k,)."""
        if self.V is not None:
            step = max(1, 60_000 // len(self.V))
            parts = [(rows[i:i + step] @ self.V.T).max(axis=1) for i in range(0, len(rows), step)]
            return np.concatenate(parts) if parts else np.zeros(0)
        return maximise_rows(rows, self.F, self.g) if len(self.g) else np.full(len(rows), np.inf)

    def cut(self, R: Array, r: Array) -> Region:
        """Return the region intersected with {R y <= r} (unit rows)."""
        F, g = np.vstack([self.F, R]), np.append(self.g, r)
        middle, radius = np.zeros(F.shape[1]), 0.01
        if self.V is None or g.min() < radius:
            radius, middle = inscribed_ball(F, g, cap=1.0)
            if radius <= FLAT:
                return Region(F, g, None, Shape.EMPTY if radius < -FLAT else Shape.FLAT)
        room = g - F @ middle
        if self.V is None:
            kept = rep.irredundant_rows(F, room)
            return Region(F[kept], g[kept], None, minimal=True)
        try:
            kept, V = rep.facets_and_vertices(F, room, merge=False)
        except NumericalError:  # thinner than Qhull can resolve, or too many coplanar facets
            return Region(F, g, None, Shape.FLAT if radius < 1e-6 else Shape.UNRESOLVED)
        return Region(F[kept], g[kept], V + middle, minimal=True)

    @property
    def is_small(self) -> bool:
        """Whether it is so much smaller than one in some coordinate that it should be rescaled."""
        return self.V is not None and bool((self.V.max(axis=0) - self.V.min(axis=0) < 2 * SMALL).any())

    def tidy(self) -> Region:
        """Return the region without redundant rows and repeated vertices."""
        if self.shape is not Shape.SOLID:
            return self
        region = self if self.minimal or not len(self.g) else self.cut(self.F[:0], self.g[:0])
        return region if region.V is None else replace(region, V=rep.merge_points(region.V))


@dataclass(frozen=True)
class Outcome:
    """How a recursion ended: converged, at a cap, or because the set has become flat, empty or small.

    Attributes
    ----------
    region : Region
        The last set.
    iterations : int
        Steps taken.
    converged : bool
        Whether no row cuts more than the tolerance any more.
    cut : float
        Largest relative cut of the last step.
    too_many_facets : bool
        Whether the cap on the number of facets stopped it.
    """

    region: Region
    iterations: int
    converged: bool
    cut: float
    too_many_facets: bool = False


def iterate(region: Region, predecessor: Callable[[Array, Array, Array | None], Rows], stop: float, limit: int,
            max_facets: int) -> Outcome:
    """Return the end of Ω ← predecessor(Ω) ∩ Ω from `region`.

    Parameters
    ----------
    region : Region
        Where to start: a superset of the answer, or of the part of it that is wanted.
    predecessor : callable
        (F, g, fresh) → rows (R, r) of the predecessor set, not necessarily of unit norm; those that follow from
        the `fresh` rows of (F, g) suffice, because what followed from the others was cut off a step before.
    stop : float
        It has converged when no row cuts more than this part of its right-hand side.
    limit, max_facets : int
        Caps of the number of steps and of facets.
    """
    cut, fresh = np.inf, None
    for iteration in range(1, limit + 1):
        R, r = unit_rows(*predecessor(region.F, region.g, fresh))
        if R is None:
            return Outcome(Region(region.F, region.g, None, Shape.EMPTY), iteration, True, 0.0)
        if region.V is None and len(r):
            R, r = _worth_testing(region, R, r)
        reach = region.reach(R)
        cutting = reach > r + CUT
        if not cutting.any():
            return Outcome(region, iteration, True, 0.0)
        cut = float(((reach - r)[cutting] / np.maximum(np.abs(r[cutting]), 1e-3)).max())
        previous = region
        region = _cut_in_rounds(region, R[cutting], r[cutting], reach[cutting] - r[cutting])
        fresh = _new_rows(region, previous)
        if region.shape is Shape.UNRESOLVED:
            return Outcome(previous, iteration, False, cut, too_many_facets=True)
        if region.shape is not Shape.SOLID:
            return Outcome(region, iteration, False, cut)
        if cut <= stop:
            return Outcome(region, iteration, True, cut)
        if region.is_small:
            return Outcome(region, iteration, False, cut)
        if len(region.g) > max_facets:
            return Outcome(region, iteration, False, cut, too_many_facets=True)
    return Outcome(region, limit, False, cut)


def _new_rows(region: Region, previous: Region) -> Array:
    """Return which rows of a region the one before did not have."""
    known = {row.tobytes() for row in np.column_stack([previous.F, previous.g])}
    return np.array([row.tobytes() not in known for row in np.column_stack([region.F, region.g])], dtype=bool)


def _cut_in_rounds(region: Region, R: Array, r: Array, depth: Array) -> Region:
    """Return the region cut by all rows, the deepest first: they make most of the others redundant."""
    while len(r) and region.shape is Shape.SOLID:
        first = np.argsort(-depth)[:_ROUND]
        region = region.cut(R[first], r[first])
        if len(first) == len(r) or region.shape is not Shape.SOLID:
            break
        depth = region.reach(R) - r
        left = depth > CUT
        R, r, depth = R[left], r[left], depth[left]
    return region


def _worth_testing(region: Region, R: Array, r: Array) -> Rows:
    """Drop the new rows that Qhull finds redundant, before one LP is spent on each."""
    F, g = np.vstack([region.F, R]), np.append(region.g, r)
    radius, middle = inscribed_ball(F, g, cap=1.0)
    if radius <= FLAT:
        return R, r
    kept = rep.irredundant_rows(F, g - F @ middle)
    new = kept[kept >= len(region.g)] - len(region.g)
    return R[new], r[new]
