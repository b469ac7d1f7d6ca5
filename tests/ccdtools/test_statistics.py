"""Means, intervals, and the power of pairing."""

import numpy as np
import pytest
from scipy import stats

from ccdtools import InputError
from ccdtools.statistics import paired_difference, summarise


def test_a_summary_agrees_with_students_t():
    v = np.random.default_rng(0).standard_normal(30)
    summary = summarise(v)
    expected = stats.t.interval(0.95, 29, loc=v.mean(), scale=v.std(ddof=1) / np.sqrt(30))
    np.testing.assert_allclose(summary.ci95, expected)
    assert (summary.mean, summary.std, summary.median, summary.n) == pytest.approx(
        (v.mean(), v.std(ddof=1), np.median(v), 30)
    )


def test_the_interval_covers_the_mean_as_often_as_it_promises():
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(2000):
        low, high = summarise(rng.normal(3.0, 2.0, 8)).ci95
        covered += low < 3.0 < high
    low, high = stats.binom.ppf([0.001, 0.999], 2000, 0.95)
    assert low <= covered <= high


def test_pairs_on_common_random_numbers_see_a_difference_that_the_means_hide():
    rng = np.random.default_rng(2)
    common = 10 * rng.standard_normal(200)
    a, b = common + 0.1 * rng.standard_normal(200) + 0.05, common + 0.1 * rng.standard_normal(200)
    difference = paired_difference(a, b)
    assert difference.mean == pytest.approx(np.mean(a) - np.mean(b))
    assert difference.ci95[0] > 0
    assert summarise(a).ci95[0] < np.mean(b)


def test_a_controller_against_itself_differs_by_exactly_nothing():
    v = np.random.default_rng(0).standard_normal(10)
    assert paired_difference(v, v) == paired_difference(np.zeros(10), np.zeros(10))
    assert paired_difference(v, v).ci95 == (0.0, 0.0)


def test_too_few_values_have_no_interval():
    empty, single = summarise([]), summarise([4.0])
    assert np.isnan([empty.mean, empty.std, empty.median, *empty.ci95]).all()
    assert empty.n == 0
    assert (single.mean, single.median, single.n) == (4.0, 4.0, 1)
    assert np.isnan([single.std, *single.ci95]).all()


def test_shapes_are_checked():
    with pytest.raises(InputError, match=r"values: got shape \(2, 2\), expected \(n,\)"):
        summarise(np.zeros((2, 2)))
    with pytest.raises(InputError, match=r"a, b: got shapes \(3,\) and \(2,\), expected as many of each"):
        paired_difference(np.zeros(3), np.zeros(2))
