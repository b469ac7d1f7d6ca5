"""Derivatives of nonlinear MPC are those of a plain program solved by Ipopt, and on linear models of linear MPC."""

import casadi as ca
import numpy as np
import pytest
from differences import distance, slopes
from plain_program import PlainProgram
from scipy.optimize import brentq
from test_nonlinear_mpc import WEIGHTS, A, B, E, cart_pole, pole

from mpc import InputError, LinearMPC, SensitivityStatus, lqr
from mpc.optimal_control import NonlinearMPC

REQUIRED = 1e-5
FAR = np.inf


def riccati(step, nx, nu, p, Q, R):
    """The terminal weight of the linearisation at rest."""
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    after = step(x, u, p)
    pair = ca.Function("pair", [x, u], [ca.jacobian(after, x), ca.jacobian(after, u)])
    A, B = (np.asarray(M, dtype=float) for M in pair(np.zeros(nx), np.zeros(nu)))
    return lqr(A, B, Q=Q, R=R)[1]


def compared(found, plain, step, x, p, sizes, weights, part=1e-3):
    """Check cost and inputs by parameters and state against differences of the plain program."""
    nx, nu, count = sizes
    by_parameters = slopes(
        lambda q: plain(x, q, riccati(step, nx, nu, q, *weights), found.plan), p, part * np.maximum(np.abs(p), 0.1)
    )
    P = riccati(step, nx, nu, p, *weights)
    by_state = slopes(lambda y: plain(y, p, P, found.plan), x, np.full(nx, part))
    assert distance(found.cost_by_parameters, by_parameters[0]) < REQUIRED
    assert distance(found.inputs_by_parameters.reshape(-1, count), by_parameters[1:]) < REQUIRED
    assert distance(found.cost_by_state, by_state[0]) < REQUIRED
    assert distance(found.inputs_by_state.reshape(-1, nx), by_state[1:]) < REQUIRED


@pytest.mark.long
@pytest.mark.parametrize(
    ("x", "changes", "kinds"),
    [
        ([0.1, 0.4, 0, 0], {}, {"input"}),
        ([0.1, 1.2, 0, 0], {}, {"input"}),
        ([0.1, 0.3, 0, 0], {"X": ([-2, -4, -FAR, -1], [2, 4, FAR, 1])}, {"input", "state"}),
        ([0.5, 0.4, 0, 0], {"U": (-30, 30), "terminal_set": ([-0.05] * 4, [0.05] * 4)}, {"terminal"}),
    ],
    ids=["input", "through the hanging pole", "state", "terminal set"],
)
def test_derivatives_are_those_of_a_plain_program(x, changes, kinds):
    controller = pole(**changes)
    found = controller.sensitivity(x)
    assert found.smooth
    assert {label.kind for label in found.active} == kinds
    X, U = changes.get("X", ([-2, -4, -FAR, -FAR], [2, 4, FAR, FAR])), changes.get("U", (-10, 10))
    terminal = changes.get("terminal_set")
    weights = np.diag([1, 5, 0.1, 0.1]), np.array([[0.05]])
    plain = PlainProgram(cart_pole, (4, 1, 1), weights, 30, X, U, terminal)
    compared(found, plain, cart_pole, np.array(x, dtype=float), np.array([0.5]), (4, 1, 1), weights)


def duffing(length, force):
    """A mass on a hardening spring, two parameters, lengths and forces in other units."""

    def step(x, u, p):
        z = x / length
        pushed = u / force - p[0] * z[0] - p[1] * z[0] ** 3 - 0.2 * z[1] - 0.1 * z[1] * ca.fabs(z[1])
        return length * ca.vertcat(z[0] + 0.1 * z[1], z[1] + 0.1 * pushed)

    return step


@pytest.mark.parametrize(("length", "force"), [(1.0, 1.0), (1e3, 1e-3), (1e-3, 1e6)])
def test_units_do_not_matter(length, force):
    p = np.array([2.0, 5.0])
    x = np.array([0.8, -0.5])

    def made(sx, su):
        Q, R = np.diag([10.0, 1.0]) / sx**2, np.array([[0.1]]) / su**2
        limits = {"U": (-3 * su, 3 * su), "X": (np.array([-1, -1]) * sx, np.array([1, 1]) * sx)}
        return NonlinearMPC(duffing(sx, su), 2, 1, Q=Q, R=R, horizon=20, p=p, **limits).sensitivity(sx * x)

    plain, scaled = made(1.0, 1.0), made(length, force)
    assert {label.kind for label in plain.active} >= {"state"}
    assert list(scaled.active) == list(plain.active)
    assert distance(scaled.cost_by_parameters, plain.cost_by_parameters) < 1e-7
    assert distance(scaled.inputs_by_parameters / force, plain.inputs_by_parameters) < 1e-6
    assert distance(scaled.input_by_state * length / force, plain.input_by_state) < 1e-6
    weights = np.diag([10.0, 1.0]), np.array([[0.1]])
    step = duffing(1.0, 1.0)
    program = PlainProgram(step, (2, 1, 2), weights, 20, ([-1, -1], [1, 1]), (-3, 3))
    compared(plain, program, step, x, p, (2, 1, 2), weights, part=1e-4)


def linear_step(x, u, w, p):
    """The linear model, of which p moves A and B."""
    moved = ca.vertcat(ca.horzcat(1, 0.1 + p[0]), ca.horzcat(0.05, 1.1))
    return moved @ x + ca.DM(B) @ u * (1 + p[1]) + ca.DM(E) @ w


@pytest.mark.parametrize(
    ("limits", "signals"),
    [
        ({"U": (-1, 1), "X": ([-2, -0.3], [2, 0.3])}, {}),
        ({"U": (-1, 1), "rate_limit": 0.2}, {"u_prev": [0.3]}),
        ({"U": (-1, 1), "X": ([-2, -0.2], [2, 0.2]), "soft": (0.5, 20.0)}, {}),
        ({"U": (-1, 1)}, {"x_ref": [0.2, 0.0], "w": np.linspace(-0.2, 0.4, 12)[:, None]}),
        ({"U": (-1, 1), "S": [[0.05], [0.02]]}, {}),
    ],
    ids=["limits", "rate", "soft", "reference and preview", "cross weight"],
)
def test_on_a_linear_model_they_are_those_of_linear_mpc(limits, signals):
    x = np.array([0.4, -0.25])
    dA, dB = np.zeros((2, 2, 2)), np.zeros((2, 1, 2))
    dA[0, 1, 0], dB[:, :, 1] = 1.0, B
    linear = LinearMPC(A, B, E=E, **WEIGHTS, **limits).sensitivity(x, dA=dA, dB=dB, **signals)
    controller = NonlinearMPC(linear_step, 2, 1, disturbances=1, p=[0.0, 0.0], **WEIGHTS, **limits)
    found = controller.sensitivity(x, **signals)
    assert found.status is linear.status
    assert list(found.active) == list(linear.active)
    for name in ("cost_by_state", "cost_by_parameters", "inputs_by_state", "inputs_by_parameters", "states_by_state",
                 "inputs_by_last_input"):  # fmt: skip
        assert getattr(found, name) == pytest.approx(getattr(linear, name), rel=1e-7, abs=1e-8)


@pytest.mark.long
def test_the_real_time_iteration_has_the_derivatives_of_the_optimum():
    x = [0.1, 0.4, 0, 0]
    rate, converged = pole(iterations=1).sensitivity(x), pole().sensitivity(x)
    assert rate.smooth
    assert rate.cost_by_parameters == pytest.approx(converged.cost_by_parameters, rel=1e-9)


@pytest.mark.long
def test_other_parameters_need_no_new_model():
    controller = pole()
    x = [0.1, 0.4, 0, 0]
    moved = controller.with_parameters([0.6]).sensitivity(x)
    assert moved.cost_by_parameters == pytest.approx(pole(p=[0.6]).sensitivity(x).cost_by_parameters, rel=1e-9)


@pytest.mark.long
def test_weakly_active_constraints_are_flagged():
    def asked(t):
        return np.abs(free.solve([0.0, t, 0, 0]).inputs[0, 0]) - 5.0

    free = pole(U=(-500, 500), X=None)
    angle = brentq(asked, 0.05, 0.5, xtol=1e-15, rtol=1e-14)
    found = pole(U=(-5, 5), X=None).sensitivity([0.0, angle, 0, 0])
    assert found.status is SensitivityStatus.ONE_SIDED
    assert {label.step for label in found.weakly_active} == {0}
    one, other = (found.along(dx=[0, sign, 0, 0]) for sign in (1, -1))
    assert abs(one.inputs[0, 0]) < 1e-6 or abs(other.inputs[0, 0]) < 1e-6
    assert max(abs(one.inputs[0, 0]), abs(other.inputs[0, 0])) > 1.0
    assert one.cost == pytest.approx(-other.cost)


@pytest.mark.long
def test_plans_without_a_solution_have_no_derivatives_and_say_so():
    controller = pole(X=([-0.1, -0.1, -0.1, -0.1], [0.1, 0.1, 0.1, 0.1]))
    found = controller.sensitivity([0.0, 0.5, 0.0, 0.0])
    assert found.status is SensitivityStatus.UNSOLVED
    assert np.isnan(found.cost_by_parameters).all()


def test_bad_input_is_named():
    with pytest.raises(InputError, match=r"dQ: got shape \(4, 4, 2\), expected \(4, 4, 1\)"):
        pole().sensitivity([0.1, 0.4, 0, 0], dQ=np.zeros((4, 4, 2)))
    with pytest.raises(InputError, match="x: got nan"):
        pole().sensitivity([0.1, np.nan, 0, 0])
