"""Updates decided by turns on the real plant."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from trial_plants import BETTER, SERVED, UNSTABLE, X0, plant, tried, wide_problem

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    discretise,
)
from ccdtools.twin import Trial, TrialConfig, switchback, switchback_on


@pytest.fixture(scope="module")
def problem():
    return wide_problem()


# ── the decision ──


def gains(kind, n, rng):
    """Differences of pairs about zero."""
    if kind == "heavy tails":
        return rng.standard_t(1.5, size=n)
    if kind == "from one block to the next":
        noise = rng.standard_normal(n + 1)
        return (noise[1:] + 0.5 * noise[:-1]) * rng.choice([-1, 1], n)
    return rng.standard_normal(n)


@pytest.mark.parametrize("kind", ["normal", "heavy tails", "from one block to the next"])
def test_a_candidate_that_is_not_better_is_rarely_adopted_however_often_one_looks(kind):
    rng = np.random.default_rng(1)
    trials = [switchback(np.zeros(60), gains(kind, 60, rng), margin=0.3) for _ in range(300)]
    assert sum(trial.status.value == "adopted" for trial in trials) <= 15 + 2 * 15**0.5


def test_one_better_by_the_margin_is_rarely_rejected():
    rng = np.random.default_rng(2)
    trials = [switchback(np.zeros(60), 0.5 + gains("normal", 60, rng), margin=0.5) for _ in range(200)]
    states = [trial.status.value for trial in trials]
    assert states.count("rejected") <= 10 + 2 * 10**0.5
    assert states.count("adopted") > 80


def test_the_bounds_hold_the_mean_gain_and_narrow():
    rng = np.random.default_rng(3)
    few, many = (switchback(np.zeros(n), 0.1 + rng.standard_normal(n), margin=0.05) for n in (40, 400))
    for trial in (few, many):
        assert trial.interval[0] < 0.1 < trial.interval[1]
    assert np.diff(many.interval) < np.diff(few.interval)


def test_units_of_the_return_do_not_matter():
    rng = np.random.default_rng(4)
    old, new = rng.standard_normal(30), rng.standard_normal(30) + 1
    one, other = switchback(old, new, margin=0.2), switchback(1e6 * old, 1e6 * new, margin=2e5)
    assert one.status is other.status
    np.testing.assert_allclose(np.array(other.interval), 1e6 * np.array(one.interval), rtol=1e-9)


def test_an_undecided_trial_says_how_many_pairs_it_needs():
    trial = switchback(np.zeros(20), np.random.default_rng(5).standard_normal(20), margin=0.1)
    assert trial.status.value == "undecided"
    assert 300 < trial.pairs_needed < 5000
    assert "20 pairs of blocks" in str(trial)


def pushed():
    """Plant whose second state is what its input was, so that gains are known exactly."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    return Plant(x, u, w, p, ca.vertcat(w[0], p * u), DesignSpace(["p"], [0.5], [1.5]), dt=0.1, continuous=False)


@pytest.fixture(scope="module")
def pushed_problem():
    return CoDesignProblem(
        discretise(pushed()), X=([-1e3] * 2, [1e3] * 2), U=(-1e3, 1e3),
        objective=QuadraticObjective(np.eye(2), [[1e-9]]),
        scenarios=FixedStart([0, 0], Gaussian([1.0, 1.0])), steps=100,
    )  # fmt: skip


def test_a_trial_goes_on_with_as_many_models_as_it_began_with(pushed_problem):
    begun = Trial(0.1 * np.ones(19), 100.0, told=np.ones((19, 2)))
    w = np.random.default_rng(0).normal(size=(24, 20, 2))
    with pytest.raises(InputError, match="model: got one, expected none, as the trial began with"):
        switchback_on(
            pushed_problem, pushed(), SERVED, BETTER, [1.0], x0=np.zeros((24, 2)), disturbance=w,
            rng=np.random.default_rng(4), before=begun, model=pushed(),
        )  # fmt: skip


@pytest.mark.parametrize(("old", "new", "said"), [
    (np.zeros(30), np.zeros(29), "29 blocks"),
    (np.zeros(5), np.zeros(5), "5 pairs of blocks"),
    (np.full(30, np.nan), np.zeros(30), "old"),
    (np.zeros((30, 2)), np.zeros(30), "old"),
])  # fmt: skip
def test_wrong_blocks_are_named(old, new, said):
    with pytest.raises(InputError, match=said):
        switchback(old, new, margin=1.0)


@pytest.mark.parametrize("options", [{"margin": 0.0}, {"margin": -1.0}, {"margin": 1.0, "level": 0.0}])
def test_wrong_margins_and_levels_are_named(options):
    with pytest.raises(InputError, match=r"margin|level"):
        switchback(np.zeros(30), np.ones(30), **options)


# ── on a plant ──


def test_a_better_law_is_adopted_and_drives_what_is_left(problem):
    found = tried(problem, BETTER)
    assert found.trial.status.value == "adopted"
    assert found.samples < 3000
    assert found.log.inputs.shape == (1, 3000, 1)
    late = found.log.inputs[0, found.samples :], found.log.states[0, found.samples : -1]
    np.testing.assert_allclose(late[0], BETTER(late[1]))


def test_a_worse_law_is_rejected(problem):
    found = tried(problem, SERVED, served=BETTER)
    assert found.trial.status.value == "rejected"
    assert found.trial.interval[1] < 0


def test_a_law_that_loses_the_run_is_rejected_at_once(problem):
    found = tried(problem, UNSTABLE)
    assert found.trial.status.value == "rejected"
    assert found.trial.lost
    assert found.trial.pairs <= 1


@pytest.mark.parametrize("seed", range(4))
def test_a_run_that_the_law_in_service_loses_is_not_laid_to_the_candidate(problem, seed):
    found = tried(problem, BETTER, served=UNSTABLE, seed=seed)
    assert found.trial.status.value == "undecided"  # of one run nothing goes on
    assert not found.trial.lost
    assert "1 lost by the law in service alone" in str(found.trial)
    assert found.samples <= 200


def test_a_candidate_that_keeps_runs_which_the_law_in_service_loses_is_adopted(problem):
    w = Gaussian([0.1, 0.1]).sample(60, 100, np.random.default_rng(0))
    laws = {"served": UNSTABLE, "better": BETTER, "lost, too": LinearFeedback(2 * UNSTABLE.K)}

    def after(current, candidate):
        rng = np.random.default_rng(1)
        return switchback_on(problem, plant(1.1), laws[current], laws[candidate], [1.0], x0=X0, disturbance=w, rng=rng)

    found = after("served", "better")
    assert found.trial.status.value == "adopted"
    assert found.trial.lost_before == 5  # 2^-5 is below 5 %
    assert not found.log.diverged[10:].any()
    both = after("served", "lost, too").trial
    assert (both.status.value, both.lost, both.lost_before) == ("undecided", False, 0)
    assert after("better", "served").trial.lost


def test_runs_lost_before_speak_for_a_candidate_at_the_level():
    rng = np.random.default_rng(0)
    adopted = 0
    for _ in range(1000):  # either law loses a run in one of three pairs, and nothing else tells them apart
        trial = Trial([], margin=1.0)
        for _ in range(30):
            trial = replace(trial, gains=np.append(trial.gains, rng.standard_normal()))
            by = rng.integers(6)
            trial = replace(trial, lost=by == 0, lost_before=trial.lost_before + (by == 1))
            if trial.status.value != "undecided":
                break
        adopted += trial.status.value == "adopted"
    assert adopted <= 60


def test_a_real_plant_of_another_rate_is_refused(problem):
    w = np.zeros((3000, 2))
    with pytest.raises(InputError, match=r"plant: got dt = 0\.2 s, expected dt = 0\.1 s of the model"):
        switchback_on(problem, replace(plant(1.0), dt=0.2), SERVED, BETTER, [1.0], x0=X0, disturbance=w,
                      rng=np.random.default_rng(0))  # fmt: skip


def test_an_undecided_trial_goes_on(problem):
    first = switchback(np.zeros(20), 10 * np.random.default_rng(8).standard_normal(20), margin=0.01)
    assert first.status.value == "undecided"
    further = tried(problem, BETTER, steps=500, before=first).trial
    assert len(further.gains) == 25
    np.testing.assert_array_equal(further.gains[:20], first.gains)


def test_too_short_a_deployment_is_refused(problem):
    with pytest.raises(InputError, match="room for 4 pairs of blocks"):
        tried(problem, BETTER, steps=400)


@pytest.mark.parametrize("options", [
    {"block": 0}, {"washout": -1}, {"margin": 0.0}, {"level": 2.0}, {"excitation": -0.1}, {"block": 1.5},
])  # fmt: skip
def test_wrong_settings_of_a_trial_are_named(options):
    with pytest.raises(InputError, match=next(iter(options))):
        TrialConfig(**options)


def test_a_trial_of_no_pairs_is_undecided():
    assert Trial([], margin=1.0).status.value == "undecided"
    assert np.isnan(Trial([], margin=1.0).mean)
