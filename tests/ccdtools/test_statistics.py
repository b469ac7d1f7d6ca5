"""Means, intervals, and the power of pairing."""

import numpy as np
import pytest
from scipy.signal import lfilter

from ccdtools import mean_interval

# ── one long run ──


def autoregression(rho, runs, steps, rng):
    """Stationary series x⁺ = ρ x + e of variance 1, (runs, steps)."""
    noise = np.sqrt(1 - rho**2) * rng.standard_normal((runs, steps))
    noise[:, 0] /= np.sqrt(1 - rho**2)
    return lfilter([1.0], [1.0, -rho], noise, axis=1)


def regimes(runs, steps, rng):
    """White noise of variance 1 about a level of ±1 that is drawn anew once in fifty samples, on average."""
    renewed = rng.random((runs, steps)) < 1 / 50
    renewed[:, 0] = True
    level = rng.choice([-1.0, 1.0], size=(runs, steps))
    latest = np.maximum.accumulate(np.where(renewed, np.arange(steps), 0), axis=1)
    return np.take_along_axis(level, latest, axis=1) + rng.standard_normal((runs, steps))


def squares(rho, runs, steps, rng):
    """A cost: the square of an autoregression, minus its mean."""
    return autoregression(rho, runs, steps, rng) ** 2 - 1


@pytest.mark.quick(2)
@pytest.mark.parametrize(
    ("process", "steps"),
    [
        (lambda n, T, rng: autoregression(0.0, n, T, rng), 200),
        (lambda n, T, rng: autoregression(0.9, n, T, rng), 1000),
        (lambda n, T, rng: autoregression(0.99, n, T, rng), 8000),
        (lambda n, T, rng: autoregression(-0.9, n, T, rng), 1000),
        (lambda n, T, rng: squares(0.95, n, T, rng), 2000),
        (regimes, 5000),
    ],
    ids=["white", "rho 0.9", "rho 0.99", "rho -0.9", "squares", "regimes"],
)
def test_the_interval_of_one_series_covers_its_expectation_as_often_as_it_says(process, steps):
    series = process(600, steps, np.random.default_rng(3))
    intervals = [mean_interval(one) for one in series]
    given = [one.ci95 for one in intervals if one.reliable]
    covered = sum(low < 0 < high for low, high in given)
    assert len(given) > 0.95 * len(series)
    assert 0.92 <= covered / len(given) <= 0.98


def test_many_correlation_times_make_the_interval_hardly_wider_than_knowing_the_variance():
    series = autoregression(0.5, 300, 2000, np.random.default_rng(4))
    half = np.median([np.diff(mean_interval(one).ci95)[0] / 2 for one in series])
    assert half == pytest.approx(1.96 * np.sqrt(3 / 2000), rel=0.5)  # (1 + ρ)/(1 − ρ) = 3


def test_a_series_of_a_few_correlation_times_has_no_interval():
    walks = np.cumsum(np.random.default_rng(5).standard_normal((200, 2000)), axis=1)
    unreliable = [one for one in map(mean_interval, walks) if not one.reliable]
    assert len(unreliable) > 0.9 * len(walks)
    assert all(np.isnan(one.ci95).all() and one.correlation > 0.4 and np.isfinite(one.mean) for one in unreliable)


def test_the_interval_follows_the_units_and_the_origin_of_the_series():
    series = squares(0.9, 1, 1500, np.random.default_rng(6))[0]
    one, other = mean_interval(series), mean_interval(3.0 - 1e9 * series)
    np.testing.assert_allclose(3.0 - 1e9 * np.array(one.ci95), other.ci95[::-1], rtol=1e-6)
    assert other.correlation == pytest.approx(one.correlation, rel=1e-6)


def test_the_interval_leans_to_the_side_of_the_rare_large_values():
    low, high = mean_interval(np.random.default_rng(7).exponential(1.0, 400) ** 2).ci95
    mean = np.mean(np.random.default_rng(7).exponential(1.0, 400) ** 2)
    assert high - mean > 1.1 * (mean - low)


def test_a_start_far_away_counts_in_the_mean_and_not_as_noise():
    series = np.random.default_rng(8).standard_normal(2000)
    moved = series.copy()
    moved[:50] -= 400.0
    one, other = mean_interval(series), mean_interval(moved)
    assert other.mean == pytest.approx(one.mean - 10.0)
    assert other.std_error == pytest.approx(one.std_error)


def test_a_series_that_never_changes_is_known_exactly():
    assert mean_interval(np.full(100, -2.0)).ci95 == (-2.0, -2.0)
    assert mean_interval(np.full(100, -2.0)).reliable


def test_too_short_a_series_has_a_mean_and_no_interval():
    short = mean_interval(np.arange(19.0))
    assert (short.mean, short.reliable) == (9.0, False)
