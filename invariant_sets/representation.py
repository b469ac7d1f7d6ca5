"""From inequalities to geometry and back: affine hull, interior point, vertices, minimal rows.

Every set is first written as {centre + basis y : F y <= g} with 0 well inside, in coordinates scaled to its own
bounding box. All tolerances below are relative to that box, so a set of size 1e-6 and one of 1e6 are treated alike.

References
----------
Fukuda (2004), Frequently asked questions in polyhedral computation: dual points, redundancy by LP.
Barber, Dobkin, Huhdanpaa (1996), The Quickhull algorithm for convex hulls, ACM TOMS 22(4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .exceptions import NumericalError
from .linear_programs import inscribed_ball, minimise

Array = np.ndarray
FLAT = 1e-9  # a set thinner than this part of its bounding box is flat; one missing by more is empty
SAME = 1e-9  # vertices and rows closer than this are one


@dataclass(frozen=True)
class Body:
    """{centre + basis y : F y <= g}: full-dimensional in y, 0 in its interior, extents of order one.

    Attributes
    ----------
    centre : (n,) array
        An interior point relative to the affine hull.
    basis : (n, k) array
        Columns span the affine hull; they carry the scale.
    F, g : (m, k) and (m,) arrays
        Rows of unit norm, g > 0.
    bounded : bool
        Whether the set is bounded.
    """

    centre: Array
    basis: Array
    F: Array
    g: Array
    bounded: bool


def body_of(A: Array, b: Array, A_eq: Array, b_eq: Array) -> Body | None:
    """Return the `Body` of {A x <= b, A_eq x = b_eq}, or None if the set is empty."""
    n = A.shape[1]
    centre, basis = np.zeros(n), np.eye(n)
    if len(b_eq):
        reduced = _solve_equalities(A_eq, b_eq)
        if reduced is None:
            return None
        centre, basis = reduced
    while True:
        F, g = unit_rows(A @ basis, b - A @ centre)
        if F is None:
            return None
        k = basis.shape[1]
        if k == 0 or len(g) == 0:
            return Body(centre, basis, F, g, bounded=k == 0)
        found = _extents_in_two_scales(F, g)
        if found is None:
            return None
        rough, y, lower, upper = found
        finite = np.isfinite(lower) & np.isfinite(upper)
        lower, upper = np.where(finite, lower, y - 1.0), np.where(finite, upper, y + 1.0)
        middle, half = (lower + upper) / 2, np.maximum((upper - lower) / 2, 1e-12)
        centre, basis = centre + basis @ (rough * middle), basis * (rough * half)
        F, g = unit_rows(A @ basis, b - A @ centre, always=True)
        radius, y = inscribed_ball(F, g, cap=1.0)
        thin = finite & (upper - lower <= FLAT * max(1.0, np.abs(middle).max()))
        if radius > FLAT and not thin.any():
            centre = centre + basis @ y
            return Body(centre, basis, F, g - F @ y, bool(finite.all()))
        flat = _implicit_equalities(F, g, y, max(radius, 0.0), thin)
        tight, level = (F[flat], g[flat]) if flat.any() else (np.eye(k)[thin], y[thin])
        y = y + np.linalg.lstsq(tight, level - tight @ y, rcond=1e-8)[0]  # onto the hull itself
        centre, basis = centre + basis @ y, basis @ null_space(tight)


def _extents_in_two_scales(F: Array, g: Array) -> tuple[Array, Array, Array, Array] | None:
    """Return a scale, a point and the extents in that scale; None if the set is empty.

    A bad scale can make a thin set look empty or unbounded, so two must agree on either.
    """
    answer = None
    for plain in (False, True):
        rough = _rough_scale(F, g, plain=plain)
        radius, y = inscribed_ball(*_unit(F * rough, g), cap=1.0)
        if radius < -FLAT:
            continue
        lower, upper = _extents(F * rough, g, slack=max(-radius, 0.0))
        answer = rough, y, lower, upper
        if np.isfinite(lower).all() and np.isfinite(upper).all():
            break
    return answer


def _solve_equalities(A_eq: Array, b_eq: Array) -> tuple[Array, Array] | None:
    norms = np.linalg.norm(A_eq, axis=1)
    scale = np.where(norms > 0, norms, 1.0)
    rows, values = A_eq / scale[:, None], b_eq / scale
    centre = np.linalg.lstsq(rows, values, rcond=1e-12)[0]
    if np.abs(rows @ centre - values).max() > FLAT * max(1.0, np.abs(values).max()):
        return None
    return centre, null_space(rows)


def null_space(rows: Array) -> Array:
    """Return an orthonormal basis (n, k) of {x : rows x = 0}."""
    _, s, vt = np.linalg.svd(rows, full_matrices=True)
    rank = int((s > 1e-8 * max(s.max(initial=0.0), 1e-300)).sum())
    return vt[rank:].T


def normals(basis: Array) -> Array:
    """Return orthonormal rows (n − k, n) that are orthogonal to the k columns of a basis."""
    left, _, _ = np.linalg.svd(basis / np.linalg.norm(basis, axis=0), full_matrices=True)
    return left[:, basis.shape[1]:].T


def unit_rows(A: Array, b: Array, *, always: bool = False):
    """Return the rows scaled to unit norm without zero rows; (None, b) if a zero row says 0 <= negative."""
    norms = np.linalg.norm(A, axis=1)
    reference = norms.max(initial=0.0)
    zero = norms <= 1e-13 * reference if reference > 0 else np.ones(len(b), bool)
    if zero.any():
        if not always and (b[zero] < -FLAT * np.maximum(1.0, np.abs(b).max())).any():
            return None, b
        A, b, norms = A[~zero], b[~zero], norms[~zero]
    return A / norms[:, None], b / norms


def _unit(F: Array, g: Array) -> tuple[Array, Array]:
    norms = np.linalg.norm(F, axis=1)
    return F / norms[:, None], g / norms


def _rough_scale(F: Array, g: Array, *, plain: bool = False) -> Array:
    """Return one length per coordinate, read off the rows without solving anything.

    Rows and columns are first balanced (Ruiz 2001, A scaling algorithm to equilibrate both rows and columns norms in
    matrices), so that every coordinate is steep in some row; then the intercepts of those rows are its lengths. A
    `plain` scale does without the intercepts, which mislead where a row passes through the origin.
    """
    scale = np.ones(F.shape[1])
    rows, right = np.abs(F), np.abs(g)
    for _ in range(4):
        columns = rows.max(axis=0)
        if (columns > 0.5).all():
            break
        factor = np.where(columns > 0, 1 / np.where(columns > 0, columns, 1.0), 1.0)
        scale, rows = scale * factor, rows * factor
        size = rows.max(axis=1)
        rows, right = rows / size[:, None], right / size
    if right.max() == 0.0:
        return scale
    # the tightest steep row on either side of a coordinate, and the wider of the two sides
    reach = right[:, None] / np.where(rows > 0.5, rows, 1.0)
    sides = [np.where((rows > 0.5) & (side * F > 0), reach, np.inf).min(axis=0) for side in (1, -1)]
    lengths = np.where(np.isfinite(sides), sides, 0.0).max(axis=0)
    proper = lengths > 1e-14 * right.max()
    uniform = scale * (lengths[proper].max() if proper.any() else right.max())
    return uniform if plain else np.where(proper, scale * lengths, uniform)


def _extents(F: Array, g: Array, slack: float) -> tuple[Array, Array]:
    """Return the lower and upper coordinate bounds of {F y <= g + slack}, infinite where there is none."""
    norms = np.linalg.norm(F, axis=1)
    rows, values = F / norms[:, None], g / norms + 1.01 * slack
    eye = np.eye(F.shape[1])
    lower = np.array([minimise(row, rows, values)[0] for row in eye])
    upper = np.array([-minimise(-row, rows, values)[0] for row in eye])
    return lower, upper


def _implicit_equalities(F: Array, g: Array, y: Array, radius: float, thin: Array) -> Array:
    """Return the rows that hold with equality on the whole of a flat set."""
    near = np.flatnonzero(g - F @ y <= 10 * FLAT + 2 * radius)
    relaxed = g + 2 * FLAT
    flat = np.zeros(len(g), bool)
    for i in near:
        flat[i] = g[i] - minimise(F[i], F, relaxed)[0] <= 20 * FLAT
    return flat


def facets_and_vertices(F: Array, g: Array, *, merge: bool = True) -> tuple[Array, Array]:
    """Return the irredundant row indices and the vertices (k, n) of the bounded {F y <= g}, g > 0.

    The hull of the dual points F/g has the irredundant rows as its vertices, and one facet per primal vertex; a
    vertex of more than n facets comes several times unless they are merged.
    """
    n = F.shape[1]
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
    """Return Qhull's hull of the points (k, n), n >= 2; raise `NumericalError` where it cannot.

    Symmetric data in five or six dimensions have so many coplanar points that Qhull stops over a wide merge. It is then
    told to go on (Q12); `facets_and_vertices` checks its answers.
    """
    from scipy.spatial import ConvexHull, QhullError

    reason = ""
    for options in (None, "Qt Qx Q12"):
        try:
            hull = ConvexHull(points, qhull_options=options)
        except QhullError as error:
            reason = str(error).splitlines()[0]
            continue
        if _holds_all(hull.equations, points):
            return hull
    raise NumericalError(f"The hull of {points.shape[0]} points in {points.shape[1]} dimensions failed: {reason}. "
                         "Rescale the data.")


def hull_volume(points: Array) -> float:
    """Return the volume of the hull of the points (k, n); joggled by 1e-10 or so where Qhull fails otherwise."""
    if points.shape[1] == 1:
        return float(np.ptp(points))
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(points).volume)
    except QhullError:
        return float(ConvexHull(points, qhull_options="QJ").volume)


def _holds_all(equations: Array, points: Array) -> bool:
    limit = SAME * np.abs(points).max()
    step = max(1, 10_000_000 // len(points))
    return all((points @ part[:, :-1].T + part[:, -1]).max() <= limit
               for part in (equations[i:i + step] for i in range(0, len(equations), step)))


def _check_vertices(V: Array, F: Array, g: Array) -> None:
    """Raise `NumericalError` unless the vertices agree with LPs in 20 directions (five and more dimensions)."""
    D = np.random.default_rng(0).standard_normal((20, F.shape[1]))
    exact = np.array([-minimise(-d, F, g)[0] for d in D])
    if not np.allclose((D @ V.T).max(axis=1), exact, rtol=0.0, atol=1e-7 * np.abs(exact).max()):
        raise NumericalError(f"The vertices of a set with {len(g)} rows in {F.shape[1]} dimensions could not be "
                             "enumerated reliably.")


def merge_points(points: Array, tol: float = SAME) -> Array:
    """Return the points without those closer than `tol` (largest coordinate difference) to an earlier one."""
    return points[distinct(points, tol)]


def distinct(points: Array, tol: float = SAME) -> Array:
    """Return the indices of the points that are not within `tol` of an earlier one.

    Copies are neighbours in the order along a fixed generic direction. Only where points that differ are neighbours
    too are all pairs compared.
    """
    if len(points) < 2:
        return np.arange(len(points))
    direction = np.cos(np.arange(1.0, points.shape[1] + 1) * 1.7) + 2.0
    along = points @ direction
    order = np.argsort(along, kind="stable")
    run = np.concatenate([[0], np.cumsum(np.diff(along[order]) > tol * np.abs(direction).sum())])
    first = np.full(run[-1] + 1, len(points))
    np.minimum.at(first, run, order)
    copies = np.abs(points[order] - points[first[run]]).max(axis=1) <= tol
    return np.sort(first) if copies.all() else _distinct_by_pairs(points, tol)


def _distinct_by_pairs(points: Array, tol: float) -> Array:
    if len(points) > 600:
        from scipy.spatial import cKDTree

        _, first = np.unique(np.round(points / tol), axis=0, return_index=True)  # most copies are closer than that
        if len(first) < len(points):
            first.sort()
            return first[distinct(points[first], tol)]
        pairs = cKDTree(points).query_pairs(tol, p=np.inf, output_type="ndarray")
        keep = np.ones(len(points), bool)
        keep[pairs.max(axis=1)] = False
        return np.flatnonzero(keep)
    close = np.abs(points[:, None] - points[None]).max(axis=2) <= tol
    return np.flatnonzero(close.argmax(axis=1) == np.arange(len(points)))


def irredundant_rows(F: Array, g: Array, tol: float = 1e-11) -> Array:
    """Return the indices of the rows that {F y <= g} needs (unit rows, 0 inside).

    Qhull's dual removes most; then one LP per row removes duplicates and rows that only touch: a row goes if the
    others alone already keep aᵀy <= b + tol. (`daqp.minrep` 0.11 is not used: it drops rows that are needed.)
    """
    kept = strongly_irredundant_rows(F, g)
    needed = [int(i) for i in kept[distinct(np.column_stack([F[kept], g[kept]]), tol)]]
    for i in list(needed):
        if len(needed) == 1:
            break
        others = [j for j in needed if j != i]
        rows, values = np.vstack([F[others], F[i]]), np.append(g[others], g[i] + 1.0)
        if -minimise(-F[i], rows, values)[0] <= g[i] + tol:
            needed = others
    return np.array(needed, dtype=int)


def strongly_irredundant_rows(F: Array, g: Array) -> Array:
    """Return the indices of the rows on the hull of the dual points F/g and 0; all rows where Qhull cannot tell.

    {F y <= g} with 0 inside may be unbounded: then 0 is a vertex of the dual hull and counts for nothing.
    """
    n = F.shape[1]
    if n == 1 or len(g) <= n + 1 or g.min() <= 1e-9:
        return np.arange(len(g))
    try:
        hull = convex_hull(np.vstack([F / g[:, None], np.zeros(n)]))
    except NumericalError:
        return np.arange(len(g))
    return np.sort(hull.vertices[hull.vertices < len(g)])


def hull_rows(points: Array) -> tuple[Array, Array, Array]:
    """Return facets (F, g) with unit rows of the hull of full-dimensional points (k, n), and its vertices' indices."""
    if points.shape[1] == 1:
        ends = np.array([points.argmax(), points.argmin()])
        return np.array([[1.0], [-1.0]]), points[ends, 0] * [1.0, -1.0], ends
    hull = convex_hull(points)
    equations = merge_points(np.unique(hull.equations, axis=0), tol=1e-11)
    index = hull.vertices[distinct(points[hull.vertices])]
    return np.ascontiguousarray(equations[:, :-1]), -equations[:, -1], index
