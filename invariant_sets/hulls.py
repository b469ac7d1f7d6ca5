"""Vertices of inequalities and back, and irredundant rows.

References
----------
Fukuda (2004), Frequently asked questions in polyhedral computation: dual points, redundancy by LP.
Barber, Dobkin, Huhdanpaa (1996), The Quickhull algorithm for convex hulls, ACM TOMS 22(4).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from invariant_sets.budgets import MOST_SORTING_FACETS
from invariant_sets.exceptions import NumericalError
from invariant_sets.linear_programs import least_value, minimise
from invariant_sets.time_limits import hull_facets
from invariant_sets.tolerances import COARSE, FLAT, PLACE, REDUNDANT

Array = np.ndarray


def facets_and_vertices(F: Array, g: Array, *, merge: bool = True) -> tuple[Array, Array]:
    """Irredundant rows and vertices (k, n) of bounded {F y <= g}, g > 0.

    The hull of the dual points F/g has the irredundant rows as its vertices, and one facet per primal vertex; a
    vertex of more than n facets comes several times unless they are merged.
    """
    n = F.shape[1]
    if n == 0:
        return np.zeros(0, int), np.zeros((1, 0))
    if n == 1:
        ends = g / F[:, 0]
        upper = np.where(F[:, 0] > 0, ends, np.inf)
        lower = np.where(F[:, 0] < 0, ends, -np.inf)
        rows = np.array([np.argmin(upper), np.argmax(lower)])
        return rows, np.array([[upper[rows[0]]], [lower[rows[1]]]])
    hull = convex_hull(F / g[:, None])
    equations = hull.equations
    V = -equations[:, :-1] / equations[:, -1:]
    if n > 4:
        _check_vertices(V, F, g)
    return hull.vertices, merge_points(V) if merge else V


def convex_hull(points: Array) -> Any:
    """Qhull's hull of the points (k, n), n >= 2, or `NumericalError`.

    Symmetric data in five or six dimensions have so many coplanar points that Qhull stops over a wide merge. It is then
    told to go on (Q12), and at last to move the points by a part of 1e-10 or so (QJ). That all points lie in the hull
    is checked each time; `facets_and_vertices` checks its answers.
    """
    from scipy.spatial import ConvexHull, QhullError

    reason = ""
    for options in (None, "Qt Qx Q12", "QJ Qx"):
        try:
            hull = ConvexHull(points, qhull_options=options)
        except QhullError as error:
            reason = str(error).splitlines()[0]
            continue
        if _holds_all(hull.equations, points):
            return hull
    raise NumericalError("The hull", points.shape, reason)


def hull_volume(points: Array) -> float:
    """Volume of the hull of the points (k, n), joggled if necessary."""
    return float(np.ptp(points)) if points.shape[1] == 1 else float(convex_hull(points).volume)


def cone_volume(F: Array, g: Array) -> float | None:
    """Volume of bounded {F y <= g}, g > 0; None where digits cancel.

    Qhull triangulates the dual, whose facets are simplicial cones of normals, one or more to a vertex v. With c = Aᵀγ
    for the n rows A of a cone, the volume is Σ (cᵀv)ⁿ / (n! |det A| Π γ). It needs no hull of the vertices, of which
    there are many more than rows in five and more dimensions. The direction c is arbitrary: two of them have to agree.

    References
    ----------
    Lawrence (1991), Polytope volume computation, Mathematics of Computation 57(195).
    """
    n = F.shape[1]
    hull = convex_hull(F / g[:, None])
    cones = F[hull.simplices]
    V = -hull.equations[:, :-1] / hull.equations[:, -1:]
    solid = np.abs(np.linalg.det(cones)) > PLACE
    cones = cones[solid]
    V = V[solid]
    sizes = np.abs(np.linalg.det(cones)) * math.factorial(n)
    found = []
    for c in np.random.default_rng(0).standard_normal((5, n)):
        gamma = np.linalg.solve(cones.transpose(0, 2, 1), np.broadcast_to(c[:, None], (len(cones), n, 1)))[..., 0]
        terms = (V @ c) ** n / (sizes * gamma.prod(axis=1))
        found.append((float(np.abs(terms).sum()), math.fsum(terms)))
    (_, best), (_, second) = sorted(found)[:2]
    return best if abs(best - second) <= COARSE * abs(best) else None


def _holds_all(equations: Array, points: Array) -> bool:
    """Whether all points are inside the facets."""
    limit = FLAT * np.abs(points).max()
    step = max(1, 10_000_000 // len(points))
    return all(
        (points @ part[:, :-1].T + part[:, -1]).max() <= limit
        for part in (equations[i : i + step] for i in range(0, len(equations), step))
    )


def _check_vertices(V: Array, F: Array, g: Array) -> None:
    """Raise `NumericalError` unless the vertices agree with random LPs."""
    D = np.random.default_rng(0).standard_normal((20, F.shape[1]))
    exact = np.array([-minimise(-d, F, g)[0] for d in D])
    if not np.allclose((D @ V.T).max(axis=1), exact, rtol=0.0, atol=COARSE * np.abs(exact).max()):
        raise NumericalError("The vertices", F.shape, "they disagree with linear programs")


def extreme_points(V: Array, F: Array, g: Array, doubt: float = 0.0) -> Array:
    """Indices of points V (k, n) that are vertices.

    Rounding puts points on edges that another row only touches; fewer than n independent rows meet there, if no more
    is in doubt. A point goes if it lies in the hull of the others, by least squares with weights that sum to one.
    """
    from scipy.optimize import nnls

    n = F.shape[1]
    if n < 2:
        return np.arange(len(V))
    tol = max(FLAT, doubt)
    kept = distinct(V, tol) if tol > FLAT else np.arange(len(V))
    products = (F[:, :, None] * F[:, None]).reshape(len(F), -1)
    step = max(1, 10_000_000 // max(len(F), 1))
    touched = [(V[kept[i : i + step]] @ F.T >= g - COARSE) @ products for i in range(0, len(kept), step)]
    sharp = np.linalg.eigvalsh(np.concatenate(touched).reshape(len(kept), n, n))[:, 0] > COARSE
    for i in kept if tol > FLAT else kept[~sharp]:
        others = kept[kept != i]  # SciPy 1.17 frees twice what it never had where there are none
        if len(others) and nnls(np.vstack([(V[others] - V[i]).T, np.ones(len(others))]), np.eye(n + 1)[-1])[1] <= tol:
            kept = others
    return kept


def merge_points(points: Array, tol: float = FLAT) -> Array:
    """Points without those within `tol` of an earlier one, by coordinates."""
    return np.asarray(points[distinct(points, tol)])


def distinct(points: Array, tol: float = FLAT) -> Array:
    """Indices of the points not within `tol` of an earlier one.

    Copies are neighbours in the order along a fixed generic direction. Only where points that differ are neighbours
    too are all pairs compared.
    """
    if len(points) < 2:
        return np.arange(len(points))
    direction = np.cos(np.arange(1.0, points.shape[1] + 1) * 1.7) + 2.0
    along = points @ direction
    order = along.argsort(kind="stable")
    along = along[order]
    apart = along[1:] - along[:-1] > tol * direction.sum()
    if apart.all():
        return np.arange(len(points))
    run = np.append(0, apart.cumsum())
    first = np.full(run[-1] + 1, len(points))
    np.minimum.at(first, run, order)
    copies = np.abs(points[order] - points[first[run]]).max(axis=1) <= tol
    return np.sort(first) if copies.all() else _distinct_by_pairs(points, tol)


def _distinct_by_pairs(points: Array, tol: float) -> Array:
    """Indices that `distinct` returns, from all close pairs."""
    from scipy.spatial import cKDTree

    _, first = np.unique(np.round(points / tol), axis=0, return_index=True)
    first.sort()
    pairs = cKDTree(points[first]).query_pairs(tol, p=np.inf, output_type="ndarray")
    keep = np.ones(len(first), bool)
    keep[pairs.max(axis=1)] = False
    return first[keep]


def irredundant_rows(F: Array, g: Array, tol: float = REDUNDANT) -> Array:
    """Indices of the rows that {F y <= g} needs (unit rows, 0 inside).

    Qhull's dual removes most; then one LP per row removes duplicates and rows that only touch: a row goes if the
    others alone already keep aᵀy <= b + tol. (`daqp.minrep` 0.11 is not used: it drops rows that are needed.)
    """
    kept = strongly_irredundant_rows(F, g)
    needed = [int(i) for i in kept[distinct(np.column_stack([F[kept], g[kept]]), tol)]]
    for i in list(needed):
        if len(needed) == 1:
            break
        others = [j for j in needed if j != i]
        rows = np.vstack([F[others], F[i]])
        values = np.append(g[others], g[i] + 1.0)
        if -least_value(-F[i], rows, values) <= g[i] + tol:
            needed = others
    return np.array(needed, dtype=int)


def strongly_irredundant_rows(F: Array, g: Array) -> Array:
    """Indices of rows on the dual hull; all where it is unavailable.

    It is not asked where the hull may have very many facets, as that of a box in 20 dimensions, which has 2²⁰.
    {F y <= g} with 0 inside may be unbounded: then 0 is a vertex of the dual hull and counts for nothing.
    """
    n = F.shape[1]
    if n == 1 or len(g) <= n + 1 or g.min() <= FLAT or hull_facets(len(g) + 1, n) > MOST_SORTING_FACETS:
        return np.arange(len(g))
    try:
        hull = convex_hull(np.vstack([F / g[:, None], np.zeros(n)]))
    except NumericalError:
        return np.arange(len(g))
    return np.sort(hull.vertices[hull.vertices < len(g)])


def hull_rows(points: Array) -> tuple[Array, Array, Array]:
    """Facets (F, g) of a hull of points (k, n), and vertex indices."""
    if points.shape[1] == 0:
        return np.zeros((0, 0)), np.zeros(0), np.arange(1)
    if points.shape[1] == 1:
        ends = np.array([points.argmax(), points.argmin()])
        return np.array([[1.0], [-1.0]]), points[ends, 0] * [1.0, -1.0], ends
    hull = convex_hull(points)
    equations = merge_points(hull.equations[np.lexsort(hull.equations.T[::-1])], tol=REDUNDANT)
    index = hull.vertices[distinct(points[hull.vertices])]
    return np.ascontiguousarray(equations[:, :-1]), -equations[:, -1], index


def counter_clockwise(V: Array) -> Array:
    """Points of the plane ordered by angle; others as they are."""
    if V.shape[1] != 2 or len(V) < 3:
        return V
    x = V - V.sum(axis=0) / len(V)
    x = x / np.maximum(np.abs(x).max(axis=0), np.finfo(float).tiny)
    return V[np.argsort(np.arctan2(x[:, 1], x[:, 0]))]
