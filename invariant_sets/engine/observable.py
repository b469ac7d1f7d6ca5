"""Quotient by the directions that the constraints never see.

With bounded inputs the lineality space of the maximal invariant set in X is the unobservable subspace of (F, A), where
F are the rows of X. In the quotient by that subspace the problem has the same form, and no such direction is left.

References
----------
Kalman (1963), Mathematical description of linear dynamical systems: what outputs see, and the quotient.
"""

from __future__ import annotations

import numpy as np

from invariant_sets.engine.local_problem import left_inverse
from invariant_sets.equalities import balancing, reduce_rows
from invariant_sets.polytope import Polytope
from invariant_sets.system_checks import LinearSystem

Array = np.ndarray


def observed_directions(A: Array, X: Polytope) -> Array | None:
    """Rows Q (k, n) of the observed directions; None if all are.

    Rows F, F A, F A² … are eliminated against one another. An entry counts as zero when it has cancelled beside
    the terms of its own sum, so that the units of the states decide nothing.
    """
    F = np.vstack([X.A, X.A_eq])
    if not len(F) or not np.abs(F).max() > 0.0:
        return None
    n = len(A)
    units = _units(A, F)
    A = A * units / units[:, None]
    Q = np.zeros((0, n))
    rows = F * units
    terms = np.abs(rows)
    while True:
        sizes = np.abs(rows).max(axis=1, keepdims=True)
        sizes = np.where(sizes > 0.0, sizes, 1.0)
        rows = np.vstack([Q, rows / sizes])
        solved, _, _ = reduce_rows(rows, np.vstack([np.abs(Q), terms / sizes]), n)
        if len(solved) == n:
            return None
        if len(solved) == len(Q):
            return np.asarray(Q / units)
        Q = rows[solved]
        rows, terms = Q @ A, np.abs(Q) @ np.abs(A)


def _units(A: Array, F: Array) -> Array:
    """Units (n,) in which outputs, now and later, see states alike."""
    seen = [F]
    for _ in range(len(A) - 1):
        ahead = seen[-1] @ A
        largest = np.abs(ahead).max(axis=1, keepdims=True)
        seen.append(ahead / np.where(largest > 0.0, largest, 1.0))
    return balancing(np.vstack(seen))[1]


def quotient(system: LinearSystem, X: Polytope, Q: Array) -> tuple[LinearSystem, Polytope]:
    """Motion of z = Q x, and X as a set of z."""
    back = left_inverse(Q.T).T  # Q back = 1, in any units
    noise = None if system.disturbances is None else system.disturbances @ Q.T
    return LinearSystem(Q @ system.A @ back, Q @ system.B, noise), X.preimage(back)
