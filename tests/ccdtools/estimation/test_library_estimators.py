"""Every plant of the library, linearised where it rests, has a Kalman filter that python-control agrees with."""

import control
import numpy as np
import pytest

import ccdtools as cc
from ccdtools.plants import library

MEASURED = {
    "illustrative": (library.illustrative, [0]),
    "quarter car": (library.quarter_car, [0, 2]),
    "quarter car with lag": (lambda: library.quarter_car(actuator_lag=True), [0, 2]),
    "quarter car, nonlinear": (lambda: library.quarter_car(nonlinear=True), [0, 2]),
    "half car": (library.half_car, [0, 2, 4, 6]),
    "full car": (library.full_car, [0, 2, 4, 6, 8, 10, 12, 14]),
    "full car on heights": (lambda: library.full_car(road="height"), [0, 2, 4, 6, 8, 10, 12]),
    "pendulum": (library.pendulum_on_cart, [0, 2]),
    "servo": (library.dc_servo, [0]),
    "chain of 3": (lambda: library.mass_chain(3), [0, 2]),
    "turbine": (library.wind_turbine, [0, 2]),
    "tanks": (lambda: library.two_tanks(linear=True), [1]),
}


def at_rest(name):
    """A, B, C, W, V of the linearisation; the noise is what the plant's own disturbances make."""
    make, measured = MEASURED[name]
    plant = make()
    p = plant.design.centre
    if not plant.linear:
        plant = cc.linearise(plant, cc.equilibrium(plant, p))
    A, B, E = cc.discretise(plant, sampling_guard="ignore").matrices(p)
    own = np.asarray(cc.noise_covariance(plant, np.eye(plant.nw))(p)) if plant.continuous else E @ E.T
    W = own + 1e-6 * np.diag(np.diag(own).max() * np.ones(len(A)))
    C = np.eye(len(A))[measured]
    return A, B, C, W, 1e-2 * np.diag(np.diag(C @ (A @ W @ A.T + W) @ C.T))


@pytest.mark.parametrize("name", MEASURED)
def test_the_gain_is_that_of_python_control(name):
    A, B, C, W, V = at_rest(name)
    steady = cc.KalmanFilter(A, B, C, W, V)
    L, P, _ = control.dlqe(A, np.eye(len(A)), C, W, V)
    size = np.sqrt(np.diag(P))
    np.testing.assert_allclose(steady.predicted / np.outer(size, size), P / np.outer(size, size), atol=1e-7)
    np.testing.assert_allclose(A @ steady.gain, L, atol=1e-7 * np.abs(L).max())
    assert np.abs(steady.poles).max() < 1


@pytest.mark.long
@pytest.mark.parametrize("name", MEASURED)
def test_a_cubature_filter_of_the_plant_itself_finds_its_state(name):
    make, measured = MEASURED[name]
    plant = make()
    p = plant.design.centre
    _, _, C, W, _ = at_rest(name)
    size = np.sqrt(np.diag(W) / np.diag(W).max()) * 1e-3
    rng = np.random.default_rng(0)
    x0 = size * rng.standard_normal((8, plant.nx))
    run = cc.simulate(plant, cc.Passive(plant.nu), x0=x0, steps=30, design=p)
    V = (1e-3 * size[measured]) ** 2
    y = run.states[:, :-1] @ C.T + np.sqrt(V) * rng.standard_normal((8, 30, len(V)))
    cubature = cc.CubatureKalmanFilter(plant, C, W=1e-12 * size**2, V=V, P0=size**2, design=p)
    found = cubature.filter(y, run.inputs)
    error = run.states[:, -2] - found.means[:, -1]
    variances = np.diagonal(found.covariances[:, -1], axis1=1, axis2=2)
    assert (variances <= np.diag(np.cov(run.states[:, -2].T)) + size**2).all()
    assert (np.abs(error) < 6 * np.sqrt(variances)).all()
