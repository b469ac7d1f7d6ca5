"""Feedback that keeps predictions of unstable plants bounded."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from mpc.checks import Array
from mpc.riccati import cost_units
from mpc.tolerances import GROWTH

if TYPE_CHECKING:
    from mpc.problem import MPCProblem

Weights: TypeAlias = tuple[Array, Array, Array, Array]


def stabilising_feedback(problem: MPCProblem) -> Array | None:
    """Gains (number of blocks, nu, nx) of u = -K_b x, or None.

    They are the optimal gains of the unconstrained problem from the Riccati recursion over the horizon, for which the
    condensed Hessian is block diagonal; where the weights do not stabilise, those for weights in units of the sets.
    The problem does not change with them, only its condition (Rossiter, Kouvaritakis and Rice, Automatica 34(1), 1998).
    """
    radius = float(np.abs(np.linalg.eigvals(problem.A)).max())
    if problem.horizon * np.log(max(radius, 1.0)) <= np.log(GROWTH):
        return None
    return _least_growing(problem, *along_horizon(problem))[0]


def stabilising_weights(problem: MPCProblem) -> Weights:
    """Regulator weights (Q, R, S, P) that keep predictions bounded."""
    return _least_growing(problem, *along_horizon(problem))[2]


def along_horizon(problem: MPCProblem) -> tuple[Array, Array]:
    """Model A (N, nx, nx) and B (N, nx, nu) of every step."""
    A, B = (np.broadcast_to(M, (problem.horizon, *M.shape)) for M in (problem.A, problem.B))
    return A, B


def feedback_along(problem: MPCProblem, A: Array, B: Array) -> Array | None:
    """Gains of `stabilising_feedback` for A (N, nx, nx), B (N, nx, nu)."""
    sx, _ = cost_units(problem.A, problem.B, problem.Q, problem.R)
    growth = _growth(problem, A, B, None, sx)
    if growth <= GROWTH:
        return None
    gains, best, _ = _least_growing(problem, A, B)
    return gains if best < growth else None


def _least_growing(problem: MPCProblem, A: Array, B: Array) -> tuple[Array, float, Weights]:
    """Gains of the problem's weights or set units, whichever grows less; their growth and weights."""
    sx, su = cost_units(problem.A, problem.B, problem.Q, problem.R)
    Q = np.diag(1 / problem.state_extent**2)
    R = np.diag(1 / np.where(problem.input_extent > 0, problem.input_extent, 1 / su) ** 2)
    own, in_units = (problem.Q, problem.R, problem.cross, problem.P), (Q, R, np.zeros_like(problem.cross), Q)
    best: tuple[Array, float, Weights] | None = None
    for weights in (own, in_units):
        gains = _riccati_gains(problem, A, B, weights)
        growth = _growth(problem, A, B, gains, sx)
        best = (gains, growth, weights) if best is None or growth < best[1] else best
        if best[1] <= GROWTH:
            break
    assert best is not None
    return best


def block_lengths(problem: MPCProblem) -> tuple[int, ...]:
    """Lengths of the input blocks, one each without move blocking."""
    return problem.blocks if problem.blocks is not None else (1,) * problem.horizon


def _riccati_gains(problem: MPCProblem, A: Array, B: Array, weights: Weights) -> Array:
    """Optimal gains block by block, backwards from the terminal weight."""
    Q, R, S, P = weights
    stage = np.block([[Q, S], [S.T, R]])
    lengths = block_lengths(problem)
    gains = np.zeros((len(lengths), problem.nu, problem.nx))
    k = problem.horizon
    for b in reversed(range(len(lengths))):
        # cost of one block in (x, u) at its start: [x; u]'M[x; u]
        M = np.zeros((problem.nx + problem.nu,) * 2)
        M[: problem.nx, : problem.nx] = P
        step = np.eye(problem.nx + problem.nu)
        for _ in range(lengths[b]):
            k -= 1
            step[: problem.nx] = np.hstack([A[k], B[k]])
            M = step.T @ M @ step
            M += stage
        Mxu = M[: problem.nx, problem.nx :]
        Muu = M[problem.nx :, problem.nx :]
        d = np.sqrt(np.abs(np.diag(Muu)))
        d[d == 0] = 1.0
        K = np.linalg.lstsq(Muu / d / d[:, None], Mxu.T / d[:, None], rcond=None)[0] / d[:, None]
        gains[b] = K
        T = np.vstack([np.eye(problem.nx), -K])
        P = T.T @ M @ T
        P = (P + P.T) / 2
    return gains


def _growth(problem: MPCProblem, A: Array, B: Array, gains: Array | None, sx: Array) -> float:
    """Largest entry of the closed-loop transitions, in cost units."""
    worst = 1.0
    product = np.eye(problem.nx)
    k = 0
    for b, length in enumerate(block_lengths(problem)):
        u = np.zeros((problem.nu, problem.nx)) if gains is None else -gains[b] @ product
        for _ in range(length):
            product = A[k] @ product + B[k] @ u
            k += 1
        worst = max(worst, float(np.abs(product * sx[:, None] / sx).max()))
        if not np.isfinite(worst):
            return np.inf
    return worst
