"""The controller protocol, and a PID that anyone can follow."""

import numpy as np
import pytest

from ccdtools import PID, InputError, LinearFeedback
from ccdtools.controllers import Passive


@pytest.mark.parametrize(
    "controller",
    [
        Passive(2),
        LinearFeedback(np.ones((2, 3)), [-1, -1], [1, 1]),
        PID(np.ones((2, 3)), [1, 2], [0, 0], [0, 0], dt=0.1, lower=[-1, -1], upper=[1, 1]),
    ],
)
def test_one_state_gives_one_input_and_a_batch_gives_a_batch(controller, rng):
    x = rng.standard_normal((6, 3))
    assert controller(x).shape == (6, 2)
    single = np.array([controller(row) for row in x])
    assert single.shape == (6, 2)
    np.testing.assert_allclose(single, controller(x))
    assert controller(x[:0]).shape == (0, 2)


def test_doing_nothing_is_zero():
    assert not Passive()(np.ones((4, 2))).any()


def test_linear_feedback_saturates():
    u = LinearFeedback([[1.0, 2.0]], [-1.0], [0.5])(np.array([[0.1, 0.2], [3.0, 0.0], [-3.0, 0.0]]))
    np.testing.assert_allclose(u, [[-0.5], [-1.0], [0.5]])


def test_linear_feedback_without_bounds_is_linear(rng):
    K, x = rng.standard_normal((2, 3)), 1e6 * rng.standard_normal((5, 3))
    np.testing.assert_allclose(LinearFeedback(K)(x), -x @ K.T)


def test_a_gain_that_is_not_finite_is_refused():
    with pytest.raises(InputError, match=r"K: got (nan|-?inf) at index"):
        LinearFeedback([[np.nan, 1.0]])


def pid(kp=0.0, ki=0.0, kd=0.0, limit=100.0, dt=0.5):
    return PID([[1.0, 0.0]], [kp], [ki], [kd], dt=dt, lower=[-limit], upper=[limit])


def run(controller, outputs):
    return [float(controller(np.array([y, 7.0]))[0]) for y in outputs]


def test_the_proportional_term_opposes_the_output():
    assert run(pid(kp=2.0), [1.0, -3.0]) == [-2.0, 6.0]


def test_the_integral_sums_the_output_over_time():
    assert run(pid(ki=1.0), [1.0, 2.0, 0.0]) == [-0.5, -1.5, -1.5]


def test_the_derivative_starts_without_a_kick():
    assert run(pid(kd=1.0), [5.0, 6.0, 6.0]) == [0.0, -2.0, 0.0]


def test_the_integral_does_not_wind_up_while_saturated():
    controller = pid(ki=1.0, limit=1.0, dt=1.0)
    assert run(controller, [1.0, 5.0, 5.0, 5.0, 0.0, -1.0]) == [-1.0, -1.0, -1.0, -1.0, -1.0, 0.0]


def test_reset_forgets_the_past():
    controller = pid(kp=1.0, ki=1.0, kd=1.0)
    first = run(controller, [1.0, 2.0, -1.0])
    controller.reset(1)
    assert run(controller, [1.0, 2.0, -1.0]) == first


def test_a_batch_of_another_size_starts_afresh():
    controller = pid(ki=1.0)
    controller(np.ones((3, 2)))
    np.testing.assert_allclose(controller(np.ones((2, 2))), -0.5)


def test_runs_of_a_batch_do_not_mix():
    together = pid(kp=1.0, ki=1.0, kd=1.0)
    both = [together(np.array([[a, 0.0], [b, 0.0]])) for a, b in ((1.0, -2.0), (3.0, 0.5))]
    alone = run(pid(kp=1.0, ki=1.0, kd=1.0), [-2.0, 0.5])
    np.testing.assert_allclose([u[1, 0] for u in both], alone)
