"""Exact zero-order hold: to rounding over the whole design box, with derivatives, and with python-control."""

from dataclasses import replace

import casadi as ca
import control
import mpmath
import numpy as np
import pytest
from study_plants import quarter_car

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Plant,
    QuadraticObjective,
    discretise,
)
from ccdtools.plants import LinearModel
from mpc import lqr

START = np.array([27692.0, 1906.5])


@pytest.fixture(scope="module")
def model():
    return discretise(quarter_car(), sampling_guard="ignore")


def continuous(plant, p):
    """Continuous A, B, E at one design."""
    z = ca.vertcat(plant.x, plant.u, plant.w)
    M = np.asarray(ca.Function("M", [plant.p], [ca.densify(ca.jacobian(plant.dynamics, z))])(p))
    return np.split(M, [plant.nx, plant.nx + plant.nu], axis=1)


def exact_hold(A, B, E, dt):
    """[A B E] by Van Loan's block exponential with 50 digits."""
    n, m = len(A), B.shape[1] + E.shape[1]
    with mpmath.workdps(50):
        M = mpmath.matrix(n + m, n + m)
        for i, row in enumerate(np.hstack([A, B, E])):
            for j, value in enumerate(row):
                M[i, j] = mpmath.mpf(float(value)) * mpmath.mpf(dt)
        F = mpmath.expm(M)
        return np.array([[float(F[i, j]) for j in range(n + m)] for i in range(n)])


def designs():
    lower, upper = np.array([1e4, 500]), np.array([4e4, 3000])
    corners = [[a, b] for a in (1e4, 4e4) for b in (500, 3000)]
    return np.vstack([corners, START, np.random.default_rng(0).uniform(lower, upper, (15, 2))])


# ── exactness ──


@pytest.mark.long
def test_the_hold_is_exact_to_rounding_over_the_design_box(model):
    plant = quarter_car()
    unit = np.array([0.25, 2.5, 0.5, 2.5])  # the size of each state, so that no entry is judged in another's units
    columns = np.r_[unit, 1000.0, 0.3]
    for p in designs():
        own, exact = np.hstack(model.matrices(p)), exact_hold(*continuous(plant, p), 0.05)
        scaled = (own - exact) / unit[:, None] * columns
        size = np.abs(exact / unit[:, None] * columns)
        for block in (slice(0, 4), slice(4, 5), slice(5, 6)):
            assert np.abs(scaled[:, block]).max() < 2e-14 * size[:, block].max()


def test_a_badly_scaled_plant_is_held_exactly_too():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    design = DesignSpace(["p"], [1.0], [3.0])
    plant = Plant(x, u, w, p, ca.vertcat(1e6 * x[1], -1e-4 * p * x[0] - 2 * x[1] + u + w), design, dt=0.2)
    for value in (1.0, 2.0, 3.0):
        own = np.hstack(discretise(plant, sampling_guard="ignore").matrices([value]))
        np.testing.assert_allclose(own, exact_hold(*continuous(plant, [value]), 0.2), rtol=1e-13)


def test_a_singular_state_matrix_is_held_exactly():
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    plant = Plant(x, u, ca.SX(0, 1), p, ca.vertcat(x[1], p * u), DesignSpace(["p"], [1], [2]), dt=0.1)
    A, B, E = discretise(plant, sampling_guard="ignore").matrices([2.0])
    np.testing.assert_allclose(A, [[1, 0.1], [0, 1]], rtol=1e-15)
    np.testing.assert_allclose(B, [[0.01], [0.2]], rtol=1e-15)
    assert E.shape == (2, 0)


def test_two_half_samples_make_a_whole_one():
    half = discretise(quarter_car(), dt=0.025, sampling_guard="ignore")
    whole = discretise(quarter_car(), sampling_guard="ignore")
    A, B, _ = half.matrices(START)
    A2, B2, _ = whole.matrices(START)
    np.testing.assert_allclose(A @ A, A2, atol=1e-12)
    np.testing.assert_allclose(A @ B + B, B2, atol=1e-16)


# ── shapes and derivatives ──


def test_many_designs_are_the_stack_of_single_ones(model):
    stacked = model.matrices(designs())
    for i, p in enumerate(designs()):
        for many, one in zip(stacked, model.matrices(p)):
            np.testing.assert_allclose(many[i], one, rtol=1e-14, atol=1e-16)
            assert one.flags["C_CONTIGUOUS"]


def test_derivatives_agree_with_central_differences(model):
    for p in designs()[4:8]:
        analytic = np.concatenate(model.derivatives(p), axis=1)
        for j, size in enumerate((3e4, 2.5e3)):
            h = 1e-5 * size * np.eye(2)[j]
            forward, backward = (np.hstack(model.matrices(p + sign * h)) for sign in (1, -1))
            numeric = (forward - backward) / (2 * h[j])
            scale = np.abs(numeric).max(axis=0)
            assert (np.abs(analytic[..., j] - numeric) < 1e-6 * scale).all()


def test_derivatives_have_one_slice_per_parameter(model):
    dA, dB, dE = model.derivatives(START)
    assert (dA.shape, dB.shape, dE.shape) == ((4, 4, 2), (4, 1, 2), (4, 1, 2))


def test_the_stepper_is_the_matrices(model, rng):
    A, B, E = model.matrices(START)
    x, u, w = rng.standard_normal((5, 4)), rng.standard_normal((5, 1)), rng.standard_normal((5, 1))
    np.testing.assert_allclose(model.stepper(START, batch=5)(x, u, w), x @ A.T + u @ B.T + w @ E.T)


def test_a_discrete_plant_is_taken_as_it_is(illustrative):
    A, B, E = illustrative.model.matrices([2.0])
    np.testing.assert_array_equal(A, [[0.8, 0.5], [0.5, 0.6]])
    np.testing.assert_array_equal(B, [[0.5], [2.0]])
    np.testing.assert_array_equal(E, np.eye(2))
    assert np.abs(np.linalg.eigvals(A)).max() == pytest.approx(1.2099, abs=1e-4)


# ── python-control, in and out ──


def systems():
    A, B, E = continuous(quarter_car(), START)
    return control.ss(A, B, np.eye(4), 0), B, E


def test_a_continuous_state_space_in_agrees_with_c2d():
    system, B, E = systems()
    model = LinearModel.from_state_space(system, E=E, dt=0.05)
    reference = control.c2d(control.ss(system.A, np.hstack([B, E]), np.eye(4), 0), 0.05)
    own = model.matrices()
    np.testing.assert_allclose(own[0], reference.A, atol=1e-10)
    np.testing.assert_allclose(own[1], reference.B[:, :1], atol=1e-12)
    np.testing.assert_allclose(own[2], reference.B[:, 1:], atol=1e-10)
    assert (model.nx, model.nu, model.nw, model.dt, model.design) == (4, 1, 1, 0.05, None)


def test_a_state_space_goes_in_and_comes_out_with_its_dt(model):
    out = model.state_space(START)
    assert out.dt == 0.05
    np.testing.assert_array_equal(out.C, np.eye(4))
    again = LinearModel.from_state_space(out)
    assert again.dt == 0.05
    for own, other in zip(again.matrices()[:2], model.matrices(START)[:2]):
        np.testing.assert_array_equal(own, other)
    assert again.matrices()[2].shape == (4, 0)


def test_a_discrete_system_of_unstated_sampling_counts_samples():
    model = LinearModel.from_state_space(control.ss([[0.5]], [[1]], [[1]], 0, True))
    assert model.dt == 1.0


def test_gains_agree_with_dlqr(study):
    A, B, _ = study.model.matrices(study.p0)
    Q, R = study.objective.Q, study.objective.R
    K, _, _ = control.dlqr(study.model.state_space(study.p0), Q, R)
    np.testing.assert_allclose(lqr(A, B, Q=Q, R=R)[0], K, rtol=1e-6)


# ── errors ──


def nonlinear(expression):
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    design = DesignSpace(["p"], [1], [2])
    names = ["position [m]", "speed [m/s]"]
    return Plant(x, u, w, p, expression(x, u, w, p), design, dt=0.1, state_names=names)


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        (lambda x, u, w, p: ca.vertcat(x[1], ca.cos(x[0]) + u), r"does not rest at x = 0, u = 0: speed \[m/s\] moves"),
        (lambda x, u, w, p: ca.vertcat(x[1], u + 1), "got a constant term in the dynamics"),
        (lambda x, u, w, p: ca.vertcat(x[1], u + p), "got a constant term in the dynamics"),
    ],
)
def test_a_co_design_refuses_a_plant_that_does_not_rest_at_zero(expression, message):
    model = discretise(nonlinear(expression))
    with pytest.raises(InputError, match=message):
        CoDesignProblem(
            model, X=(-1, 1), U=(-1, 1), objective=QuadraticObjective(np.eye(2), [[1.0]]),
            scenarios=FixedStart([0.0, 0.0], Gaussian([0.1])),
        )  # fmt: skip


def test_the_real_plants_are_no_linear_models(suspension, illustrative):
    assert suspension.real.plant.nonlinear_states == ("ż_us [m/s]", "ż_s [m/s]")
    assert illustrative.real.plant.nonlinear_states == ("x1", "x2")


@pytest.mark.parametrize("dt", [0.0, -0.1, np.nan, np.inf])
def test_a_sampling_time_must_be_positive(dt):
    with pytest.raises(InputError, match=r"dt: got .*, expected a positive number"):
        discretise(quarter_car(), dt=dt, sampling_guard="ignore")
    with pytest.raises(InputError, match=r"dt: got .*, expected a positive number"):
        LinearModel.from_state_space(systems()[0], dt=dt)


def test_a_discrete_system_keeps_its_sampling_time(illustrative, model):
    with pytest.raises(InputError, match=r"dt: got 0.5, expected 1.0 or nothing. The plant is discrete"):
        discretise(illustrative.plant, dt=0.5)
    with pytest.raises(InputError, match=r"dt: got 0.1, expected 0.05 or nothing. The system is sampled"):
        LinearModel.from_state_space(model.state_space(START), dt=0.1)
    with pytest.raises(InputError, match=r"dt: got nothing, expected a sampling time"):
        LinearModel.from_state_space(systems()[0])


def test_a_disturbance_matrix_has_one_row_per_state():
    with pytest.raises(InputError, match=r"E: got shape \(3, 1\), expected 4 rows"):
        LinearModel.from_state_space(systems()[0], E=np.ones((3, 1)), dt=0.1)


def test_designs_out_of_bounds_are_refused(model):
    with pytest.raises(InputError, match="design: got k_s = 1, expected"):
        model.matrices([1.0, 1000.0])
    with pytest.raises(InputError, match="expected 2 values"):
        model.matrices()
    with pytest.raises(InputError, match="design: got c_s = 1"):
        model.derivatives([2e4, 1.0])


def test_one_scaling_serves_the_whole_box():
    """The number of squarings comes from samples of the box; a box a hundred times wider is still exact."""
    plant = quarter_car()
    wide = DesignSpace(["k_s", "c_s"], [1e3, 50.0], [4e6, 3e4])
    model = discretise(replace(plant, design=wide), sampling_guard="ignore")
    unit = np.array([0.25, 2.5, 0.5, 2.5])
    for p in ([1e3, 50.0], [4e6, 3e4], [4e6, 50.0], [1e5, 1e3]):
        exact = exact_hold(*continuous(plant, p), 0.05)[:, :4] / unit[:, None] * unit
        assert np.abs(model.matrices(p)[0] / unit[:, None] * unit - exact).max() < 1e-11 * np.abs(exact).max()
