"""Transcriptions converge as fast as theory says, in cost and costates."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mpc.optimal_control import HermiteSimpson, MultipleShooting, Phase, Radau, Trapezoidal, build, solve

A = np.array([[0.0, 1.0], [-1.0, 0.5]])
B = np.array([[0.0], [1.0]])
START = np.array([1.0, 0.5])
SMOOTH = Phase(
    dynamics=lambda x, u: ca.DM(A) @ x + ca.DM(B) @ u,
    states=2,
    inputs=1,
    stage_cost=lambda x, u: (ca.sumsqr(x) + u**2) / 2,
    terminal_cost=lambda x: ca.sumsqr(x),
    start=START,
    duration=2.0,
)


@pytest.fixture(scope="module")
def riccati():
    """Cost and costate at the start, by the Riccati equation."""

    def backwards(_, flat):
        S = flat.reshape(2, 2)
        return (S @ A + A.T @ S - S @ B @ B.T @ S + np.eye(2)).ravel()

    end = solve_ivp(backwards, [0, 2], 2 * np.eye(2).ravel(), rtol=1e-13, atol=1e-14, method="DOP853").y[:, -1]
    S = end.reshape(2, 2)
    return 0.5 * START @ S @ START, S @ START


@pytest.mark.parametrize(
    ("scheme", "order", "intervals"),
    [
        (Trapezoidal(), 2, (32, 64)),
        (HermiteSimpson(), 4, (8, 16)),
        (Radau(1), 1, (64, 128)),
        (Radau(2), 3, (8, 16)),
        (Radau(3), 5, (4, 8)),
        (Radau(4), 7, (4, 8)),
        (MultipleShooting(), 2, (16, 32)),  # of inputs that are held; its integrator has order 4
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_cost_and_costate_converge_with_the_order_of_the_scheme(riccati, scheme, order, intervals):
    cost, costate = riccati
    found = [solve(build(SMOOTH, scheme, n), tolerance=1e-12) for n in intervals]
    assert all(solution.solved_on_mesh for solution in found)
    of_cost = [abs(solution.cost - cost) for solution in found]
    of_costate = [np.abs(solution.phases[0].costates[0] - costate).max() for solution in found]
    assert np.log2(of_cost[0] / of_cost[1]) == pytest.approx(order, abs=0.2)
    assert np.log2(of_costate[0] / of_costate[1]) == pytest.approx(order, abs=0.2)


@pytest.mark.check
@pytest.mark.parametrize("substeps", [1, 2])
def test_runge_kutta_in_shooting_has_order_four(substeps):
    exact = solve(build(SMOOTH, MultipleShooting(integrator="cvodes", tolerance=1e-12), 8), tolerance=1e-12)
    errors = [
        abs(solve(build(SMOOTH, MultipleShooting(substeps=s), 8), tolerance=1e-12).cost - exact.cost)
        for s in (substeps, 2 * substeps)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.2)


def test_what_a_mesh_is_said_to_miss_bounds_what_its_plan_misses():
    for scheme, intervals in ((Trapezoidal(), 40), (HermiteSimpson(), 10), (Radau(3), 6)):
        solution = solve(build(SMOOTH, scheme, intervals))
        times = solution.times
        for k, said in enumerate(solution.errors[0]):
            drive = lambda t, x, s=solution: A @ x + B @ s.u(t)  # noqa: E731
            met = solve_ivp(drive, times[k : k + 2], solution.phases[0].states[k], rtol=1e-11, atol=1e-12).y[:, -1]
            missed = np.abs(met - solution.phases[0].states[k + 1]) / np.abs(solution.phases[0].states).max(axis=0)
            assert missed.max() <= 1.1 * said + 1e-9
