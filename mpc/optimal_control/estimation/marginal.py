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
from mpc.tolerances import NEAR_OPTIMUM, ROUNDED_SUM


@dataclass(frozen=True, eq=False)
class Spread:
    """Half the log-determinant of a course's information, about parameters p, to second order."""

    p: Array  # (np,)
    deviations: Array  # (k, np): p to deviations that are independent
    slope: Array  # (k,)
    curvature: Array  # (k, k)
    held: Array  # (np − k, np): p to what the data do not tell, and so stays
    convex: bool  # whether its curvature is whole

    def __call__(self, p: Any) -> Any:
        """Change from that at p."""
        z, away = (ca.mtimes(ca.DM(turned), p - ca.DM(self.p)) for turned in (self.deviations, self.held))
        of_slope = ca.dot(ca.DM(self.slope), z) + ca.dot(z, ca.mtimes(ca.DM(self.curvature), z)) / 2
        return of_slope + ca.sumsqr(away) / 2

    def moved(self, p: Array) -> float:
        """Distance of other parameters (np,), in deviations."""
        return float(np.abs(self.deviations @ (p - self.p)).max(initial=0.0))


def spread_of(solution: Solution, known: Information, residual: ca.Function, before: Spread | None) -> Spread:
    """Expansion at a solution, whose cost had that of `before` in it.

    Laplace's approximation of the likelihood of p, which is exact where the plant is linear and noise is normal, is the
    joint one less this. Bounds that act on p may be left by it.
    """
    program, p = solution.program, solution.program.parameters
    moves, root = _told(solution, replace(known, directions=np.eye(len(known.places))), before)
    moves = moves @ np.linalg.inv(root)
    turned, size, ways = np.linalg.svd(moves[p])
    some = np.flatnonzero(size > ROUNDED_SUM * size.max(initial=0.0))
    size, k, step = size[some], len(some), NEAR_OPTIMUM
    moves = (moves @ ways[some].T) * program.scale[:, None]

    def value(*at: int) -> float:
        """Half the log-determinant, a step along each; ~i is back along i."""
        ahead = sum((moves[:, i] if i >= 0 else -moves[:, ~i] for i in at), np.zeros(len(moves)))
        return half_log_determinant(program, solution.unknowns + step * ahead, residual)

    middle, on, back = value(), np.array([value(i) for i in range(k)]), np.array([value(~i) for i in range(k)])
    curvature = np.diag(on - 2 * middle + back)
    for i, j in combinations(range(k), 2):
        curvature[i, j] = curvature[j, i] = value(i, j) - on[i] - on[j] + middle
    joint = np.eye(k)
    if before is not None:
        own = before.deviations @ moves[p]
        joint = joint - own.T @ before.curvature @ own
    deviations, rest = turned[:, some].T / size[:, None], turned[:, len(some) :].T / (step * size.min(initial=1.0))
    convex = bool(np.linalg.eigvalsh(curvature / step**2 + joint).min(initial=1.0) > 0)
    values, ways = np.linalg.eigh(curvature / step**2)
    whole = (ways * (values if convex else np.maximum(values, 0.0))) @ ways.T
    return Spread(solution.p, deviations / program.scale[p], (on - back) / (2 * step), whole, rest / program.scale[p],
                  convex)  # fmt: skip


def half_log_determinant(program: NonlinearProgram, v: Array, residual: ca.Function) -> float:
    """Half the log-determinant of a course's information, but a constant."""
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


def _told(solution: Solution, known: Information, spread: Spread | None) -> tuple[Array, Array]:
    """Moves (n, r) by what is told, and a root (r, r) of second derivatives.

    These are 1 if linearised: of the cost, less what holds the rest.
    """
    W, A = lagrangian(solution)
    moves, p = tangents(solution, known, W, A) @ known.found.parts, solution.program.parameters
    H = moves.T @ (W @ moves)
    if spread is not None:
        held = (spread.held * solution.program.scale[p]) @ moves[p]
        H = H - held.T @ held
    try:
        return moves, np.asarray(np.linalg.cholesky(H).T)
    except np.linalg.LinAlgError:
        return moves, np.eye(len(H))


def observed(solution: Solution, known: Information, spread: Spread) -> Information:
    """Information by second derivatives in place of slopes."""
    slopes = _told(solution, known, spread)[1] @ np.linalg.pinv(known.found.parts) @ known.directions.T
    return replace(known, slopes=slopes)
