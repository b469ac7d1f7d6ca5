"""Constant terms, first-order hold, noise covariance, and plants from matrices, against scipy and python-control."""

import casadi as ca
import control
import numpy as np
import pytest
from nonlinear_plants import swing
from scipy.integrate import quad_vec
from scipy.linalg import expm
from study_plants import quarter_car

from ccdtools import (
    DesignSpace,
    InputError,
    LinearFeedback,
    Plant,
    discretise,
    plant_from_matrices,
    plant_from_state_space,
    simulate,
)
from ccdtools.plants import LinearModel, first_order_hold, noise_covariance

BOX = DesignSpace(["k", "d"], [20.0, 0.1], [200.0, 2.0])


def hanging(continuous=True, dt=0.05):
    """A mass on a spring under gravity, its position counted from where the spring is slack."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    if not continuous:
        return Plant(
            x, u, w, p, ca.vertcat(x[0] + dt * x[1], x[1] - p[0] * dt * x[0] + u - 9.81 * dt + w), BOX, dt, False
        )
    return Plant(x, u, w, p, ca.vertcat(x[1], -9.81 - p[0] * x[0] - p[1] * x[1] + u + w), BOX, dt)


def matrices(p):
    """Continuous A, B, c of it."""
    return np.array([[0, 1], [-p[0], -p[1]]]), np.array([[0.0], [1.0]]), np.array([0, -9.81])


def test_a_constant_term_is_held_exactly_at_a_thousand_designs():
    model = discretise(hanging())
    designs = np.random.default_rng(0).uniform(BOX.lower, BOX.upper, (1000, 2))
    for p, own, A_own in zip(designs, model.constant(designs), model.matrices(designs)[0]):
        A, _, c = matrices(p)
        M = expm(np.block([[A * 0.05, c[:, None] * 0.05], [np.zeros((1, 3))]]))
        np.testing.assert_allclose(own, M[:2, 2], rtol=1e-12)
        np.testing.assert_allclose(A_own, M[:2, :2], rtol=0, atol=1e-12 * np.abs(M[:2, :2]).max())


def test_a_model_with_a_constant_term_falls_as_its_plant_does():
    model, plant = discretise(hanging()), hanging()
    runs = [simulate(one, LinearFeedback([[0.0, 0.0]]), x0=[0.1, 0.0], steps=50, design=[50.0, 0.3]).states
            for one in (model, plant)]  # fmt: skip
    np.testing.assert_allclose(*runs, atol=1e-6)
    assert model.affine
    assert "a constant term" in repr(model)


def test_a_discrete_plant_keeps_its_constant_term():
    model = discretise(hanging(continuous=False))
    np.testing.assert_allclose(model.constant([50.0, 0.3]), [0.0, -9.81 * 0.05])


def test_a_state_space_has_no_place_for_a_constant_term():
    with pytest.raises(InputError, match="a constant term"):
        discretise(hanging()).state_space([50.0, 0.3])
    with pytest.raises(InputError, match=r"c: got shape \(3, 1\), expected \(2, 1\)"):
        LinearModel(ca.SX(0, 1), ca.SX.eye(2), ca.SX.ones(2, 1), ca.SX(2, 0), 0.1, None, ca.SX.ones(3, 1))


# ── first-order hold ──


def test_a_first_order_hold_is_that_of_python_control():
    plant = quarter_car()
    held = first_order_hold(plant)
    for p in plant.design.spread()[:8]:
        A, B0, B1, E0, E1, c = held.matrices(p)
        z = ca.vertcat(plant.x, plant.u, plant.w)
        J = np.asarray(ca.Function("J", [plant.p], [ca.densify(ca.jacobian(plant.dynamics, z))])(p))
        foh = control.ss(J[:, :4], J[:, 4:], np.eye(4), np.zeros((4, 2))).sample(0.05, method="foh")
        # python-control moves the state by B1 u, so that its inputs are causal: B = B0 + A B1, D = B1
        own = np.hstack([B0 + A @ B1, E0 + A @ E1])
        np.testing.assert_allclose(own, foh.B, rtol=1e-9, atol=1e-9 * np.abs(foh.B).max())
        np.testing.assert_allclose(np.hstack([B1, E1]), foh.D, rtol=1e-9, atol=1e-9 * np.abs(foh.D).max())
        assert not c.any()


def test_a_ramp_is_followed_exactly():
    p = [60.0, 0.4]
    A, B0, B1, _, _, c = first_order_hold(hanging()).matrices(p)
    Ac, Bc, cc = matrices(p)
    x, u, u_next = np.array([0.2, -0.1]), 1.5, -2.0
    exact = (
        expm(Ac * 0.05) @ x
        + quad_vec(
            lambda s: expm(Ac * (0.05 - s)) @ (Bc[:, 0] * (u + (u_next - u) * s / 0.05) + cc), 0, 0.05, epsabs=1e-14
        )[0]
    )
    np.testing.assert_allclose(A @ x + B0[:, 0] * u + B1[:, 0] * u_next + c, exact, rtol=1e-12)


def test_steps_are_the_sum_of_the_two_ends():
    held, model = first_order_hold(quarter_car()), discretise(quarter_car(), sampling_guard="ignore")
    p = [27692.0, 1906.5]
    A, B0, B1, E0, E1, _ = held.matrices(p)
    for own, M in zip((A, B0 + B1, E0 + E1), model.matrices(p)):
        np.testing.assert_allclose(own, M, rtol=1e-11, atol=1e-14)


# ── noise ──


def test_the_noise_covariance_is_the_integral():
    plant = quarter_car()
    covariance = noise_covariance(plant, [[0.3]])
    for p in ([1e4, 500.0], [4e4, 3000.0]):
        z = ca.vertcat(plant.x, plant.w)
        J = np.asarray(ca.Function("J", [plant.p], [ca.densify(ca.jacobian(plant.dynamics, z))])(p))
        A, E = J[:, :4], J[:, 4:]

        def grown(s, A=A, E=E):
            return expm(A * s) @ E @ E.T @ expm(A * s).T * 0.3

        exact = quad_vec(grown, 0, 0.05, epsabs=1e-13, epsrel=1e-12)[0]
        own = np.asarray(covariance(p))
        size = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
        assert (np.abs(own - exact) <= 1e-10 * size).all()
        assert np.linalg.eigvalsh(own / size).min() > -1e-12


def test_noise_of_a_stiff_plant_does_not_overflow():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = Plant(x, u, w, p, ca.vertcat(-1e6 * x[0] + w, -p * x[1] + w + u), DesignSpace(["p"], [0.5], [2.0]), dt=0.1)
    Q = np.asarray(noise_covariance(plant, [[2.0]])([1.0]))
    np.testing.assert_allclose(Q[0, 0], 2.0 / 2e6, rtol=1e-9)
    np.testing.assert_allclose(Q[1, 1], 1 - np.exp(-0.2), rtol=1e-10)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: noise_covariance(hanging(continuous=False), [[1.0]]), "plant: got a discrete plant"),
        (lambda: noise_covariance(hanging(), [[-1.0]]), "intensity: got"),
        (lambda: noise_covariance(swing(), [[1.0]]), r"dynamics nonlinear in x, u or w for ω \[rad/s\]"),
        (lambda: first_order_hold(swing()), "dynamics nonlinear"),
        (lambda: first_order_hold(hanging(continuous=False)), "plant: got a discrete plant"),
        (lambda: first_order_hold(hanging(), dt=0.0), "dt: got 0.0"),
    ],
)
def test_what_has_no_hold_or_noise_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


# ── plants from matrices, outputs ──


def test_a_plant_from_matrices_of_the_design_is_the_one_written_out():
    p = ca.SX.sym("p", 2)
    A = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-p[0], -p[1]))
    own = plant_from_matrices(A, [0.0, 1.0], [0.0, 1.0], c=[0.0, -9.81], p=p, design=BOX, dt=0.05)
    for M, N in zip(discretise(own).matrices([50.0, 0.3]), discretise(hanging()).matrices([50.0, 0.3])):
        np.testing.assert_allclose(M, N, rtol=1e-14)
    np.testing.assert_allclose(discretise(own).constant([50.0, 0.3]), discretise(hanging()).constant([50.0, 0.3]))


def test_a_state_space_is_one_of_one_design():
    plant = Plant(*(ca.SX.sym(n) for n in "xuwp"), ca.SX(0), DesignSpace(["k"], [1], [2]), dt=0.1)
    with pytest.raises(InputError, match=r"p: got shape \(1, 1\), expected one design"):
        discretise(plant).state_space([[1.5]])


@pytest.mark.parametrize("sampled", [False, True])
def test_a_state_space_of_python_control_goes_in_and_comes_out(sampled):
    system = control.ss([[0.0, 1.0], [-2.0, -0.3]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
    system = system.sample(0.1) if sampled else system
    plant = plant_from_state_space(system, dt=None if sampled else 0.1)
    out = discretise(plant).state_space()
    reference = system if sampled else system.sample(0.1)
    np.testing.assert_allclose(out.A, reference.A, rtol=1e-12)
    np.testing.assert_allclose(out.B, reference.B, rtol=1e-12)
    np.testing.assert_allclose(plant.observe([[1.0, 2.0], [3.0, 4.0]], [[0.0], [0.0]]), [[1.0], [3.0]])


def test_outputs_are_observed_along_runs_and_survive_a_pickle():
    import pickle

    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    rate = -p[0] * x[0] - p[1] * x[1] + u
    plant = Plant(
        x, u, w, p, ca.vertcat(x[1], rate + w), BOX, dt=0.05, outputs=[rate, x[0] ** 2],
        output_names=["a [m/s²]", "s²"], output_limits=([-5.0, -np.inf], [5.0, 1.0]),
    )  # fmt: skip
    states, inputs = np.random.default_rng(0).standard_normal((3, 7, 2)), np.ones((3, 7, 1))
    y = pickle.loads(pickle.dumps(plant)).observe(states, inputs, [50.0, 0.3])
    np.testing.assert_allclose(y[..., 0], -50 * states[..., 0] - 0.3 * states[..., 1] + 1.0)
    np.testing.assert_allclose(y[..., 1], states[..., 0] ** 2)
    assert plant.ny == 2
    assert plant.output_limits[0].tolist() == [-5.0, -np.inf]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"outputs": [ca.SX.sym("z")]}, r"outputs: got unknown symbols \['z'\]"),
        ({"outputs": ca.SX.ones(2, 2)}, r"outputs: got shape \(2, 2\)"),
        ({"outputs": [ca.SX(1)], "output_names": ["a", "b"]}, "output_names: got"),
        ({"outputs": [ca.SX(1)], "output_limits": 3.0}, "output_limits: got"),
        ({"outputs": [ca.SX(1)], "output_limits": (2.0, 1.0)}, "expected lower < upper"),
        ({"outputs": [ca.SX(1)], "output_limits": ([1.0, 2.0], 3.0)}, "output_limits, lower: got"),
        ({"outputs": [ca.SX(1)], "output_limits": (np.nan, 3.0)}, "output_limits, lower: got"),
    ],
)
def test_outputs_that_make_no_sense_are_refused(options, message):
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    with pytest.raises(InputError, match=message):
        Plant(x, u, None, None, -x + u, DesignSpace([], [], []), dt=0.1, **options)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: plant_from_matrices([[1.0, 2.0]], [1.0], dt=0.1), r"A: got shape \(1, 2\)"),
        (lambda: plant_from_matrices([[1.0]], [[1.0], [2.0]], dt=0.1), r"B: got shape \(2, 1\), expected 1 rows"),
        (lambda: plant_from_matrices([[1.0]], [1.0], dt=0.1, D=[[1.0]]), "C: got nothing, beside D"),
        (lambda: plant_from_matrices([[1.0]], [1.0], dt=0.1, C=[[1.0, 2.0]]), r"C: got shape \(1, 2\)"),
        (lambda: plant_from_matrices("A", [1.0], dt=0.1), "A: got 'A'"),
        (lambda: plant_from_matrices([[ca.SX.sym("z")]], [1.0], dt=0.1), "stack expressions"),
        (lambda: plant_from_state_space(control.ss([[1.0]], [[1.0]], [[1.0]], [[0.0]])), "dt: got nothing"),
        (lambda: plant_from_state_space(3.0), "system: got 3.0"),
    ],
)
def test_matrices_that_do_not_fit_are_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_matrices_that_make_no_plant_are_refused_by_name():
    with pytest.raises(InputError, match="foo: got 1, expected nothing of that name, but continuous, state_names"):
        plant_from_matrices([[1.0]], [[1.0]], dt=0.1, foo=1)
    with pytest.raises(InputError, match=r"c: got shape \(2, 2\), expected \(2,\), one number per state"):
        plant_from_matrices(np.eye(2), np.eye(2), dt=0.1, c=np.eye(2))
