"""What test_detectability.py claims, seen from inside."""

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc
from ccdtools.estimation import CubatureKalmanFilter
from ccdtools.estimation.steady_state import Detectability
from ccdtools.plants import library

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


def pendulum(output, unit=1.0):
    """Upright, with friction; states in another unit."""
    return plant(lambda x, u: (x[1], unit * (2 * ca.sin(x[0] / unit) - 0.1 * x[1] / unit + u)),
                 outputs=[lambda x: output(x / unit)])  # fmt: skip


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
def test_what_sees_the_mode_that_grows_is_seen(unit):
    found = estimator(pendulum(lambda x: x[0], unit), unit=unit)
    assert found.detectability is Detectability.SEEN
    assert "not seen" not in repr(found)


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
def test_outputs_that_are_level_at_rest_alone_are_named(unit):
    found = estimator(pendulum(lambda x: ca.cos(x[0]), unit), unit=unit)
    assert found.detectability is Detectability.SEEN_AWAY
    assert "not seen at the first estimate" in repr(found)
    assert "Start the filter elsewhere" in found.detectability.advice
    away = estimator(pendulum(lambda x: ca.cos(x[0]), unit), unit=unit, x0=(0.5, 0.0))
    assert away.detectability is Detectability.SEEN


def test_a_position_by_dead_reckoning_drifts_and_is_let_through():
    rolling = plant(lambda x, u: (x[1], -0.1 * x[1] * ca.fabs(x[1]) - 0.2 * x[1] + u), outputs=[lambda x: x[1]])
    found = estimator(rolling)
    assert found.detectability is Detectability.DRIFTING
    assert "variance" in found.detectability.advice


def test_derivatives_that_are_not_finite_say_nothing():
    away = plant(lambda x, u: (-x[0], -x[1] + u), outputs=[lambda x: ca.sqrt(x[0] - 100)])
    assert estimator(away).detectability is Detectability.UNKNOWN


def test_the_outputs_of_the_library_see_their_plants():
    own = library.pendulum_on_cart()
    nx = own.nx
    found = CubatureKalmanFilter(
        own, np.eye(nx)[:2], W=[1e-6] * nx, V=[1e-4] * 2, P0=[0.01] * nx, design=own.design.centre
    )
    assert found.detectability in (Detectability.SEEN, Detectability.DRIFTING)
