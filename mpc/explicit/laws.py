"""Minimiser laws of active sets, and checks that they hold."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from mpc.checks import Array
from mpc.explicit.scaled_qp import ScaledQP
from mpc.tolerances import LAW_ERROR, LAW_ROUNDING_FAR, LAWS_AT_ONCE, NEARLY_DEPENDENT

ActiveSets = list[tuple[int, ...]]


class ScaledLaws(NamedTuple):
    """Laws v = law[r] [t; 1], (n, nv, nt + 1), and validity (n,)."""

    law: Array
    holds: np.ndarray


def checked_laws(qp: ScaledQP, active_sets: ActiveSets, centres: Array) -> ScaledLaws:
    """Law of each active set, checked at the region's centre.

    A law holds where its active rows hold with equality, no row is violated and no multiplier negative, to `LAW_ERROR`
    in units of the bounds and of the variables.
    """
    law = np.zeros((len(active_sets), qp.M.shape[1], qp.D.shape[1]))
    accepted = max(LAW_ERROR / max(1.0, qp.far), LAW_ROUNDING_FAR)  # in units of how far the optimum is
    holds = np.ones(len(active_sets), dtype=bool)
    where = np.hstack([centres, np.ones((len(centres), 1))])
    sizes = -(-np.array([len(act) for act in active_sets]) // 4)  # in fours: those of similar size together
    for size in {*sizes.tolist()} - {0}:
        which = np.flatnonzero(sizes == size)
        rows, right, gram = _padded(qp, [active_sets[r] for r in which])
        law[which], missed, pull = _law(rows, right, gram)
        force = (pull @ where[which, :, None])[:, :, 0]  # minus the multipliers
        holds[which] = missed <= accepted
        holds[which] &= force.max(axis=1) <= LAW_ERROR * np.maximum(1.0, np.abs(force).max(axis=1))
    return ScaledLaws(law, holds & (_violation(qp, law, where) <= accepted))


def _padded(qp: ScaledQP, active_sets: ActiveSets) -> tuple[Array, Array, Array]:
    """Padded rows of M and D and Gram matrices of active sets."""
    width = max(len(act) for act in active_sets)
    act = np.array([act + (-1,) * (width - len(act)) for act in active_sets])
    rows = qp.M[act]
    right = qp.D[act]
    gram = qp.gram[act[:, :, None], act[:, None, :]]
    none = act < 0
    if none.any():
        rows[none] = 0.0
        right[none] = 0.0
        gram[none[:, :, None] | none[:, None, :]] = 0.0
        gram[:, np.arange(width), np.arange(width)] += none
    return rows, right, gram


def _law(rows: Array, right: Array, gram: Array) -> tuple[Array, Array, Array]:
    """Least-norm solution v of rows v = right [t; 1], error and weights."""
    inverse = np.linalg.inv(gram)
    across = rows.transpose(0, 2, 1)
    pull = inverse @ right
    law = across @ pull
    law += across @ (inverse @ (right - rows @ law))  # the rounding of a nearly singular gram is taken out
    for k in np.flatnonzero(np.abs(inverse).max(axis=(1, 2)) > NEARLY_DEPENDENT):
        law[k], pull[k] = _law_by_directions(rows[k], right[k])
    size = 1.0 + np.abs(right).sum(axis=2) + np.linalg.norm(law, axis=1).sum(axis=1)[:, None]
    missed = (np.abs(rows @ law - right).sum(axis=2) / size).max(axis=1)
    return law, missed, pull


def _law_by_directions(rows: Array, right: Array) -> tuple[Array, Array]:
    """Law of one active set by a QR factorisation."""
    real = rows.any(axis=1)
    Q, R = np.linalg.qr(rows[real].T)
    along = solve_triangular(R, right[real], trans="T")
    pull = np.zeros_like(right)
    pull[real] = solve_triangular(R, along)
    return Q @ along, pull


def _violation(qp: ScaledQP, law: Array, where: Array) -> Array:
    """Largest relative violation of each law at its point."""
    parts = [np.zeros(0)]
    for first in range(0, len(law) if len(qp.M) else 0, LAWS_AT_ONCE):
        part = where[first : first + LAWS_AT_ONCE]
        v = np.einsum("rvc,rc->rv", law[first : first + LAWS_AT_ONCE], part)
        bounds = part @ qp.D.T
        size = 1.0 + np.abs(bounds) + np.linalg.norm(v, axis=1)[:, None]
        parts.append(((v @ qp.M.T - bounds) / size).max(axis=1))
    return np.concatenate(parts) if len(qp.M) else np.zeros(len(law))


def in_units(qp: ScaledQP, law: Array) -> Array:
    """Laws of v in scaled parameters as z = law [θ; 1] in units."""
    law = qp.free + qp.back @ law
    law[:, :, :-1] /= qp.half
    law[:, :, -1] -= law[:, :, :-1] @ qp.centre
    return law
