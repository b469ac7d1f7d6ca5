"""Between a body and rows in the units of x: hulls of points, minimal rows, the largest ball.

References
----------
Barber, Dobkin, Huhdanpaa (1996), The Quickhull algorithm for convex hulls, ACM TOMS 22(4).
Boyd, Vandenberghe (2004), Convex Optimization, section 8.5.1.
"""

from __future__ import annotations

import numpy as np

from invariant_sets.hulls import hull_rows, irredundant_rows
from invariant_sets.interior_form import FLAT, Body, normals
from invariant_sets.linear_programs import minimise

Array = np.ndarray


def hull_of_points(V: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Return unit rows (A, b), equalities (A_eq, b_eq) and the vertices' indices of the hull of the points V (k, n)."""
    centre = V.mean(axis=0)
    scale = np.ptp(V, axis=0) / 2
    scale[scale <= 1e-15 * np.abs(V).max(axis=0)] = 1.0
    Y = (V - centre) / scale
    _, s, vt = np.linalg.svd(Y, full_matrices=len(Y) < 2 * Y.shape[1])
    rank = int((s > FLAT * max(s.max(initial=0.0), FLAT)).sum())
    N, M = vt[:rank], vt[rank:] / scale
    extreme = np.arange(1)
    A, b = np.zeros((0, V.shape[1])), np.zeros(0)
    if rank:
        F, g, extreme = hull_rows(Y @ N.T)
        rows = F @ N
        rows[np.abs(rows) <= 4e-16] = 0.0  # rounding here, but not always in the units of x
        A, b = rows / scale, g + rows @ (centre / scale)
        norms = np.linalg.norm(A, axis=1)
        A, b = A / norms[:, None], b / norms
    M = M / np.linalg.norm(M, axis=1)[:, None]
    return A, b, M, M @ centre, extreme


def minimal_rows(body: Body) -> tuple[Array, Array, Array, Array]:
    """Return rows (A, b) and equalities (A_eq, b_eq) of the body in the units of x, none of them redundant."""
    kept = irredundant_rows(body.F, body.g) if len(body.g) else np.zeros(0, int)
    n, k = body.basis.shape
    if k < n:
        A, normal = body.F[kept] @ np.linalg.pinv(body.basis), normals(body.basis)
        return A, body.g[kept] + A @ body.centre, normal, normal @ body.centre
    A = body.F[kept] @ np.linalg.inv(body.basis)
    norms = np.linalg.norm(A, axis=1)
    return A / norms[:, None], (body.g[kept] + A @ body.centre) / norms, np.zeros((0, n)), np.zeros(0)


def largest_ball(body: Body) -> tuple[Array, float]:
    """Return centre (n,) and radius of a largest ball in the units of x; 0 if flat, inf if none is largest."""
    n = len(body.centre)
    if body.basis.shape[1] < n:
        return body.centre.copy(), 0.0
    if not len(body.g):
        return body.centre.copy(), np.inf
    norms = np.linalg.norm(body.F @ np.linalg.inv(body.basis), axis=1)  # of the rows in the units of x
    unit = (body.g / norms).min()
    rows = np.vstack([np.column_stack([body.F, unit * norms]), np.append(np.zeros(n), -1.0)])
    size = np.linalg.norm(rows, axis=1)
    cost = np.append(np.zeros(n), -1.0)
    value, y = minimise(cost, rows / size[:, None], np.append(body.g, 0.0) / size)
    if y is None:
        return body.centre.copy(), np.inf
    return body.centre + body.basis @ y[:-1], -value * unit
