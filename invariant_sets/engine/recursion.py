"""Recursion Ω ← Pre(Ω) ∩ Ω on arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from invariant_sets import hulls
from invariant_sets.budgets import CHEAP_HULL_DIM
from invariant_sets.exceptions import NumericalError
from invariant_sets.interior_form import unit_rows
from invariant_sets.linear_programs import largest_ball, maximise_rows
from invariant_sets.projection import needed_rows
from invariant_sets.results import Status, status_of
from invariant_sets.time_limits import NO_DEADLINE, Deadline, LimitReached
from invariant_sets.tolerances import COARSE, FLAT, MUCH, REDUNDANT, ROUNDING, SMALL

Array = np.ndarray
Rows = tuple[Array, Array]
Predecessor = Callable[[Rows, Array | None], Rows]


class Shape(Enum):
    """Shape of a set in a recursion."""

    SOLID = "full-dimensional"
    FLAT = "of lower dimension"
    EMPTY = "empty"
    UNRESOLVED = "too intricate for double precision"


@dataclass(frozen=True)
class Region:
    """Set {F y <= g}, with vertices V where bounded and few enough."""

    # rows of unit norm
    F: Array  # (m, n)
    g: Array  # (m,)
    V: Array | None  # (k, n): vertices; None if unbounded, or if the region is kept by its rows alone
    shape: Shape = Shape.SOLID  # if not SOLID, V is not kept up to date
    minimal: bool = False  # whether the rows are known to be irredundant

    def reach(self, rows: Array, deadline: Deadline = NO_DEADLINE) -> Array:
        """Support (k,) of the region along each row."""
        if not len(rows):
            return np.zeros(0)
        if self.V is not None:
            step = max(1, 60_000 // len(self.V))  # rows times vertices of one product
            return np.concatenate([(rows[i : i + step] @ self.V.T).max(axis=1) for i in range(0, len(rows), step)])
        if not len(self.g):
            return np.full(len(rows), np.inf)
        parts = []
        for i in range(0, len(rows), 20):
            deadline.check()
            parts.append(maximise_rows(rows[i : i + 20], self.F, self.g))
        return np.concatenate(parts)

    def cut(self, R: Array, r: Array, deadline: Deadline = NO_DEADLINE) -> Region:
        """Region cut by unit rows R y <= r; may raise `LimitReached`."""
        F = np.vstack([self.F, R])
        g = np.append(self.g, r)
        middle = np.zeros(F.shape[1])
        radius = 0.01
        if self.V is None or g.min() < radius:
            ball = largest_ball(F, g)
            radius = ball.radius
            middle = ball.centre
            if radius <= FLAT:
                return Region(F, g, None, Shape.EMPTY if radius < -FLAT else Shape.FLAT)
        room = g - F @ middle
        if self.V is None:
            few = F.shape[1] <= CHEAP_HULL_DIM
            kept = hulls.irredundant_rows(F, room) if few else needed_rows(F, room, deadline)
            return Region(F[kept], g[kept], None, minimal=True)
        deadline.check_hull(len(g), F.shape[1])
        try:
            kept, V = hulls.facets_and_vertices(F, room, merge=False)
        except NumericalError:  # thinner than Qhull can resolve, or too many coplanar facets
            return Region(F, g, None, Shape.FLAT if radius < COARSE else Shape.UNRESOLVED)
        return Region(F[kept], g[kept], V + middle, minimal=True)

    @property
    def is_small(self) -> bool:
        """Whether the region should be rescaled, being much smaller than one."""
        return self.V is not None and bool((self.V.max(axis=0) - self.V.min(axis=0) < SMALL).any())

    def tidy(self, deadline: Deadline = NO_DEADLINE) -> Region:
        """Region without redundant rows and repeated vertices."""
        if self.shape is not Shape.SOLID:
            return self
        region = self if self.minimal or not len(self.g) else self.cut(self.F[:0], self.g[:0], deadline)
        return region if region.V is None else replace(region, V=hulls.merge_points(region.V))


@dataclass(frozen=True)
class Outcome:
    """Outcome of a recursion: converged, capped, or no longer solid."""

    region: Region  # the last set
    iterations: int  # steps taken
    converged: bool = False  # whether no row cuts more than the tolerance any more
    limit: Status | None = None  # the cap on time or facets that stopped it
    # rows of the region that the last step brought; all of them if None. A recursion that goes on starts from these
    fresh: Array | None = None  # (m,) bool


@dataclass(frozen=True)
class Limits:
    """Limits at which a computation stops."""

    tol: float  # largest relative gap between the outer and the inner set [-]
    # most steps, and most facets
    iterations: int
    facets: int
    deadline: Deadline = NO_DEADLINE  # latest end


def iterate(
    region: Region, predecessor: Predecessor, limits: Limits, *, stop: float = REDUNDANT, fresh: Array | None = None
) -> Outcome:
    """Outcome of Ω ← predecessor(Ω) ∩ Ω from `region`.

    Parameters
    ----------
    region : Region
        Where to start: a superset of the answer, or of the part of it that is wanted.
    predecessor : callable
        ((F, g), fresh) → rows (R, r) of the predecessor set; those that follow from the `fresh` rows of (F, g)
        suffice, because what followed from the others was cut off a step before.
    limits : Limits
        When to give up.
    stop : float
        It has converged when no row cuts more than this part of its right-hand side.
    fresh : (m,) bool array, optional
        Rows of the region that the step before brought, where a recursion goes on; all of them by default.
    """
    for iteration in range(1, limits.iterations + 1):
        try:
            limits.deadline.check()
            smaller, cut = _one_step(region, predecessor, fresh, limits.deadline)
        except LimitReached as limit:
            return Outcome(region, iteration - 1, limit=status_of(limit), fresh=fresh)
        if smaller.shape is Shape.UNRESOLVED:
            return Outcome(region, iteration, limit=Status.FACET_LIMIT)
        if smaller is region or smaller.shape is not Shape.SOLID:
            return Outcome(smaller, iteration, converged=smaller is region)
        known = {row.tobytes() for row in np.column_stack([region.F, region.g])}
        fresh = np.array([row.tobytes() not in known for row in np.column_stack([smaller.F, smaller.g])], dtype=bool)
        region = smaller
        if cut <= stop or region.is_small:
            return Outcome(region, iteration, converged=cut <= stop)
        if len(region.g) > limits.facets:
            return Outcome(region, iteration, limit=Status.FACET_LIMIT)
    return Outcome(region, limits.iterations)


def _one_step(
    region: Region, predecessor: Predecessor, fresh: Array | None, deadline: Deadline
) -> tuple[Region, float]:
    """Intersection predecessor(region) ∩ region and the largest relative cut."""
    R, r = unit_rows(*predecessor((region.F, region.g), fresh))
    if R is None:
        return Region(region.F, region.g, None, Shape.EMPTY), 0.0
    if region.V is None and len(r):
        R, r = _worth_testing(region, R, r, deadline)
    reach = region.reach(R, deadline)
    cutting = reach > r + ROUNDING
    if not cutting.any():
        return region, 0.0
    depth = (reach - r)[cutting]
    cut = float((depth / np.maximum(np.abs(r[cutting]), 1 / MUCH)).max())
    return _cut_in_rounds(region, R[cutting], r[cutting], depth, deadline), cut


def _cut_in_rounds(region: Region, R: Array, r: Array, depth: Array, deadline: Deadline) -> Region:
    """Region cut by all rows, the deepest first."""
    while len(r) and region.shape is Shape.SOLID:
        first = np.argsort(-depth)[:200]
        region = region.cut(R[first], r[first], deadline)
        if len(first) == len(r) or region.shape is not Shape.SOLID:
            break
        depth = region.reach(R, deadline) - r
        left = depth > ROUNDING
        left[first] = False  # whatever rounding says of them, so that every round leaves fewer rows
        R = R[left]
        r = r[left]
        depth = depth[left]
    return region


def _worth_testing(region: Region, R: Array, r: Array, deadline: Deadline) -> Rows:
    """New rows without those that others make redundant."""
    F = np.vstack([region.F, R])
    g = np.append(region.g, r)
    ball = largest_ball(F, g)
    if ball.radius <= FLAT:
        return R, r
    kept = needed_rows(F, g - F @ ball.centre, deadline)
    new = kept[kept >= len(region.g)] - len(region.g)
    return R[new], r[new]
