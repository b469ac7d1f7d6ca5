"""What a cubature Kalman filter cannot see is refused or said when it is made, and a rest up to rounding is a rest."""

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc
from ccdtools import InputError, KalmanFilter
from ccdtools.estimation import CubatureKalmanFilter
from ccdtools.exceptions import NotDetectableError

NONE = cc.DesignSpace([], [], [])


def plant(rates, nx=2, outputs=(), dt=0.1):
    """A plant of the given rates and outputs, functions of x and u."""
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u")
    return cc.Plant(x, u, None, None, ca.vertcat(*rates(x, u)), NONE, dt, outputs=[h(x) for h in outputs])


def estimator(own, *, x0=(0.0, 0.0), unit=1.0, **more):
    """Its filter, states in another unit."""
    scale = unit**2
    given = {"W": [1e-4 * scale] * 2, "V": [1e-2], "P0": [0.1 * scale] * 2, "x0": np.array(x0) * unit} | more
    return CubatureKalmanFilter(own, **given)


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
def test_a_mode_that_grows_and_is_seen_nowhere_is_refused_and_named(unit):
    two = plant(lambda x, u: (-x[0] + 0.1 * ca.tanh(x[0]) + u, 0.5 * x[1]), outputs=[lambda x: x[0]])
    with pytest.raises(NotDetectableError, match="mostly of x2") as caught:
        estimator(two, unit=unit)
    assert caught.value.states == (1,)
    assert caught.value.eigenvalue == pytest.approx(np.exp(0.05), rel=1e-5)


@pytest.mark.parametrize("output", [lambda x: 0 * x[:, :1] + 3.0, lambda x, u: u])
def test_outputs_that_depend_on_no_state_are_refused(output):
    stable = plant(lambda x, u: (-x[0] + 0.1 * ca.sin(x[1]), -x[1] + u))
    with pytest.raises(NotDetectableError, match="do not depend on the state"):
        estimator(stable, output=output)


@pytest.mark.parametrize("steady", [True, False])
def test_a_constant_term_counts_beside_what_the_filter_predicts(steady):
    def of(constant, unit=1.0):
        own = plant(lambda x, u: (x[1], -x[0] - x[1] + u + constant * unit), outputs=[lambda x: x[0] / unit])
        W = np.array([1e-6, 1e-4]) * unit**2
        more = {} if steady else {"P0": [1e-4 * unit**2] * 2}
        return KalmanFilter.of(own, W=W, V=[1e-2], steady=steady, **more)

    for unit in (1.0, 1e-7, 1e7):
        rounded = of(1e-8, unit)
        np.testing.assert_allclose(rounded.filter(np.ones((5, 1)), np.zeros((5, 1))).means / unit,
                                   of(0.0).filter(np.ones((5, 1)), np.zeros((5, 1))).means, rtol=1e-6)  # fmt: skip
        with pytest.raises(InputError, match="a constant term in the dynamics, up to"):
            of(1e-3, unit)
