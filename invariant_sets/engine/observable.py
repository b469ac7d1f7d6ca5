"""Quotient by the directions that the constraints never see.

With bounded inputs the lineality space of the maximal invariant set in X is the unobservable subspace of (F, A), where
F are the rows of X. In the quotient by that subspace the problem has the same form, and no such direction is left.

References
----------
Paige (1981), Properties of numerical algorithms related to computing controllability, IEEE TAC 26(1): the staircase
by singular values.
"""

from __future__ import annotations

import numpy as np

from invariant_sets.engine.local_problem import left_inverse
from invariant_sets.polytope import Polytope
from invariant_sets.system_checks import LinearSystem
from invariant_sets.tolerances import CANCELLED, DEPENDENT

Array = np.ndarray


def observed_directions(A: Array, X: Polytope) -> Array | None:
    """Rows Q (k, n) of the observed directions; None if all are."""
    F = np.vstack([X.A, X.A_eq])
    if not len(F) or not np.abs(F).max() > 0.0:
        return None
    from scipy.linalg import matrix_balance

    balanced, scale = matrix_balance(A, permute=False, separate=False)
    scale = np.diag(scale)  # balanced = scale⁻¹ A scale
    rows = F * scale
    norms = np.abs(rows).max(axis=1)
    Q = _row_space(rows[norms > 0.0] / norms[norms > 0.0, None], 1.0)
    size = max(float(np.linalg.norm(balanced, 2)), np.finfo(float).tiny)
    for _ in range(len(A)):  # every pass but the last adds a direction
        if len(Q) == len(A):
            break
        ahead = Q @ balanced
        more = _row_space(ahead - ahead @ Q.T @ Q, size)
        if not len(more):
            Q[np.abs(Q) <= CANCELLED] = 0.0
            return Q / scale
        Q = _row_space(np.vstack([Q, more]), 1.0)
    return None


def _row_space(rows: Array, size: float) -> Array:
    """Orthonormal rows that span the given ones, up to rounding."""
    _, values, vt = np.linalg.svd(rows, full_matrices=False)
    return vt[values > DEPENDENT * size]


def quotient(system: LinearSystem, X: Polytope, Q: Array) -> tuple[LinearSystem, Polytope]:
    """Motion of z = Q x, and X as a set of z."""
    back = left_inverse(Q.T).T  # Q back = 1, in any units
    noise = None if system.disturbances is None else system.disturbances @ Q.T
    return LinearSystem(Q @ system.A @ back, Q @ system.B, noise), X.preimage(back)
