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
    gains, prices, rounded = gains_along(A, B, weights_along(N, *weights))
    assert (rounded < 1e-9 * np.diagonal(prices, axis1=1, axis2=2)).all()
    for _ in range(3):
        v = rng.normal(size=(N, nu)) / unit
        assert sum(m @ M @ m for m, M in zip(v, prices)) == pytest.approx(simulated(v, A, B, gains, weights), rel=1e-9)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
@pytest.mark.parametrize("growth", [0.8, 1.0, 1.3])
def test_prices_that_the_last_input_takes_away_leave_rounding_to_the_others(growth, unit):
    """Only the last state costs: one input meets it, whatever the others do."""
    N, nx = 20, 3
    rng = np.random.default_rng(0)
    A = growth * np.tile(np.linalg.qr(rng.normal(size=(nx, nx)))[0], (N, 1, 1))
    B = unit * np.tile(rng.normal(size=(nx, nx)), (N, 1, 1))
    none = np.zeros((nx, nx))
    _, prices, rounded = gains_along(A, B, weights_along(N, none, none, none, np.eye(nx)))
    known = np.diagonal(prices, axis1=1, axis2=2) > 2 * rounded
    assert known[-1].all()
    assert not known[:-1].any()
