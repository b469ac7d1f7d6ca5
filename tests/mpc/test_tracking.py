"""References are met without offset although the model is wrong."""

import numpy as np
import pytest
from plants import box, double_integrator

from mpc import InputError, LinearMPC, OffsetFreeMPC


@pytest.fixture
def regulator():
    A, B = double_integrator()
    return LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=10, X=box([5, 5]), U=box([1]))


def run(controller, reference, steps, push):
    A, B = double_integrator()
    x = np.zeros(2)
    for _ in range(steps):
        u = controller(x, reference)
        x_next = 0.97 * A @ x + 1.1 * B @ u + push  # another plant than the model
        controller = controller.observe(x, u, x_next)
        x = x_next
    return x, controller


def test_constant_disturbance_and_wrong_model_leave_no_offset(regulator):
    x, controller = run(OffsetFreeMPC(regulator, [[1.0, 0.0]]), [2.0], 150, np.array([0.0, 0.1]))
    assert x[0] == pytest.approx(2.0, abs=1e-6)
    assert np.abs(controller.disturbance).max() > 0.01


def test_without_the_estimate_there_is_an_offset(regulator):
    A, B = double_integrator()
    x = np.zeros(2)
    for _ in range(150):
        x = 0.97 * A @ x + 1.1 * B @ regulator(x, x_ref=[2.0, 0.0]) + [0.0, 0.1]
    assert abs(x[0] - 2.0) > 1e-3


def test_an_unreachable_reference_gets_the_nearest_steady_state(regulator):
    state, action = OffsetFreeMPC(regulator, [[1.0, 0.0]]).target([9.0])
    np.testing.assert_allclose(state, [5.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(action, [0.0], atol=1e-6)


def test_target_is_a_steady_state_under_the_disturbance(regulator):
    controller = OffsetFreeMPC(regulator, [[1.0, 0.0]], disturbance=[0.05, 0.1])
    x, u = controller.target([1.0])
    np.testing.assert_allclose(regulator.A @ x + regulator.B @ u + [0.05, 0.1], x, atol=1e-9)
    assert x[0] == pytest.approx(1.0, abs=1e-6)


def test_bad_input_is_refused(regulator):
    with pytest.raises(InputError, match=r"expected a number in \(0, 1\]"):
        OffsetFreeMPC(regulator, [[1.0, 0.0]], gain=0.0)
    with pytest.raises(InputError, match="C: got shape"):
        OffsetFreeMPC(regulator, [1.0, 0.0])
    with pytest.raises(InputError, match="reference: got shape"):
        OffsetFreeMPC(regulator, [[1.0, 0.0]])([0.0, 0.0], [1.0, 2.0])
    with pytest.raises(InputError, match="no steady state"):
        OffsetFreeMPC(regulator, [[1.0, 0.0]], disturbance=[0.0, 3.0]).target([0.0])


def test_a_reference_of_its_own_needs_none_in_the_loop():
    regulator = LinearMPC([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], Q=np.eye(2), R=0.1, horizon=20, U=(-1, 1))
    law, asked = OffsetFreeMPC(regulator, [[1.0, 0.0]], reference=[0.3]), OffsetFreeMPC(regulator, [[1.0, 0.0]])
    assert "reference" not in law.needs
    assert "reference" in asked.needs
    np.testing.assert_array_equal(law([0.1, 0.0]), asked([0.1, 0.0], reference=[0.3]))
    np.testing.assert_array_equal(law([0.1, 0.0], reference=[0.2]), asked([0.1, 0.0], reference=[0.2]))
    with pytest.raises(InputError, match="reference"):
        OffsetFreeMPC(regulator, [[1.0, 0.0]], reference=[0.3, 0.0])
