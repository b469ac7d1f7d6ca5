"""The cubature Kalman filter of states that are known, or all but follow from others, in any units."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc
from ccdtools.estimation import CubatureKalmanFilter
from ccdtools.plants import library

STEPS = 40
PENDULUM = library.pendulum_on_cart()
P = PENDULUM.design.centre


def pendulum(known=0):
    """A pendulum, beside so many states that stay where they are and change its gravity."""
    x, u, w = ca.SX.sym("x", 2 + known), ca.SX.sym("u"), ca.SX.sym("w")
    gravity = ca.sum1(x[2:]) if known else 2.0
    rates = [x[1], -gravity * ca.sin(x[0]) + u + w, *[0] * known]
    return cc.Plant(x, u, w, None, rates, cc.DesignSpace([], [], []), 0.1, outputs=[ca.sin(x[0])])


def test_what_is_known_exactly_is_no_state():
    rng = np.random.default_rng(0)
    y, u = 0.5 * rng.standard_normal((3, STEPS, 1)), rng.standard_normal((3, STEPS, 1))
    told = {"V": [0.01], "disturbance": ([0.1], [0.3])}
    own = CubatureKalmanFilter(pendulum(), W=np.zeros(2), P0=[1.0, 0.0], x0=[1.0, 0.0], **told).filter(y, u)
    more = CubatureKalmanFilter(pendulum(2), W=np.zeros(4), P0=[1.0, 0, 0, 0], x0=[1.0, 0.0, 3.0, -1.0], **told).filter(
        y, u
    )
    np.testing.assert_allclose(more.means[..., :2], own.means, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(more.means[..., 2:], np.broadcast_to([3.0, -1.0], (3, STEPS, 2)), rtol=1e-14)
    np.testing.assert_allclose(more.covariances[..., :2, :2], own.covariances, rtol=1e-8, atol=1e-14)


@pytest.mark.parametrize("units", [1.0, 1e-6])
def test_what_becomes_known_leaves_a_belief_smoothly(units):
    one = np.array([1.0, units])
    x, u, w = (ca.SX.sym(name, n) for name, n in (("x", 2), ("u", 1), ("w", 1)))
    after = [x[0] + x[1] / units, units * (0.5 * x[1] / units - 2 * ca.sin(x[0]) + u + w)]
    plant = cc.Plant(x, u, w, None, after, cc.DesignSpace([], [], []), 1.0, continuous=False, outputs=[ca.sin(x[0])])
    some = CubatureKalmanFilter(plant, W=np.zeros(2), V=[0.01], P0=np.ones(2), disturbance=([0.0], [0.01]))
    left = np.geomspace(1e-20, 1e-3, 2000)  # variance of the second state beside the first
    beside = np.sqrt(1 - left)
    P = np.array([[np.ones(2000), beside], [beside, np.ones(2000)]]).transpose(2, 0, 1) * np.outer(one, one)
    belief, u = replace(some.start(2000), mean=np.tile([1.0, 0.0], (2000, 1)), covariance=P), np.zeros((2000, 1))
    for found in (some.predict(belief, u), some.update(belief, u + 1, u)):
        for part in (found.mean / one, found.covariance / np.outer(one, one)):
            moves = np.abs(np.diff(part, axis=0)).reshape(1999, -1).max(axis=0)
            assert (moves < 0.05 * np.ptp(part, axis=0).ravel() + 1e-4).all()


@pytest.mark.parametrize("units", [1.0, 1e-6])
@pytest.mark.parametrize("beside", [0.1, 3e-4, 1e-4, 1e-5, 1e-8, 0.0])
def test_a_state_before_does_not_hide_the_rate_that_led_from_it(beside, units):
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u")  # position a sample before, position, rate
    rate = x[2] / units
    plant = cc.Plant(x, u, None, None, [x[1], x[1] + beside * rate, x[2]], cc.DesignSpace([], [], []), 1.0,
                     continuous=False, outputs=[rate**2])  # fmt: skip
    root = np.array([[1.0, 0.0], [1.0, beside], [0.0, units]])
    found = CubatureKalmanFilter(plant, W=np.zeros(3), V=[0.01], P0=root @ root.T).filter(
        np.zeros((1, 1, 1)), np.zeros((1, 1, 1))
    )
    np.testing.assert_allclose(found.innovations, [[[-1.0]]], rtol=1e-5)  # the variance of the rate


@pytest.mark.parametrize("beyond", [1e-16, 1e-9, 5e-3])
def test_a_covariance_that_rounding_has_made_indefinite_is_no_end(beyond):
    """After precise sensors differences of large numbers are left; what they err by is a variance."""
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    after = [x[0] + 0.1 * ca.tanh(5 * x[1]), ca.sin(x[0]) + u + w]
    plant = cc.Plant(x, u, w, None, after, cc.DesignSpace([], [], []), 1.0, continuous=False, outputs=[ca.sin(x[0])])
    some = CubatureKalmanFilter(plant, W=np.zeros(2), V=[0.01], P0=np.ones(2), disturbance=([0.0], [0.01]))
    zero, start = np.zeros((1, 1)), replace(some.start(1), mean=np.array([[0.3, 0.1]]))
    singular, other = (
        replace(start, covariance=np.array([[[1.0, 1.0 + more], [1.0 + more, 1.0]]])) for more in (0.0, beyond)
    )
    for found, near in ((one(singular), one(other)) for one in
                        (lambda b: some.predict(b, zero), lambda b: some.update(b, zero, zero))):  # fmt: skip
        np.testing.assert_allclose(near.mean, found.mean, atol=3 * beyond**0.5)
        np.testing.assert_allclose(near.covariance, found.covariance, atol=3 * beyond**0.5)


@pytest.mark.parametrize("hidden", [0.0, 0.1, 0.7, 0.999, 1.0])
def test_a_rate_that_all_but_follows_from_two_positions_moves_the_likelihood_smoothly(hidden):
    """`hidden` is how much of the rate their difference says, `beside` how large it is beside the positions."""
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u")
    plant = cc.Plant(x, u, None, None, [x[1], x[1] + x[2], x[2]], cc.DesignSpace([], [], []), 1.0,
                     continuous=False, outputs=[ca.tanh(3 * x[2])])  # fmt: skip
    some = CubatureKalmanFilter(plant, W=np.zeros(3), V=[0.01], P0=np.ones(3))
    beside, rest = np.geomspace(1e-9, 1e-2, 2000), np.sqrt(1 - hidden**2)
    roots = np.array([[[1.0, 0.0, 0.0], [1.0, one, 0.0], [0.0, hidden, rest]] for one in beside])
    start = some.start(2000)
    belief = replace(start, mean=np.tile([0.0, 0.0, 0.5], (2000, 1)), covariance=roots @ roots.transpose(0, 2, 1))
    zero = np.zeros((2000, 1))
    rates = some.update(belief, zero, zero).mean[:, 2]
    assert np.ptp(rates) > 0.01  # a cubature rule of more axes is another rule
    assert np.abs(np.diff(rates)).max() < 0.02 * np.ptp(rates)


@pytest.mark.parametrize("units", [[1.0, 1.0], [1e-6, 1e6]])
def test_a_start_on_a_line_stays_symmetric_and_finite(units):
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    first, second = x[0] / units[0], x[1] / units[1]
    plant = cc.Plant(x, u, None, None, [units[0] * second, units[1] * (u - 2 * ca.sin(first))],
                     cc.DesignSpace([], [], []), 0.1, outputs=[ca.sin(first)])  # fmt: skip
    along = np.array(units)
    found = CubatureKalmanFilter(plant, W=np.zeros(2), V=[1e-8], P0=np.outer(along, along)).filter(
        np.full((STEPS, 1), 0.3), np.zeros((STEPS, 1))
    )
    one = CubatureKalmanFilter(
        cc.Plant(x, u, None, None, [x[1], u - 2 * ca.sin(x[0])], cc.DesignSpace([], [], []), 0.1,
                 outputs=[ca.sin(x[0])]), W=np.zeros(2), V=[1e-8], P0=np.ones((2, 2)),
    ).filter(np.full((STEPS, 1), 0.3), np.zeros((STEPS, 1)))  # fmt: skip
    np.testing.assert_allclose(found.means / along, one.means, atol=1e-7)  # a sum's rounding in its root
    variances = np.diagonal(one.covariances, axis1=-2, axis2=-1)
    assert np.isfinite(one.covariances).all()
    assert (variances > -1e-13).all()
