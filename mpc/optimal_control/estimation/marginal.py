"""Likelihood of parameters alone, over all courses of a disturbance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse.linalg import splu

from mpc.checks import Array
from mpc.optimal_control.estimation.curvature import lagrangian, tangents
from mpc.optimal_control.estimation.information import Information, augmented, linearised
from mpc.optimal_control.program import NonlinearProgram
from mpc.optimal_control.solution import Solution
from mpc.tolerances import ROUNDED_SUM, SETTLED_ESTIMATE


@dataclass(frozen=True, eq=False)
class Spread:
    """Half the log-determinant of a course's information, about parameters p, to second order."""

    p: Array  # (np,)
    deviations: Array  # (k, np): p to deviations that are independent
    slope: Array  # (k,)
    curvature: Array  # (k, k)

    def __call__(self, p: Any) -> Any:
        """Its change from that at p."""
        z = ca.mtimes(ca.DM(self.deviations), p - ca.DM(self.p))
        return ca.dot(ca.DM(self.slope), z) + ca.dot(z, ca.mtimes(ca.DM(self.curvature), z)) / 2

    def moved(self, p: Array) -> float:
        """Distance of other parameters (np,), in deviations."""
        return float(np.abs(self.deviations @ (p - self.p)).max(initial=0.0))


def spread_of(solution: Solution, known: Information, residual: ca.Function, before: Spread | None) -> Spread:
    """Expansion at a solution, whose cost had that of `before` in it.

    Laplace's approximation of the likelihood of p, which is exact where the plant is linear and noise is normal, is the
    joint one less this.
    """
    program, p = solution.program, solution.program.parameters
    moves = tangents(solution, known, *lagrangian(solution)) @ known.found.parts @ np.linalg.inv(_root(solution, known))
    turned, size, ways = np.linalg.svd(moves[p], full_matrices=False)
    some = size > ROUNDED_SUM * size.max(initial=0.0)
    moves, step = (moves @ ways[some].T) * program.scale[:, None], SETTLED_ESTIMATE
    k = moves.shape[1]

    def value(*at: int) -> float:
        """Half the log-determinant, a step along each of these directions; ~i is back along i."""
        ahead = sum((moves[:, i] if i >= 0 else -moves[:, ~i] for i in at), np.zeros(len(moves)))
        return half_log_determinant(program, solution.unknowns + step * ahead, residual)

    middle, on, back = value(), np.array([value(i) for i in range(k)]), np.array([value(~i) for i in range(k)])
    curvature = np.diag(on - 2 * middle + back)
    for i, j in combinations(range(k), 2):
        curvature[i, j] = curvature[j, i] = value(i, j) - on[i] - on[j] + middle
    to_deviations = (turned[:, some] / size[some]).T / program.scale[p]
    joint = np.eye(k)
    if before is not None:
        own = before.deviations @ moves[p]
        joint = joint - own.T @ before.curvature @ own
    curvature = _kept_convex(curvature / step**2, joint)
    return Spread(solution.p, to_deviations, (on - back) / (2 * step), curvature)


def _kept_convex(curvature: Array, joint: Array) -> Array:
    """Curvature (k, k), or the part of it that is not negative where its sum with the joint one is not positive."""
    if np.linalg.eigvalsh(curvature + joint).min(initial=1.0) > 0:
        return curvature
    values, ways = np.linalg.eigh(curvature)
    return np.asarray((ways * np.maximum(values, 0.0)) @ ways.T)


def half_log_determinant(program: NonlinearProgram, v: Array, residual: ca.Function) -> float:
    """Half the log-determinant of the information of disturbances and first states at unknowns (n,), but a constant."""
    found = 0.0
    for part, priced, dynamics in linearised(program, v, residual):
        own = np.arange(part.first, part.last)
        states = own[part.coordinates[0] < part.layout.nx][part.layout.nx :]
        free = own[program.lower[own] < program.upper[own]]
        found += _log_determinant(augmented(priced[:, free], dynamics[:, free])) / 2
        found -= _log_determinant(dynamics[:, states])
    return found


def _log_determinant(K: Any) -> float:
    """Logarithm of the absolute value of a sparse determinant."""
    return float(np.log(np.abs(splu(K.tocsc()).U.diagonal())).sum())


def _root(solution: Solution, known: Information) -> Array:
    """Root R (r, r) of the second derivatives R'R of the least cost by what is told, which are 1 if linearised."""
    W, A = lagrangian(solution)
    Z = tangents(solution, known, W, A) @ known.found.parts
    try:
        return np.asarray(np.linalg.cholesky(Z.T @ (W @ Z)).T)
    except np.linalg.LinAlgError:
        return np.eye(Z.shape[1])


def observed(solution: Solution, known: Information) -> Information:
    """Information by second derivatives instead of slopes: residuals beside a disturbance do not vanish on average."""
    slopes = _root(solution, known) @ np.linalg.pinv(known.found.parts) @ known.directions.T
    return replace(known, slopes=slopes)
