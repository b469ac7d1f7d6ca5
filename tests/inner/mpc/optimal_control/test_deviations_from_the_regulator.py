"""Counted from the regulator along a plan, every move costs for itself: as simulated step by step."""

import numpy as np
import pytest

from mpc.optimal_control.condensing import gains_along
from mpc.optimal_control.quadratic_stages import weights_along


def simulated(v, A, B, gains, weights):
    """Cost of moves v (N, nu) from rest under du = v - K dx."""
    Q, R, S, P = weights
    x, cost = np.zeros(len(Q)), 0.0
    for Ak, Bk, K, move in zip(A, B, gains, v):
        u = move - K @ x
        cost += x @ Q @ x + u @ R @ u + 2 * x @ S @ u
        x = Ak @ x + Bk @ u
    return cost + x @ P @ x


@pytest.mark.parametrize("unit", [1.0, 1e4])
@pytest.mark.parametrize("S", [0.0, 0.1])
@pytest.mark.parametrize(("nx", "nu", "N", "radius"), [(1, 1, 1, 0.9), (2, 1, 6, 1.3), (6, 2, 12, 1.0), (3, 3, 2, 0.5)])
def test_what_a_move_costs_does_not_depend_on_the_others(nx, nu, N, radius, S, unit):
    rng = np.random.default_rng(nx)
    A, B = rng.normal(size=(N, nx, nx)), unit * rng.normal(size=(N, nx, nu))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    weights = np.eye(nx), unit**2 * np.eye(nu), np.full((nx, nu), S * unit), 2.0 * np.eye(nx)
    gains, prices = gains_along(A, B, weights_along(N, *weights))
    for _ in range(3):
        v = rng.normal(size=(N, nu)) / unit
        assert sum(m @ M @ m for m, M in zip(v, prices)) == pytest.approx(simulated(v, A, B, gains, weights), rel=1e-9)
