"""A feedback over the horizon around which inputs are planned, so that predictions of unstable plants stay bounded."""

from __future__ import annotations

import numpy as np

from mpc.checks import Array
from mpc.lqr import cost_units
from mpc.problem import MPCProblem
from mpc.tolerances import GROWTH


def stabilising_feedback(problem: MPCProblem) -> Array | None:
    """Gains (number of blocks, nu, nx) of u = -K_b x at the start of each block, or None where none is needed.

    They are the optimal gains of the unconstrained problem from the Riccati recursion over the horizon, for which the
    condensed Hessian is block diagonal; where the weights do not stabilise, those for weights in units of the sets.
    The problem does not change with them, only its condition (Rossiter, Kouvaritakis and Rice, Automatica 34(1), 1998).
    """
    radius = float(np.abs(np.linalg.eigvals(problem.A)).max())
    if problem.horizon * np.log(max(radius, 1.0)) <= np.log(GROWTH):
        return None
    gains, _ = _chosen(problem)
    return gains


def stabilising_weights(problem: MPCProblem) -> tuple[Array, Array, Array, Array]:
    """Weights (Q, R, S, P) whose regulator keeps predictions bounded: the problem's, or those in units of its sets."""
    _, weights = _chosen(problem)
    return weights


def _chosen(problem: MPCProblem) -> tuple[Array, tuple[Array, Array, Array, Array]]:
    """Gains over the horizon, and the weights that they are of."""
    sx, su = cost_units(problem.A, problem.B, problem.Q, problem.R)
    none = np.zeros((problem.nx, problem.nu))
    own = (problem.Q, problem.R, none if problem.S is None else problem.S, problem.P)
    gains = _riccati_gains(problem, *own)
    growth = _closed_loop_growth(problem, gains, sx)
    if growth > GROWTH:
        Q = np.diag(1 / problem.state_extent**2)
        R = np.diag(1 / np.where(problem.input_extent > 0, problem.input_extent, 1 / su) ** 2)
        others = _riccati_gains(problem, Q, R, none, Q)
        if _closed_loop_growth(problem, others, sx) < growth:
            return others, (Q, R, none, Q)
    return gains, own


def block_lengths(problem: MPCProblem) -> tuple[int, ...]:
    """Lengths of the blocks over which inputs are held; all one without move blocking."""
    return problem.blocks if problem.blocks is not None else (1,) * problem.horizon


def _riccati_gains(problem: MPCProblem, Q: Array, R: Array, S: Array, P: Array) -> Array:
    """Optimal gains block by block, backwards from the terminal weight."""
    A = problem.A
    B = problem.B
    lengths = block_lengths(problem)
    gains = np.zeros((len(lengths), problem.nu, problem.nx))
    for b in reversed(range(len(lengths))):
        # cost of one block in (x, u) at its start: [x; u]'M[x; u]
        M = np.zeros((problem.nx + problem.nu,) * 2)
        M[: problem.nx, : problem.nx] = P
        step = np.block([[A, B], [np.zeros((problem.nu, problem.nx)), np.eye(problem.nu)]])
        for _ in range(lengths[b]):
            M = step.T @ M @ step
            M[: problem.nx, : problem.nx] += Q
            M[problem.nx :, problem.nx :] += R
            M[: problem.nx, problem.nx :] += S
            M[problem.nx :, : problem.nx] += S.T
        Mxu = M[: problem.nx, problem.nx :]
        Muu = M[problem.nx :, problem.nx :]
        K = _solve_scaled(Muu, Mxu.T)
        gains[b] = K
        T = np.vstack([np.eye(problem.nx), -K])
        P = T.T @ M @ T
        P = (P + P.T) / 2
    return gains


def _solve_scaled(M: Array, right: Array) -> Array:
    """M⁻¹ right for a symmetric M ⪰ 0, scaled to a unit diagonal; least squares where it is singular."""
    d = np.sqrt(np.abs(np.diag(M)))
    d[d == 0] = 1.0
    return np.asarray(np.linalg.lstsq(M / d / d[:, None], right / d[:, None], rcond=None)[0] / d[:, None])


def _closed_loop_growth(problem: MPCProblem, gains: Array, sx: Array) -> float:
    """Largest entry of the closed-loop transition from the start to any block, in units of the cost."""
    worst = 1.0
    product = np.eye(problem.nx)
    for K, length in zip(gains, block_lengths(problem)):
        u = -K @ product
        for _ in range(length):
            product = problem.A @ product + problem.B @ u
        worst = max(worst, float(np.abs(product * sx[:, None] / sx).max()))
        if not np.isfinite(worst):
            return np.inf
    return worst
