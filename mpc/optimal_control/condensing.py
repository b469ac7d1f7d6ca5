"""Compiled passes along a linearised plan.

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
    gains, *_ = gains_along(one, one, np.ones((2, 2, 2)), False)
    gains_along(one, one, np.ones((2, 2, 2)))
    moved(one, one, gains, column, np.ones(1), one)
    pulled(one, one, gains, np.ones((1, 2, 1)), one)


@njit(cache=True)
def gains_along(A: Array, B: Array, weights: Array, rounding: bool = True) -> tuple[Array, Array, Array]:
    """Gains (N, nu, nx) and prices of the regulator of dx⁺ = A dx + B du.

    A (N, nx, nx) and B (N, nx, nu); the weights (N + 1, nx + nu, nx + nu) are [Q S; S' R] of every step and P of the
    end. With them what a deviation v from the regulator, du = v - K dx, costs at every step whatever the others: v'Mv,
    the M (N, nu, nu), whose diagonals are known to (N, nu), if asked: prices of states are rounded where inputs take
    them away.
    """
    N, nx, nu = B.shape
    gains = np.zeros((N, nu, nx))
    prices = np.zeros((N, nu, nu))
    V = weights[N, :nx, :nx].copy()
    rounded = np.zeros((N, nu))
    error = np.zeros((nx, nx))  # of V, as a positive semidefinite matrix
    both = np.zeros((nx, nx + nu))
    for k in range(N - 1, -1, -1):
        both[:, :nx] = A[k]
        both[:, nx:] = B[k]
        M = weights[k] + both.T @ (V @ both)
        prices[k] = M[nx:, nx:]
        slope = np.ascontiguousarray(M[nx:, :nx])
        gains[k] = _divided(prices[k], slope)
        V = M[:nx, :nx] - slope.T @ gains[k]
        V = 0.5 * (V + V.T)
        if not rounding:
            continue
        rounded[k] = np.diag(B[k].T @ (error @ B[k]))
        closed = A[k] - B[k] @ gains[k]
        sums = np.abs(np.diag(M))
        own = np.diag(sums[:nx]) + gains[k].T @ (np.diag(sums[nx:]) @ gains[k])  # `_divided` adds as much to prices
        error = closed.T @ (error @ closed) + ROUNDED_SUM * own
    return gains, prices, rounded


@njit(cache=True)
def moved(A: Array, B: Array, gains: Array, gaps: Array, first: Array, v: Array) -> tuple[Array, Array]:
    """Moves of states and inputs under du = v - K dx.

    They are (c, N + 1, nx) and (c, N, nu), for c sequences v (c, N, nu). `A` (N, nx, nx), `B` (N, nx, nu) and `gains`
    (N, nu, nx) are those along the plan; `gaps` (N, nx) are added to the next states, and dx_0 is `first` (nx,).
    """
    N, nx, nu = B.shape
    states = np.zeros((len(v), N + 1, nx))
    inputs = v.copy()
    for c in range(len(v)):
        states[c, 0] = first
        for k in range(N):
            for i in range(nu):
                for j in range(nx):
                    inputs[c, k, i] -= gains[k, i, j] * states[c, k, j]
            for i in range(nx):
                after = gaps[k, i]
                for j in range(nx):
                    after += A[k, i, j] * states[c, k, j]
                for j in range(nu):
                    after += B[k, i, j] * inputs[c, k, j]
                states[c, k + 1, i] = after
    return states, inputs


@njit(cache=True)
def pulled(A: Array, B: Array, gains: Array, by_state: Array, by_input: Array) -> tuple[Array, Array]:
    """Slopes (c, N, nu) by v of functions of the moves, and their costates (c, N + 1, nx).

    Their slopes by the moves of `moved` are (c, N + 1, nx) and (c, N, nu).
    """
    N, nx, nu = B.shape
    slopes = by_input.copy()
    costates = by_state.copy()
    for c in range(len(slopes)):
        for k in range(N - 1, -1, -1):
            for i in range(nx):
                costate = costates[c, k + 1, i]
                if costate != 0.0:
                    for j in range(nu):
                        slopes[c, k, j] += B[k, i, j] * costate
                    for j in range(nx):
                        costates[c, k, j] += A[k, i, j] * costate
            for i in range(nu):
                for j in range(nx):
                    costates[c, k, j] -= gains[k, i, j] * slopes[c, k, i]
    return slopes, costates


@njit(cache=True)
def _divided(M: Array, right: Array) -> Array:
    """Product M⁻¹ right for M ⪰ 0 (nu, nu), in units in which its diagonal is one."""
    n = len(M)
    scale = np.zeros((n, 1))
    for i in range(n):
        scale[i, 0] = 1.0 / np.sqrt(M[i, i]) if M[i, i] > 0 else 0.0
    regular = M * scale * scale.T + ROUNDED_SUM * np.eye(n)
    return np.linalg.solve(regular, right * scale) * scale
