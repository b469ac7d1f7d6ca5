"""Compiled elimination of the states of a linearised plan.

Save this file after a change in `tolerances.py`: numba's cache on disk does not notice it.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import njit

from mpc.checks import Array
from mpc.tolerances import GAIN_REGULARISATION


@cache
def compile_kernels() -> None:
    """Compile the kernels before a clock runs."""
    one, column = np.ones((1, 1, 1)), np.ones((1, 1))
    gains, _ = gains_along(one, one, column, column, column, column)
    responses(one, one, gains, column, np.ones(1))
    costates_along(one, one, gains, np.ones((2, 1)), column)


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
        VA, VB = _product(V, A[k]), _product(V, B[k])
        Bt = np.ascontiguousarray(B[k].T)
        M = R + _product(Bt, VB)
        slope = np.ascontiguousarray(S.T) + _product(Bt, VA)
        K = _divided(M, slope)
        V = Q + _product(np.ascontiguousarray(A[k].T), VA) - _product(np.ascontiguousarray(slope.T), K)
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
def costates_along(A: Array, B: Array, gains: Array, by_state: Array, by_input: Array) -> Array:
    """Costates (N + 1, nx) from slopes by states (N + 1, nx) and inputs (N, nu).

    Backwards along the closed loop: what the inputs' slopes leave, zero at an optimum, keeps the digits.
    """
    N, nx, nu = B.shape
    found = np.zeros((N + 1, nx))
    found[N] = by_state[N]
    for k in range(N - 1, -1, -1):
        for i in range(nx):
            found[k, i] = by_state[k, i]
            for j in range(nx):
                found[k, i] += A[k, j, i] * found[k + 1, j]
        for i in range(nu):
            left = by_input[k, i]
            for j in range(nx):
                left += B[k, j, i] * found[k + 1, j]
            for j in range(nx):
                found[k, j] -= gains[k, i, j] * left
    return found


@njit(cache=True)
def _product(M: Array, L: Array) -> Array:
    """Matrix product of small matrices."""
    found = np.zeros((M.shape[0], L.shape[1]))
    for i in range(M.shape[0]):
        for j in range(M.shape[1]):
            for k in range(L.shape[1]):
                found[i, k] += M[i, j] * L[j, k]
    return found


@njit(cache=True)
def _divided(M: Array, right: Array) -> Array:
    """Product M⁻¹ right for M ⪰ 0 (nu, nu), by scaled Cholesky."""
    n = len(M)
    scale = np.zeros(n)
    for i in range(n):
        scale[i] = 1.0 / np.sqrt(M[i, i]) if M[i, i] > 0 else 0.0
    L = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            left = M[i, j] * scale[i] * scale[j] + (GAIN_REGULARISATION if i == j else 0.0)
            for k in range(j):
                left -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(max(left, GAIN_REGULARISATION)) if i == j else left / L[j, j]
    found = np.zeros(right.shape)
    for i in range(n):
        found[i] = right[i] * scale[i]
        for k in range(i):
            found[i] -= L[i, k] * found[k]
        found[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            found[i] -= L[k, i] * found[k]
        found[i] /= L[i, i]
    for i in range(n):
        found[i] *= scale[i]
    return found
