"""Kalman filters: their gains, their estimates, what is left of the measurements, and what they refuse."""

import pickle
import warnings

import casadi as ca
import control
import numpy as np
import pytest
from gaussians import conditioned, random_system
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

import ccdtools as cc
from ccdtools import InputError, KalmanFilter, LinearFeedback, Measurement
from ccdtools.controllers import Observed
from ccdtools.exceptions import NotDetectableError
from ccdtools.plants import LinearModel
from mpc import lqr

A = np.array([[1.0, 0.1], [0.0, 1.0]])
B = np.array([[0.005], [0.1]])
C = np.array([[1.0, 0.0]])
W = np.diag([1e-4, 1e-3])
V = np.array([[1e-2]])


@pytest.mark.parametrize("steady", [True, False])
def test_a_mean_of_the_process_noise_moves_the_estimate_as_it_moves_the_state(steady, rng):
    c, start = np.array([0.02, -0.1]), {} if steady else {"P0": [1.0, 0.5]}
    one, other = (KalmanFilter(A, B, C, W, V, steady=steady, c=mean, **start) for mean in (c, None))
    moved, by_one, by_other = np.zeros(2), one.start(3), other.start(3)
    for _ in range(20):
        y, u = rng.standard_normal((2, 3, 1))
        by_one = one.predict(one.update(by_one, y + moved[:1], u), u)
        by_other = other.predict(other.update(by_other, y, u), u)
        moved = A @ moved + c
        np.testing.assert_allclose(by_one.mean, by_other.mean + moved, atol=1e-10)
    assert np.array_equal(KalmanFilter(**one.to_dict()).c, c)
    with pytest.raises(InputError, match="c: "):
        KalmanFilter(A, B, C, W, V, c=[1.0])


@pytest.mark.parametrize("seed", range(5))
def test_the_steady_gain_is_that_of_python_control(seed):
    A, B, C, W, V = random_system(np.random.default_rng(seed))
    steady = KalmanFilter(A, B, C, W, V)
    L, P, poles = control.dlqe(A, np.eye(4), C, W, V)
    np.testing.assert_allclose(A @ steady.gain, L, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(steady.predicted, P, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(np.sort(np.abs(steady.poles)), np.sort(np.abs(poles)), rtol=1e-6)
    S = C @ P @ C.T + V
    np.testing.assert_allclose(steady.covariance, P - P @ C.T @ np.linalg.solve(S, C @ P), rtol=1e-7, atol=1e-10)


def test_of_short_samples_the_gain_is_that_of_continuous_time():
    F, G = np.array([[0.0, 1.0], [-4.0, -0.5]]), np.array([[0.0], [1.0]])
    L, _, _ = control.lqe(F, G, C, [[2.0]], [[0.03]])
    plant = cc.plant_from_matrices(F, [[0.0], [1.0]], G, dt=1e-4)
    A, B, _ = cc.discretise(plant).matrices()
    steady = KalmanFilter(A, B, C, np.asarray(cc.noise_covariance(plant, [[2.0]])([])), [[0.03 / 1e-4]])
    np.testing.assert_allclose(steady.gain / 1e-4, L, rtol=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_the_filter_over_time_conditions_on_all_measurements_so_far(seed):
    rng = np.random.default_rng(seed)
    A, B, C, W, V = random_system(rng)
    D = rng.standard_normal((2, 2))
    half = rng.standard_normal((4, 2))
    P0 = half @ half.T  # of rank 2: two combinations of the first state are known exactly
    x0 = rng.standard_normal(4)
    y, u = rng.standard_normal((3, 9, 2)), rng.standard_normal((3, 9, 2))
    found = KalmanFilter(A, B, C, W, V, D=D, steady=False, x0=x0, P0=P0).filter(y, u)
    for i in range(3):
        means, covariances = conditioned(A, B, C, D, W, V, x0, P0, y[i], u[i])
        np.testing.assert_allclose(found.means[i], means, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(found.covariances, covariances, rtol=1e-8, atol=1e-9)


def test_in_the_long_run_both_filters_are_one():
    rng = np.random.default_rng(0)
    y, u = rng.standard_normal((400, 1)), rng.standard_normal((400, 1))
    steady = KalmanFilter(A, B, C, W, V)
    over_time = KalmanFilter(A, B, C, W, V, steady=False, P0=[10.0, 0.1])
    first, other = steady.filter(y, u), over_time.filter(y, u)
    assert np.abs(first.means[:, 5] - other.means[:, 5]).max() > 1e-3
    np.testing.assert_allclose(first.means[:, -1], other.means[:, -1], rtol=1e-8)
    np.testing.assert_allclose(other.covariances[-1], steady.covariance, rtol=1e-8)
    np.testing.assert_allclose(first.covariances[0], other.covariances[-1], rtol=1e-8)
    np.testing.assert_allclose(first.innovation_covariances[0], other.innovation_covariances[-1], rtol=1e-8)


def simulated(steps, runs, rng):
    """States, outputs and inputs of the plant above with its noises."""
    x = np.zeros((runs, steps, 2))
    u = rng.standard_normal((runs, steps, 1))
    for k in range(1, steps):
        x[:, k] = x[:, k - 1] @ A.T + u[:, k - 1] @ B.T + rng.standard_normal((runs, 2)) @ np.sqrt(W)
    return x, x @ C.T + 0.1 * rng.standard_normal((runs, steps, 1)), u


@pytest.mark.check
def test_innovations_are_white_with_the_covariance_that_was_predicted():
    _, y, u = simulated(10_100, 1, np.random.default_rng(1))
    found = KalmanFilter(A, B, C, W, V).filter(y, u)
    e = found.innovations[0, 100:, 0]
    n = len(e)
    assert e.var() / found.innovation_covariances[-1, 0, 0] == pytest.approx(1, abs=4 * np.sqrt(2 / n))
    correlations = [np.mean(e[:-lag] * e[lag:]) / e.var() for lag in range(1, 21)]
    assert np.abs(correlations).max() < 4 / np.sqrt(n)
    assert n * np.sum(np.square(correlations)) < 45.3  # of χ² with 20 degrees of freedom, one in 1000


def test_errors_have_the_covariance_that_is_stated():
    x, y, u = simulated(60, 4000, np.random.default_rng(2))
    found = KalmanFilter(A, B, C, W, V, steady=False, P0=[1e-12, 1e-12]).filter(y, u)
    for k in (1, 5, 59):
        error = x[:, k] - found.means[:, k]
        ratio = np.linalg.solve(np.linalg.cholesky(found.covariances[k]), error.T)
        np.testing.assert_allclose(ratio @ ratio.T / 4000, np.eye(2), atol=4 * np.sqrt(2 / 4000))


def test_the_cost_of_lqg_is_that_of_the_trace_formula():
    Q, R = np.diag([1.0, 0.1]), np.array([[0.5]])
    K, S = lqr(A, B, Q=Q, R=R)
    steady = KalmanFilter(A, B, C, W, V)
    expected = np.trace(S @ W) + np.trace(K.T @ (B.T @ S @ B + R) @ K @ steady.covariance)
    model = LinearModel.from_state_space(control.ss(A, B, np.eye(2), 0, 0.1), E=np.eye(2))
    rng = np.random.default_rng(3)
    run = cc.simulate(
        model, Observed(LinearFeedback(K), steady), x0=np.zeros((400, 2)), steps=600, rng=rng,
        disturbance=cc.Gaussian(np.sqrt(np.diag(W))), output=Measurement(C, noise=[0.1]),
    )  # fmt: skip
    x, u = run.states[:, 200:-1], run.inputs[:, 200:]
    costs = (np.einsum("nki,ij,nkj->nk", x, Q, x) + np.einsum("nki,ij,nkj->nk", u, R, u)).mean(axis=1)
    assert abs(costs.mean() - expected) < 3 * costs.std() / 20
    assert costs.std() / 20 < 0.02 * expected


@pytest.mark.parametrize("steady", [True, False])
def test_in_other_units_the_estimates_are_the_same(steady):
    A, B, C, W, V = random_system(np.random.default_rng(7))
    rng = np.random.default_rng(8)
    y, u = rng.standard_normal((50, 2)), rng.standard_normal((50, 2))
    state, outer, inner = np.array([1e4, 1e-4, 1.0, 1e2]), np.array([1e-4, 1e4]), np.array([1e3, 1e-3])
    start = {} if steady else {"P0": np.eye(4)}
    there = {} if steady else {"P0": np.diag(state**2)}
    own = KalmanFilter(A, B, C, W, V, steady=steady, x0=[1.0, 2.0, 3.0, 4.0], **start)
    other = KalmanFilter(
        A * state[:, None] / state, B * state[:, None] / inner, C * outer[:, None] / state,
        W * state[:, None] * state, V * outer[:, None] * outer, steady=steady, x0=[1.0, 2.0, 3.0, 4.0] * state, **there,
    )  # fmt: skip
    np.testing.assert_allclose(other.filter(y * outer, u * inner).means / state, own.filter(y, u).means, rtol=1e-7)


def test_covariances_stay_semidefinite_where_measurements_are_nearly_exact():
    P0 = 1e8 * np.eye(2)
    exact = KalmanFilter(A, B, C, 1e-12 * np.eye(2), [[1e-12]], steady=False, P0=P0)
    found = exact.filter(np.zeros((200, 1)), np.zeros((200, 1)))
    for P in found.covariances:
        np.testing.assert_array_equal(P, P.T)
        assert np.linalg.eigvalsh(P / np.sqrt(np.outer(np.diag(P), np.diag(P))))[0] > -1e-12


def test_a_mode_that_outputs_do_not_see_is_named():
    with pytest.raises(NotDetectableError, match=r"eigenvalue 1\.2 .*mostly of x2") as raised:
        KalmanFilter(np.diag([0.5, 1.2]), np.ones((2, 1)), C, np.eye(2), V)
    assert raised.value.eigenvalue == pytest.approx(1.2)
    assert raised.value.states == (1,)
    assert isinstance(pickle.loads(pickle.dumps(raised.value)), NotDetectableError)
    KalmanFilter(np.diag([0.5, 0.9]), np.ones((2, 1)), C, np.eye(2), V)  # one that decays need not be seen


def test_a_position_that_only_speeds_are_measured_of_is_named_in_any_units():
    for scale in (np.ones(2), np.array([1e4, 1e-4]), np.array([1e-4, 1e4])):
        with pytest.raises(NotDetectableError, match="mostly of x1, with relative strength"):
            KalmanFilter(A * scale[:, None] / scale, B, [[0.0, 1.0]], W * scale[:, None] * scale, V)


def test_a_nearly_unobservable_pair_is_refused_where_scipy_answers():
    F, H = np.array([[1.3, 0.0], [0.0, 0.7]]), np.array([[1e-9, 1.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        P = solve_discrete_are(F.T, H.T, np.eye(2), V)
    assert np.abs(P).max() > 1e10
    with pytest.raises(NotDetectableError, match="mostly of x1"):
        KalmanFilter(F, np.ones((2, 1)), H, np.eye(2), V)


def test_a_mode_on_the_unit_circle_without_noise_is_named_and_filtered_over_time():
    F, H = np.array([[0.8, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    with pytest.raises(NotDetectableError, match=r"W: .* eigenvalue 1 .*mostly of x2, on the unit .*steady=False"):
        KalmanFilter(F, np.ones((2, 1)), H, [1.0, 0.0], V)
    found = KalmanFilter(F, np.ones((2, 1)), H, [1.0, 0.0], V, steady=False, P0=[1.0, 1.0])
    variances = found.filter(np.zeros((200, 1)), np.zeros((200, 1))).covariances[:, 1, 1]
    assert (np.diff(variances) < 0).all()
    assert variances[-1] < 0.01


@pytest.mark.parametrize("drift", [1e-10, 1e-14, 1e-20])
@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
def test_a_bias_that_hardly_drifts_is_filtered_slowly(drift, unit):
    F, H = np.array([[0.9, 0.3 / unit], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    noise = np.diag([1e-2, drift * unit**2])
    steady = KalmanFilter(F, np.ones((2, 1)), H, noise, [[1.0]])
    P = steady.predicted
    K = F @ P @ H.T / (H @ P @ H.T + 1.0)
    size = np.sqrt(np.diag(P))
    residual = (F @ P @ F.T - K @ H @ P @ F.T + noise - P) / np.outer(size, size)
    assert np.abs(residual).max() < 1e-12
    assert 0 < 1 - np.abs(steady.poles).max() < 1e-4
    # a bias of slow drift q, seen through gain g with noise of density r, has the variance √(q r) / g of long runs
    gain = 0.3 / (1 - 0.9)
    density = 1.0 + 1e-2 / 0.1**2
    assert P[1, 1] == pytest.approx(unit**2 * np.sqrt(drift * density) / gain, rel=0.01)


def test_without_process_noise_a_stable_plant_is_predicted():
    still = KalmanFilter(0.5 * A, B, C, np.zeros((2, 2)), V)
    np.testing.assert_array_equal(still.gain, np.zeros((2, 1)))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"A": np.ones((2, 3))}, "A: got shape"),
        ({"B": np.ones((3, 1))}, r"B: got shape \(3, 1\), expected \(2, nu\)"),
        ({"C": np.ones((1, 3))}, "C: got shape"),
        ({"D": np.ones((2, 2))}, "D: got shape"),
        ({"W": np.eye(3)}, r"W: got shape \(3, 3\)"),
        ({"W": [[1.0, 2.0], [2.0, 1.0]]}, "W: got an indefinite matrix"),
        ({"W": [[1e-8, 2.0], [2.0, 1e8]]}, "W: got an indefinite matrix"),
        ({"W": [[1.0, 0.5], [0.0, 1.0]]}, "W: got a matrix that is not symmetric"),
        ({"W": [1.0, -1.0]}, "W: got a negative variance"),
        ({"W": [[np.nan, 0], [0, 1]]}, "W: got (nan|-?inf) at index"),
        ({"V": [0.0]}, "V: got a variance of 0, expected a positive definite matrix. Give an output without noise"),
        ({"C": np.eye(2), "V": np.ones((2, 2))}, "V: got a singular matrix"),
        ({"P0": np.eye(2)}, "P0: got a covariance, expected nothing with steady=True"),
        ({"steady": False}, "P0: got nothing"),
        ({"steady": "no"}, "steady"),
        ({"steady": False, "P0": [[1.0, 2.0], [2.0, 1.0]]}, "P0: got an indefinite"),
        ({"x0": [1.0]}, "x0: got shape"),
    ],
)
def test_what_makes_no_filter_is_named(changed, message):
    given = {"A": A, "B": B, "C": C, "W": W, "V": V} | changed
    with pytest.raises(InputError, match=message):
        KalmanFilter(**given)


def test_records_of_other_sizes_are_refused():
    steady = KalmanFilter(A, B, C, W, V)
    with pytest.raises(InputError, match="outputs: got shape"):
        steady.filter(np.zeros((5, 2)), np.zeros((5, 1)))
    with pytest.raises(InputError, match=r"inputs: got shape \(1, 4, 1\)"):
        steady.filter(np.zeros((5, 1)), np.zeros((4, 1)))


def test_records_of_one_channel_may_be_vectors():
    steady = KalmanFilter(A, B, C, W, V)
    y, u = np.arange(5.0), np.ones(5)
    np.testing.assert_array_equal(steady.filter(y, u).means, steady.filter(y[None, :, None], u[:, None]).means)


def test_a_plant_without_inputs_has_a_filter():
    found = KalmanFilter(A, np.zeros((2, 0)), C, W, V)
    assert found.filter(np.zeros((5, 1)), np.zeros((5, 0))).means.shape == (1, 5, 2)


def test_the_error_covariance_solves_its_own_equation_in_a_pickle_too():
    for steady in (KalmanFilter(A, B, C, W, V), pickle.loads(pickle.dumps(KalmanFilter(A, B, C, W, V)))):
        M = steady.gain
        F = (np.eye(2) - M @ C) @ A
        noise = (np.eye(2) - M @ C) @ W @ (np.eye(2) - M @ C).T + M @ V @ M.T
        np.testing.assert_allclose(solve_discrete_lyapunov(F, noise), steady.covariance, rtol=1e-8)
        assert not steady.gain.flags.writeable


def two_tanks_with_flow():
    """A nonlinear plant that rests away from zero, whose outputs see the state, the input and the design."""
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    flows = [p * ca.sqrt(x[0]), ca.sqrt(x[1])]
    return cc.Plant(x, u, None, p, [u - flows[0], flows[0] - flows[1]], cc.DesignSpace(["p"], [0.5], [2.0]), 0.2,
                    outputs=[flows[1] + 0.1 * u, 2 * x[0]])  # fmt: skip


@pytest.mark.parametrize("steady", [True, False])
def test_the_filter_of_a_plant_at_rest_takes_its_outputs_from_there(steady):
    plant = two_tanks_with_flow()
    rest = cc.equilibrium(plant, [1.0], u=[2.0], guess=([4.0, 4.0], [2.0]))
    given = {} if steady else {"P0": [0.1, 0.1]}
    linear = cc.linearise(plant, rest)
    own = KalmanFilter.of(linear, W=[1e-6, 1e-6], V=[1e-6, 1e-6], design=[1.0], steady=steady, **given)
    np.testing.assert_allclose(own.y0, [2 + 0.2, 8.0])
    np.testing.assert_allclose(own.C, [[0.0, 0.25], [2.0, 0.0]])
    np.testing.assert_allclose(own.D, [[0.1], [0.0]])
    slopes = control.ss([[-0.25, 0.0], [0.25, -0.25]], [[1.0], [0.0]], np.eye(2), np.zeros((2, 1))).sample(0.2)
    np.testing.assert_allclose(own.A, slopes.A, atol=1e-12)
    np.testing.assert_allclose(own.B, slopes.B, atol=1e-12)
    around = cc.deviations(plant, rest)
    run = cc.simulate(
        around, Observed(LinearFeedback([[0.3, 0.1]]), own), x0=[0.05, -0.1], steps=60, design=[1.0],
        output=Measurement(around, noise=[1e-3, 1e-3]), rng=np.random.default_rng(0),
    )  # fmt: skip
    before = np.concatenate([np.zeros((1, 1, 1)), run.inputs[:, :-1]], axis=1)
    found = own.filter(around.observe(run.states[:, :-1], before, [1.0]), run.inputs)
    np.testing.assert_allclose(found.means[0, -1], run.states[0, -2], atol=1e-4)


def test_only_linear_plants_with_outputs_have_a_kalman_filter_of_their_own():
    plant = two_tanks_with_flow()
    noise = {"W": [1.0, 1.0], "V": [1.0, 1.0], "design": [1.0]}
    with pytest.raises(InputError, match=r"plant: got nonlinear dynamics.*CubatureKalmanFilter"):
        KalmanFilter.of(plant, **noise)
    with pytest.raises(InputError, match="plant: got a constant term"):
        KalmanFilter.of(cc.linearise(plant, [4.0, 4.0], [1.0]), **noise)
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    linear = cc.Plant(x, u, None, None, -x, cc.DesignSpace([], [], []), 0.1, outputs=[x[0] * u])
    with pytest.raises(InputError, match="plant: got outputs that are not linear"):
        KalmanFilter.of(linear, W=[1.0, 1.0], V=[1.0])
    with pytest.raises(InputError, match="a plant without outputs"):
        KalmanFilter.of(cc.Plant(x, u, None, None, -x, cc.DesignSpace([], [], []), 0.1), W=[1.0, 1.0], V=[1.0])


@pytest.mark.parametrize("steady", [True, False])
@pytest.mark.parametrize("rows", [np.zeros((2, 1)), np.zeros((3, 2)), np.zeros(3), None])
def test_signals_of_other_runs_are_named(steady, rows):
    own = KalmanFilter([[0.9]], [[1.0]], [[1.0]], [1.0], [1.0], P0=None if steady else [1.0], steady=steady)
    belief, still = own.start(3), np.zeros((3, 1))
    for name, step in (
        ("u", lambda: own.predict(belief, rows)), ("u", lambda: own.update(belief, still, rows)),
        ("y", lambda: own.update(belief, rows, still)), ("y", lambda: own.innovation(belief, rows, still)),
    ):  # fmt: skip
        with pytest.raises(InputError, match=f"^{name}: got"):
            step()
