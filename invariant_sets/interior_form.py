"""Sets as `Body` {centre + basis y : F y <= g}, from any rows.

What is large, small or zero is judged by the set's own extents, which a `LocalBox` finds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from invariant_sets.bodies import Body, Stated, row_norms
from invariant_sets.equalities import eliminated, opposite_rows, starting_scale
from invariant_sets.hulls import extreme_points, hull_rows
from invariant_sets.linear_programs import largest_ball, maximise_rows
from invariant_sets.local_box import LocalBox, half_widths, hidden_equalities, rescaled_view
from invariant_sets.tolerances import COARSE, FLAT, MUCH, PLACE, ROUNDING

Array = np.ndarray


def body_of(stated: Stated) -> Body | None:
    """`Body` of {A x <= b, A_eq x = b_eq}, None if empty."""
    A, b, A_eq, b_eq, terms, sizes = stated
    used = A.any(axis=1)
    used_eq = A_eq.any(axis=1)
    if (b[~used] < 0).any() or b_eq[~used_eq].any():
        return None
    A = A[used]
    b = b[used]
    E = A_eq[used_eq]
    e = b_eq[used_eq]
    terms = terms[used]
    sizes = sizes[used_eq]
    if not len(e) and len(b) and (np.count_nonzero(A, axis=1) == 1).all():
        return _box(A, b, terms)
    chosen, needless = opposite_rows(A, b, terms)
    if len(chosen):
        E = np.vstack([E, A[chosen]])
        e = np.append(e, b[chosen])
        sizes = np.append(sizes, terms[chosen])
        A = A[~needless]
        b = b[~needless]
        terms = terms[~needless]
    stated = Stated(A, b, E, e, terms, sizes)
    scale, far = starting_scale(stated)
    if far.any():
        near = body_of(Stated(A[~far], b[~far], E, e, terms[~far], sizes))
        if near is not None and (support(near, A[far]) <= b[far]).all():
            return near
    return _solved(stated, scale)


def _solved(stated: Stated, scale: Array) -> Body | None:
    """`Body` of the stated rows, equalities eliminated, None if empty."""
    A, b, E, e, terms, sizes = stated
    n = A.shape[1]
    centre = np.zeros(n)
    hidden = 0
    rescaled = 0
    # equalities that hide in the inequalities are added as they show, and all is done again in units that suit the set
    while True:  # every pass adds an equality, of which there are n at most, or rescales, three times at most
        hull = eliminated(E, e, sizes, centre, scale)
        if hull is None:
            return None
        cancelled = FLAT if hidden else ROUNDING
        if hull.basis.shape[1] == 1:
            return _interval(A, b, terms, hull, cancelled)
        box = rescaled_view(A, b, terms, hull.centre, hull.basis, cancelled=cancelled)
        if box is None:
            return None
        widths = half_widths(box)
        within_rounding = box.is_flat and box.room == 0.0  # such a set tells no scale
        endless = box.basis[:, box.unbounded].any(axis=1)  # what is seen of it is the box's own width
        measured = np.where((widths > 0.0) & ~endless & (not within_rounding), widths, scale)
        if not box.is_flat and len(e) and rescaled < 3 and np.abs(np.log10(measured / scale)).max() > np.log10(MUCH):
            centre = box.centre
            scale = measured
            rescaled += 1
        elif box.basis.shape[1] == 0 or not box.is_flat or hidden > n:
            return _body(box, hull, widths)
        else:
            rows = hidden_equalities(box)
            centre = box.centre + box.basis @ box.ball.centre
            E = np.vstack([E, A[rows]])
            e = np.append(e, b[rows] if within_rounding else A[rows] @ centre)
            sizes = np.append(sizes, np.maximum(terms[rows], np.abs(e[-len(rows) :])))
            scale = measured
            hidden += 1
            rescaled = 0


def support(body: Body, D: Array) -> Array:
    """Maxima (k,) of the rows of D (k, n), +inf if unbounded."""
    local = D @ body.basis
    cancelled = np.abs(local) <= ROUNDING * (np.abs(D) @ np.abs(body.basis))
    local = np.where(cancelled, 0.0, local) if body.basis.shape[1] < body.basis.shape[0] else local
    size = np.abs(local).max(axis=1, initial=0.0)
    moving = size > 0
    spread = np.zeros(len(D))
    spread[moving] = size[moving] * maximise_rows(local[moving] / size[moving, None], body.F, body.g)
    values = D @ body.centre + spread
    return np.where(np.abs(values) > ROUNDING * (np.abs(D) @ np.abs(body.centre)), values, 0.0)


def _part(whole: Body, inner: Body) -> Body:
    """Part of a set whose y lies in a body."""
    half = np.abs(whole.basis) @ inner.half_widths
    if len(whole.free) < len(whole.centre) and len(inner.free) > 1:
        shape = replace(inner, centre=np.zeros(len(whole.free)))
        widths = support(shape, whole.basis) / 2 + support(shape, -whole.basis) / 2
        half = np.where(np.isfinite(widths), widths, half)
    return Body(
        whole.centre + whole.basis @ inner.centre,
        whole.basis @ inner.basis,
        inner.F,
        inner.g,
        inner.sizes,
        inner.bounded,
        whole.free[inner.free],
        half,
        whole.terms + np.abs(whole.basis) @ inner.terms,
    )


def _interval(A: Array, b: Array, terms: Array, hull: Body, cancelled: float) -> Body | None:
    """`Body` of rows on a line, None if empty."""
    slope = A @ hull.basis
    sizes = np.abs(A) @ np.abs(hull.basis)
    slope = np.where(np.abs(slope) > cancelled * sizes, slope, 0.0)
    room = b - A @ hull.centre
    error = ROUNDING * (terms + np.abs(A) @ np.abs(hull.centre)) + 100 * cancelled * sizes[:, 0] * (slope[:, 0] == 0.0)
    level = slope[:, 0] == 0.0
    if (room[level] < -error[level]).any():
        return None
    along = _box(slope[~level], room[~level], error[~level] / ROUNDING)
    if along is None:
        return None
    return _part(hull, along)


def _box(A: Array, b: Array, terms: Array) -> Body | None:
    """`Body` of rows that hold one coordinate each, None if empty."""
    n = A.shape[1]
    column = np.abs(A).argmax(axis=1)
    slope = A[np.arange(len(b)), column]
    bound = b / np.abs(slope)
    doubt = ROUNDING * terms / np.abs(slope)
    reach, room = _tightest(np.where(slope > 0, column, n + column), bound, doubt, 2 * n)
    upper = reach[:n]
    lower = -reach[n:]
    doubt = np.maximum(room[:n], room[n:])
    size = np.where(np.isfinite(reach), np.abs(reach), 0.0).reshape(2, n).max(axis=0)
    width = upper / 2 - lower / 2
    if (-width > doubt).any():
        return None
    solid = width > doubt
    doubt = doubt / ROUNDING
    unit = np.where(size > 0, size, 1.0)
    low = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper - unit, -unit))
    high = np.where(np.isfinite(upper), upper, low + unit)
    centre = low / 2 + high / 2
    half = high / 2 - low / 2
    free = solid.nonzero()[0]
    eye = np.eye(len(free))
    length = half[free]
    ends = np.concatenate([upper[free] - centre[free], centre[free] - lower[free]])
    used = np.isfinite(ends)
    scale = np.concatenate([length, length])[used]
    return Body(
        centre,
        np.diag(half)[:, free],
        np.concatenate([eye, -eye])[used],
        ends[used] / scale,
        np.concatenate([doubt[free], doubt[free]])[used] / scale,
        bool(used.all()),
        free,
        np.where(solid, half, 0.0),
        np.maximum(np.abs(centre), doubt),
    )


def _tightest(column: Array, bound: Array, doubt: Array, n: int) -> tuple[Array, Array]:
    """Least bound (n,) of each column, and its doubt."""
    most = np.full(n, np.inf)
    np.minimum.at(most, column, bound + doubt)
    felt = bound + doubt <= most[column]
    least = np.full(n, np.inf)
    room = np.zeros(n)
    np.minimum.at(least, column[felt], bound[felt])
    np.maximum.at(room, column[felt], doubt[felt])
    return least, room


def _body(box: LocalBox, hull: Body, widths: Array) -> Body:
    """`Body` of the box about its ball's centre."""
    y = box.ball.centre
    bounded = not box.unbounded.any()
    touching = np.arange(len(box.g))
    if bounded:
        touching = np.flatnonzero(box.g <= (1 + COARSE) * np.abs(box.F).sum(axis=1))
    F = box.F[touching]
    g = box.g[touching]
    centre = box.centre + box.basis @ y
    return Body(
        centre,
        box.basis,
        F,
        np.maximum(g - F @ y, FLAT),
        box.error[touching] / ROUNDING,
        bounded,
        hull.free,
        widths,
        np.maximum(np.abs(centre), hull.terms),
    )


def tightened(body: Body, Q: Body, V: Array | None = None) -> Body | None:
    """Set {x : x + q in the set for all q in Q}, not `settled`, or None.

    Everything happens about the centres of the two sets, where their distance from the origin costs no digits.
    V (k, n), the vertices of Q less its centre, are quicker than linear programs, and right to `FLAT`.
    """
    shape = replace(Q, centre=np.zeros(len(Q.centre)))
    across = body.normals
    if (
        len(across)
        and (
            support(shape, across)
            > FLAT * (np.abs(across) @ (body.half_widths + Q.half_widths))
            + ROUNDING * (np.abs(across) @ (body.terms + Q.terms))
        ).any()
    ):
        return None
    slope = body.F @ body.inverse
    reach = support(shape, slope) if V is None else (slope @ V.T).max(axis=1)
    if np.isinf(reach).any():
        return None
    sizes = body.sizes + reach + PLACE / ROUNDING * (np.abs(slope) @ (body.terms + Q.terms))
    return replace(body, g=body.g - reach, sizes=sizes, centre=body.centre - Q.centre, terms=body.terms + Q.terms)


def settled(body: Body) -> Body | None:
    """Set re-centred and rescaled after g has changed, or None if empty."""
    if not len(body.free):
        return body
    none = np.zeros((0, len(body.free)))
    found = body_of(Stated(body.F, body.g, none, none[:, 0], body.sizes, none[:, 0]))
    return None if found is None else _part(body, found)


def body_of_vertices(A: Array, b: Array, V: Array) -> Body | None:
    """`Body` of {A x <= b} with vertices V (k, n), or None."""
    lower = V.min(axis=0)
    upper = V.max(axis=0)
    centre = (lower + upper) / 2
    half = (upper - lower) / 2
    if (half <= ROUNDING * np.abs(centre)).any():
        return None
    F = A * half
    g = b - A @ centre
    norms = row_norms(F)
    if not norms.all():
        return None
    F = F / norms[:, None]
    g = g / norms
    ball = largest_ball(F, g)
    y = ball.centre
    if ball.radius <= FLAT or (((V - centre) / half @ F.T).max(axis=0) > g + COARSE).any():
        return None
    centre = centre + half * y
    room = g - F @ y
    return Body(centre, np.diag(half), F, room, room, True, np.arange(len(half)), half, np.abs(centre))


def hull_about(anchor: Array, Y: Array, terms: Array) -> tuple[Body, Array]:
    """Hull of anchor + Y (k, n) as a `Body`, and vertex indices.

    The points are taken to units in which they spread by about one. A direction in which they spread by less than
    `FLAT`, or by less than `PLACE` times the terms (n,) of the coordinates, is flat; the hull is then that of some
    coordinates, on which the others depend.
    """
    from scipy.linalg import qr

    n = Y.shape[1]
    lower = Y.min(axis=0)
    upper = Y.max(axis=0)
    half = upper / 2 - lower / 2
    doubt = PLACE * terms
    moving = half > doubt
    unit = np.exp2(np.ceil(np.log2(np.where(moving, half, 1.0))))
    Z = np.where(moving, (Y - Y[0]) / unit, 0.0)
    _, _, axes = np.linalg.svd(Z, full_matrices=len(Z) < 2 * n)
    spread = np.abs(Z @ axes.T).max(axis=0)
    solid = spread > np.maximum(FLAT * spread.max(), np.abs(axes) @ np.where(moving, doubt / unit, 0.0))
    free = np.arange(n)
    graph = np.eye(n)
    if not solid.all():
        free = np.sort(qr(axes[solid], mode="r", pivoting=True)[1][: int(solid.sum())])  # pivots of the rows
        graph = np.linalg.solve(axes[solid][:, free], axes[solid])
        graph = np.where(np.abs(graph) > ROUNDING, graph, 0.0)
        graph[:, free] = np.eye(len(free))
    F, g, extreme = hull_rows(Z[:, free])
    extreme = extreme[extreme_points(Z[extreme][:, free], F, g)]
    F = np.where(np.abs(F) > PLACE, F, 0.0)  # rounding here, but not always in the units of x
    first = anchor + np.where(moving, Y[0], lower / 2 + upper / 2)
    centre = first + unit * (Z[extreme][:, free].mean(axis=0) @ graph)
    shift = F @ ((centre - first) / unit)[free]
    size = half[free] / unit[free]
    norms = np.linalg.norm(F * size, axis=1)
    return Body(
        centre,
        unit[:, None] * graph.T * size,
        F * size / norms[:, None],
        (g - shift) / norms,
        (np.abs(g) + np.abs(shift)) / norms,
        True,
        free,
        np.where(moving, half, 0.0),
        np.maximum(terms, np.abs(centre)),
    ), extreme


def normals(basis: Array) -> Array:
    """Orthonormal rows (n − k, n) across the k columns of a basis."""
    left, _, _ = np.linalg.svd(basis / row_norms(basis.T), full_matrices=True)
    return left[:, basis.shape[1] :].T


def unit_rows(A: Array, b: Array) -> tuple[Array | None, Array]:
    """Rows of unit norm without zero rows; (None, b) if one contradicts."""
    norms = row_norms(A)
    reference = norms.max(initial=0.0)
    zero = norms <= ROUNDING * reference if reference > 0 else np.ones(len(b), bool)
    if zero.any():
        if (b[zero] < -FLAT * np.maximum(1.0, np.abs(b).max())).any():
            return None, b
        A = A[~zero]
        b = b[~zero]
        norms = norms[~zero]
    return A / norms[:, None], b / norms
