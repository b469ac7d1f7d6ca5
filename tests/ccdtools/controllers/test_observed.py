"""Controllers on estimates: the loop that is written by hand, with every kind of controller, from outputs alone."""

import copy
import pickle

import control
import numpy as np
import pytest

import ccdtools as cc
from ccdtools import InputError, KalmanFilter, LinearFeedback, Measurement
from ccdtools.controllers import Filtered, Observed
from ccdtools.estimation import CubatureKalmanFilter
from invariant_sets import AdmissibleInputs, Polytope, maximal_control_invariant_set
from mpc import LinearMPC, OffsetFreeMPC, lqr

A = np.array([[1.0, 0.1], [0.0, 1.0]])
B = np.array([[0.005], [0.1]])
C = np.array([[1.0, 0.0]])
W, V = np.diag([1e-5, 1e-4]), np.array([[1e-4]])
X = Polytope.from_bounds([-2.0, -0.5], [2.0, 0.5])
U = Polytope.from_bounds([-1.0], [1.0])
MODEL = cc.LinearModel.from_state_space(control.ss(A, B, np.eye(2), 0, 0.1), E=np.eye(2))
K, _ = lqr(A, B, Q=np.eye(2), R=[[0.1]])
STEADY = KalmanFilter(A, B, C, W, V)
OVER_TIME = KalmanFilter(A, B, C, W, V, steady=False, x0=[-0.5, 0.0], P0=[1.0, 0.1])
CUBATURE = CubatureKalmanFilter(MODEL, C, W=W, V=V, P0=[1.0, 0.1], x0=[-0.5, 0.0])
X0 = np.array([[-1.0, 0.0], [0.5, 0.2], [0.3, -0.1]])
STEPS = 30
NOISE = 0.01 * np.random.default_rng(1).standard_normal((3, STEPS, 1))
SENSOR = Measurement(C, noise=NOISE)
FEEDBACK = LinearFeedback(K, [-1.0], [1.0])


@pytest.fixture(scope="module")
def admissible():
    return AdmissibleInputs(A, B, maximal_control_invariant_set(A, B, X, U).set, U)


def run(controller, output=SENSOR, x0=X0, **options):
    w = 0.003 * np.random.default_rng(2).standard_normal((len(x0), STEPS, 2))
    return cc.simulate(MODEL, controller, x0=x0, steps=STEPS, output=output, **({"disturbance": w} | options))


def by_hand(gains, x0, noise, w):
    """The loop of one run with gains M_k of the filter."""
    x, estimate, u = x0, np.array([-0.5, 0.0]), np.zeros(1)
    states = [x]
    for k in range(STEPS):
        if k:
            estimate = A @ estimate + B @ u
        estimate = estimate + gains[k] @ (C @ x + noise[k] - C @ estimate)
        u = np.clip(-K @ estimate, -1, 1)
        x = A @ x + B @ u + w[k]
        states.append(x)
    return np.array(states)


@pytest.mark.parametrize("estimator", [OVER_TIME, CUBATURE], ids=["kalman", "cubature"])
def test_the_loop_is_the_one_written_by_hand(estimator):
    P, gains = np.diag([1.0, 0.1]), []
    for k in range(STEPS):
        P = A @ P @ A.T + W if k else P
        gains.append(P @ C.T / (C @ P @ C.T + V))
        P = P - gains[-1] @ C @ P
    closed = run(Observed(FEEDBACK, estimator))
    for i in range(3):
        expected = by_hand(gains, X0[i], NOISE[i], closed.disturbances[i])
        np.testing.assert_allclose(closed.states[i], expected, rtol=1e-9, atol=1e-11)


def controllers():
    options = {"Q": np.eye(2), "R": [[0.1]], "horizon": 5, "X": X, "U": U}
    nominal = LinearMPC(A, B, uses=("reference",), **options)
    return {
        "feedback": FEEDBACK,
        "mpc": LinearMPC(A, B, **options),
        "limited mpc": LinearMPC(A, B, rate_limit=[0.2], uses=("reference",), **options),
        "previewing mpc": LinearMPC(A, B, E=np.eye(2), rate_limit=[0.3], uses=("preview",), **options),
        "offset-free mpc": OffsetFreeMPC(nominal, C=np.eye(2)),
        "pid": cc.PID(C, [2.0], [0.5], [1.0], dt=0.1, lower=[-1.0], upper=[1.0]),
        "clock": Clock(),
        "memory of one run": Summing(),
    }


class Clock:
    """u = −K x, faded out over time; it also looks at the output."""

    needs = frozenset({"time", "output"})

    def __call__(self, x, *, time, y):
        return -(x @ K.T) / (1 + 0.1 * time) - 0.01 * y[..., :1]


class Summing:
    """u = −K x − ∫x₁, for one run."""

    def __init__(self):
        self.total = 7.0

    def reset(self):
        self.total = 0.0

    def __call__(self, x):
        assert x.shape == (2,)
        self.total += x[0]
        return -K @ x - 0.01 * self.total


@pytest.mark.parametrize("estimator", [STEADY, OVER_TIME, CUBATURE], ids=["steady", "over time", "cubature"])
@pytest.mark.parametrize("name", controllers())
def test_runs_at_once_are_runs_one_by_one_and_start_afresh(name, estimator):
    observed = Observed(controllers()[name], estimator)
    together = run(observed, reference=[0.3, 0.0])
    again = run(observed, reference=[0.3, 0.0])
    np.testing.assert_array_equal(together.states, again.states)
    assert observed.estimate is None
    for i in range(3):
        alone = run(observed, Measurement(C, noise=NOISE[i : i + 1]), X0[i : i + 1], reference=[0.3, 0.0],
                    disturbance=together.disturbances[i])  # fmt: skip
        np.testing.assert_allclose(alone.states[0], together.states[i], rtol=1e-6, atol=1e-7)


def test_one_run_may_be_controlled_with_vectors():
    rows, vector = Observed(FEEDBACK, STEADY), Observed(FEEDBACK, STEADY)
    y, last = np.array([[0.3], [0.2], [-0.1]]), np.zeros(1)
    for one in y:
        u = vector(y=one, u_prev=last)
        assert u.shape == (1,)
        np.testing.assert_array_equal(rows(np.full((1, 2), np.nan), y=one[None], u_prev=last[None]), u[None])
        last = u
    np.testing.assert_array_equal(vector.estimate, rows.estimate)
    vector.reset(1)
    assert vector.estimate is None
    assert vector(y=0.1, u_prev=0.0) == pytest.approx(-K @ STEADY.gain @ [0.1])


def test_the_state_itself_is_not_looked_at():
    np.testing.assert_array_equal(
        Observed(FEEDBACK, STEADY)([[9.0, 9.0]], y=[[0.1]], u_prev=[[0.0]]),
        Observed(FEEDBACK, STEADY)([[0.0, 0.0]], y=[[0.1]], u_prev=[[0.0]]),
    )


def test_the_filter_is_told_the_input_that_was_applied(admissible):
    greedy = LinearFeedback([[20.0, 1.0]], [-1.0], [1.0])
    outer = Filtered(Observed(greedy, STEADY), admissible)
    closed = run(outer, C, disturbance=None)
    assert outer.counts.changed > 0
    assert cc.excursions(closed.states, X).peak.max() == 0
    heard = Spy(STEADY)
    closed = run(Filtered(Observed(greedy, heard), admissible), C, disturbance=None)
    np.testing.assert_array_equal(np.array(heard.inputs).transpose(1, 0, 2), closed.inputs[:, :-1])


class Spy:
    """An estimator that keeps the inputs it predicts with."""

    nx, nu, ny = 2, 1, 1

    def __init__(self, estimator):
        self.start, self.update = estimator.start, estimator.update
        self.estimator = estimator
        self.inputs = []

    def __deepcopy__(self, memory):
        return self

    def predict(self, belief, u):
        self.inputs.append(u)
        return self.estimator.predict(belief, u)


def test_inputs_are_filtered_by_the_estimate_within(admissible):
    greedy = LinearFeedback([[20.0, 1.0]], [-1.0], [1.0])
    safe = Filtered(greedy, admissible)
    observed = Observed(safe, OVER_TIME)
    run(observed)
    assert 0 < safe.counts.changed <= safe.counts.inputs == 3 * STEPS
    observed.reset(1)
    u = observed(y=[0.9], u_prev=[0.0])
    np.testing.assert_allclose(u, Filtered(greedy, admissible)(observed.estimate[0]))


def test_a_comparison_times_it_without_counting(admissible):
    scenario = cc.Scenario(MODEL, X0, np.zeros((3, STEPS, 2)), output=Measurement(C, noise=[0.01]), seed=1)
    safe = Filtered(FEEDBACK, admissible)
    observed = Observed(safe, STEADY)
    table = cc.compare({"LQR": FEEDBACK, "LQG": observed}, scenario, X=X,
                       objective=cc.QuadraticObjective(np.eye(2), [[0.1]]))  # fmt: skip
    assert safe.counts.inputs == 3 * STEPS
    assert table["LQG"].paired_to_lqr.mean < 0
    assert table["LQG"].step_time > 0


def test_a_policy_keeps_its_design_behind_the_estimate(illustrative, clone):
    policy = cc.LearnedPolicy(clone(illustrative), [2.0])
    estimator = CubatureKalmanFilter(illustrative.model, [[1.0, 0.0]], W=[1e-4, 1e-4], V=[1e-4], P0=[4.0, 4.0],
                                     x0=[-1.5, -1.5], design=[2.0])  # fmt: skip
    observed = Observed(policy, estimator)
    options = {"x0": [-2.0, -2.0], "output": Measurement([[1.0, 0.0]], noise=[0.01]), "rng": np.random.default_rng(0)}
    log = cc.deploy(illustrative.model, observed, [2.0], np.zeros((40, 2)), **options)
    assert np.abs(log.states[:, -1]).max() < 0.5
    with pytest.raises(InputError, match="the design of the policy"):
        cc.deploy(illustrative.model, observed, [2.5], np.zeros((40, 2)), **options)
    both = Filtered(observed, cc.admissible_inputs(illustrative.problem(), [2.0]))
    np.testing.assert_array_equal(both.design, [2.0])


def test_a_run_that_is_lost_takes_no_other_with_it():
    class Wary:
        def __call__(self, x):
            assert np.isfinite(x).all()
            return -x @ K.T

    w = np.zeros((2, 20, 2))
    w[1, 3] = 1e300
    for estimator in (STEADY, CUBATURE):
        observed = Observed(Wary(), estimator)
        closed = cc.simulate(MODEL, observed, x0=[[1.0, 0.0], [1.0, 0.0]], steps=20, disturbance=w, output=far_off)
        alone = cc.simulate(MODEL, observed, x0=[1.0, 0.0], steps=20, disturbance=w[0], output=far_off)
        assert closed.diverged_at.tolist() == [-1, 3]
        np.testing.assert_allclose(closed.states[0], alone.states[0], rtol=1e-12)


def far_off(x):
    """The position, infinite where it is huge."""
    return x[:, :1] + 0 * x[:, :1] ** 2


def test_an_estimate_that_is_lost_in_a_run_that_is_not_is_an_error():
    with pytest.raises(InputError, match="controller: got an input that is not finite at step 0"):
        run(Observed(FEEDBACK, STEADY), lambda x: np.where(x[:, :1] < 0, np.nan, x[:, :1]))


def test_copies_and_pickles_start_afresh():
    observed = Observed(FEEDBACK, STEADY)
    first = observed(y=[0.3], u_prev=[0.0])
    for again in (copy.deepcopy(observed), pickle.loads(pickle.dumps(observed))):
        assert again.estimate is None
        np.testing.assert_array_equal(again(y=[0.3], u_prev=[0.0]), first)
        assert repr(again) == repr(observed)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Observed(K, STEADY), "controller: got .*A gain K becomes a controller"),
        (lambda: run(STEADY), r"controller: got a KalmanFilter.*Observed\(controller, estimator\) is one"),
        (lambda: Observed(FEEDBACK, FEEDBACK), "estimator: got a LinearFeedback, expected an estimator"),
        (lambda: Observed(FEEDBACK, KalmanFilter), "estimator: got the class KalmanFilter"),
        (lambda: Observed(FEEDBACK, STEADY)([0.0, 0.0]), r"y: got nothing, expected \(1,\) or \(n, 1\)"),
        (lambda: Observed(FEEDBACK, STEADY)(y=[0.0]), "u_prev: got nothing"),
        (lambda: Observed(FEEDBACK, STEADY)(y=[0.0, 1.0], u_prev=[0.0]), r"y: got shape \(2,\)"),
        (lambda: Observed(FEEDBACK, STEADY)(y=[[0.0]], u_prev=[[0.0], [0.0]]), "u_prev: got 2 rows"),
        (lambda: run(Observed(FEEDBACK, STEADY), output=None), r"y: got shape .*Pass output=Measurement"),
        (lambda: run(Observed(FEEDBACK, STEADY), output=np.eye(2)), r"y: got shape \(3, 2\)"),
        (lambda: run(Observed(cc.Passive(2), STEADY)), r"controller: got inputs of shape \(3, 2\)"),
        (lambda: run(Observed(LinearFeedback([[1.0, 0.0, 0.0]]), STEADY)), "x: got shape"),
    ],
)
def test_what_does_not_fit_is_named(call, message):
    with pytest.raises(InputError, match=message):
        call()
