"""Unbounded sets by points and rays, from rows and back.

Both ways go through one convex hull, as for bounded sets: the facets of the hull of the dual points F/g and 0 are the
vertices, and those through 0 the rays.

References
----------
Ziegler (1995), Lectures on Polytopes, sections 1.1, 1.5 and 2.3: generators, homogenisation, duality.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from invariant_sets.bodies import row_norms
from invariant_sets.hulls import convex_hull, hull_rows, merge_points
from invariant_sets.linear_programs import largest_ball
from invariant_sets.time_limits import NO_DEADLINE, Deadline
from invariant_sets.tolerances import FLAT, REDUNDANT, ROUNDING

Array = np.ndarray


@dataclass(frozen=True)
class Generators:
    """Set conv(points) + cone(rays) + span(lines)."""

    points: Array  # (p, n): at least one
    # directions without an end, and without an end on either side
    rays: Array  # (r, n)
    lines: Array  # (l, n)

    def image(self, M: Array, c: Array) -> Generators:
        """Generators of {M x + c}."""
        return Generators(self.points @ M.T + c, self.rays @ M.T, self.lines @ M.T)

    def plus(self, other: Generators) -> Generators:
        """Generators of the Minkowski sum."""
        sums = (self.points[:, None, :] + other.points[None, :, :]).reshape(-1, self.points.shape[1])
        return Generators(sums, np.vstack([self.rays, other.rays]), np.vstack([self.lines, other.lines]))


def generators(F: Array, g: Array, deadline: Deadline = NO_DEADLINE) -> Generators:
    """Generators of {F y <= g} with unit rows and g > 0."""
    k = F.shape[1]
    across, lines = _spanned(F)
    if not len(across):
        return Generators(np.zeros((1, k)), np.zeros((0, k)), lines)
    dual = np.vstack([(F @ across.T) / g[:, None], np.zeros(len(across))])
    if len(across) == 1:
        ends = np.array([value for value in (dual[:-1, 0].max(), dual[:-1, 0].min()) if value != 0.0])
        ends = ends if len(ends) < 2 or ends[0] * ends[1] < 0 else ends[np.abs(ends).argmax()][None]
        points = (1 / ends)[:, None]
        rays = -np.sign(ends)[:, None] if len(ends) == 1 else np.zeros((0, 1))
    else:
        deadline.check_hull(len(dual), dual.shape[1])
        size = np.abs(dual).max()
        equations = convex_hull(dual / size).equations
        normal = equations[:, :-1]
        offset = -equations[:, -1]
        far = offset <= REDUNDANT  # facets through 0
        points = merge_points(normal[~far] / offset[~far, None] / size)
        rays = merge_points(normal[far])
    return Generators(points @ across, rays @ across, lines)


def rows_of(G: Generators, deadline: Deadline = NO_DEADLINE) -> tuple[Array, Array, Array, Array]:
    """Unit rows (A, b) and equalities (A_eq, b_eq) of the generated set.

    The set is taken to units in which its points spread by about one, lines are divided out, and a set that is flat in
    those units is solved on its hull.
    """
    middle = G.points.mean(axis=0)
    spread = np.abs(G.points - middle).max(axis=0)
    length = np.abs(np.vstack([G.rays, G.lines])).max(axis=0, initial=0.0)
    unit = np.where(spread > ROUNDING * np.abs(middle), spread, np.where(length > 0, length, 1.0))
    points = (G.points - middle) / unit
    rays = _of_length_one(G.rays / unit)
    lines = G.lines / unit
    across = _spanned(_of_length_one(lines))[1]
    inner = np.zeros(len(across))
    while len(rays) and len(across):  # every pass divides out a line that the rays hold together
        seen = _of_length_one(rays @ across.T)
        ball = largest_ball(seen, np.zeros(len(seen)), box=1.0) if len(seen) else None
        rays = seen @ across
        if ball is None or ball.radius > FLAT:
            inner = inner if ball is None else ball.centre
            break
        held = ball.dual > FLAT * ball.dual.max()
        across = _spanned(seen[held])[1] @ across
        rays = rays[~held]
    inner = inner if len(inner) == len(across) else np.zeros(len(across))
    solid, flat = _spanned(np.vstack([points, rays]) @ across.T)
    local = solid @ across
    F, g = _solid_rows(points @ local.T, rays @ local.T, solid @ inner, deadline)
    g = np.where(np.abs(g) > ROUNDING, g, 0.0)  # rows through the middle of the points
    A = F @ local / unit
    E = flat @ across / unit
    norms = row_norms(A)
    norms_eq = row_norms(E)
    A = A / norms[:, None]
    E = E / norms_eq[:, None]
    return A, g / norms + A @ middle, E, E @ middle


def _of_length_one(R: Array) -> Array:
    """Directions with norm one, without rounded zeros."""
    norms = row_norms(R)
    kept = norms > FLAT * norms.max(initial=0.0)
    return np.asarray(R[kept] / norms[kept, None])


def _spanned(R: Array) -> tuple[Array, Array]:
    """Orthonormal rows that span R, and rows across them."""
    n = R.shape[1]
    if not len(R) or not n:
        return np.zeros((0, n)), np.eye(n)
    _, values, vt = np.linalg.svd(R, full_matrices=True)
    rank = int((values > FLAT * max(values[0], FLAT)).sum())
    return vt[:rank], vt[rank:]


def _solid_rows(points: Array, rays: Array, inner: Array, deadline: Deadline) -> tuple[Array, Array]:
    """Rows (F, g) of solid conv(points) + cone(rays), innerᵀray < 0."""
    k = points.shape[1]
    if k == 0:
        return np.zeros((0, 0)), np.zeros(0)
    deadline.check_hull(len(points) + len(rays), k)
    if not len(rays):
        F, g, _ = hull_rows(points)
        return F, g
    # a plane cuts the cone over the set, of (p, 1) and (r, 0): a facet of the cut for each of the set, perhaps one more
    cone = np.vstack([np.column_stack([points, np.ones(len(points))]), np.column_stack([rays, np.zeros(len(rays))])])
    plane = np.append(-inner, 1.0 + (points @ inner).max())
    directions = _spanned(plane[None] / np.linalg.norm(plane))[1]
    cut = cone / (cone @ plane)[:, None] @ directions.T
    F, g, _ = hull_rows(cut)
    facets = F @ directions - g[:, None] * plane
    facets = facets / np.linalg.norm(facets, axis=1)[:, None]
    finite = np.linalg.norm(facets[:, :k], axis=1) > FLAT
    return facets[finite, :k], -facets[finite, k]
