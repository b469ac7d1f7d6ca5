"""Conditional quantiles: order, loss, coverage, and that time is never shuffled."""

import numpy as np
import pytest
from scipy.stats import binom, norm

from learning import QuantileConfig, fit_quantiles
from learning.exceptions import InputError

SHORT = QuantileConfig(hidden=(16, 16), steps=500, batch=256)


def heteroscedastic(n, seed):
    """y = sin(2 x₁) + (0.2 + 0.4 x₂²) ε, and a second output ten thousand times smaller, skewed."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (n, 2))
    first = np.sin(2 * x[:, 0]) + (0.2 + 0.4 * x[:, 1] ** 2) * rng.standard_normal(n)
    second = 1e-4 * (x[:, 1] + rng.exponential(1 + x[:, 0] ** 2))
    return x, np.stack([first, second], axis=1)


@pytest.fixture(scope="module")
def fitted():
    return fit_quantiles(*heteroscedastic(6000, 0), rng=np.random.default_rng(1), config=SHORT)


# ── the loss ──




# ── the network ──




@pytest.mark.check
def test_quantiles_of_a_fitted_network_never_cross(fitted):
    q = fitted.predict(10 * np.random.default_rng(0).standard_normal((2000, 2)))
    assert (np.diff(q, axis=1) > 0).all()


@pytest.mark.check
def test_five_calibrated_levels_never_cross():
    # The fit sees two peaks for x < 0 and a bell for x > 0; what calibrates it has two peaks at x > 0.
    rng = np.random.default_rng(3)
    x = rng.uniform(-1, 1, (4000, 1))
    peaks = rng.choice([-1.0, 1.0], (4000, 1)) + 0.02 * rng.standard_normal((4000, 1))
    y = np.where(x < 0, peaks, rng.standard_normal((4000, 1)))
    x[3600:], y[3600:] = np.abs(x[3600:]), peaks[3600:]
    config = QuantileConfig(levels=(0.1, 0.4, 0.5, 0.6, 0.9), hidden=(16,), steps=400, calibration=0.1)
    net = fit_quantiles(x, y, rng=rng, config=config)
    assert (np.diff(net.predict(np.linspace(-1, 1, 400)[:, None]), axis=1) >= 0).all()


def test_the_calibration_of_five_levels_makes_each_of_them_nominal():
    levels = (0.1, 0.3, 0.5, 0.7, 0.9)
    config = QuantileConfig(levels=levels, hidden=(8,), steps=40, calibration=0.5)
    x, y = heteroscedastic(8000, 4)
    net = fit_quantiles(x, y[:, :1], rng=np.random.default_rng(0), config=config)
    new_x, new_y = heteroscedastic(8000, 5)
    below = (new_y[:, None, :1] <= net.predict(new_x)).mean(axis=0)[:, 0]
    median = below[2]  # the median is not calibrated, and forty steps leave it off
    np.testing.assert_allclose(below[[0, 1, 3, 4]], np.array(levels)[[0, 1, 3, 4]], atol=0.03)
    assert abs(median - 0.5) < 0.1


def test_quantiles_are_constant_outside_the_training_range(fitted):
    inside, outside = fitted.predict([[0.2, fitted.input_upper[1].item()]]), fitted.predict([[0.2, 50.0]])
    np.testing.assert_allclose(inside, outside)


# ── the fit ──


def test_the_fitted_median_and_width_follow_the_truth(fitted):
    x, _ = heteroscedastic(500, 7)
    q = fitted.predict(x)[:, :, 0]
    assert np.sqrt(np.mean((q[:, 1] - np.sin(2 * x[:, 0])) ** 2)) < 0.1
    width = 2 * norm.ppf(0.9) * (0.2 + 0.4 * x[:, 1] ** 2)
    assert np.corrcoef(q[:, 2] - q[:, 0], width)[0, 1] > 0.9


def test_coverage_on_fresh_samples_lies_in_a_binomial_interval(fitted):
    n = 2000
    x, y = heteroscedastic(n, 8)
    q = fitted.predict(x)
    inside = ((y >= q[:, 0]) & (y <= q[:, 2])).mean(axis=0)
    # binomial spread of the test samples and of the 1200 samples that calibrated
    low, high = (binom.ppf(level, 750, 0.8) / 750 for level in (0.001, 0.999))
    assert ((inside > low) & (inside < high)).all()


@pytest.mark.check
def test_calibration_mends_a_scale_that_changes_at_the_end():
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (3000, 1))
    y = rng.standard_normal((3000, 1))
    y[2400:] *= 3.0
    net = fit_quantiles(x, y, rng=rng, config=QuantileConfig(hidden=(8,), steps=300))
    fresh = 3.0 * rng.standard_normal((4000, 1))
    q = net.predict(rng.uniform(-1, 1, (4000, 1)))
    assert ((fresh >= q[:, 0]) & (fresh <= q[:, 2])).mean() == pytest.approx(0.8, abs=0.06)


def test_the_same_generator_gives_the_same_quantiles():
    x, y = heteroscedastic(200, 0)
    short = QuantileConfig(hidden=(4,), steps=20)
    a, b = (fit_quantiles(x, y, rng=np.random.default_rng(3), config=short).predict(x) for _ in range(2))
    np.testing.assert_array_equal(a, b)


def test_a_constant_feature_or_target_is_no_division_by_zero():
    x = np.hstack([np.random.default_rng(0).standard_normal((200, 1)), np.ones((200, 1))])
    y = np.zeros((200, 1))
    q = fit_quantiles(x, y, rng=np.random.default_rng(0), config=QuantileConfig(hidden=(4,), steps=20)).predict(x)
    assert np.isfinite(q).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: QuantileConfig(levels=(0.1, 0.9)), "levels: got .* expected an odd number of increasing levels"),
        (lambda: QuantileConfig(levels=(0.9, 0.5, 0.1)), "levels: got .* increasing levels in .0, 1."),
        (lambda: QuantileConfig(levels=(0.0, 0.5, 0.9)), "levels: got .* increasing levels in .0, 1."),
        (lambda: QuantileConfig(levels=(0.1, 0.4, 0.9)), "levels: got 0.4 in the middle, expected the median 0.5"),
    ],
)
def test_levels_without_a_median_or_order_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


@pytest.mark.parametrize(
    ("x", "y", "stretches", "message"),
    [
        (np.zeros((30, 2)), np.zeros((29, 1)), None, r"inputs, targets: got shapes \(30, 2\) and \(29, 1\)"),
        (np.zeros((19, 2)), np.zeros((19, 1)), None, "n ≥ 20"),
        (np.zeros(30), np.zeros((30, 1)), None, "expected .n, d., .n, m."),
        (np.full((30, 2), np.nan), np.zeros((30, 1)), None, "inputs, targets: got values that are not finite"),
        (np.zeros((30, 2)), np.full((30, 1), np.inf), None, "inputs, targets: got values that are not finite"),
        (np.zeros((30, 2)), np.zeros((30, 1)), [10, 10], "stretches: got lengths that sum to 20, expected 30"),
    ],
)
def test_bad_samples_are_refused_in_one_line(x, y, stretches, message):
    with pytest.raises(InputError, match=message):
        fit_quantiles(x, y, stretches=stretches, rng=np.random.default_rng(0))


def test_targets_of_one_output_may_be_a_vector(rng):
    x = rng.standard_normal((200, 2))
    short = QuantileConfig(steps=20)
    fits = [fit_quantiles(x, y, rng=np.random.default_rng(1), config=short) for y in (x[:, 0], x[:, :1])]
    np.testing.assert_array_equal(fits[0].predict(x), fits[1].predict(x))
    assert fits[0].predict(x[:5].tolist()).shape == (5, 3, 1)


def test_inputs_of_another_width_than_in_the_fit_are_refused(rng):
    network = fit_quantiles(rng.standard_normal((30, 2)), np.zeros(30), rng=rng, config=QuantileConfig(steps=1))
    for inputs in (np.zeros((3, 5)), np.zeros(3), 1.0, "a"):
        with pytest.raises(InputError, match="inputs: got"):
            network.predict(inputs)
