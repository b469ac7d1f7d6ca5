"""The step of continuous dynamics over a sample, beside SciPy's integrators."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from mpc import InputError
from mpc.optimal_control import NonlinearMPC, Phase, build, sampled, solve

OSCILLATOR = np.array([[0.0, 1.0], [-40.0, -0.6]])


def oscillator(x, u):
    return ca.vertcat(x[1], -40 * x[0] - 0.6 * x[1] + 3 * u)


def stepped(step, *arguments):
    return np.array(ca.DM(step(*map(ca.DM, arguments)))).ravel()


def test_the_step_is_of_order_four():
    x, u, dt = np.array([0.3, -1.0]), 0.7, 0.2
    block = expm(np.block([[OSCILLATOR, np.array([[0.0], [3.0]])], [np.zeros((1, 3))]]) * dt)
    exact = block[:2, :2] @ x + block[:2, 2] * u
    errors = [np.abs(stepped(sampled(oscillator, dt, parts=parts), x, u) - exact).max() for parts in (16, 32, 64)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.2)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(4, abs=0.2)


def test_time_signals_and_parameters_are_held_or_run_as_they_should():
    def tank(t, x, p, w):  # in any order, as a list
        return [p[0] * ca.sin(3 * t) - p[1] * ca.sqrt(x[0]) + w[0], x[0] - x[1]]

    x, p, w = [2.0, 0.5], [0.4, 0.7], [0.3]
    exact = solve_ivp(
        lambda t, z: [p[0] * np.sin(3 * t) - p[1] * np.sqrt(z[0]) + w[0], z[0] - z[1]], (1.2, 1.7), x, rtol=1e-11,
        atol=1e-12,
    ).y[:, -1]  # fmt: skip
    assert stepped(sampled(tank, 0.5, parts=32), 1.2, x, p, w) == pytest.approx(exact, rel=1e-7)


def test_a_casadi_function_is_stepped_too():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    unnamed = ca.Function("f", [x, u], [oscillator(x, u)])
    named = ca.Function("f", [u, x], [oscillator(x, u)], ["u", "x"], ["rate"])
    expected = stepped(sampled(oscillator, 0.1), [0.3, -1.0], 0.7)
    assert stepped(sampled(unnamed, 0.1), [0.3, -1.0], 0.7) == pytest.approx(expected, rel=1e-15)
    assert stepped(sampled(named, 0.1), 0.7, [0.3, -1.0]) == pytest.approx(expected, rel=1e-15)


def test_nonlinear_mpc_and_discrete_phases_take_it():
    def pendulum(x, u, p):
        return ca.vertcat(x[1], -9.81 / p[0] * ca.sin(x[0]) + u)

    law = NonlinearMPC(
        sampled(pendulum, 0.05), 2, 1, Q=np.eye(2), R=[[0.1]], P=np.eye(2), horizon=20, U=(-3, 3), p=[0.8]
    )
    found = law.solve([0.6, 0.0])
    # the same program of a discrete phase, which Ipopt solves
    phase = Phase(
        dynamics=sampled(lambda x, u: pendulum(x, u, [0.8]), 0.05), states=2, inputs=1, discrete=True,
        start=[0.6, 0.0], duration=20, stage_cost=lambda x, u: ca.sumsqr(x) + 0.1 * u**2,
        terminal_cost=lambda x: ca.sumsqr(x), u_bounds=([-3], [3]),
    )  # fmt: skip
    discrete = solve(build(phase))
    assert found.cost == pytest.approx(discrete.cost, rel=1e-7)
    assert found.inputs[0] == pytest.approx(np.ravel(discrete.phases[0].inputs)[0], abs=1e-5)


def test_a_mistake_is_told_with_the_users_own_line():
    def wrong(x, u):
        return ca.vertcat(x[1], x[2] + u)  # of two states

    with pytest.raises(InputError, match=r"line \d+ of test_sampled.py"):
        NonlinearMPC(sampled(wrong, 0.1), 2, 1, Q=np.eye(2), R=[[1.0]], horizon=3)


@pytest.mark.parametrize(
    ("dynamics", "how", "argument"),
    [
        (lambda x, force: x, {}, "dynamics"), (lambda u: u, {}, "dynamics"), (3, {}, "dynamics"),
        (oscillator, {"dt": 0.0}, "dt"), (oscillator, {"dt": -1}, "dt"), (oscillator, {"dt": None}, "dt"),
        (oscillator, {"dt": np.nan}, "dt"), (oscillator, {"parts": 0}, "parts"),
    ],
)  # fmt: skip
def test_bad_statements_name_the_argument(dynamics, how, argument):
    with pytest.raises(InputError) as error:
        sampled(dynamics, **({"dt": 0.1} | how))
    assert error.value.argument == argument


def test_a_step_takes_what_a_function_of_its_arguments_takes():
    def clocked(x, u, t):
        return ca.vertcat(x[1], u * t)

    step, x = sampled(clocked, 0.1, parts=2), ca.DM([0.3, -1.0])
    here = stepped(step, x, 0.5, 2.0)
    np.testing.assert_array_equal(np.array(step(t=2.0, x=x, u=0.5)).ravel(), here)
    np.testing.assert_array_equal(stepped(sampled(clocked, 0.1, parts=2), x, 0.5, 2.0), here)
    with pytest.raises(TypeError, match="t"):
        step(x, 0.5)
