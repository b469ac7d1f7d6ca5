"""The Hessian that an optimum carries to the next sample is the Lagrangian's, by CasADi."""

import casadi as ca
import numpy as np
import pytest

from mpc import Status
from mpc.optimal_control import NonlinearMPC, Phase

N, START = 20, np.array([2.0, 0.0])


def swing(x, u):
    return ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * (3 * ca.sin(x[0]) + u - 0.2 * x[1] * u))


def by_weights():
    return NonlinearMPC(swing, 2, 1, Q=np.diag([2.0, 0.1]), R=[[0.3]], P=np.diag([5.0, 1.0]), horizon=N, U=(-4, 4))


def by_phase():
    return NonlinearMPC(Phase(
        swing, 2, 1, discrete=True, duration=N, u_bounds=(-4, 4),
        stage_cost=lambda x, u: 2 * x[0] ** 2 + 0.1 * x[1] ** 2 + 0.3 * u**2,
        terminal_cost=lambda x: 5 * x[0] ** 2 + x[1] ** 2,
    ))  # fmt: skip


@pytest.mark.parametrize("made", [by_weights, by_phase])
def test_the_hessian_of_an_optimum_is_the_lagrangians(made):
    controller = made()
    u = controller(START)
    controller(np.asarray(swing(START, u)).ravel() + np.array([0.01, -0.02]))
    (plan,) = controller.last_plans
    assert plan.status is Status.SOLVED
    x, u, costate = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("costate", 2)
    cost = 2 * x[0] ** 2 + 0.1 * x[1] ** 2 + 0.3 * u**2
    bent, _ = ca.hessian(cost + ca.dot(costate, swing(x, u)), ca.vertcat(x, u))
    stage = ca.Function("stage", [x, u, costate], [bent])
    each = [np.asarray(stage(*point)) for point in zip(plan.states, plan.inputs, plan.costates)]
    assert np.abs(plan.hessian[:-1] - each).max() < 1e-3 * np.abs(each).max()
    assert plan.hessian[-1] == pytest.approx(np.diag([10.0, 2.0, 0.0]))
    with pytest.raises(ValueError, match="read-only"):
        plan.hessian[0] = 0.0


@pytest.mark.parametrize("made", [by_weights, by_phase])
@pytest.mark.parametrize("size", [-1.0, 0.0, 100.0])
def test_a_wrong_one_is_taken_for_no_other_optimum(made, size):
    controller = made()
    controller(START)
    first = controller.last_plans[0]
    object.__setattr__(first, "hessian", size * np.tile(np.eye(3), (N + 1, 1, 1)))
    after = np.asarray(swing(START, first.inputs[0])).ravel() + np.array([0.05, 0.1])
    controller(after)
    (plan,) = controller.last_plans
    assert plan.status is Status.SOLVED
    assert plan.cost == pytest.approx(made().solve(after).cost, rel=1e-7)


def test_it_is_not_carried_where_a_signal_may_change_it():
    """A cost by a signal that falls from 1e6 to 1 was SOLVED at 0.4 % above the optimum."""
    phase = Phase(
        lambda x, u: swing(x, u), 2, 1, discrete=True, duration=N, u_bounds=(-3, 3), signal=np.ones((N + 1, 1)),
        stage_cost=lambda x, u, w: w * (ca.sumsqr(x) + 0.1 * u**2), terminal_cost=lambda x, w: 5 * w * ca.sumsqr(x),
    )  # fmt: skip
    controller, x = NonlinearMPC(phase, uses=("preview",)), START
    for size in (1e6, 1e6, 1.0):
        controller(x, w=[size])
        now, x = x, controller.last_plans[0].states[1]
    (plan,) = controller.last_plans
    assert plan.hessian is None
    assert plan.cost == pytest.approx(NonlinearMPC(phase).solve(now, w=[1.0]).cost, rel=1e-7)


def test_multipliers_of_another_statement_are_not_begun_with():
    signal = Phase(
        lambda x, u, w: swing(x, u) + ca.vertcat(0, 0.1 * w), 2, 1, discrete=True, duration=N, u_bounds=(-4, 4),
        signal=np.zeros((N + 1, 1)), stage_cost=lambda x, u: ca.sumsqr(x) + u**2,
    )  # fmt: skip
    start = by_weights()
    start(START)
    start(START)
    for law in (NonlinearMPC(signal), by_phase()):
        assert law.solve(START, start=start.last_plans[0]).cost == pytest.approx(law.solve(START).cost, rel=1e-7)
