"""The cubature Kalman filter: the linear one of linear models, else that of the textbook, and consistent errors."""

import copy
import pickle

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc
from ccdtools import InputError, KalmanFilter, Measurement
from ccdtools.estimation import CubatureKalmanFilter
from ccdtools.plants import library

STEPS = 40
PENDULUM = library.pendulum_on_cart()
P = PENDULUM.design.centre


@pytest.fixture(scope="module")
def servo():
    """Return a linear plant with outputs that depend on the input, its matrices and a record."""
    plant = library.dc_servo()
    angle = plant.x[0]
    plant = cc.Plant(plant.x, plant.u, plant.w, plant.p, plant.dynamics, plant.design, plant.dt,
                     outputs=[angle + 0.3 * plant.u[0], 2 * plant.x[1]])  # fmt: skip
    rng = np.random.default_rng(0)
    return plant, rng.standard_normal((3, STEPS, 2)), rng.standard_normal((3, STEPS, plant.nu))


COVARIANCES = {"W": [1e-4, 1e-2], "V": [1e-2, 0.1], "P0": [1.0, 2.0], "x0": [0.1, -0.2]}


@pytest.mark.parametrize("kind", ["exact", "integrated", "sampled"])
def test_of_a_linear_model_it_is_the_kalman_filter(servo, kind):
    plant, y, u = servo
    p = plant.design.centre
    A, B, _ = cc.discretise(plant).matrices(p)
    linear = KalmanFilter(A, B, [[1, 0], [0, 2]], D=[[0.3], [0]], steady=False, **COVARIANCES).filter(y, u)
    sampled = cc.SampledModel(plant, plant.dt)
    model = {"exact": cc.discretise(plant), "integrated": plant, "sampled": sampled}[kind]
    cubature = CubatureKalmanFilter(model, plant, design=p, **COVARIANCES).filter(y, u)
    exact = 1e-9 if kind == "exact" else 1e-5  # Runge–Kutta
    np.testing.assert_allclose(cubature.means, linear.means, rtol=exact, atol=exact)
    np.testing.assert_allclose(cubature.innovations, linear.innovations, rtol=exact, atol=exact)
    for i in range(3):
        np.testing.assert_allclose(cubature.covariances[i], linear.covariances, rtol=exact, atol=exact**2)
        np.testing.assert_allclose(
            cubature.innovation_covariances[i], linear.innovation_covariances, rtol=exact, atol=exact**2
        )


def test_a_constant_term_of_a_linear_model_is_predicted():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    falls = cc.Plant(x, u, None, None, [0.5 * x + u + 3.0], cc.DesignSpace([], [], []), 1.0, continuous=False)
    found = CubatureKalmanFilter(cc.discretise(falls), [[1.0]], W=[1e-9], V=[1e9], P0=[1e-9]).filter(
        np.zeros((4, 1)), np.zeros((4, 1))
    )
    np.testing.assert_allclose(found.means[0, :, 0], [0.0, 3.0, 4.5, 5.25], rtol=1e-6)


def by_hand(step, h, W, V, x, cov, y, u):
    """The filter of the textbook for one run: cubature points and their covariances."""

    def moments(f, x, cov):
        root = np.sqrt(len(x)) * np.linalg.cholesky(cov)
        points = x + np.vstack([root.T, -root.T])
        values = np.array([f(point) for point in points])
        away, mean = points - x, values.mean(axis=0)
        left = values - mean
        return mean, left.T @ left / len(points), away.T @ left / len(points)

    means = []
    last = np.zeros(u.shape[1])
    for k in range(len(y)):
        if k:
            x, cov, _ = moments(lambda z: step(z, last), x, cov)  # noqa: B023
            cov = cov + W
        expected, S, both = moments(h, x, cov)
        K = both @ np.linalg.inv(S + V)
        x, cov = x + K @ (y[k] - expected), cov - K @ (S + V) @ K.T
        means.append(x)
        last = u[k]
    return np.array(means)


def polar(x):
    """Distance and angle of the tip of the pole, of unit length, seen from beside the cart."""
    across, up = x[..., 0] + np.sin(x[..., 2]), 1.5 + np.cos(x[..., 2])
    return np.stack([np.hypot(across, up), np.arctan2(across, up)], axis=-1)


def polar_plant():
    """The pendulum with the same outputs as expressions."""
    across, up = PENDULUM.x[0] + ca.sin(PENDULUM.x[2]), 1.5 + ca.cos(PENDULUM.x[2])
    outputs = [ca.sqrt(across**2 + up**2), ca.atan2(across, up)]
    return cc.Plant(PENDULUM.x, PENDULUM.u, PENDULUM.w, PENDULUM.p, PENDULUM.dynamics, PENDULUM.design, PENDULUM.dt,
                    outputs=outputs)  # fmt: skip


def a_record(runs, seed=0, noise=0.01):
    """States, outputs and inputs of the pendulum, kept upright."""
    A, B, _ = cc.discretise(library.pendulum_on_cart(linear=True)).matrices(P)
    from mpc import lqr

    K, _ = lqr(A, B, Q=np.eye(4), R=[[1.0]])
    rng = np.random.default_rng(seed)
    x0 = 0.05 * rng.standard_normal((runs, 4))
    run = cc.simulate(PENDULUM, cc.LinearFeedback(K), x0=x0, steps=STEPS, design=P)
    states = run.states[:, :-1]
    return states, polar(states) + noise * rng.standard_normal((runs, STEPS, 2)), run.inputs


GIVEN = {"W": 1e-8 * np.ones(4), "V": 1e-4 * np.ones(2), "P0": 0.05**2 * np.ones(4), "design": P}


@pytest.mark.parametrize("output", [polar, polar_plant()], ids=["function", "plant"])
def test_it_is_the_filter_of_the_textbook(output):
    _, y, u = a_record(12)
    found = CubatureKalmanFilter(PENDULUM, output, **GIVEN).filter(y, u)
    step = PENDULUM.step
    for i in (0, 11):
        means = by_hand(
            lambda x, last: np.asarray(step(x, last, np.zeros(PENDULUM.nw), P)).ravel(), polar,
            1e-8 * np.eye(4), 1e-4 * np.eye(2), np.zeros(4), 0.05**2 * np.eye(4), y[i], u[i],
        )  # fmt: skip
        np.testing.assert_allclose(found.means[i], means, rtol=1e-8, atol=1e-10)


def test_all_runs_at_once_are_the_runs_one_by_one():
    _, y, u = a_record(9)
    filter_ = CubatureKalmanFilter(PENDULUM, polar_plant(), **GIVEN)
    together = filter_.filter(y, u)
    for i in (0, 8):
        np.testing.assert_allclose(filter_.filter(y[i], u[i]).means[0], together.means[i], rtol=1e-10, atol=1e-13)


@pytest.mark.long
def test_errors_are_as_large_as_is_stated():
    states, y, u = a_record(300, seed=3)
    given = GIVEN | {"W": 1e-14 * np.ones(4)}
    found = CubatureKalmanFilter(PENDULUM, polar, **given).filter(y, u)
    blind = CubatureKalmanFilter(PENDULUM, polar, **(given | {"V": 1e12 * np.ones(2)})).filter(y, u)
    error = states[:, -1] - found.means[:, -1]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariances[:, -1]), error)
    assert nees.mean() == pytest.approx(4, abs=4 * np.sqrt(2 * 4 / 300))
    assert np.abs(error).mean() < 0.3 * np.abs(states[:, -1] - blind.means[:, -1]).mean()


def test_units_change_nothing():
    _, y, u = a_record(4)
    units = np.array([1e4, 1e-4, 1e3, 1e-3])
    x, u_, w, p = PENDULUM.x, PENDULUM.u, PENDULUM.w, PENDULUM.p
    moved = ca.substitute(PENDULUM.dynamics, x, x / ca.DM(units)) * ca.DM(units)
    other = cc.Plant(x, u_, w, p, moved, PENDULUM.design, PENDULUM.dt)
    scaled = {"W": 1e-8 * units**2, "P0": 0.05**2 * units**2, "V": GIVEN["V"], "design": P}
    found = CubatureKalmanFilter(other, lambda x: polar(x / units), **scaled).filter(y, u).means / units
    own = CubatureKalmanFilter(PENDULUM, polar, **GIVEN).filter(y, u).means
    np.testing.assert_allclose(found, own, rtol=1e-5, atol=1e-8)


def test_a_function_of_input_and_design_is_given_them():
    plant = library.quarter_car()
    p = plant.design.centre
    heard = []

    def h(x, u, p):
        heard.append((u.copy(), p))
        return x[:, :1] + u

    y, u = np.ones((1, 3, 1)), np.arange(3.0).reshape(1, 3, 1)
    CubatureKalmanFilter(plant, h, W=np.ones(4), V=[1.0], P0=np.ones(4), design=p).filter(y, u)
    np.testing.assert_array_equal(np.unique(np.concatenate([u for u, _ in heard])), [0.0, 1.0])
    np.testing.assert_array_equal(heard[-1][1], p)


def test_states_that_are_known_exactly_are_not_moved():
    found = CubatureKalmanFilter(PENDULUM, polar, W=np.zeros(4), V=[1.0, 1.0], P0=np.zeros(4), design=P)
    y, u = np.ones((5, 2)), np.zeros((5, 1))
    np.testing.assert_array_equal(found.filter(y, u).means, np.zeros((1, 5, 4)))


def test_a_disturbance_of_a_linear_plant_is_that_of_the_kalman_filter(servo):
    plant, y, u = servo
    p = plant.design.centre
    model = cc.discretise(plant)
    A, B, E = model.matrices(p)
    mean, S = np.full(plant.nw, 0.3), 0.04 * np.eye(plant.nw)
    told = {"V": [1e-2, 0.1], "P0": np.zeros(2), "x0": [0.1, -0.2]}
    linear = KalmanFilter(A, B, [[1, 0], [0, 2]], D=[[0.3], [0]], W=E @ S @ E.T, c=E @ mean, steady=False, **told)
    cubature = CubatureKalmanFilter(model, plant, design=p, W=np.zeros(2), disturbance=(mean, S), **told)
    np.testing.assert_allclose(cubature.filter(y, u).means, linear.filter(y, u).means, rtol=1e-10, atol=1e-10)


def test_what_jumps_is_filtered_as_in_the_textbook():
    x, u, none = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX(0, 1)

    def step(x, u, sign=np.sign):
        return [x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - x[0] - sign(x[1]))]

    def quantised(x, floor=np.floor):
        return [floor(4 * x[0]) / 4, x[1] + (x[0] > 0.5)]

    plant = cc.Plant(x, u, none, none, step(x, [u], ca.sign), cc.DesignSpace([], [], []), 0.1, continuous=False,
                     outputs=quantised(x, ca.floor))  # fmt: skip
    rng = np.random.default_rng(0)
    y, inputs, cov = rng.standard_normal((STEPS, 2)), rng.standard_normal((STEPS, 1)), np.diag([1.0, 0.5])
    W, V = np.diag([1e-3, 1e-2]), np.diag([0.02, 0.1])
    found = CubatureKalmanFilter(plant, W=W, V=V, P0=cov, x0=[0.3, -0.2]).filter(y, inputs)
    expected = by_hand(lambda x, u: np.array(step(x, u)), lambda x: np.array(quantised(x)), W, V,
                       np.array([0.3, -0.2]), cov, y, inputs)  # fmt: skip
    np.testing.assert_allclose(found.means[0], expected, rtol=0, atol=1e-9)


def test_a_linear_output_beside_another_is_seen_however_far_away():
    x, u, none = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX(0, 1)
    plant = cc.Plant(x, u, none, none, x + u, cc.DesignSpace([], [], []), 0.1, continuous=False,
                     outputs=[ca.sin(x[0]), x[1]])  # fmt: skip
    told = CubatureKalmanFilter(plant, W=np.zeros(2), V=[1.0, 1e-6], P0=[0.1, 1e-6], x0=[0.0, 1e15])
    found = told.filter(np.array([[0.0, 1e15]]), np.zeros((1, 1)))
    assert found.covariances[0, 0, 1, 1] == pytest.approx(5e-7, rel=1e-9)


@pytest.mark.parametrize(("speed", "deviation"), [(10.0, 1e-5), (300.0, 1e-5), (1e4, 1e-4), (1e6, 1.0)])
def test_a_position_that_nothing_sees_drifts_however_far_from_zero(speed, deviation):
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    dynamics = [x[1], u - 1e-3 * x[1] * ca.fabs(x[1])]
    plant = cc.Plant(x, u, None, None, dynamics, cc.DesignSpace([], [], []), 0.01, outputs=[x[1]])
    told = {"W": [1e-6, 1e-4], "V": [1e-2], "P0": [deviation**2, deviation**2], "x0": [speed, speed]}
    assert "neither grows nor decays" in repr(CubatureKalmanFilter(plant, **told))


def rubbing():
    """Mass on a spring with dry friction, whose acceleration and position are measured."""
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    force = -x[0] - 0.3 * x[1] - ca.tanh(x[1] / 0.02) + u
    return cc.Plant(x, u, w, None, [x[1], force + w], cc.DesignSpace([], [], []), 0.02, substeps=4,
                    outputs=[force, x[0]])  # fmt: skip


@pytest.mark.check
def test_dry_friction_is_estimated_nearly_as_well_as_by_particles():
    plant, rng, runs, steps, particles = rubbing(), np.random.default_rng(0), 6, 100, 10_000
    V, S, start = np.array([0.04, 1e-4]), 4.0, np.array([0.3, 0.5])
    w = np.sqrt(S) * rng.standard_normal((runs, steps, 1))
    u = np.repeat(2 * rng.standard_normal((runs, steps // 20, 1)), 20, axis=1)
    rows, move = [start * rng.standard_normal((runs, 2))], plant.stepper(np.zeros(0), batch=runs)
    for k in range(steps - 1):
        rows.append(move(rows[-1], u[:, k], w[:, k]))
    x = np.stack(rows, axis=1)
    last = np.concatenate([np.zeros((runs, 1, 1)), u[:, :-1]], axis=1)
    y = np.stack([plant.observe(x[:, k], last[:, k]) for k in range(steps)], axis=1)
    y = y + np.sqrt(V) * rng.standard_normal(y.shape)
    estimator = CubatureKalmanFilter(plant, W=np.zeros(2), V=V, P0=start**2, disturbance=([0.0], [S]))
    means = estimator.filter(y, u).means
    best, step = np.empty_like(means), plant.stepper(np.zeros(0), batch=particles)
    for i in range(runs):
        at = start * rng.standard_normal((particles, 2))
        for k in range(steps):
            held = np.repeat(last[i, k : k + 1], particles, axis=0)
            at = at if k == 0 else step(at, held, np.sqrt(S) * rng.standard_normal((particles, 1)))
            fit = -0.5 * ((y[i, k] - plant.observe(at, held)) ** 2 / V).sum(axis=1)
            weight = np.exp(fit - fit.max())
            weight /= weight.sum()
            best[i, k] = weight @ at
            at = at[rng.choice(particles, particles, p=weight)]
    mine, theirs = (np.sqrt(((found - x) ** 2).mean(axis=(0, 1))) for found in (means, best))
    assert (mine < 1.5 * theirs).all()  # an extended filter errs twice as far and more


def test_implicit_steps_are_filtered_too():
    plant = library.quarter_car(nonlinear=True)
    p = plant.design.centre
    given = {"W": 1e-6 * np.ones(4), "V": [1e-4], "P0": 1e-2 * np.ones(4), "design": p}
    rng = np.random.default_rng(0)
    y, u = 0.01 * rng.standard_normal((2, 10, 1)), rng.standard_normal((2, 10, 1))
    explicit, implicit = (
        CubatureKalmanFilter(cc.discretise(plant, method=method), [[1.0, 0, 0, 0]], **given).filter(y, u).means
        for method in ("rk4", "collocation")
    )
    np.testing.assert_allclose(implicit, explicit, rtol=1e-4, atol=1e-6)


def test_copies_and_pickles_do_the_same():
    _, y, u = a_record(2)
    own = CubatureKalmanFilter(PENDULUM, polar_plant(), **GIVEN)
    assert copy.deepcopy(own) is own
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(own)).filter(y, u).means, own.filter(y, u).means)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"model": polar}, "model: got"),
        ({"output": None}, "output: got a plant without outputs"),
        ({"model": cc.discretise(library.pendulum_on_cart(linear=True)), "output": None}, "output: got nothing"),
        ({"output": [[1.0, 0.0]]}, "output: got shape"),
        ({"output": library.quarter_car()}, "output: got a plant without outputs"),
        ({"output": lambda x: x[:, 0]}, r"output: got outputs of shape \(1,\) for states \(1, 4\)"),
        ({"output": lambda x, v: x}, r"output: got a function of \(x, v\)"),
        ({"output": lambda *, x: x}, "output: got a function of"),
        ({"design": None}, "design: got nothing"),
        ({"design": [1.0]}, "design: got shape"),
        ({"V": [1.0]}, "V: got shape"),
        ({"W": -np.ones(4)}, "W: got a negative variance"),
        ({"P0": None}, "P0: got nothing"),
        ({"x0": [0.0]}, "x0: got shape"),
        ({"disturbance": 0.1}, r"disturbance: got 0.1, expected a mean \(1,\) and a covariance \(1, 1\)"),
        ({"disturbance": ([0.0], -np.ones(1))}, "disturbance: got a negative variance"),
    ],
)
def test_what_makes_no_filter_is_named(changed, message):
    given = {"model": PENDULUM, "output": polar} | GIVEN | changed
    with pytest.raises(InputError, match=message):
        CubatureKalmanFilter(**given)


def test_the_noise_of_a_measurement_plays_no_part():
    _, y, u = a_record(1)
    noisy = CubatureKalmanFilter(PENDULUM, Measurement(polar, noise=[1.0, 1.0]), **GIVEN)
    np.testing.assert_array_equal(
        noisy.filter(y, u).means, CubatureKalmanFilter(PENDULUM, polar, **GIVEN).filter(y, u).means
    )
