"""Independent check of invariance: one small linear program at every vertex, measured by its own witness."""

from __future__ import annotations

import daqp
import numpy as np

from .linear_programs import minimise
from .polytope import Polytope

Array = np.ndarray
_DOUBTFUL = 1e-12


def control_violation(A: Array, B: Array, C: Polytope, U: Polytope, E: Array | None = None,
                      W: Polytope | None = None) -> tuple[float, int]:
    """Return by how much the worst vertex of C leaves it under the best input, and the number of vertices.

    Parameters
    ----------
    A, B, E : arrays
        Dynamics x⁺ = A x + B u + E w.
    C, U, W : Polytope
        Bounded sets.

    Returns
    -------
    violation : float
        max over vertices x of min over u in U of max over facets i and vertices w of
        (fᵢᵀ(A x + B u + E w) − gᵢ) / (width of C along fᵢ). By convexity it bounds the violation on all of C.
    points : int
        Number of vertices checked.

    Notes
    -----
    The linear program only proposes u; the violation is then recomputed from u by a matrix product, so a solver
    error can make the result too large, never too small.
    """
    V, u_vertices = C.vertices, U.vertices
    heights = V @ C.A.T
    width = heights.max(axis=0) - heights.min(axis=0)
    width = np.where(width > 0, width, 1.0)
    F, g = C.A / width[:, None], C.b / width
    if E is not None and W is not None:
        g = g - (F @ E @ W.vertices.T).max(axis=1)
    lower, upper = u_vertices.min(axis=0), u_vertices.max(axis=0)
    middle, half = (lower + upper) / 2, np.where(upper > lower, (upper - lower) / 2, 1.0)
    slope, room = F @ B * half, g - V @ (F @ A).T - F @ B @ middle
    H, h = U.A * half, U.b - U.A @ middle
    size = np.linalg.norm(H, axis=1)
    H, h = H / size[:, None], h / size
    nu = B.shape[1]
    rows = np.ascontiguousarray(np.block([[slope, -np.ones((len(F), 1))], [H, np.zeros((len(H), 1))]]))
    cost = np.zeros(nu + 1)
    cost[nu] = 1.0
    worst = -np.inf
    for k in range(len(V)):
        right = np.concatenate([room[k], h])
        v, _, flag, _ = daqp.solve(None, cost, rows, right, primal_tol=1e-11)
        leaves = _leaves(v[:nu], slope, room[k], H, h) if flag == 1 else np.inf
        if leaves > _DOUBTFUL:  # DAQP ends its proximal iterations early now and then: ask the checked solver
            v = minimise(cost, rows, right)[1]
            leaves = min(leaves, np.inf if v is None else _leaves(v[:nu], slope, room[k], H, h))
        worst = max(worst, leaves)
    return float(worst), len(V)


def _leaves(v: Array, slope: Array, room: Array, H: Array, h: Array) -> float:
    """Return the violation of the witness v, infinite if v itself is not in U."""
    return float((slope @ v - room).max()) if (H @ v - h).max(initial=0.0) <= 1e-9 else np.inf
