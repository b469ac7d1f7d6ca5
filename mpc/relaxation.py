"""The least relaxation of state constraints that makes an infeasible problem feasible."""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from mpc.checks import Array
from mpc.dense_qp import TOLERANCE, DenseQP
from mpc.parametric_qp import ParametricQP

_SHARES = (1e-6, 1e-3, 1.0)  # weight of the control cost beside the squared violation; more where less is too stiff
_FAR = 1e4  # farther than this, in units of the set, only the direction counts
_MARGIN = 1e-8  # the relaxed bounds leave this much room, in units of the bounds


def least_violation(problem: ParametricQP, units: Array, q: Array, b: Array) -> tuple[Array, Array] | None:
    """Right-hand side relaxed by the least squares of the largest violation per step.

    Only rows of state and terminal constraints are relaxed; input, rate and slack rows are kept (Kerrigan and
    Maciejowski, *Soft constraints and exact penalty functions in MPC*, 2000, in two stages instead of one penalty).

    Parameters
    ----------
    problem : ParametricQP
        The infeasible problem.
    units : (m,) array
        Unit in which each row is compared with the others.
    q, b : (nz,) and (m,) array
        The QP at the parameter of interest.

    Returns
    -------
    relaxed : (m,) array
        The relaxed right-hand side.
    z : (nz,) array
        A point that satisfies it. Instead of both None when the hard rows conflict among themselves.
    """
    soft = np.array([label.kind in ("state", "terminal") for label in problem.labels], dtype=bool)
    if not soft.any():
        return None
    steps = np.array([label.step for label in problem.labels])
    last = int(steps[soft].max())
    columns = np.zeros((problem.m, last))
    columns[soft, steps[soft] - 1] = -units[soft]
    typical = _typical_cost(problem)
    for share in _SHARES:
        share = share / typical
        elastic = DenseQP(block_diag(share * problem.H, np.eye(last)), np.hstack([problem.G, columns]))
        result = elastic.solve(np.concatenate([share * q, np.zeros(last)]), b, doubt=True)
        if result.infeasible or result.residuals.worst <= TOLERANCE:
            break
    if result.infeasible or not np.isfinite(result.z).all():
        return None
    slack = np.maximum(-columns @ result.z[problem.nz :], 0.0)
    relaxed: Array = np.where(slack > 2 * _MARGIN * units, b + slack + _MARGIN * units, b + soft * _MARGIN * units)
    # what the first stage left violated by rounding is granted too
    z = result.z[: problem.nz]
    return relaxed + np.where(soft, np.maximum(problem.G @ z - relaxed, 0.0), 0.0), z


def _typical_cost(problem: ParametricQP) -> float:
    """Cost of inputs at their bounds, where there are bounds."""
    size = 1 / np.sqrt(np.diag(problem.H))
    for i in (i for i, label in enumerate(problem.labels) if label.kind in ("input", "slack")):
        for j in np.flatnonzero(problem.G[i]):
            size[j] = max(size[j], abs(problem.w[i] / problem.G[i, j]))
    return float(size**2 @ np.diag(problem.H))


def box_of(H: Array, h: Array) -> tuple[Array, Array] | None:
    """Bounds (low, high) of {u : Hu <= h} when every row concerns one entry, infinite where there is none."""
    if (np.count_nonzero(H, axis=1) != 1).any():
        return None
    low, high = np.full(H.shape[1], -np.inf), np.full(H.shape[1], np.inf)
    for row, bound in zip(H, h):
        j = int(np.flatnonzero(row)[0])
        if row[j] > 0:
            high[j] = min(high[j], bound / row[j])
        else:
            low[j] = max(low[j], bound / row[j])
    return low, high


def nearest_points(V: Array, H: Array, h: Array) -> Array:
    """Points (n, nu) of {u : Hu <= h} nearest to the rows of V; exact for a box, else see `nearest_point`."""
    box = box_of(H, h)
    if box is not None:
        return np.asarray(np.clip(V, *box), dtype=np.float64)
    return np.array([nearest_point(v, H, h) for v in V]).reshape(V.shape)


def nearest_point(v: Array, H: Array, h: Array) -> Array:
    """Point of {u : Hu <= h} nearest to v, or to v shrunk when v is very far away."""
    far = _FAR * max(float(np.abs(h).max()), np.finfo(float).tiny) / np.linalg.norm(H, axis=1).min()
    shrunk = v * min(1.0, far / max(float(np.abs(v).max()), np.finfo(float).tiny))
    return DenseQP(np.eye(len(v)), H).solve(-shrunk, h).z
