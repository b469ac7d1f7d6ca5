"""Loops whose programs are linear: their plans cost what linear programming says."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import linprog

from mpc import InputError
from mpc.optimal_control import NonlinearMPC, Phase

SAMPLES = 24


def programs(a, B, c, price, N, x_bounds, u_bounds):
    """Least cost of a sample from x, by HiGHS, for x⁺ = a x + B u + c[k] and the price of inputs (N, m) from k on."""
    m = len(B)
    reached = np.zeros((N, N * m))
    for i in range(N):
        reached[i] = a * reached[i - 1] if i else 0
        reached[i, i * m : (i + 1) * m] += B

    def least(k, x):
        free = np.zeros(N)
        for i in range(N):
            free[i] = a * (free[i - 1] if i else x) + c[k + i]
        rows, sides = np.vstack([reached, -reached]), np.append(x_bounds[1] - free, free - x_bounds[0])
        found = linprog(price[k : k + N].ravel(), rows, sides, bounds=u_bounds)
        return found.fun if found.status == 0 else None

    return least


@pytest.mark.parametrize(("N", "most", "seed"), [(24, 4, 0), (12, 3, 0), (24, 3, 1)])
def test_a_house_heated_at_known_prices_costs_the_least(N, most, seed):
    """Samples were SOLVED up to 8 % above it: Hessians were rounding, limits that push not met."""
    a, n = np.exp(-1 / 30), np.arange(SAMPLES + N + 2)
    price = 0.2 + 0.15 * np.sin(2 * np.pi * n / 24) + 0.05 * np.random.default_rng(seed).random(len(n))
    outside = 5 + 5 * np.sin(2 * np.pi * n / 24 - 2)
    w = np.column_stack([price, outside])
    law = NonlinearMPC(Phase(
        lambda x, u, w: a * x + (1 - a) * (w[1] + 8 * u), 1, 1, discrete=True, duration=N, u_bounds=(0, most),
        x_bounds=(19, 23), stage_cost=lambda u, w: w[0] * u, signal=w[: N + 1],
    ))  # fmt: skip
    least = programs(a, [8 * (1 - a)], (1 - a) * outside, price[:, None], N, (19, 23), (0, most))
    x = np.array([20.0])
    for k in range(SAMPLES):
        u = law(x, w=w[k : k + N + 1])
        plan = law.last_plans[0]
        assert plan.status.name == "SOLVED"
        assert plan.cost == pytest.approx(least(k, x[0]), rel=1e-5)
        x = a * x + (1 - a) * (outside[k] + 8 * u)


@pytest.mark.parametrize("size", [1, 1000])
def test_a_battery_that_trades_at_known_prices_earns_the_most(size):
    N, n = 24, np.arange(SAMPLES + 26)
    price = 60 + 30 * np.sin(2 * np.pi * n / 24) + 10 * np.random.default_rng(0).normal(size=len(n))
    law = NonlinearMPC(Phase(
        lambda x, u: x + 0.95 * u[0] - u[1] / 0.95, 1, 2, discrete=True, duration=N, u_bounds=(0, 50 * size),
        x_bounds=(0, 200 * size), stage_cost=lambda u, w: w * (u[0] - u[1]) / 1e3, signal=price[: N + 1, None],
    ))  # fmt: skip
    trades = np.column_stack([price, -price]) / 1e3
    least = programs(1.0, [0.95, -1 / 0.95], 0 * price, trades, N, (0, 200 * size), (0, 50 * size))
    x = np.array([100.0 * size])
    for k in range(SAMPLES):
        u = law(x, w=price[k : k + N + 1, None])
        plan = law.last_plans[0]
        assert plan.status.name == "SOLVED"
        assert plan.cost == pytest.approx(least(k, x[0]), rel=1e-5)
        x = np.clip(x + 0.95 * u[0] - u[1] / 0.95, 0, 200 * size)


@pytest.mark.parametrize(("seed", "priced"), [(7, False), (50, True), (97, True)])
def test_states_held_in_a_band_by_slacks_cost_the_least(seed, priced):
    """In random units; one fails where limits that pull, that push unmet, or stand-ins count for nothing."""
    rng = np.random.default_rng(seed)
    nx, nu = rng.integers(1, 4), rng.integers(1, 3)
    N = int(rng.integers(8, 25))
    A = rng.normal(size=(nx, nx))
    A *= rng.choice([0.8, 0.95, 1.0]) / max(abs(np.linalg.eigvals(A)))
    B = rng.normal(size=(nx, nu))
    rng.choice(5)
    of_x, of_u, of_cost = 10 ** rng.uniform(-3, 3, nx), 10 ** rng.uniform(-3, 3, nu), 10 ** rng.uniform(-2, 4)
    wide = rng.choice([1.0, 10.0, 100.0])
    by_state, by_input = rng.normal(size=nx) * (rng.random(nx) < 0.5), np.abs(rng.normal(size=nu)) / 2
    rng.normal(size=nx), rng.random(nx), rng.normal(size=nx), rng.uniform(size=14 + N)
    band, weight = (0.7, 10) if priced else (0.3, 20)
    prices = of_cost * np.concatenate([by_state * priced, by_input, np.full(nx, weight)])
    law = NonlinearMPC(Phase(
        lambda x, u: (of_x[:, None] * A / of_x) @ x + (of_x[:, None] * B / of_u) @ u[:nu], nx, nu + nx, discrete=True,
        duration=N, x_bounds=(-wide * of_x, wide * of_x),
        u_bounds=(np.append(-of_u, np.zeros(nx)), np.append(of_u, np.full(nx, 10 * wide))),
        stage_cost=lambda x, u: ca.dot(prices, ca.vertcat(x / of_x, u[:nu] / of_u, u[nu:])),
        path=lambda x, u: ca.vertcat(x / of_x - band - u[nu:], -band - x / of_x - u[nu:]),
    ))  # fmt: skip

    def least(x):
        """Least cost from x, in units of 1."""
        m = nu + nx
        moved = np.zeros((N + 1, nx, N * m))
        free = [x]
        for k in range(N):
            moved[k + 1] = A @ moved[k]
            moved[k + 1][:, k * m : k * m + nu] += B
            free.append(A @ free[-1])
        slack = np.zeros((N, nx, N * m))
        for k in range(N):
            slack[k, :, k * m + nu : (k + 1) * m] = np.eye(nx)
        rows = [(moved[:-1] - slack, band - np.array(free[:-1])), (-moved[:-1] - slack, band + np.array(free[:-1])),
                (moved[1:], wide - np.array(free[1:])), (-moved[1:], wide + np.array(free[1:]))]  # fmt: skip
        slopes = np.tile(prices[nx:], N) + np.tensordot(prices[:nx], moved[:-1].sum(axis=0), 1)
        bounds = np.tile(np.column_stack([[-1.0] * nu + [0.0] * nx, [1.0] * nu + [10 * wide] * nx]), (N, 1))
        found = linprog(slopes, np.vstack([a.reshape(-1, N * m) for a, _ in rows]),
                        np.concatenate([b.ravel() for _, b in rows]), bounds=bounds)  # fmt: skip
        return found.fun + prices[:nx] @ np.sum(free[:-1], axis=0)

    x = rng.uniform(-1, 1, nx) * rng.choice([0.5, 0.9])
    for _ in range(8):
        u = law(of_x * x)
        plan = law.last_plans[0]
        assert plan.status.name == "SOLVED"
        assert plan.cost == pytest.approx(least(x), rel=1e-5, abs=1e-8 * of_cost * N)
        x = np.clip(A @ x + B @ (u[:nu] / of_u) + 0.01 * rng.normal(size=nx), -0.95 * wide, 0.95 * wide)


def swing(x, u):
    """A pendulum, by Euler's rule."""
    return ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * (u - ca.sin(x[0])))


@pytest.mark.parametrize(
    "cost", [lambda x, u: u, lambda x, u: u + 0.1 * x[0], lambda x: -x[0], lambda u: -ca.sqrt(1 + u**2)]
)
def test_a_cost_that_falls_without_end_is_an_error_until_inputs_have_bounds(cost):
    free = Phase(swing, 2, 1, discrete=True, duration=10, stage_cost=cost)
    with pytest.raises(InputError, match="stage_cost: got a cost that falls without end") as caught:
        NonlinearMPC(free)([1.0, 1.0])
    assert "Bound states and inputs" in str(caught.value)
    law = NonlinearMPC(replace(free, u_bounds=(-1, 1)))
    law([1.0, 1.0])
    assert law.last_plans[0].status.name == "SOLVED"


@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize(
    ("model", "cost", "least"),
    [(lambda x, u: x + ca.tanh(1e-7 * u), lambda x: (x - 1e3) ** 2, 0),
     (lambda x, u: x + 0.1 * (u - ca.sin(x)), lambda x, u: -x + 1e-12 * u**2, -np.inf),
     (lambda x, u: x + 1e-4 * u / ca.sqrt(1 + 1e-8 * u**2), lambda x: 1 / (1 + x**2), -np.inf)],
    ids=["saturated", "cheap inputs", "saturated and flat"],
)  # fmt: skip
def test_a_cost_with_an_end_is_no_error_where_iterations_are_few(model, cost, least, iterations):
    free = Phase(model, 1, 1, discrete=True, duration=10, stage_cost=cost, u_bounds=(least, np.inf))
    law = NonlinearMPC(free, most_iterations=iterations)
    assert np.isfinite(law([3.0])).all()
