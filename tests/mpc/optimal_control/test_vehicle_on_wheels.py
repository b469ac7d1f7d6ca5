"""A cart that cannot move sideways: at rest its linearisation cannot be stabilised, its plans need no regulator."""

import copy
import pickle

import casadi as ca
import numpy as np
import pytest
from differences import slopes
from nonlinear_programs import optimum

from mpc import NotStabilisableError, Status
from mpc.optimal_control import NonlinearMPC

Q, R, P = np.diag([1.0, 1.0, 0.1]), np.diag([0.1, 0.1]), np.diag([10.0, 10.0, 1.0])
FASTEST = np.array([1.0, 2.0])
UNITS = [(np.ones(3), np.ones(2), 1.0), (np.array([1e3, 1e3, 57.3]), np.array([3.6, 57.3]), 1e4)]


def rolled(x, u):
    """Speed and rate of turn, held for 0.1 s; position and heading."""
    return ca.vertcat(x[0] + 0.1 * u[0] * ca.cos(x[2]), x[1] + 0.1 * u[0] * ca.sin(x[2]), x[2] + 0.1 * u[1])


def law(sx=UNITS[0][0], su=UNITS[0][1], cost=1.0, P=P, **changes):
    """The controller in these units."""
    return NonlinearMPC(
        lambda x, u: sx * rolled(x / sx, u / su), 3, 2, horizon=20, U=(-FASTEST * su, FASTEST * su),
        Q=cost * Q / sx / sx[:, None], R=cost * R / su / su[:, None],
        P=None if P is None else cost * P / sx / sx[:, None], **changes,
    )  # fmt: skip


def plain(x, plan):
    """The optimum by Ipopt in SI units, begun near a plan."""
    columns = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    model = ca.Function("model", columns, [rolled(*columns)])
    return optimum(model, x, Q=Q, R=R, P=P, horizon=20, U=(-FASTEST, FASTEST), guess=plan)


@pytest.mark.parametrize(("sx", "su", "cost"), UNITS)
@pytest.mark.parametrize("x", [[-1.0, 0.5, 0.0], [1.0, 0.5, 0.3], [0.0, 0.5, 0.01], [-0.5, -1.0, 2.0]])
def test_plans_are_optima_although_there_is_no_regulator(x, sx, su, cost):
    plan = law(sx, su, cost).solve(sx * x)
    assert plan.status is Status.SOLVED
    best, inputs, _ = plain(np.array(x), (plan.states / sx, plan.inputs / su))
    assert plan.cost / cost == pytest.approx(best, rel=1e-6)
    assert plan.inputs / su == pytest.approx(inputs, abs=2e-4)


def test_derivatives_need_no_regulator_either():
    x = np.array([1.0, 0.5, 0.3])
    found = law().sensitivity(x)
    near = found.plan.states, found.plan.inputs
    assert found.smooth
    assert found.cost_by_state == pytest.approx(slopes(lambda y: plain(y, near)[0], x, [1e-4] * 3), rel=1e-5)
    expected = slopes(lambda y: plain(y, near)[1][0], x, [1e-4] * 3)
    assert found.input_by_state == pytest.approx(expected, abs=1e-4 * np.abs(expected).max())


def test_without_a_terminal_weight_it_says_what_to_do():
    with pytest.raises(NotStabilisableError, match="give P") as caught:
        law(P=None)
    assert caught.value.eigenvalue == pytest.approx(1.0)


def test_copies_answer_alike_and_remember_for_themselves():
    controller, x = law(), np.array([1.0, 0.5, 0.3])
    first = controller(x)
    stored = pickle.loads(pickle.dumps(controller))  # its model is a function within a function
    for other in (copy.copy(controller), copy.deepcopy(controller), stored):
        assert other.solve(x).inputs[0] == pytest.approx(first, abs=1e-6)
    before = controller.last_plans
    copy.copy(controller)(-x)
    assert controller.last_plans == before
    assert stored.last_plans[0].inputs == pytest.approx(before[0].inputs)
