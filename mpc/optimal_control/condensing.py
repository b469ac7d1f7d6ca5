"""Compiled elimination of the states of a linearised plan.

Save this file after a change in `tolerances.py`: numba's cache on disk does not notice it.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import njit

from mpc.checks import Array
from mpc.tolerances import ROUNDED_SUM


@cache
def compile_kernels() -> None:
    """Compile the kernels before a clock runs."""
    one, column = np.ones((1, 1, 1)), np.ones((1, 1))
    gains, _ = gains_along(one, one, column, column, column, column)
    responses(one, one, gains, column, np.ones(1))


@njit(cache=True)
def gains_along(A: Array, B: Array, Q: Array, R: Array, S: Array, P: Array) -> tuple[Array, Array]:
    """Gains (N, nu, nx) and prices of the regulator of dx⁺ = A dx + B du.

    A (N, nx, nx) and B (N, nx, nu); weights as of a quadratic cost x'Qx + 2 x'Su + u'Ru. With them what a deviation v
    from the regulator, du = v - K dx, costs at every step whatever the others: v'Mv, the M (N, nu, nu).
    """
    N, nx, nu = B.shape
    gains = np.zeros((N, nu, nx))
    prices = np.zeros((N, nu, nu))
    V = P.copy()
    for k in range(N - 1, -1, -1):
        M = R + B[k].T @ V @ B[k]
        slope = S.T + B[k].T @ V @ A[k]
        K = _divided(M, slope)
        V = Q + A[k].T @ V @ A[k] - slope.T @ K
        V = 0.5 * (V + V.T)
        gains[k] = K
        prices[k] = M
    return gains, prices


@njit(cache=True)
def responses(A: Array, B: Array, gains: Array, gaps: Array, first: Array) -> tuple[Array, Array, Array, Array]:
    """Responses (N + 1, nx, N nu), (N, nu, N nu) to v, du = v - K dx, and v = 0.

    `A` (N, nx, nx), `B` (N, nx, nu) and `gains` (N, nu, nx) are those along the plan; `gaps` (N, nx) are added to the
    next states, and dx_0 is `first` (nx,).
    """
    N, nx, nu = B.shape
    by_state = np.zeros((N + 1, nx, N * nu))
    by_input = np.zeros((N, nu, N * nu))
    states = np.zeros((N + 1, nx))
    inputs = np.zeros((N, nu))
    states[0] = first
    for k in range(N):
        for i in range(nu):
            for j in range(nx):
                inputs[k, i] -= gains[k, i, j] * states[k, j]
                for c in range(k * nu):
                    by_input[k, i, c] -= gains[k, i, j] * by_state[k, j, c]
            by_input[k, i, k * nu + i] = 1.0
        for i in range(nx):
            states[k + 1, i] = gaps[k, i]
            for j in range(nx):
                states[k + 1, i] += A[k, i, j] * states[k, j]
                for c in range(k * nu):
                    by_state[k + 1, i, c] += A[k, i, j] * by_state[k, j, c]
            for j in range(nu):
                states[k + 1, i] += B[k, i, j] * inputs[k, j]
                for c in range((k + 1) * nu):
                    by_state[k + 1, i, c] += B[k, i, j] * by_input[k, j, c]
    return by_state, by_input, states, inputs


@njit(cache=True)
def _divided(M: Array, right: Array) -> Array:
    """Product M⁻¹ right for M ⪰ 0 (nu, nu), in units in which its diagonal is one."""
    n = len(M)
    scale = np.zeros((n, 1))
    for i in range(n):
        scale[i, 0] = 1.0 / np.sqrt(M[i, i]) if M[i, i] > 0 else 0.0
    regular = M * scale * scale.T + ROUNDED_SUM * np.eye(n)
    return np.linalg.solve(regular, right * scale) * scale
