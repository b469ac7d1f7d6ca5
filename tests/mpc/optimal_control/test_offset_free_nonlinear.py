"""A wrong nonlinear model leaves an offset; an estimated disturbance removes it, and the target is a steady state."""

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import root

from mpc import InputError, LinearMPC, OffsetFreeMPC
from mpc.optimal_control import NonlinearMPC, OffsetFreeNonlinearMPC

UNITS = [(np.ones(2), 1.0, 1.0), (np.array([57.3, 57.3]), 1e3, 1e-4), (np.array([1e3, 3.6e6]), 1e-3, 1e6)]


def pendulum(x, u, mass=1.0, gravity=9.81, push=0.0):
    """A hanging pendulum with a torque, sampled at 50 ms."""

    def rate(z):
        return ca.vertcat(z[1], -gravity * ca.sin(z[0]) - 0.5 * z[1] + (4 * u + push) / mass)

    h = 0.05
    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))


def regulator(sx, su, cost, **changes):
    """MPC of the pendulum with its states and torque in other units."""
    return NonlinearMPC(
        lambda x, u: sx * pendulum(x / sx, u / su), 2, 1, horizon=15, U=(-4 * su, 4 * su),
        Q=cost * np.array([5.0, 0.1]) / sx**2, R=cost * 0.05 / su**2, **changes,
    )  # fmt: skip


def run(controller, plant, sx, su, steps=120, **names):
    """States (steps + 1, 2) in rad and rad/s."""
    x, u = np.zeros(2), np.zeros(1)
    states = [x]
    for _ in range(steps):
        u = controller(sx * x, **names, **({"u_prev": u} if "last_input" in controller.needs else {}))
        x = np.asarray(plant(x, u / su)).ravel()
        states.append(x)
    return np.array(states)


@pytest.mark.long
@pytest.mark.quick(5)
@pytest.mark.parametrize(("sx", "su", "cost"), UNITS)
@pytest.mark.parametrize("iterations", [None, 1])
@pytest.mark.parametrize(
    "wrong", [{"mass": 1.4}, {"gravity": 12.0}, {"push": 2.0}, {"mass": 0.8, "gravity": 8.0, "push": -1.0}],
    ids=["mass", "gravity", "force", "all of them"],
)  # fmt: skip
def test_a_wrong_model_leaves_no_offset(wrong, iterations, sx, su, cost):
    angle = 0.7
    law = regulator(sx, su, cost, iterations=iterations)

    def plant(x, u):
        return pendulum(x, u, **wrong)

    freed = run(OffsetFreeNonlinearMPC(law, [[1, 0]]).loop(), plant, sx, su, reference=[sx[0] * angle])
    assert freed[-1] == pytest.approx([angle, 0.0], abs=1e-6)
    holds = su * 9.81 * np.sin(angle) / 4
    left = run(law, plant, sx, su, x_ref=[sx[0] * angle, 0.0], u_ref=[holds])
    assert abs(left[-1, 0] - angle) > 0.01


def at_rest(x, u):
    """How far the model moves from a state, with 0.05 rad/s added in every sample."""
    return np.asarray(pendulum(x, u)).ravel() + np.array([0.0, 0.05]) - x


@pytest.mark.parametrize(("sx", "su", "cost"), UNITS)
@pytest.mark.parametrize("angle", [0.3, 1.2, -0.9])
def test_the_target_is_the_steady_state_of_the_model(angle, sx, su, cost):
    controller = OffsetFreeNonlinearMPC(regulator(sx, su, cost), [[1, 0]], disturbance=sx * [0.0, 0.05])
    rate, torque = root(lambda v: at_rest([angle, v[0]], v[1]), [0.0, 0.0]).x
    target = controller.nearest_target([sx[0] * angle])
    assert target.steady
    assert target.state / sx == pytest.approx([angle, rate], abs=1e-6)
    assert target.input[0] / su == pytest.approx(torque, abs=1e-6)


def test_a_reference_that_no_input_holds_gets_the_nearest_one():
    law = regulator(np.ones(2), 1.0, 1.0)
    weak = OffsetFreeNonlinearMPC(NonlinearMPC(law.step, 2, 1, Q=[5, 0.1], R=0.05, horizon=15, U=(-1, 1)), [[1, 0]])
    target = weak.nearest_target([1.5])
    assert target.steady
    assert target.state[0] == pytest.approx(np.arcsin(4 / 9.81), abs=1e-6)
    assert target.input[0] == pytest.approx(1.0)


@pytest.mark.long
@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("reference", "limits", "sx", "su"),
    [(0.27, {}, 1.0, 1.0), (0.27, {"X": 2.0}, 1e3, 1e-2), (0.3, {}, 1e-4, 3.6e3), (0.3, {"X": 2.0}, 1.0, 1.0),
     (1.0, {}, 1e3, 1e-2), (1.0, {"X": 2.0}, 1e-4, 3.6e3)],
)  # fmt: skip
def test_beyond_the_top_of_a_curve_of_steady_states_the_top_is_held(reference, limits, sx, su):
    def brewed(x, u):  # at rest x = u - u², at most 0.25
        return x + 0.1 * (-x + u - u**2)

    law = NonlinearMPC(
        lambda x, u: sx * brewed(x / sx, u / su), 1, 1, Q=1 / sx**2, R=0.01 / su**2, horizon=20, U=(-su, 3 * su),
        **{name: (-sx * value, sx * value) for name, value in limits.items()},
    )  # fmt: skip
    target = OffsetFreeNonlinearMPC(law, [[1]]).nearest_target([sx * reference])
    assert target.steady
    assert target.state / sx == pytest.approx([0.25], abs=1e-8)
    assert target.input / su == pytest.approx([0.5], abs=1e-4)
    loop, x, u = OffsetFreeNonlinearMPC(law, [[1]]).loop(), np.zeros(1), np.zeros(1)
    for _ in range(150):
        u = loop(sx * x, reference=[sx * reference], u_prev=u)
        x = brewed(x, u / su) + 0.001
    assert x == pytest.approx([0.26], abs=1e-6)  # which the disturbance of 0.01 raises


def test_on_a_linear_model_it_is_the_linear_one():
    A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]])
    weights = {"Q": [1.0, 0.1], "R": 0.1, "horizon": 12, "U": (-1, 1)}
    linear = OffsetFreeMPC(LinearMPC(A, B, E=np.eye(2), **weights), [[1, 0]])
    law = NonlinearMPC(lambda x, u: ca.DM(A) @ x + ca.DM(B) @ u, 2, 1, **weights)
    nonlinear = OffsetFreeNonlinearMPC(law, [[1, 0]])
    x = np.array([0.2, -0.1])
    for _ in range(20):
        u = nonlinear(x, [0.5])
        assert u == pytest.approx(linear(x, [0.5]), abs=1e-6)
        after = 0.98 * A @ x + B @ u + [0.0, 0.02]
        linear, nonlinear = linear.observe(x, u, after), nonlinear.observe(x, u, after)
        assert nonlinear.disturbance == pytest.approx(linear.disturbance, abs=1e-9)
        x = after


def test_runs_have_estimates_and_plans_of_their_own():
    law = OffsetFreeNonlinearMPC(regulator(np.ones(2), 1.0, 1.0), [[1, 0]])
    together, alone = law.loop(2), [law.loop(), law.loop()]
    x, u = np.array([[0.0, 0.0], [0.4, 0.2]]), np.zeros((2, 1))
    for _ in range(6):
        each = np.array([one(row, reference=[0.5], u_prev=last) for one, row, last in zip(alone, x, u)])
        u = together(x, reference=[0.5], u_prev=u)
        assert u == pytest.approx(each, abs=1e-6)
        x = np.array([np.asarray(pendulum(row, v, mass=1.3)).ravel() for row, v in zip(x, u)])


@pytest.mark.parametrize(
    ("arguments", "argument"),
    [({"mpc": 3}, "mpc"), ({"C": [[1, 0, 0]]}, "C"), ({"gain": 0}, "gain"), ({"disturbance": [1]}, "disturbance")],
)
def test_a_bad_statement_is_refused(arguments, argument):
    stated = {"mpc": regulator(np.ones(2), 1.0, 1.0), "C": [[1, 0]]} | arguments
    with pytest.raises(InputError) as caught:
        OffsetFreeNonlinearMPC(stated.pop("mpc"), stated.pop("C"), **stated)
    assert caught.value.argument == argument
