"""What test_statistics.py claims, seen from inside."""

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from ccdtools import InputError, mean_interval
from ccdtools.statistics import (
    change_of_level,
    interval_of_crossed,
    interval_of_parts,
    paired_difference,
    paired_returns,
    summarise,
    summarise_returns,
)


def test_a_summary_of_values_that_are_not_skewed_agrees_with_students_t():
    v = 3.0 + np.tile([-1.0, 1.0], 15)
    summary = summarise(v)
    expected = stats.t.interval(0.95, 29, loc=v.mean(), scale=v.std(ddof=1) / np.sqrt(30))
    np.testing.assert_allclose(summary.ci95, expected)
    assert (summary.mean, summary.std, summary.median, summary.n) == pytest.approx(
        (v.mean(), v.std(ddof=1), np.median(v), 30)
    )


@pytest.mark.check
def test_the_interval_covers_the_mean_as_often_as_it_promises():
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(2000):
        low, high = summarise(rng.normal(3.0, 2.0, 8)).ci95
        covered += low < 3.0 < high
    low, high = stats.binom.ppf([0.001, 0.999], 2000, 0.95)
    assert low <= covered <= high


@pytest.mark.parametrize(
    ("drawn", "mean"),
    [
        (lambda rng, shape: -(rng.standard_normal(shape) ** 2), -1.0),
        (lambda rng, shape: -np.exp(rng.standard_normal(shape)), -np.exp(0.5)),
        (lambda rng, shape: rng.standard_normal(shape) - 10 * (rng.random(shape) < 0.05), -0.5),
    ],
)
def test_the_interval_covers_means_of_rare_losses_from_both_sides(drawn, mean):
    ends = np.array([summarise(one).ci95 for one in drawn(np.random.default_rng(3), (1000, 100))])
    above, below = np.mean(ends[:, 0] > mean), np.mean(ends[:, 1] < mean)
    assert above < 0.055  # a symmetric interval promises too much in 5 to 9 % of the samples
    assert below < 0.035


def test_a_mean_whose_spread_a_few_runs_make_says_so():
    calm = np.random.default_rng(4).standard_normal(400)
    assert summarise(calm).warning == summarise(calm[:9]).warning == summarise(np.ones(400)).warning == ""
    assert "a few runs make most of its spread" in summarise(np.where(np.arange(400) < 4, -100.0, calm)).warning
    assert summarise(np.where(np.arange(400) < 40, -100.0, calm)).warning == ""
    assert "a few runs make" in summarise(np.where(np.arange(90) < 1, -100.0, calm[:90])).warning


@pytest.mark.parametrize(("part", "rounding"), [(0.3e-6, True), (3e-6, False)])
def test_two_runs_within_a_millionth_of_the_return_differ_by_rounding(part, rounding):
    base = -np.ones((1, 200))
    moved = part * np.random.default_rng(0).choice([-1.0, 1.0], (1, 200))
    ends = paired_returns(base + moved, base).ci95
    assert np.allclose(ends, [-200 * part, 200 * part], rtol=1e-6) == rounding


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


def autoregression(rho, runs, steps, rng):
    """Stationary series x⁺ = ρ x + e of variance 1, (runs, steps)."""
    noise = np.sqrt(1 - rho**2) * rng.standard_normal((runs, steps))
    noise[:, 0] /= np.sqrt(1 - rho**2)
    return lfilter([1.0], [1.0, -rho], noise, axis=1)


def squares(rho, runs, steps, rng):
    """A cost: the square of an autoregression, minus its mean."""
    return autoregression(rho, runs, steps, rng) ** 2 - 1


def test_one_run_has_the_interval_of_its_own_series_scaled_to_its_length():
    rewards = squares(0.8, 2, 1000, np.random.default_rng(9))
    summary, of_mean = summarise_returns(rewards[:1]), mean_interval(rewards[0])
    assert (summary.n, summary.mean, summary.median) == (1, pytest.approx(rewards[0].sum()), summary.mean)
    np.testing.assert_allclose(summary.ci95, 1000 * np.array(of_mean.ci95))
    assert summary.std == pytest.approx(1000 * of_mean.std_error)
    paired = paired_returns(rewards[:1], rewards[1:])
    np.testing.assert_allclose(paired.ci95, 1000 * np.array(mean_interval(rewards[0] - rewards[1]).ci95))


def test_several_runs_are_taken_run_by_run():
    rewards = np.random.default_rng(10).standard_normal((7, 300))
    assert summarise_returns(rewards) == summarise(rewards.sum(axis=1))
    assert paired_returns(rewards, 0 * rewards) == paired_difference(rewards.sum(axis=1), np.zeros(7))


def test_a_difference_of_rounding_is_bounded_and_not_taken_for_a_process():
    rewards = np.cumsum(np.random.default_rng(15).standard_normal((1, 3000)), axis=1)
    difference = paired_returns(rewards * (1 + 1e-12), rewards)
    assert difference.ci95[0] == -difference.ci95[1]
    assert 0 < difference.ci95[1] <= 1e-11 * np.abs(rewards).sum()
    assert np.isnan(paired_returns(1.1 * rewards, rewards).ci95).all()


def test_the_one_run_of_many_that_did_not_diverge_has_no_interval():
    rewards = np.random.default_rng(11).standard_normal((1, 300))
    assert np.isnan(summarise_returns(rewards, runs=4000).ci95).all()
    assert np.isnan(summarise_returns(rewards[:0], runs=1).mean)


def rough(runs, steps, rng):
    """Costs on roads whose roughness differs from road to road, and twice their part of a tenth, with noise."""
    level = -np.exp(0.3 * rng.standard_normal((runs, 1))) * rng.chisquare(3, (runs, steps))
    return level, 0.1 * level * (1 + 0.5 * rng.standard_normal((runs, steps)))


def test_a_change_that_is_a_part_of_the_level_is_known_better_than_the_level():
    level, change = rough(20, 200, np.random.default_rng(12))
    relative, absolute = change_of_level(change, level), paired_returns(change, 0 * change)
    assert relative.mean == pytest.approx(absolute.mean)
    assert np.diff(relative.ci95) < 0.3 * np.diff(absolute.ci95)


@pytest.mark.parametrize("runs", [1, 20])
def test_the_interval_of_a_change_of_level_covers_the_ratio_as_often_as_it_says(runs):
    rng = np.random.default_rng(13)
    covered = 0
    for _ in range(400):
        level, change = rough(runs, 300, rng)
        low, high = sorted(end / level.sum(axis=1).mean() for end in change_of_level(change, level).ci95)
        covered += low < 0.1 < high
    assert 0.92 <= covered / 400 <= 0.98


def test_a_change_of_nothing_or_of_a_level_of_both_signs():
    level = np.ones((1, 100))
    assert change_of_level(0 * level, level).ci95 == (0.0, 0.0)
    assert change_of_level(0 * level, 0 * level).ci95 == (0.0, 0.0)
    level[0, ::2] = -1.0
    change = np.random.default_rng(14).standard_normal((1, 100))
    np.testing.assert_allclose(change_of_level(change, level).ci95, paired_returns(change, 0 * change).ci95)


def test_series_and_rewards_are_checked():
    with pytest.raises(InputError, match=r"series: got shape \(2, 2\), expected \(n,\)"):
        mean_interval(np.zeros((2, 2)))
    with pytest.raises(InputError, match=r"series: got (nan|-?inf) at index"):
        mean_interval(np.full(50, np.nan))
    with pytest.raises(InputError, match=r"rewards: got shape \(5,\), expected \(n, T\)"):
        summarise_returns(np.zeros(5))
    with pytest.raises(InputError, match=r"a, b: got shapes \(1, 5\) and \(1, 4\), expected as many of each"):
        paired_returns(np.zeros((1, 5)), np.zeros((1, 4)))


def test_levels_that_hold_for_a_third_of_a_series_have_no_interval():
    rng = np.random.default_rng(16)
    phase = rng.integers(0, 300, (200, 1))
    levels = np.take_along_axis(rng.standard_normal((200, 5)), (np.arange(1000) + phase) // 300, axis=1)
    assert sum(mean_interval(one).reliable for one in levels) < 0.1 * len(levels)


def test_the_interval_of_parts_covers_the_mean_of_a_skewed_tail_that_a_normal_one_misses():
    rng = np.random.default_rng(17)
    parts = np.where(rng.random((1000, 200)) < 0.1, rng.exponential(10.0, (1000, 200)), 0.0)  # as of the worst tenth
    ends = np.array([interval_of_parts(one) for one in parts])
    normal = np.abs(parts.mean(axis=1) - 1.0) < 1.96 * parts.std(axis=1) / np.sqrt(200)
    assert 0.93 <= np.mean((ends[:, 0] < 1.0) & (ends[:, 1] > 1.0)) <= 0.98
    assert normal.mean() < 0.92


def product(rng, rows, columns):
    """What trained gains (rows) lose on runs (columns), by their product alone."""
    return np.exp(0.5 * rng.standard_normal((rows, 1)) + 0.5 * rng.standard_normal((1, columns)))


def together(rng, rows, columns):
    return rng.standard_normal((rows, columns))


def apart(rng, rows, columns):
    return rng.standard_normal((rows, 1)) + rng.standard_normal((1, columns)) + rng.standard_normal((rows, columns))


@pytest.mark.long
@pytest.mark.parametrize(
    ("drawn", "truth", "least", "most"),
    [(apart, 0.0, 0.935, 0.965), (product, np.exp(0.25), 0.92, 0.965), (together, 0.0, 0.95, 0.99)],
)
def test_rows_and_columns_that_are_both_drawn_are_covered(drawn, truth, least, most):
    """Adding the squares of both half-widths covers 96 to 97 % of `apart`, and 99.7 % of `together`."""
    rng = np.random.default_rng(8)
    ends = [interval_of_crossed(drawn(rng, 20, 20)) for _ in range(2000)]
    assert least <= np.mean([low <= truth <= high for low, high in ends]) <= most


def test_mean_squares_of_rows_columns_and_of_both_together_make_the_variance():
    rows, columns = np.array([-2.0, -1.0, 1.0, 2.0]), np.array([-3.0, 0.0, 3.0])
    both = 0.5 * np.outer([1.0, -1.0, -1.0, 1.0], [1.0, -2.0, 1.0])
    low, high = interval_of_crossed(7.0 + rows[:, None] + columns + both)
    of_rows, of_columns, rest = 10 / 3 / 4, 18 / 2 / 3, (both**2).sum() / 6 / 12
    variance = of_rows + of_columns - rest
    degrees = variance**2 / (of_rows**2 / 3 + of_columns**2 / 2 + rest**2 / 6)
    half = stats.t.ppf(0.975, degrees) * np.sqrt(variance)
    assert (low, high) == pytest.approx((7 - half, 7 + half))


def test_one_row_or_one_column_is_no_source_of_chance():
    parts = np.random.default_rng(2).exponential(size=9)
    for table in (parts[None], parts[:, None], np.tile(parts, (5, 1))):
        assert interval_of_crossed(table) == pytest.approx(interval_of_parts(parts))


def test_a_crossed_interval_knows_neither_units_nor_which_side_is_called_rows():
    table = apart(np.random.default_rng(3), 6, 11)
    expected = interval_of_crossed(table)
    assert interval_of_crossed(table.T) == pytest.approx(expected)
    assert interval_of_crossed(5 - 1e6 * table) == pytest.approx(tuple(5 - 1e6 * end for end in expected[::-1]))


def test_of_seeds_that_lost_all_but_one_there_is_no_crossed_interval():
    table = apart(np.random.default_rng(3), 3, 11)
    table[0, 4] = np.nan
    low, high = interval_of_crossed(table)
    assert low < np.nanmean(table) < high
    table[1:] = np.nan
    assert np.isnan(interval_of_crossed(table)).all()
