"""Every plant of the library: complete, at rest where it says so, sampled fast enough, and exactly discretised."""

import pickle
import warnings

import casadi as ca
import numpy as np
import pytest
from library_oracles import matrices, rates
from scipy.linalg import expm, matrix_balance

from ccdtools import DesignSpace, Plant, discretise
from ccdtools.plants import library
from mpc import lqr

LINEAR = {
    "illustrative": (library.illustrative, 2),
    "quarter car": (library.quarter_car, 4),
    "quarter car with lag": (lambda: library.quarter_car(actuator_lag=True), 5),
    "half car": (library.half_car, 8),
    "full car": (library.full_car, 15),
    "full car on heights": (lambda: library.full_car(road="height"), 14),
    "pendulum, linear": (lambda: library.pendulum_on_cart(linear=True), 4),
    "servo": (library.dc_servo, 2),
    "chain": (library.mass_chain, 20),
    "chain of 3 on one wall": (lambda: library.mass_chain(3, walls=1, driven=(1, 3), disturbed=(2,)), 6),
    "turbine": (library.wind_turbine, 3),
    "tanks, linear": (lambda: library.two_tanks(linear=True), 2),
}
NONLINEAR = {
    "quarter car, nonlinear": (lambda: library.quarter_car(nonlinear=True), 4),
    "pendulum": (library.pendulum_on_cart, 4),
    "tanks": (library.two_tanks, 2),
}
REAL = {
    "illustrative": (lambda: library.illustrative(real=True), 2),
    "quarter car": (lambda: library.quarter_car(real=True), 4),
    "quarter car with lag": (lambda: library.quarter_car(actuator_lag=True, real=True), 5),
    "half car": (lambda: library.half_car(real=True), 8),
    "full car": (lambda: library.full_car(real=True), 15),
    "full car on heights": (lambda: library.full_car(road="height", real=True), 14),
    "pendulum, linear": (lambda: library.pendulum_on_cart(real=True), 4),
    "servo": (lambda: library.dc_servo(real=True), 2),
    "chain": (lambda: library.mass_chain(real=True), 20),
    "chain of 3 on one wall": (
        lambda: library.mass_chain(3, walls=1, driven=(1, 3), disturbed=(2,), real=True), 6,
    ),
    "turbine": (lambda: library.wind_turbine(real=True), 3),
    "tanks, linear": (lambda: library.two_tanks(real=True), 2),
}  # fmt: skip
EVERY = [*LINEAR.values(), *NONLINEAR.values(), *REAL.values()]
NAMES = [*LINEAR, *NONLINEAR, *(f"real {name}" for name in REAL)]
MOVING = {"illustrative", "tanks, linear"}  # real plants whose steady state is elsewhere
SWINGING = MOVING | {"pendulum, linear"}


@pytest.fixture(params=EVERY, ids=NAMES)
def every(request):
    """Return each plant, with the number of states that it should have."""
    make, states = request.param
    return make(), states


@pytest.fixture(params=LINEAR, ids=list(LINEAR))
def linear(request):
    """Return each linear plant."""
    return LINEAR[request.param][0]()


def test_every_public_name_is_there():
    assert len(library.__all__) <= 15
    assert all(hasattr(library, name) for name in library.__all__)


def test_every_plant_says_its_states_and_carries_names_and_units(every):
    plant, states = every
    assert f"Plant({states} states" in repr(plant)
    assert isinstance(plant.design, DesignSpace)
    assert len(set(plant.state_names)) == plant.nx
    if plant.continuous:
        assert all("[" in name for name in (*plant.state_names, *plant.input_names))
        assert all(plant.design.units)


def test_every_plant_is_pickled(every, rng):
    plant, _ = every
    again = pickle.loads(pickle.dumps(plant))
    x, u, w = (0.1 * rng.standard_normal(n) for n in (plant.nx, plant.nu, plant.nw))
    p = plant.design.centre
    assert isinstance(again, Plant)
    np.testing.assert_array_equal(rates(again, p, x, u, w), rates(plant, p, x, u, w))
    assert repr(again) == repr(plant)


@pytest.mark.parametrize("name", [*LINEAR, *NONLINEAR])
def test_every_nominal_plant_rests_at_the_origin_for_every_design(name):
    plant = (LINEAR | NONLINEAR)[name][0]()
    for p in plant.design.spread():
        np.testing.assert_allclose(rates(plant, p, np.zeros(plant.nx)), 0.0, atol=1e-12)


@pytest.mark.parametrize("name", REAL)
def test_a_real_plant_rests_there_too_but_where_it_says_otherwise(name):
    plant = REAL[name][0]()
    resting = [np.abs(rates(plant, p, np.zeros(plant.nx))).max() < 1e-12 for p in plant.design.spread()]
    assert not any(resting) if name in MOVING else all(resting)


@pytest.mark.parametrize("name", REAL)
def test_a_real_plant_is_not_linear_and_moves_otherwise_than_its_model(name, rng):
    model, real = LINEAR[name][0](), REAL[name][0]()
    p = model.design.centre
    u = np.full(model.nu, 3.0)
    states = (np.zeros(model.nx), 0.2 * rng.standard_normal(model.nx))
    assert any(not np.allclose(rates(model, p, x, u), rates(real, p, x, u), rtol=1e-2) for x in states)
    assert not real.linear


@pytest.mark.parametrize("name", [name for name in REAL if not name.startswith(("pendulum", "illustrative"))])
def test_a_real_plant_that_is_stable_is_integrated_without_running_away(name):
    plant = REAL[name][0]()
    advance = plant.stepper(plant.design.centre, batch=1)
    x = np.full((1, plant.nx), 0.02)
    for _ in range(300):
        x = advance(x, np.zeros((1, plant.nu)), np.zeros((1, plant.nw)))
    assert np.isfinite(x).all()
    assert np.abs(x).max() < (5.0 if name in MOVING else 0.2)


def test_no_linear_plant_draws_a_warning_of_its_sampling_time(linear):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        discretise(linear)


@pytest.mark.long
def test_every_linear_plant_is_linear_and_exactly_discretised(linear):
    """Against SciPy, each block in coordinates that balance the matrix, at 50 random designs."""
    if not linear.continuous:
        return
    model = discretise(linear)
    blocks = np.cumsum([linear.nx, linear.nu])
    for p in linear.design.latin_hypercube(50, np.random.default_rng(1)):
        M = np.zeros((linear.nx + linear.nu + linear.nw,) * 2)
        M[: linear.nx] = np.hstack(matrices(linear, p)) * linear.dt
        _, (scale, _) = matrix_balance(M, permute=False, separate=True)
        exact = expm(M / scale[:, None] * scale)[: linear.nx]
        own = np.hstack(model.matrices(p)) / scale[: linear.nx, None] * scale
        for mine, theirs in zip(np.split(own, blocks, axis=1), np.split(exact, blocks, axis=1)):
            assert np.abs(mine - theirs).max() <= 1e-12 * np.abs(theirs).max()


@pytest.mark.quick(7)
@pytest.mark.parametrize("name", LINEAR)
def test_the_regulator_of_every_linear_plant_holds_the_real_one(name):
    """Closer to the origin than it started; bounded where its rest is elsewhere or dry friction keeps it swinging."""
    model, real = discretise(LINEAR[name][0]()), REAL[name][0]()
    p = real.design.centre
    A, B, _ = model.matrices(p)
    K, _ = lqr(A, B, Q=np.eye(model.nx), R=np.eye(model.nu))
    assert np.abs(np.linalg.eigvals(A - B @ K)).max() < 1
    advance = real.stepper(p, batch=1)
    x = np.full((1, real.nx), 0.02)
    for _ in range(1000):
        x = advance(x, -x @ K.T, np.zeros((1, real.nw)))
    assert np.abs(x).max() < (1.0 if name in SWINGING else 0.02)


def test_a_linear_plant_has_no_terms_of_higher_order(linear, rng):
    z = ca.vertcat(linear.x, linear.u, linear.w)
    assert not ca.depends_on(ca.jacobian(linear.dynamics, z), z)
