"""Independent check of invariance: one small linear program at every vertex, measured by its own witness."""

from __future__ import annotations

import daqp
import numpy as np

from invariant_sets.engine.predecessor import predecessor_rows
from invariant_sets.interior_form import unit_rows
from invariant_sets.linear_programs import minimise
from invariant_sets.polytope import Polytope

Array = np.ndarray
_DOUBTFUL = 1e-12


def control_violation(A: Array, B: Array, C: Polytope, U: Polytope, disturbances: Array | None = None, *,
                      target: Polytope | None = None) -> tuple[float, int]:
    """Return by how much the worst vertex of C leaves `target` (C itself) under the best input, and the count.

    Parameters
    ----------
    A, B : arrays
        Dynamics x⁺ = A x + B u + w.
    C, U : Polytope
        State and input sets, not empty.
    disturbances : (k, nx) array, optional
        Vertices of E W.
    target : Polytope, optional
        Where the successors must lie; C if left out.

    Returns
    -------
    violation : float
        max over vertices x of min over u in U of max over facets i and disturbances w of
        (fᵢᵀ(A x + B u + w) − gᵢ) / (range of fᵢ over the bounding box of C). By convexity it bounds the
        violation on all of C. Unbounded sets are checked at the facets of their predecessor set instead.
    points : int
        Number of vertices (or facets) checked.

    Notes
    -----
    The linear program only proposes u; the violation is then recomputed from u by a matrix product, so a solver
    error can make the result too large, never too small.
    """
    target = C if target is None else target
    if not C.is_bounded:
        return _facet_violation(A, B, C, U, disturbances, target)
    F, g = relative_rows(target)
    if not len(g):
        return -np.inf, len(C.vertices)
    if disturbances is not None:
        g = g - (F @ disturbances.T).max(axis=1)
    body = U._body
    assert body is not None
    slope, room = F @ B @ body.basis, g - C.vertices @ (F @ A).T - F @ B @ body.centre
    H, h = body.F, body.g
    nu = H.shape[1]
    if nu == 0:
        return float((-room).max()), len(room)
    rows = np.ascontiguousarray(np.block([[slope, -np.ones((len(F), 1))], [H, np.zeros((len(H), 1))]]))
    cost = np.zeros(nu + 1)
    cost[nu] = 1.0
    witnesses = np.zeros((len(room), nu))
    for k in range(len(room)):
        v, _, flag, _ = daqp.solve(None, cost, rows, np.concatenate([room[k], h]), primal_tol=1e-11)
        witnesses[k] = v[:nu] if flag == 1 else np.inf
    leaves = _leaves(witnesses, slope, room, H, h)
    for k in map(int, np.flatnonzero(leaves > _DOUBTFUL)):  # DAQP may stop early: ask the checked solver
        v = minimise(cost, rows, np.concatenate([room[k], h]))[1]
        if v is not None:
            leaves[k] = min(leaves[k], _leaves(v[None, :nu], slope, room[k:k + 1], H, h)[0])
    return float(leaves.max()), len(room)


def relative_rows(C: Polytope) -> tuple[Array, Array]:
    """Return all rows of C as inequalities, divided by their range over its bounding box."""
    scale, scale_eq = C._row_scales
    F = np.vstack([C.A / scale[:, None], C.A_eq / scale_eq[:, None], -C.A_eq / scale_eq[:, None]])
    return F, np.concatenate([C.b / scale, C.b_eq / scale_eq, -C.b_eq / scale_eq])


def _leaves(v: Array, slope: Array, room: Array, H: Array, h: Array) -> Array:
    """Return the violation of each witness (k, nu), infinite if it is not in U itself."""
    with np.errstate(invalid="ignore"):
        inside = (v @ H.T - h <= 1e-9).all(axis=1)
        return np.where(inside, (v @ slope.T - room).max(axis=1), np.inf)


def _facet_violation(A: Array, B: Array, C: Polytope, U: Polytope, disturbances: Array | None,
                     target: Polytope) -> tuple[float, int]:
    """Return by how much C leaves the predecessor set of `target`, by one LP a facet."""
    F, g = relative_rows(target)
    if not len(g):
        return -np.inf, 0
    body = U._body
    assert body is not None
    H = np.hstack([np.zeros((len(body.g), len(A))), body.F])
    R, r = predecessor_rows(F, g - F @ B @ body.centre, A, B @ body.basis, H, body.g, disturbances)
    R, r = unit_rows(R, r)
    if R is None:
        return np.inf, 0
    if not len(r):
        return -np.inf, 0
    scale = np.abs(R) @ (2 * np.linalg.norm(C._body.basis, axis=1))  # type: ignore[union-attr]
    return float(((C._supports(R) - r) / scale).max()), len(r)
