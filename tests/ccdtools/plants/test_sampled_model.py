"""Nonlinear plants as discrete models: orders of convergence, promised errors, derivatives, and what is refused."""

import pickle
import re
from dataclasses import replace

import casadi as ca
import mpmath
import numpy as np
import pytest
import torch
from nonlinear_plants import (
    GRAVITY,
    hot_plate,
    motor,
    motor_rates,
    stiff,
    stiff_rates,
    swing,
    swing_rates,
    tank_rates,
    tanks,
)
from scipy.integrate import solve_ivp

from ccdtools import DesignSpace, Gaussian, InputError, LinearFeedback, Plant, discretise, equilibrium, simulate
from ccdtools.exceptions import SamplingWarning
from ccdtools.plants import SampledModel, deviations

SWING = {"X": ([-3.0, -6.0], [3.0, 6.0]), "U": (-5.0, 5.0), "W": (-1.0, 1.0)}
STIFF = {"X": ([-1.5, -1.5], [1.5, 1.5]), "U": (-1.0, 1.0)}
MOTOR = {"X": ([-20.0, -20.0, -50.0], [20.0, 20.0, 50.0]), "U": (-10.0, 10.0), "W": (-0.5, 0.5)}
TANKS = {"X": ([0.05, 0.05], [1.0, 1.0]), "U": (0.0, 1e-3), "W": (-1e-4, 1e-4)}


def exact(rates, x, u, w, p, dt):
    """x⁺ by an implicit method of high order, at tolerances near rounding."""
    size = np.maximum(np.abs(x), 1e-3)
    run = solve_ivp(
        lambda t, y: rates(y, u, w, p), (0, dt), x, method="Radau" if rates is stiff_rates else "DOP853", rtol=1e-12,
        atol=1e-13 * size,
    )  # fmt: skip
    return run.y[:, -1]


def drawn(model, limits, n, rng):
    """Points within the limits and the box of designs."""
    zero = np.zeros(1)
    boxes = [[np.atleast_1d(v).astype(float) for v in limits.get(name, (zero, zero))] for name in "XUW"]
    parts = [rng.uniform(*box, (n, len(box[0]))) for box in boxes]
    return (*parts, rng.uniform(model.design.lower, model.design.upper, (n, model.design.dim)))


@pytest.mark.check
@pytest.mark.parametrize(("method", "order"), [("rk4", 4), ("collocation", 5)])
def test_a_method_has_its_order(method, order):
    x, u, w, p = np.array([2.0, 1.0]), np.array([0.5]), np.array([-0.3]), np.array([0.8])
    with mpmath.workdps(25):
        flow = mpmath.odefun(
            lambda t, y: [y[1], -GRAVITY / p[0] * mpmath.sin(y[0]) - 0.2 * y[1] + (u[0] + w[0]) / p[0] ** 2], 0, list(x)
        )
        truth = np.array([float(v) for v in flow(0.4)])
    errors = []
    for parts in (8, 16, 32, 64, 128):
        reached = SampledModel(swing(dt=0.4), 0.4, method, parts).advance(x[None], u[None], w[None], p)[0]
        errors.append(np.abs(reached - truth).max())
    fine = [error for error in errors if error > 1e-13]
    assert np.log2(fine[-2] / fine[-1]) == pytest.approx(order, abs=0.1)


@pytest.mark.quick(2)
@pytest.mark.parametrize(
    ("plant", "rates", "limits", "count"),
    [(swing(), swing_rates, SWING, 60), (tanks(), tank_rates, TANKS, 60), (stiff(), stiff_rates, STIFF, 15)],
    ids=["swing", "tanks", "stiff"],
)
def test_the_error_that_is_promised_is_kept_at_points_that_were_not_looked_at(plant, rates, limits, count):
    models = [discretise(plant, accuracy=one, sampling_guard="ignore", **limits) for one in (1e-4, 1e-8)]
    assert models[0].error.relative <= 1e-4
    assert models[1].error.relative <= 1e-8
    for x, u, w, p in zip(*drawn(models[0], limits, count, np.random.default_rng(5))):
        truth = exact(rates, x, u, w, p, plant.dt)
        for model in models:
            reached = model.advance(x[None], u[None], w[None], p)[0]
            assert (np.abs(reached - truth) <= model.error.bound + 1e-11).all()


@pytest.mark.long
def test_a_stiff_plant_is_collocated_and_a_smooth_one_takes_few_runge_kutta_steps():
    assert discretise(stiff(), sampling_guard="ignore", **STIFF).method == "collocation"
    smooth = discretise(swing(), **SWING)
    assert (smooth.method, smooth.substeps) == ("rk4", 7)
    assert discretise(swing(), accuracy=1e-3, **SWING).substeps < smooth.substeps


@pytest.mark.long
def test_a_motor_whose_current_settles_within_a_fiftieth_of_a_sample_is_accurate_by_default():
    with pytest.warns(SamplingWarning, match=r"takes 176 Runge.* at accuracy=1e-06; 44 reach .*\. Hardest") as seen:
        model = discretise(motor(), **MOTOR)
    assert (model.method, model.substeps) == ("rk4", 176)
    advised = float(re.search(r"44 reach ([\d.e-]+)\.", str(seen[0].message))[1])
    assert discretise(motor(), accuracy=1.1 * advised, **MOTOR).substeps <= 44
    for x, u, w, p in zip(*drawn(model, MOTOR, 20, np.random.default_rng(0))):
        run = solve_ivp(lambda t, y: motor_rates(y, u, w, p), (0, 0.05), x, "Radau", rtol=1e-11, atol=1e-11)  # noqa: B023
        assert (np.abs(model.advance(x[None], u[None], w[None], p)[0] - run.y[:, -1]) <= model.error.bound + 1e-9).all()


@pytest.mark.check
def test_an_accuracy_that_is_not_reached_is_answered_by_one_that_is():
    fast = motor(1e-4)  # its current settles within a five-hundredth of a sample
    with pytest.raises(InputError, match="is reached") as refused:
        discretise(fast, accuracy=1e-10, **MOTOR)
    advised = float(re.search(r"Take accuracy=([\d.e-]+\d)\.", str(refused.value))[1])
    assert discretise(fast, accuracy=advised, sampling_guard="ignore", **MOTOR).error.relative <= advised


def test_without_limits_parts_that_grow_what_the_plant_damps_are_warned_of():
    with pytest.warns(SamplingWarning, match=r"settles within 0.001 s, which 10 Runge.*Pass X.*substeps=18") as seen:
        discretise(motor())
    assert len(seen) == 1
    discretise(replace(motor(), substeps=18))
    discretise(motor(), method="collocation")


def test_other_units_of_a_state_change_neither_method_nor_parts():
    own = discretise(tanks(), **TANKS)
    for unit in (1e-6, 1e6):
        X = tuple(np.array(bound) / unit for bound in TANKS["X"])
        other = discretise(tanks(unit=unit), **(TANKS | {"X": X}))
        assert (other.method, other.substeps) == (own.method, own.substeps)
        assert other.error.relative == pytest.approx(own.error.relative, rel=1e-6)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_casadi_arrays_and_tensors_take_the_same_collocation_step(unit):
    rng = np.random.default_rng(0)
    X = tuple(np.array(bound) / unit for bound in TANKS["X"])
    model = discretise(tanks(unit=unit), method="collocation", sampling_guard="ignore", **(TANKS | {"X": X}))
    x, u, w, p = drawn(model, TANKS | {"X": X}, 20, rng)
    arrays = model.advance(x, u, w, p)
    tensors = model.advance(*(torch.tensor(a) for a in (x, u, w, p)))
    native = np.asarray(model.step(x.T, u.T, w.T, p.T)).T
    np.testing.assert_allclose(tensors, arrays, rtol=1e-13)
    np.testing.assert_allclose(native, arrays, rtol=1e-11)


@pytest.mark.long
@pytest.mark.parametrize("method", ["rk4", "collocation"])
def test_a_step_of_tensors_has_first_and_second_derivatives(method):
    model = SampledModel(swing(), 0.1, method, 2)
    points = [
        torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in ([[0.3, -1.0], [2.0, 0.4]], [[0.2], [-1.0]])
    ]
    p = torch.tensor([0.7], dtype=torch.float64, requires_grad=True)
    w = torch.zeros(1, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x, u, p: model.advance(x, u, w, p), (*points, p))
    assert torch.autograd.gradgradcheck(lambda x, u, p: model.advance(x, u, w, p), (*points, p))


@pytest.mark.parametrize("method", ["rk4", "collocation"])
def test_jacobians_are_those_of_the_step(method):
    model = SampledModel(swing(), 0.1, method, 4)
    x, u, w, p = np.array([0.4, -0.3]), np.array([1.0]), np.array([0.2]), [1.1]
    A, B, E = model.jacobians(x, u, w, p)
    given = [torch.tensor(v, dtype=torch.float64) for v in (x, u, w)]
    own = torch.autograd.functional.jacobian(
        lambda *z: model.advance(*z, torch.tensor(p, dtype=torch.float64)), tuple(given)
    )
    for M, J in zip((A, B, E), own):
        np.testing.assert_allclose(M, J.numpy(), rtol=1e-9, atol=1e-12)


def test_a_step_that_cannot_be_solved_ends_the_run_and_not_the_others():
    x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p")
    blows_up = Plant(x, u, None, p, p * ca.exp(x) + u, DesignSpace(["p"], [0.5], [2.0]), dt=0.1)
    model = SampledModel(blows_up, 0.1, "collocation", 1)
    run = simulate(model, LinearFeedback([[0.0]]), x0=[[-3.0], [6.0]], steps=5, design=[1.0])
    assert run.diverged.tolist() == [False, True]
    assert np.isfinite(run.states[0]).all()


@pytest.mark.long
def test_a_stiff_plant_in_deviations_is_collocated_with_its_centre():
    plant = hot_plate()
    hanging = deviations(plant, equilibrium(plant, [1000.0], guess=([300, 300.0], [0.0])))
    with pytest.warns(SamplingWarning, match="8 parts by collocation, as long as 480 Runge–Kutta parts"):
        model = discretise(hanging, X=(-50.0, 50.0), U=(-100.0, 100.0), W=(-10.0, 10.0))
    assert model.method == "collocation"


def test_collocation_of_single_precision_loses_no_run_and_is_that_of_double():
    rng = np.random.default_rng(1)
    points = [a.astype(np.float32) for a in drawn(SampledModel(stiff(), 0.02), STIFF, 500, rng)]
    model = SampledModel(stiff(), 0.02, "collocation", 2)
    truth = model.advance(*(a.astype(float) for a in points))
    assert np.isfinite(truth).all()
    single = [torch.tensor(a, requires_grad=True) for a in points]
    double = [torch.tensor(a.astype(float), requires_grad=True) for a in points]
    assert model.advance(*points).dtype == np.float32
    np.testing.assert_allclose(model.advance(*points), truth, atol=1e-6)
    after = model.advance(*single)
    assert after.dtype == torch.float32
    np.testing.assert_allclose(after.detach().numpy(), truth, atol=1e-6)
    slopes = [torch.autograd.grad(model.advance(*given).sum(), given) for given in (single, double)]
    for own, exact_slope in zip(*slopes):
        np.testing.assert_allclose(own.numpy(), exact_slope.numpy(), rtol=1e-5, atol=1e-6)


@pytest.mark.check
def test_a_point_at_which_newton_does_not_converge_is_named_with_it():
    x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p")
    blows_up = Plant(x, u, None, p, p * ca.exp(x) + u, DesignSpace(["p"], [0.5], [2.0]), dt=0.1)
    with pytest.raises(InputError, match=r"nothing is reached; collocation: Newton's method does not converge at x = "):
        discretise(blows_up, method="collocation", X=(-6.0, 6.0))


@pytest.mark.check
def test_a_sampled_model_simulates_as_its_plant_does():
    model = discretise(swing(), accuracy=1e-9, **SWING)
    K = [[8.0, 3.0]]
    runs = [
        simulate(plant, LinearFeedback(K), x0=[1.0, 0.0], steps=40, design=[0.9], disturbance=Gaussian([0.1]),
                 rng=np.random.default_rng(1)).states for plant in (model, swing())
    ]  # fmt: skip
    np.testing.assert_allclose(*runs, atol=1e-5)


def test_a_discrete_nonlinear_plant_is_taken_as_it_is():
    x, u, w, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = Plant(x, u, w, p, p * ca.sin(x) + u * w, DesignSpace(["p"], [0.5], [2.0]), dt=0.5, continuous=False)
    model = discretise(plant)
    assert model.advance(np.array([[1.0]]), np.array([[2.0]]), np.array([[3.0]]), np.array([0.7]))[
        0, 0
    ] == pytest.approx(0.7 * np.sin(1.0) + 6.0)
    assert "a discrete plant" in repr(model)


def test_a_model_says_what_it_is_and_survives_a_pickle():
    model = discretise(swing(), **SWING)
    assert "error at most" in repr(model)
    assert "not measured" in repr(discretise(swing()))
    again = pickle.loads(pickle.dumps(model))
    point = (np.array([[0.3, 0.1]]), np.array([[0.1]]), np.array([[0.0]]), np.array([1.0]))
    np.testing.assert_array_equal(again.advance(*point), model.advance(*point))
    assert again.error.relative == model.error.relative


@pytest.mark.long
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"X": (-1, 1), "accuracy": 0.0}, "accuracy: got 0.0, expected"),
        ({"X": (-1, 1), "method": "euler"}, "method: got 'euler'"),
        ({"U": (-1, 1)}, "X: got nothing, beside limits of u or w"),
        ({"X": ([0, 0, 0], [1, 1, 1])}, r"X\[0\]: got shape \(3,\)"),
        ({"X": ([-np.inf, -1], [1, 1])}, "X: got an empty or unbounded set"),
        ({"X": ([0.0, -1], [0.0, 1])}, r"X: got no width in θ \[rad\]"),
        ({"X": (-1e3, 1e3), "method": "rk4", "accuracy": 1e-14}, "accuracy: got 1e-14, where .* is reached"),
    ],
)
def test_what_cannot_be_sampled_is_refused_by_name(options, message):
    with pytest.raises(InputError, match=message):
        discretise(swing(), **options)


def test_a_derivative_that_does_not_exist_is_refused_at_its_point():
    x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p")
    plant = Plant(x, u, None, p, u - p * ca.sqrt(x), DesignSpace(["p"], [0.5], [2.0]), dt=0.1)
    with pytest.raises(InputError, match="where a derivative is not finite"):
        SampledModel(plant, 0.1).jacobians([0.0], [0.0], None, [1.0])


def test_the_error_is_kept_in_a_part_of_the_box_of_designs_and_dropped_beyond_it():
    model = discretise(swing(), **SWING)
    assert model.within(DesignSpace(["l"], [0.6], [1.8], ["m"])).error is model.error
    assert model.within(DesignSpace(["l"], [0.2], [1.8], ["m"])).error is None


@pytest.mark.parametrize("method", ["rk4", "collocation"])
@pytest.mark.parametrize(("sizes", "argument"), [((1, 1, 1, 1), "x"), ((3, 1, 1, 1), "x"), ((2, 2, 1, 1), "u"),
                                                 ((2, 1, 0, 1), "w"), ((2, 1, 1, 2), "p")])  # fmt: skip
def test_a_step_of_arrays_of_other_sizes_is_refused_by_name(method, sizes, argument):
    for model in (SampledModel(swing(), 0.1, method, 2), SampledModel(swing(), 0.1, method, 2).with_errors()):
        given = [np.zeros((4, size)) for size in sizes]
        given[2] = np.zeros((4, sizes[2] + 2 * model.errors))
        with pytest.raises(InputError, match=rf"^{argument}: got shape \(4, "):
            model.advance(*given)
