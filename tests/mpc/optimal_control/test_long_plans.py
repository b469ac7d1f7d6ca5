"""Plans over hundreds of steps."""

import tracemalloc

import casadi as ca
import numpy as np
import pytest

from mpc import Status
from mpc.optimal_control import NonlinearMPC, Phase


def pendulum(x, u):
    """Pendulum by its angle from upright, 20 ms."""
    rate = x[1] + 0.02 * (9.81 * ca.sin(x[0]) + u[0] - 0.1 * x[1])
    return ca.vertcat(x[0] + 0.02 * rate, rate)


def law_of(horizon, **stated):
    limits = {"X": ([-4, -0.7], [4, 0.7]), "U": ([-8.0], [8.0])}
    return NonlinearMPC(pendulum, 2, 1, Q=np.diag([1, 0.1]), R=[[0.01]], horizon=horizon, starts=1, **limits, **stated)


@pytest.mark.long
def test_memory_of_a_followed_plan_grows_with_its_length_not_with_its_square():
    peaks = []
    for horizon in (75, 300):
        law = law_of(horizon, iterations=1)
        x = np.array([0.5, 0.0])
        for _ in range(2):
            x = np.asarray(pendulum(x, law(x))).ravel()
        tracemalloc.start()
        law(x)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 6 * peaks[0]


@pytest.mark.long
@pytest.mark.parametrize("soft", [None, (2.0, 5.0)])
def test_long_plan_with_acting_limits_costs_what_ipopt_finds(soft):
    horizon, start = 150, np.array([0.6, 0.0])
    law = law_of(horizon, soft=soft)
    plan = law.solve(start)
    x, u, over = ca.MX.sym("x", 2, horizon + 1), ca.MX.sym("u", 1, horizon), ca.MX.sym("over", horizon)
    gaps = [x[:, 0] - start, *(x[:, k + 1] - pendulum(x[:, k], u[:, k]) for k in range(horizon))]
    cost = ca.sumsqr(x[0, :-1]) + 0.1 * ca.sumsqr(x[1, :-1]) + 0.01 * ca.sumsqr(u)
    cost += ca.bilin(ca.DM(np.asarray(law.linear.P)), x[:, -1], x[:, -1])
    cost += 0 if soft is None else soft[0] * ca.sum1(over) + soft[1] * ca.sumsqr(over)
    rows = [ca.vec(x[0, 1:]) / 4, ca.vec(x[1, 1:]) / 0.7]
    limits = [sign * row - 1 - over for row in rows for sign in (1, -1)]
    v, g = ca.vertcat(ca.vec(x), ca.vec(u), over), ca.vertcat(*gaps, *limits)
    options = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.tol": 1e-10}
    solver = ca.nlpsol("reference", "ipopt", {"x": v, "f": cost, "g": g}, options)
    most_over = 0.0 if soft is None else 9.0
    high = np.r_[np.full(2 * horizon + 2, np.inf), np.full(horizon, 8.0), np.full(horizon, most_over)]
    low = np.where(np.arange(len(high)) < len(high) - horizon, -high, 0.0)
    least = np.r_[np.zeros(2 * horizon + 2), np.full(4 * horizon, -np.inf)]
    found = solver(x0=np.r_[np.tile(start, horizon + 1), np.zeros(2 * horizon)], lbx=low, ubx=high, lbg=least, ubg=0)
    assert plan.status is Status.SOLVED
    assert np.sum(np.abs(plan.states[1:, 1]) > 0.7 - 1e-6) > 5
    assert plan.cost == pytest.approx(float(found["f"]), rel=1e-6)


def pole(x, u):
    """Cart of 1 kg with a pole of 0.2 kg and 0.5 m, 50 ms by the midpoint rule; angle from upright."""

    def rate(x):
        sine, cosine = ca.sin(x[2]), ca.cos(x[2])
        push = (u[0] + 0.1 * x[3] ** 2 * sine - 0.2 * 9.81 * sine * cosine) / (1 + 0.2 * sine**2)
        return ca.vertcat(x[1], push, x[3], (9.81 * sine - push * cosine) / 0.5)

    return x + 0.05 * rate(x + 0.025 * rate(x))


@pytest.mark.check
def test_plan_that_the_model_leaves_through_rounding_is_not_solved():
    size = np.array([0.829, 0.0753, 1e3, 2.021])
    law = NonlinearMPC(
        pole, 4, 1, Q=np.diag([0.559, 3.825, 3.291, 1.614]), R=[[0.018]], P=np.diag([1.201, 40.965, 85.98, 13.23]),
        horizon=60, X=(-size, size), U=([-0.999], [0.999]), rate_limit=[0.065], soft=(100.0, 10.0),
    )  # fmt: skip
    reference = np.tile([0.051, 0.025, -0.091, 0.064], (61, 1))
    plan = law.solve([-0.314, -0.031, 0.365, -1.103], x_ref=reference, u_prev=[0.0])
    x, u, over = ca.MX.sym("x", 4, 61), ca.MX.sym("u", 1, 60), ca.MX.sym("over", 60)
    error, units = x - reference.T, np.diag(1 / size)
    gaps = [x[:, 0] - plan.states[0], *(x[:, k + 1] - pole(x[:, k], u[:, k]) for k in range(60))]
    cost = sum(ca.sumsqr(ca.DM(np.sqrt(law.linear.Q)) @ error[:, k]) for k in range(60)) + 0.018 * ca.sumsqr(u)
    cost += ca.sumsqr(ca.DM(np.sqrt(law.linear.P)) @ error[:, 60]) + 100 * ca.sum1(over) + 10 * ca.sumsqr(over)
    limits = [sign * ca.DM(units) @ x[:, k + 1] - 1 - over[k] for k in range(60) for sign in (1, -1)]
    changes = [sign * (u - ca.horzcat(0, u[:, :-1])).T - 0.065 for sign in (1, -1)]
    v, g = ca.vertcat(ca.vec(x), ca.vec(u), over), ca.vertcat(*gaps, *limits, *changes)
    options = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.tol": 1e-9}
    solver = ca.nlpsol("reference", "ipopt", {"x": v, "f": cost, "g": g}, options | {"expand": True})
    high = np.r_[np.full(244, np.inf), np.full(60, 0.999), np.full(60, np.inf)]
    low = np.r_[-high[:304], np.zeros(60)]
    least = np.r_[np.zeros(244), np.full(600, -np.inf)]
    found = solver(
        x0=np.r_[plan.states.ravel(), plan.inputs.ravel(), np.zeros(60)], lbx=low, ubx=high, lbg=least, ubg=0
    )
    assert solver.stats()["success"]
    assert plan.status is not Status.SOLVED or plan.cost <= float(found["f"]) * (1 + 1e-5)


@pytest.mark.check
def test_a_rod_whose_inputs_hardly_pay_is_followed_by_programs():
    """Bounds that meet in one point let programs go in circles: every second sample was Ipopt's, 40 times as long."""
    n = 40

    def rate(x, u):
        flow = ca.vertcat(0, x[1:] - x[:-1], 0)
        heat = 0.2 * ca.vertcat(u[0], ca.DM.zeros(n - 2), u[1])
        return 0.4 * (flow[1:] - flow[:-1]) + heat - 2e-11 * ((x + 300) ** 4 - 300**4)

    def step(x, u):
        a = rate(x, u)
        b = rate(x + 0.25 * a, u)
        c = rate(x + 0.25 * b, u)
        return x + (a + 2 * b + 2 * c + rate(x + 0.5 * c, u)) / 12

    phase = Phase(
        step, n, 2, discrete=True, duration=50, x_bounds=(-50, 400), u_bounds=([0, 0], [200, 60]),
        stage_cost=lambda x, u: 1e-3 * (x[n // 2] - 120) ** 2 + 1e-3 * ca.sumsqr(u) + 1e-6 * ca.sumsqr(x),
    )  # fmt: skip
    controller, x = NonlinearMPC(phase, starts=1), np.zeros(n)
    solvers = []
    for _ in range(4):
        controller(x)
        (plan,) = controller.last_plans
        x = np.array(step(ca.DM(x), ca.DM(plan.inputs[0]))).ravel()
        solvers.append(plan.solver)
    assert solvers == ["Ipopt", "SQP", "SQP", "SQP"]
