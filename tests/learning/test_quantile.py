"""Conditional quantiles: order, loss, coverage, and that time is never shuffled."""

import numpy as np
import pytest
import torch
from scipy.stats import binom, ks_2samp, norm, spearmanr

from learning import QuantileConfig, fit_quantiles, load, save
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


@pytest.mark.long
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


# ── joint draws ──


def drawn(network, inputs, n=20000):
    """Draws (n, m) at one input (d,)."""
    quantiles = torch.tensor(network.predict(np.tile(inputs, (n, 1))))
    return network.draw(quantiles, torch.rand((n, 1), generator=torch.Generator().manual_seed(0))).numpy()


def skewed(n=4000):
    """Outputs of a constant distribution: the second is a monotone map of one correlated with the first."""
    rng = np.random.default_rng(6)
    normal = rng.standard_normal((n, 2)) @ np.linalg.cholesky([[1.0, 0.6], [0.6, 1.0]]).T
    first = np.exp(normal[:, 0])
    return np.ones((n, 1)), np.stack([first, 1e-3 * normal[:, 1] ** 3, -2 * first], axis=1)


@pytest.fixture(scope="module")
def constant():
    x, y = skewed()
    config = QuantileConfig(hidden=(4,), steps=100)
    return fit_quantiles(x, y, rng=np.random.default_rng(0), config=config), y


def test_draws_have_the_distribution_of_the_samples_in_their_tails_too(constant):
    network, y = constant
    for draws, samples in zip(drawn(network, [1.0]).T, y.T):
        assert ks_2samp(draws, samples).statistic < 0.025
        assert draws.std() == pytest.approx(samples.std(), rel=0.06)


def test_draws_are_as_dependent_as_the_samples(constant):
    network, y = constant
    draws = drawn(network, [1.0])
    np.testing.assert_allclose(spearmanr(draws)[0], spearmanr(y)[0], atol=0.03)
    assert np.corrcoef(draws[:, 0], draws[:, 2])[0, 1] < -0.999  # one signal that drives both is drawn as one


def test_draws_follow_the_width_and_cover_the_outer_levels_as_stated(fitted):
    for inputs in ([0.0, 0.0], [0.0, 0.9]):
        draws = drawn(fitted, inputs)
        low, _, high = fitted.predict(np.array(inputs))
        np.testing.assert_allclose(((draws >= low) & (draws <= high)).mean(axis=0), 0.8, atol=0.03)


def test_draws_are_differentiable_in_the_quantiles(fitted):
    quantiles = torch.tensor(fitted.predict(np.zeros((4, 2))), requires_grad=True)
    uniform = torch.rand((4, 1), dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    assert torch.autograd.gradcheck(lambda q: fitted.draw(q, uniform), (quantiles,))


def test_a_network_from_its_file_draws_the_same(tmp_path, constant):
    network, _ = constant
    save(tmp_path / "quantiles.safetensors", network)
    again, _ = load(tmp_path / "quantiles.safetensors")
    np.testing.assert_array_equal(drawn(again, [1.0], 50), drawn(network, [1.0], 50))


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
    network = fit_quantiles(rng.standard_normal((45, 2)), np.zeros(45), rng=rng, config=QuantileConfig(steps=1))
    for inputs in (np.zeros((3, 5)), np.zeros(3), 1.0, "a"):
        with pytest.raises(InputError, match="inputs: got"):
            network.predict(inputs)
