"""A PID that is tuned, not crippled."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    PID,
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    discretise,
    saturated_lqr,
    simulate,
)
from ccdtools.comparison.pid_tuning import _Trial, tuned_pid
from ccdtools.controllers import Passive
from mpc import lqr


def mean_return(study, controller, p):
    problem = study.problem()
    x0, w = problem.scenarios.sample(500, 100, np.random.default_rng(99))
    run = simulate(problem.model, controller, x0=x0, steps=100, disturbance=w, design=p, limit=problem.limit)
    assert run.diverged.mean() < 0.01
    return run.returns(problem.objective)[~run.diverged].mean()


@pytest.mark.check
def test_it_recovers_most_of_what_lqr_gains_over_doing_nothing(suspension):
    problem, p = suspension.problem(), suspension.p0
    A, B, _ = problem.model.matrices(p)
    K = lqr(A, B, Q=problem.objective.Q, R=problem.objective.R)[0]
    best = mean_return(suspension, LinearFeedback(K, *problem.input_bounds), p)
    nothing = mean_return(suspension, Passive(), p)
    pid = tuned_pid(problem, p, rng=np.random.default_rng(0), runs=64, screened=24, refinements=80)
    assert (mean_return(suspension, pid, p) - nothing) / (best - nothing) > 0.5


@pytest.mark.check
def test_it_stabilises_the_unstable_example(illustrative):
    pid = tuned_pid(illustrative.problem(), [2.0], rng=np.random.default_rng(0), runs=64, screened=24, refinements=80)
    assert mean_return(illustrative, pid, [2.0]) > -45  # LQR −29.8


def test_it_keeps_the_input_bounds_and_the_sampling_time(suspension):
    problem = suspension.problem()
    pid = tuned_pid(problem, suspension.p0, rng=np.random.default_rng(0), runs=4, screened=3, refinements=1)
    assert pid.dt == 0.05
    np.testing.assert_array_equal([pid.lower, pid.upper], [[-1000], [1000]])
    assert pid.C.shape == (1, 4)


def test_candidate_outputs_may_be_given(illustrative):
    C = np.array([[[1.0, 1.0]]])
    pid = tuned_pid(
        illustrative.problem(), [2.0], rng=np.random.default_rng(0), outputs=C, runs=8, screened=3, refinements=1
    )
    np.testing.assert_array_equal(pid.C, [[1.0, 1.0]])


def test_the_generator_decides(illustrative):
    options = {"runs": 8, "screened": 4, "refinements": 5}
    gains = [tuned_pid(illustrative.problem(), [2.0], rng=np.random.default_rng(3), **options) for _ in range(2)]
    assert gains[0].kp == pytest.approx(gains[1].kp)
    assert gains[0].ki == pytest.approx(gains[1].ki)


@pytest.mark.check
@pytest.mark.parametrize(("unit", "weight", "hardly"), [(1.0, 0.01, True), (1e4, 0.01, True), (1.0, 30.0, False)])
def test_a_pid_that_sees_hardly_any_of_the_cost_says_what_part_of_lqr_s_gain_it_recovers(unit, weight, hardly):
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    after = ca.vertcat(0.5 * x[0], 0.97 * p * x[1]) + u / unit + w
    model = discretise(Plant(x, u, w, p, after, DesignSpace(["p"], lower=[0.9], upper=[1.0]), dt=1.0, continuous=False))
    problem = CoDesignProblem(
        model, X=(-50, 50), U=(-9 * unit, 9 * unit), steps=60, scenarios=FixedStart([0.0, 0.0], Gaussian([1.0, 1.0])),
        objective=QuadraticObjective(np.diag([weight, 1.0]), [[1e-3 / unit**2]]),
    )  # fmt: skip
    given = {"outputs": np.array([[[1.0, 0.0]]]), "runs": 32, "screened": 12, "refinements": 40}
    pid = tuned_pid(problem, [1.0], rng=np.random.default_rng(0), **given)
    assert np.any([pid.kp, pid.ki, pid.kd])
    x0, w = problem.scenarios.sample(300, 60, np.random.default_rng(9))
    own, lqr, passive = (
        simulate(model, law, x0=x0, steps=60, disturbance=w, design=[1.0]).returns(problem.objective).mean()
        for law in (pid, saturated_lqr(problem, [1.0]), Passive())
    )
    assert ((own - passive) / (lqr - passive) < 0.05) == hardly == ("of what LQR gains over the passive" in pid.remark)


@pytest.mark.parametrize(("gain", "least", "most", "hardly"), [(0.0008, 0.01, 0.03, True), (0.008, 0.1, 0.25, False)])
def test_a_pid_is_no_baseline_that_recovers_less_than_a_twentieth_of_what_lqr_gains(gain, least, most, hardly):
    x, u, w, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    space = DesignSpace(["p"], lower=[0.9], upper=[1.0])
    model = discretise(Plant(x, u, w, p, 0.95 * p * x + u + w, space, dt=1.0, continuous=False))
    problem = CoDesignProblem(
        model, X=(-50, 50), U=(-9, 9), steps=200, scenarios=FixedStart([9.0], Gaussian([1e-3])),
        objective=QuadraticObjective([[1.0]], [[1e-3]]),
    )  # fmt: skip
    pid = PID([[1.0]], [gain], [0.0], [0.0], dt=1.0, lower=[-9.0], upper=[9.0])
    trial = _Trial.from_problem(problem, np.array([1.0]), 4, np.random.default_rng(0))
    passive, lqr, own = ((a**2 + k**2 * 1e-3) / (1 - a**2) for a, k in ((0.95, 0), (0.001, 0.949), (0.95 - gain, gain)))
    assert least < (passive - own) / (passive - lqr) < most  # costs from a start without noise
    assert bool(trial.remark(pid)) == hardly
