"""Changes of a user's numbers: their signs, intervals and words, beside the same worked out by hand."""

import numpy as np
import pytest
from scipy import stats

from ccdtools import InputError, Trajectory
from ccdtools.comparison.metrics import metric_changes


def runs(values, *, steps=40, lost=()):
    """Runs of one state that holds a value each, with some of them lost."""
    values = np.asarray(values, dtype=float)
    states = np.tile(values[:, None, None], (1, steps + 1, 1))
    zeros = np.zeros((len(values), steps, 1))
    lost_at = np.where(np.isin(np.arange(len(values)), lost), 3, -1)
    return Trajectory(states, zeros, zeros, lost_at, np.zeros(1), 0.1)


def level(run):
    """The mean of the state."""
    return {"level [m]": float(run.states.mean())}


def test_the_interval_is_that_of_paired_runs_by_students_t_where_they_are_not_skewed(rng):
    before = rng.normal(10.0, 3.0, 30)
    after = before + 1.0 + np.tile([-0.5, 0.5], 15)
    (found,) = metric_changes(level, runs(before), runs(after))
    wanted = stats.ttest_rel(after, before).confidence_interval()
    assert found.change.ci95 == pytest.approx((wanted.low, wanted.high))
    assert found.change.mean == pytest.approx((after - before).mean())
    assert found.word == "worse"


@pytest.mark.parametrize(
    ("shift", "noise", "word"), [(0.2, 0.1, "worse"), (-0.2, 0.1, "better"), (0.0, 0.01, "same"), (0.0, 3.0, "open")]
)
def test_words_say_the_sign_and_whether_it_is_beyond_chance(shift, noise, word):
    before = np.full(50, 10.0)
    (found,) = metric_changes(level, runs(before), runs(before + shift + noise * np.tile([1, -1], 25)))
    assert found.word == word


def test_more_is_better_where_the_metrics_say_so():
    def range_left(run):
        return level(run)

    range_left.larger_is_better = {"level [m]"}
    (found,) = metric_changes(range_left, runs([1.0, 1.1]), runs([2.0, 2.1]))
    assert found.word == "better"
    range_left.larger_is_better = {"level"}
    with pytest.raises(InputError, match=r"larger_is_better: got level, .* expected names among level \[m\]"):
        metric_changes(range_left, runs([1.0, 1.1]), runs([2.0, 2.1]))


def test_one_long_run_is_judged_by_its_stretches(rng):
    noise = rng.standard_normal(400)
    states = np.r_[0.0, noise].reshape(1, -1, 1)
    zeros = np.zeros((1, 400, 1))
    before = Trajectory(5 + states, zeros, zeros, np.array([-1]), np.zeros(1), 0.1)
    after = Trajectory(6 + states, zeros, zeros, np.array([-1]), np.zeros(1), 0.1)
    (found,) = metric_changes(level, before, after)
    assert found.word == "worse"
    assert found.change.ci95 == pytest.approx((1.0, 1.0))


def test_lost_runs_are_in_neither_number():
    (found,) = metric_changes(level, runs([1.0, 2.0, 900.0], lost=[2]), runs([1.0, 2.0, 3.0]))
    assert (found.before, found.after) == (1.5, 1.5)
    assert metric_changes(level, runs([1.0], lost=[0]), runs([1.0])) == ()


def test_runs_that_do_not_pair_are_refused():
    with pytest.raises(InputError, match=r"before, after: got \(2, 40\) and \(3, 40\)"):
        metric_changes(level, runs([1.0, 2.0]), runs([1.0, 2.0, 3.0]))
