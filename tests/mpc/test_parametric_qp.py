"""The QP as an object: its layout, its labels, and what can be done with it."""

import numpy as np
import pytest
from plants import SUSPENSION, box, double_integrator, suspension

from mpc import InputError, LinearMPC


@pytest.fixture
def mpc():
    A, B, E = suspension()
    return LinearMPC(A, B, E=E, horizon=4, **SUSPENSION)


def test_labels_say_where_every_row_comes_from(mpc):
    qp = mpc.build()
    assert qp.m == len(qp.labels) == 4 * (2 + 8)
    assert qp.labels[0] == ("input", 0, 0)
    assert {label.step for label in qp.labels if label.kind == "state"} == {1, 2, 3, 4}
    assert str(qp.labels[2]) == "state constraint 0 at step 1"


def test_cost_and_sequences_are_those_of_the_model(mpc):
    qp, rng = mpc.build("x_ref", "u_ref", "w"), np.random.default_rng(0)
    assert [name for name, _ in qp.parameters] == ["x", "x_ref", "u_ref", "w"]
    x, x_ref, u_ref, w = rng.normal(size=4), rng.normal(size=(5, 4)), rng.normal(size=(4, 1)), rng.normal(size=(4, 1))
    theta, z = qp.theta(x=x, x_ref=x_ref, u_ref=u_ref, w=w), rng.normal(size=4)
    states, inputs = [x], qp.inputs(z, theta)
    for u, wk in zip(inputs, w):
        states.append(mpc.A @ states[-1] + mpc.B @ u + mpc.E @ wk)
    np.testing.assert_allclose(qp.states(z, theta), states)
    error, effort = np.array(states) - x_ref, inputs - u_ref
    cost = sum(e @ mpc.Q @ e for e in error[:-1]) + error[-1] @ mpc.P @ error[-1] + 1e-6 * np.sum(effort**2)
    assert qp.cost(z, theta) == pytest.approx(cost)
    rows = np.concatenate([np.concatenate([mpc.U.A @ u - mpc.U.b, mpc.X.A @ s - mpc.X.b])
                           for u, s in zip(inputs, states[1:])])  # fmt: skip
    np.testing.assert_allclose(qp.G @ z - qp.w - qp.S @ theta, rows, atol=1e-9)


def test_fixing_parameters_changes_nothing_but_the_layout(mpc):
    qp, rng = mpc.build("x_ref", "w"), np.random.default_rng(1)
    x, x_ref, w, z = rng.normal(size=4), rng.normal(size=(5, 4)), rng.normal(size=(4, 1)), rng.normal(size=4)
    theta = qp.theta(x=x, x_ref=x_ref, w=w)
    fixed = qp.fix(x_ref=x_ref, w=w)
    assert fixed.parameters == (("x", 4),)
    assert fixed.cost(z, x) == pytest.approx(qp.cost(z, theta))
    for a, b in zip(fixed.at(x), qp.at(theta)):
        np.testing.assert_allclose(a, b)
    np.testing.assert_allclose(fixed.states(z, x), qp.states(z, theta))


def test_is_read_only(mpc):
    with pytest.raises(ValueError, match="read-only"):
        mpc.build().H[0, 0] = 1.0
    with pytest.raises(AttributeError):
        mpc.build().nu = 2
    with pytest.raises(AttributeError):
        mpc.horizon = 3


def test_long_unstable_horizons_keep_a_good_condition():
    A, B = np.array([[1.5, 0.3], [0.0, 1.3]]), np.array([[0.0], [1.0]])
    qp = LinearMPC(A, B, Q=np.eye(2), R=[[1.0]], horizon=60, U=box([1.0])).build()
    assert np.linalg.cond(qp.H) < 1e3
    theta, z = np.array([0.1, -0.2]), np.random.default_rng(2).normal(size=60)
    inputs, states = qp.inputs(z, theta), qp.states(z, theta)
    np.testing.assert_allclose(states[1:], states[:-1] @ A.T + inputs @ B.T, atol=1e-8)


def test_wrong_names_are_refused(mpc):
    with pytest.raises(InputError, match="unknown parameter 'y'"):
        mpc.build("y")
    with pytest.raises(InputError, match=r"fix: got parameters \['w'\]"):
        mpc.build().fix(w=[0.0])
    with pytest.raises(InputError, match=r"theta: got parameters \['x'\], expected \['w', 'x'\]"):
        mpc.build("w").theta(x=np.zeros(4))
    A, B = double_integrator()
    with pytest.raises(InputError, match="unknown parameter 'w'"):
        LinearMPC(A, B, Q=[1, 1], R=[1], horizon=2).build("w")
