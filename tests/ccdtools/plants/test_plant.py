"""Plants: integration, and declarations that make no sense."""

import gc
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from study_plants import quarter_car

from ccdtools import DesignSpace, InputError, Plant, discretise

START = np.array([27692.0, 1906.5])
ONE = DesignSpace(["p"], [0.5], [2.0])


def pendulum(substeps=10, dt=0.2):
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    return Plant(x, u, w, p, ca.vertcat(x[1], -p * ca.sin(x[0]) + u + w), ONE, dt=dt, substeps=substeps)


def one(value):
    return np.array(value, dtype=float)


def test_runge_kutta_is_of_fourth_order():
    exact = solve_ivp(lambda t, x: [x[1], -1.3 * np.sin(x[0]) + 0.2], (0, 0.8), [2.0, 1.0], rtol=1e-13, atol=1e-14)
    errors = []
    for substeps in (1, 2, 4, 8):
        step = pendulum(substeps, dt=0.8).step(one([2.0, 1.0]), one([0.5]), one([-0.3]), one([1.3]))
        errors.append(np.abs(np.asarray(step).ravel() - exact.y[:, -1]).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert ((orders > 3.6) & (orders < 4.6)).all()


def test_the_linear_quarter_car_integrates_to_its_exact_discretisation(rng):
    x, u, w = rng.standard_normal((20, 4)) * 0.1, 500 * rng.standard_normal((20, 1)), rng.standard_normal((20, 1))
    plant = quarter_car()
    exact = discretise(plant, sampling_guard="ignore").stepper(START, batch=20)(x, u, w)
    errors = [
        np.abs(replace(plant, substeps=n).stepper(START, batch=20)(x, u, w) - exact).max() / np.abs(exact).max()
        for n in (10, 20, 40)
    ]
    assert errors[0] < 1e-3
    np.testing.assert_array_less([12, 12], np.array(errors[:-1]) / errors[1:])


@pytest.mark.parametrize("sign", [1, -1])
def test_the_nonlinear_force_pushes_the_unsprung_mass_along_and_the_sprung_mass_back(sign):
    def rates(nonlinear, x):
        return np.asarray(quarter_car(nonlinear=nonlinear).right_hand_side(one(x), [0], [0], START)).ravel()

    k, c = 0.01 * START
    x = sign * one([0.0, 0.4, 0.3, 1.6])
    force = sign * (k * 0.3**3 + c * 1.2**2)
    difference = rates(True, x) - rates(False, x)
    np.testing.assert_allclose(difference, [0, force / 65, 0, -force / 325], rtol=1e-9, atol=1e-9)


def test_the_quarter_car_has_the_matrices_of_the_literature():
    # Allison, Guo and Han 2014, with k_s in row 2, column 3.
    k, c = START
    plant = quarter_car()
    A = ca.Function("A", [plant.p], [ca.jacobian(plant.dynamics, plant.x)])(START)
    B = ca.Function("B", [plant.p], [ca.jacobian(plant.dynamics, plant.u)])(START)
    E = ca.Function("E", [plant.p], [ca.jacobian(plant.dynamics, plant.w)])(START)
    expected = [[0, 1, 0, 0], [-232.5e3 / 65, -c / 65, k / 65, c / 65], [0, -1, 0, 1], [0, c / 325, -k / 325, -c / 325]]
    np.testing.assert_allclose(np.asarray(A), expected)
    np.testing.assert_allclose(np.asarray(B).ravel(), [0, -1 / 65, 0, 1 / 325])
    np.testing.assert_allclose(np.asarray(E).ravel(), [-1, 0, 0, 0])


def test_the_wheel_hop_of_the_quarter_car_is_where_it_is_known_to_be():
    def hop(p):
        plant = quarter_car()
        A = np.asarray(ca.Function("A", [plant.p], [ca.jacobian(plant.dynamics, plant.x)])(p))
        return np.abs(np.linalg.eigvals(A).imag).max() / (2 * np.pi)

    assert hop(START) == pytest.approx(9.59, abs=0.01)
    assert hop([4e4, 500]) == pytest.approx(10.30, abs=0.01)


def test_the_real_illustrative_plant_agrees_with_its_equations(illustrative, rng):
    x, u, w = rng.uniform(-3, 3, (30, 2)), rng.uniform(-1, 1, (30, 1)), 0.1 * rng.standard_normal((30, 2))
    x1, x2 = x.T
    nominal = x @ np.array([[0.8, 0.5], [0.5, 0.6]]).T + u * [0.5, 2.0] + w
    np.testing.assert_allclose(illustrative.plant.stepper(one([2.0]), batch=30)(x, u, w), nominal)
    drift = 0.1 * np.stack([np.sin(x1) * x1 + np.cos(x2) * x2, np.sin(x2) * x2 + np.cos(x1) * x1], axis=1)
    gain = np.stack([0.5 * np.sin(x1), 0.5 * 2.0 * np.cos(x2)], axis=1) * u
    real = illustrative.real.plant.stepper(one([2.0]), batch=30)(x, u, w)
    np.testing.assert_allclose(real, nominal + np.array([0.1, -0.2]) + drift + gain)


@pytest.mark.parametrize("n", [1, 3, 7, 8, 50])
def test_small_and_large_batches_agree(n, rng):
    plant = pendulum()
    x, u, w = rng.standard_normal((n, 2)), rng.standard_normal((n, 1)), rng.standard_normal((n, 1))
    whole = plant.stepper(one([1.2]), batch=n)(x, u, w)
    single = plant.stepper(one([1.2]), batch=1)
    rows = np.concatenate([single(x[i : i + 1], u[i : i + 1], w[i : i + 1]) for i in range(n)])
    np.testing.assert_allclose(whole, rows, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("of", [lambda plant: plant, discretise])
def test_steppers_broadcast_and_refuse_other_widths(of, rng):
    step = of(pendulum()).stepper(one([1.2]), batch=5)
    x, u, w = rng.standard_normal((5, 2)), rng.standard_normal((1, 1)), np.zeros(1)
    rows = step(x, np.tile(u, (5, 1)), np.zeros((5, 1)))
    np.testing.assert_allclose(step(x, u, w), rows, rtol=1e-13)
    np.testing.assert_allclose(step(x[0], u[0], w), rows[0], rtol=1e-13)
    with pytest.raises(InputError, match=r"^u: got shape \(5, 2\)"):
        step(x, np.zeros((5, 2)), w)


def test_without_inputs_the_undisturbed_step_is_that_of_its_states(rng):
    x, none = ca.SX.sym("x", 2), ca.SX(0, 1)
    model = discretise(Plant(x, none, none, none, ca.vertcat(x[1], -ca.sin(x[0])), DesignSpace([], [], []), dt=0.1))
    states = rng.standard_normal((3, 4, 2))
    nothing = np.zeros(0)
    expected = model.advance(states, nothing, nothing, nothing)
    np.testing.assert_array_equal(model.undisturbed(())(states, np.zeros((3, 4, 0))), expected)


@pytest.mark.check
def test_the_stepper_of_one_run_is_the_step_itself_and_outlives_its_plant(rng):
    x, u, w = (rng.standard_normal((1, size)) for size in (2, 1, 1))
    single = pendulum().stepper(one([1.2]), batch=1)
    gc.collect()
    first = single(x, u, w)
    single(-x, u, w)
    np.testing.assert_array_equal(first, np.asarray(pendulum().step(x.T, u.T, w.T, [1.2])).T)


@pytest.mark.parametrize("n", [1, 3, 20])
def test_a_plant_needs_no_disturbance(n, rng):
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    plant = Plant(x, u, ca.SX(0, 1), p, ca.vertcat(x[1], -p * x[0] + u), ONE, dt=0.1)
    assert plant.nw == 0
    states, inputs = rng.standard_normal((n, 2)), rng.standard_normal((n, 1))
    expected = discretise(plant).stepper(one([1.0]), batch=n)(states, inputs, np.zeros((n, 0)))
    own = plant.stepper(one([1.0]), batch=n)(states, inputs, np.zeros((n, 0)))
    np.testing.assert_allclose(own, expected, atol=1e-8)


def test_labels_default_to_letters_with_numbers():
    plant = pendulum()
    assert plant.state_names == ("x1", "x2")
    assert plant.input_names == ("u1",)
    assert (plant.nx, plant.nu, plant.nw) == (2, 1, 1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x": ca.SX([1, 2])}, "x: got a SX that is not symbolic, expected a casadi.SX symbol"),
        ({"u": ca.MX.sym("u")}, "u: got a MX, expected a casadi.SX symbol"),
        ({"dynamics": ca.SX.sym("q", 3)}, r"dynamics: got shape \(3, 1\), expected \(2, 1\), one row per state"),
        ({"dynamics": ca.SX.sym("q", 2)}, r"dynamics: got unknown symbols \['q_0', 'q_1'\]"),
        ({"dynamics": float("nan") * ca.SX.ones(2)}, "dynamics: got an expression with a constant that is NaN.*ca.sin"),
        ({"p": ca.SX.sym("p", 2)}, r"p: got 2 symbols, expected 1 \(p\)"),
        ({"dt": 0.0}, "dt: got 0.0, expected a positive number"),
        ({"dt": np.nan}, "dt: got nan"),
        ({"substeps": 0}, "substeps: got 0, expected a whole number, at least 1"),
    ],
)
def test_declarations_that_make_no_sense_are_refused(changes, message):
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX(0, 1), ca.SX.sym("p")
    given = {"x": x, "u": u, "w": w, "p": p, "dynamics": ca.vertcat(x[1], u), "design": ONE, "dt": 0.1}
    with pytest.raises(InputError, match=message):
        Plant(**(given | changes))
