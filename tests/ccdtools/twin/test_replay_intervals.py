"""Intervals on a replay are of the logged runs, not of how often these are drawn."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from ccdtools import CVaR, Gaussian, LinearFeedback, closed_loop_returns, load_study
from ccdtools.exceptions import LimitWarning
from ccdtools.twin import deploy, fit_plant, identified_lqr, replay_problem

LOGS, RUNS, STEPS = 60, 12, 40
DESIGN = [1.0]
STRONG, WEAK = LinearFeedback([[0.6, 0.6]], -3, 3), LinearFeedback([[0.3, 0.3]], -3, 3)


def logged(problem, seed, runs=RUNS, steps=STEPS):
    rng = np.random.default_rng(seed)
    w = Gaussian([0.3, 0.3]).sample(runs, steps, rng)
    return deploy(problem.model, STRONG, DESIGN, w, x0=np.zeros((runs, 2)))


def returned(problem, log, controller, seed=0, **options):
    episodes = replay_problem(problem, log, **options)
    return closed_loop_returns(episodes, controller, DESIGN, np.random.default_rng(seed), runs=400)


@pytest.fixture(scope="module")
def problem():
    return load_study("illustrative").problem()


@pytest.mark.long
def test_the_interval_covers_what_other_logs_say(problem):
    truth = returned(problem, logged(problem, 10_000, runs=6000), STRONG, window=STEPS).summary.mean
    found = [returned(problem, logged(problem, seed), STRONG, window=STEPS) for seed in range(LOGS)]
    inside = [one.summary.ci95[0] <= truth <= one.summary.ci95[1] for one in found]
    alone = [abs(one.values.mean() - truth) <= 2 * one.values.std() / len(one.values) ** 0.5 for one in found]
    assert np.mean(inside) >= 0.85
    assert np.mean(alone) < 0.6  # of draws as if each were a run


def test_a_gain_in_pairs_is_over_logged_runs(problem):
    log = logged(problem, 1)
    one, other = (returned(problem, log, law, window=STEPS) for law in (STRONG, WEAK))
    parts = one.parts(np.arange(400)) - other.parts(np.arange(400))
    assert parts.shape == (RUNS,)
    assert parts.mean() == pytest.approx((one.values - other.values).mean())


def test_the_text_says_what_was_drawn_and_what_counts(problem):
    log = logged(problem, 2)
    text = str(returned(problem, log, STRONG, window=30, warm_up=10))
    assert f"400 runs drawn from {RUNS} logged stretches, from sample 10 on" in text


def test_one_logged_run_has_a_mean_and_no_interval(problem):
    found = returned(problem, logged(problem, 3, runs=1), STRONG, window=STEPS).summary
    assert np.isfinite(found.mean)
    assert np.isnan(found.ci95).all()


def test_stretches_of_a_long_run_are_groups_of_another_risk_too(problem):
    long = logged(problem, 4, runs=1, steps=2000)
    found = returned(replace(problem, risk=CVaR(0.2)), long, STRONG, window=20)
    assert len(np.unique(found.labels)) > 90  # of 99
    low, high = found.summary.ci95
    assert low < found.summary.mean < high


def test_few_runs_are_of_all_that_was_logged(problem):
    log = logged(problem, 5, runs=200)
    found = closed_loop_returns(replay_problem(problem, log, window=STEPS), STRONG, DESIGN,
                                np.random.default_rng(0), runs=100)  # fmt: skip
    assert len(np.unique(found.labels)) > 50  # in the order of the log they were the first 8


@pytest.mark.parametrize("taken", [
    lambda problem, log: replay_problem(problem, log, window=STEPS),
    lambda problem, log: identified_lqr(problem, DESIGN, log),
    fit_plant,
])  # fmt: skip
def test_a_log_of_other_coordinates_is_doubted(problem, taken):
    log = logged(problem, 6)
    with pytest.warns(LimitWarning, match="100% of the logged states lie outside X"):
        taken(problem, replace(log, states=log.states + 60.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error", LimitWarning)
        taken(problem, log)


def test_logs_of_other_lengths_have_stretches_of_their_own(problem):
    logs = [logged(problem, 7, runs=1, steps=1000), logged(problem, 8, runs=8, steps=40)]
    replay = replay_problem(problem, logs, window=10).scenarios
    x0, _, labels = replay.windows(4000, 10, np.random.default_rng(0))
    moving = x0.any(axis=1)  # all runs begin at 0, and the first of both logs count as of one disturbance
    second = (x0[:, None] == logs[1].states[1:].reshape(-1, 2)).all(axis=2).any(axis=1)
    assert not set(labels[moving & second]) & set(labels[moving & ~second])


def test_a_risk_of_few_logged_runs_has_no_interval(problem):
    found = returned(replace(problem, risk=CVaR(0.2)), logged(problem, 9, runs=3), STRONG, window=STEPS).summary
    assert np.isnan(found.ci95).all()
    assert "fewer than 10: no interval" in found.warning
