"""Moving-horizon estimates beside the Kalman filter, a conic solver, and a loop."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import casadi as ca
import clarabel
import numpy as np
import pytest
from estimation_problems import kalman_difference
from scipy import sparse
from scipy.optimize import least_squares

from ccdtools import KalmanFilter
from ccdtools.controllers import Observed
from mpc import InputError
from mpc.optimal_control import NonlinearMPC, sampled
from mpc.optimal_control.estimation import MovingHorizonEstimator

NO_INPUT = np.zeros((1, 0))
WALK = {"window": 3, "W": [1.0], "V": [1.0], "P0": [1.0]}


def followed(estimator, outputs):
    """Beliefs after each row of outputs, of a plant without inputs."""
    belief, found = estimator.start(1), []
    for k, y in enumerate(outputs):
        belief = estimator.predict(belief, NO_INPUT) if k else belief
        belief = estimator.update(belief, np.reshape(y, (1, -1)), NO_INPUT)
        found.append(belief)
    return found


@pytest.mark.long
@pytest.mark.parametrize(("seed", "window"), [(0, 2), (1, 5), (2, 12), (3, 5), (4, 1)])
def test_on_linear_plants_it_is_the_kalman_filter(seed, window):
    assert kalman_difference(seed, window, samples=25) < 1e-8


def test_a_drifting_parameter_is_a_state_that_nothing_moves_but_noise():
    filter_ = KalmanFilter([[0.9, 1], [0, 1]], np.zeros((2, 1)), [[1, 0]], np.diag([0.01, 0.002]), [[0.04]],
                           steady=False, P0=np.diag([1, 0.5]))  # fmt: skip
    estimator = MovingHorizonEstimator(
        lambda x, w, p: 0.9 * x + p + w, lambda x: x, 1, 0, window=6, W=[0.01], V=[0.04], P0=[1], p=[0], P_p=[0.5],
        p_drift=[0.002],
    )  # fmt: skip
    outputs = 3 + np.random.default_rng(0).normal(size=40)
    known = filter_.start(1)
    for k, belief in enumerate(followed(estimator, outputs)):
        known = filter_.predict(known, np.zeros((1, 1))) if k else known
        known = filter_.update(known, outputs[k].reshape(1, 1), np.zeros((1, 1)))
        np.testing.assert_allclose([belief.mean[0, 0], belief.parameters[0, 0]], known.mean[0], atol=1e-9)


@pytest.mark.long
def test_threads_may_share_an_estimator():
    estimator = MovingHorizonEstimator(lambda x, w: ca.sin(x) + w, lambda x: x, 1, 0, **WALK)
    logs = list(np.random.default_rng(0).normal(size=(6, 20)))
    alone = [followed(estimator, log)[-1].mean for log in logs]
    with ThreadPoolExecutor(6) as threads:
        together = list(threads.map(lambda log: followed(estimator, log)[-1].mean, logs))
    np.testing.assert_array_equal(together, alone)


def test_a_first_estimate_whose_outputs_have_no_slope_is_left():
    outputs = 1 + 0.1 * np.random.default_rng(0).normal(size=8)
    estimator = MovingHorizonEstimator(lambda x, w: x + w, lambda x: x**2, 1, 0, **WALK | {"window": 8, "V": [0.01]})
    last = followed(estimator, outputs)[-1]
    weigh = lambda x: np.concatenate([x[:1], np.diff(x), 10 * (x**2 - outputs)])  # noqa: E731
    known = least_squares(weigh, np.ones(8), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert last.status[0].name == "SOLVED"
    np.testing.assert_allclose(abs(last.mean[0, 0]), known.x[-1], rtol=1e-6)


def test_limits_give_the_optimum_of_the_quadratic_program():
    A, W, steps, limit = np.array([[1, 0.1], [0, 0.95]]), np.diag([1e-3, 1e-2]), 7, ([-0.1, -0.2], [0.5, 0.2])
    y = np.random.default_rng(2).normal(size=8) * 0.5 + 0.4
    estimator = MovingHorizonEstimator(
        lambda x, w: A @ x + w, lambda x: x[0], 2, 0, window=8, W=W, V=[0.05], P0=[1, 1], x_bounds=limit,
        w_bounds=(-0.05, 0.05),
    )  # fmt: skip
    last = followed(estimator, y)[-1]
    n, m = 2 * (steps + 1), 2 * steps
    Q = np.diag(np.r_[np.tile([20.0, 0.0], steps + 1), np.tile(1 / np.diag(W), steps)])
    Q[:2, :2] += np.eye(2)
    g = np.r_[np.stack([-20 * y, 0 * y], axis=1).ravel(), np.zeros(m)]
    move = np.hstack([np.kron(np.eye(steps, steps + 1), A) - np.kron(np.eye(steps, steps + 1, 1), np.eye(2)),
                      np.eye(m)])  # fmt: skip
    low, high = (np.r_[np.tile(side, steps + 1), sign * np.full(m, 0.05)] for side, sign in zip(limit, (-1, 1)))
    rows = sparse.csc_matrix(np.vstack([move, np.eye(n + m), -np.eye(n + m)]))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    cones = [clarabel.ZeroConeT(m), clarabel.NonnegativeConeT(2 * (n + m))]
    found = clarabel.DefaultSolver(sparse.csc_matrix(np.triu(Q)), g, rows, np.r_[np.zeros(m), high, -low], cones,
                                   settings).solve()  # fmt: skip
    assert str(found.status) == "Solved"
    assert last.status[0].name == "SOLVED"
    np.testing.assert_allclose(last.windows[0].course.ravel(), np.array(found.x)[:n], atol=1e-6)


@pytest.mark.long
def test_a_loop_on_measured_angles_swings_to_rest_with_its_unknown_friction_found():
    step = sampled(lambda x, u, p: ca.vertcat(x[1], ca.sin(x[0]) - p * x[1] + u), 0.1)
    law = NonlinearMPC(lambda x, u: step(x, u, 0.1), 2, 1, Q=np.eye(2), R=[[0.1]], horizon=20, U=([-2], [2]))
    estimator = MovingHorizonEstimator(
        lambda x, u, w, p: step(x, u, p) + w, lambda x: x[0], 2, 1, window=10, W=[1e-8, 1e-7], V=[1e-4],
        P0=[0.1, 0.1], x0=[0.8, 0], p=[0.1], P_p=[1.0], p_bounds=([0], [None]),
    )  # fmt: skip
    loop, x, u = Observed(law, estimator), np.array([1.0, 0.0]), np.zeros(1)
    rng, belief = np.random.default_rng(0), estimator.start(1)
    for k in range(60):
        y = x[:1] + 0.01 * rng.normal(size=1)
        belief = estimator.update(estimator.predict(belief, u[None]) if k else belief, y[None], u[None])
        u = loop(None, y=y, u_prev=u)
        x = np.array(step(x, u, 0.6)).ravel()
    assert np.abs(x).max() < 0.05
    np.testing.assert_allclose(belief.mean[0], x, atol=0.03)
    assert 0.3 < belief.parameters[0, 0] < 0.9
    assert belief.status[0].name == "SOLVED"


def test_an_estimate_stays_within_limits_however_far_an_output_is():
    estimator = MovingHorizonEstimator(lambda x, w: x + w, lambda x: x, 1, 0, **WALK, x_bounds=([0], [1]))
    belief = followed(estimator, [1e9])[-1]
    assert belief.status[0].name == "SOLVED"
    np.testing.assert_allclose(belief.mean, 1.0, atol=1e-6)


def test_a_course_at_a_limit_leaves_it_where_a_cheaper_one_lies_within():
    """Batch reactor 2A → B seen by its pressure (Haseltine and Rawlings, Ind. Eng. Chem. Res. 44, 2005)."""
    react = lambda x: ca.vertcat(x[0] - 0.032 * x[0] ** 2, x[1] + 0.016 * x[0] ** 2)  # noqa: E731
    first, rng, x, outputs = np.array([0.1, 4.5]), np.random.default_rng(5), np.array([3.0, 1.0]), []
    for _ in range(4):
        outputs.append(x.sum() + 0.1 * rng.normal())
        x = np.array(react(x)).ravel() + 0.01 * rng.normal(size=2)
    estimator = MovingHorizonEstimator(
        lambda x, w: react(x) + w, lambda x: x[0] + x[1], 2, 0, window=4, W=[1e-4, 1e-4], V=[1e-2], P0=[36, 36],
        x0=first, x_bounds=([0, 0], [None, None]),
    )  # fmt: skip
    for count, belief in enumerate(followed(estimator, outputs), 1):
        known = ca.Opti()
        course = known.variable(2, count)
        moved = [100 * (course[:, k + 1] - react(course[:, k])) for k in range(count - 1)]
        missed = 10 * (ca.sum1(course) - ca.DM(outputs[:count]).T)
        known.minimize(ca.sumsqr((course[:, 0] - first) / 6) + ca.sumsqr(missed) + ca.sumsqr(ca.vertcat(0, *moved)))
        known.subject_to(ca.vec(course) >= 0)
        known.set_initial(course, ca.repmat(ca.DM(first), 1, count))
        known.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "tol": 1e-10})
        assert belief.status[0].name == "SOLVED"
        np.testing.assert_allclose(belief.windows[0].course, known.solve().value(course).T.reshape(-1, 2), atol=1e-5)


def test_limits_that_cannot_hold_together_leave_the_filter_and_say_so():
    estimator = MovingHorizonEstimator(
        lambda x, w: x + 5 + w, lambda x: x, 1, 0, **WALK, x_bounds=([0], [1]), w_bounds=(-1, 1)
    )
    first, second = followed(estimator, [0.5, 0.5])
    assert (first.status[0].name, second.status[0].name) == ("SOLVED", "FILTERED")
    assert "Kalman" in second.status[0].advice
    assert np.isfinite(second.mean).all()


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"W": [-1.0]}, "W"), ({"W": [0.0]}, "W"), ({"V": [0.0]}, "V"), ({"P0": [-1.0]}, "P0"),
        ({"window": 0}, "window"), ({"x0": [1, 2]}, "x0"), ({"x_bounds": ([1], [0])}, "x_bounds"),
        ({"p": [1.0], "p_drift": [-1.0]}, "p_drift"), ({"p": [1.0], "P_p": [1.0, 1.0]}, "P_p"),
        ({"W": [1.0, 1.0]}, "step"), ({"tolerance": 2.0}, "tolerance"),
    ],
)  # fmt: skip
def test_wrong_statements_are_named(wrong, name):
    with pytest.raises(InputError, match=f"^{name}"):
        MovingHorizonEstimator(lambda x, w: x + w, lambda x: x, 1, 0, **(WALK | wrong))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"x0": [3.0], "x_bounds": ([0], [1])}, r"x0: got \[3\.\], expected one within x_bounds, \[0\.\] to \[1\.\]"),
        ({"x_bounds": ([1], [None])}, r"x0: got \[0\.\], expected one within x_bounds"),
        ({"p": [-1.0], "p_bounds": ([0], [None])}, r"p: got \[-1\.\], expected one within p_bounds"),
        ({"x0": [1.0], "x_bounds": ([0], [1])}, None),
    ],
)
def test_first_estimates_outside_their_limits_are_named(given, said):
    with pytest.raises(InputError, match=said) if said else nullcontext():
        MovingHorizonEstimator(lambda x, w: x + w, lambda x: x, 1, 0, **WALK, **given)


@pytest.mark.parametrize("y", [[[np.inf]], [[1.0, 2.0]], [[1.0], [2.0]]])
def test_wrong_outputs_are_named(y):
    estimator = MovingHorizonEstimator(lambda x, w: x + w, lambda x: x, 1, 0, **WALK)
    with pytest.raises(InputError, match=r"^y: "):
        estimator.update(estimator.start(1), y, NO_INPUT)


@pytest.mark.parametrize("u", [np.zeros((2, 1)), np.zeros((3, 2)), np.zeros(3), np.full((3, 1), np.nan)])
def test_wrong_inputs_are_named_and_no_run_is_left_out(u):
    estimator = MovingHorizonEstimator(lambda x, u, w: x + u + w, lambda x: x, 1, 1, **WALK)
    y, still = np.zeros((3, 1)), np.zeros((3, 1))
    begun = estimator.update(estimator.start(3), y, still)
    for step in (lambda: estimator.predict(begun, u), lambda: estimator.update(estimator.predict(begun, still), y, u)):
        with pytest.raises(InputError, match=r"^u: "):
            step()


def test_beliefs_out_of_turn_are_named():
    estimator = MovingHorizonEstimator(lambda x, w: x + w, lambda x: x, 1, 0, **WALK)
    begun = estimator.update(estimator.start(1), [[0.0]], NO_INPUT)
    with pytest.raises(InputError, match="belief: got one out of turn, expected one after `start` or `predict`"):
        estimator.update(begun, [[0.0]], NO_INPUT)
    with pytest.raises(InputError, match=r"belief: got one out of turn, expected one after `update`\. Update with NaN"):
        estimator.predict(estimator.predict(begun, NO_INPUT), NO_INPUT)


@pytest.mark.parametrize(("apart", "regular"), [(3e-12, True), (3e-13, False)])
def test_noises_that_are_one_but_for_rounding_have_no_covariance(apart, regular):
    V = [[1, 1 - apart], [1 - apart, 1]]
    with nullcontext() if regular else pytest.raises(InputError, match="singular"):
        MovingHorizonEstimator(lambda x, w: x + w, lambda x: [x, 2 * x], 1, 0, **(WALK | {"V": V}))


@pytest.mark.parametrize("unit", [1.0, 1e6])
def test_a_record_is_filtered_as_sample_by_sample(unit):
    rng = np.random.default_rng(0)
    y, u = unit * rng.normal(size=(2, 6, 1)), rng.normal(size=(2, 6, 1))
    y[0, 3] = np.nan
    estimator = MovingHorizonEstimator(
        lambda x, u, w, p: 0.9 * x + unit * p * u + w, lambda x: x, 1, 1, window=3, W=[unit**2], V=[unit**2],
        P0=[unit**2], p=[0.5], P_p=[1.0], p_bounds=(0, 1),
    )  # fmt: skip
    found, belief = estimator.filter(y, u), estimator.start(2)
    for k in range(6):
        before = u[:, k - 1] if k else np.zeros((2, 1))
        belief = estimator.update(estimator.predict(belief, before) if k else belief, y[:, k], before)
        np.testing.assert_array_equal(found.means[:, k], belief.mean)
        np.testing.assert_array_equal(found.covariances[:, k], belief.covariance)
        np.testing.assert_array_equal(found.parameters[:, k], belief.parameters)
        assert found.status[k] == belief.status
    np.testing.assert_array_equal(estimator.filter(y[1, :, 0], u[1, :, 0]).means, found.means[1:])


def test_along_a_linear_record_it_is_the_kalman_filter():
    y, u = np.random.default_rng(1).normal(size=(2, 8))
    known = KalmanFilter([[0.9]], [[1.0]], [[1.0]], [[1.0]], [[1.0]], steady=False, P0=[[1.0]]).filter(y, u)
    found = MovingHorizonEstimator(lambda x, u, w: 0.9 * x + u + w, lambda x: x, 1, 1, **WALK).filter(y, u)
    np.testing.assert_allclose(found.means, known.means, atol=1e-9)


@pytest.mark.parametrize(("y", "u", "name"), [(np.zeros((4, 2)), np.zeros(4), "outputs"), (np.zeros(4), 0.0, "inputs"),
                                              (np.zeros(4), np.zeros(3), "inputs")])  # fmt: skip
def test_records_that_do_not_fit_are_named(y, u, name):
    with pytest.raises(InputError, match=f"^{name}: got shape"):
        MovingHorizonEstimator(lambda x, u, w: x + u + w, lambda x: x, 1, 1, **WALK).filter(y, u)
