"""What test_quantile.py claims, seen from inside."""

import numpy as np
import pytest
import torch
from scipy.stats import norm

from learning import QuantileConfig, fit_quantiles
from learning.quantile import QuantileNetwork, _split, pinball

LEVELS = (0.1, 0.5, 0.9)
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


@pytest.mark.parametrize("level", [0.1, 0.5, 0.9])
def test_pinball_is_minimised_by_the_true_quantile(level):
    y = np.random.default_rng(0).standard_normal((20000, 1))
    grid = np.linspace(-2, 2, 81)
    losses = [pinball(y, np.full((20000, 1, 1), q), (level,))[0] for q in grid]
    assert grid[np.argmin(losses)] == pytest.approx(norm.ppf(level), abs=0.06)


def test_pinball_agrees_with_its_definition():
    y, q = np.array([[1.0], [3.0]]), np.array([[[0.0], [2.0]], [[4.0], [2.0]]])
    # residuals 1, −1 (first sample), −1, 1 (second): 0.1·1 + 0.1·1, 0.9·1 + 0.9·1, over four
    assert pinball(y, q, (0.1, 0.9))[0] == pytest.approx((0.1 * 1 + 0.1 * 1 + 0.9 * 1 + 0.9 * 1) / 4)


def test_pinball_of_tensors_equals_pinball_of_arrays():
    rng = np.random.default_rng(0)
    y, q = rng.standard_normal((30, 2)), rng.standard_normal((30, 3, 2))
    torch.testing.assert_close(pinball(torch.tensor(y), torch.tensor(q), LEVELS), torch.tensor(pinball(y, q, LEVELS)))


@pytest.mark.check
def test_a_median_alone_is_fitted_without_a_word_and_kept():
    x, y = heteroscedastic(2000, 0)
    config = QuantileConfig(levels=(0.5,), hidden=(16,), steps=400)
    network = fit_quantiles(x, y, rng=np.random.default_rng(1), config=config)
    median = network.predict(x)
    assert median.shape == (2000, 1, 2)
    assert (y[:, 0] < median[:, 0, 0]).mean() == pytest.approx(0.5, abs=0.05)
    again = QuantileNetwork.from_shape(network.shape())
    again.load_state_dict(network.state_dict())
    np.testing.assert_array_equal(again.predict(x), median)


@pytest.mark.parametrize("levels", [LEVELS, (0.05, 0.25, 0.5, 0.75, 0.95)])
def test_quantiles_of_an_untrained_network_never_cross(levels):
    net = QuantileNetwork(3, 2, levels, (8,), seed=2)
    q = net.predict(100 * np.random.default_rng(0).standard_normal((500, 3)))
    assert q.shape == (500, len(levels), 2)
    assert (np.diff(q, axis=1) >= 0).all()


def test_a_network_without_training_data_has_no_range():
    net = QuantileNetwork(1, 1, LEVELS, (8,))
    assert not np.allclose(net.predict([[1.0]]), net.predict([[100.0]]))


@pytest.mark.check
def test_pinball_falls_below_that_of_constant_quantiles(fitted):
    x, y = heteroscedastic(2000, 9)
    constant = np.broadcast_to(np.quantile(heteroscedastic(6000, 0)[1], LEVELS, axis=0)[None], (2000, 3, 2))
    assert (pinball(y, fitted.predict(x), LEVELS) < 0.95 * pinball(y, constant, LEVELS)).all()


def test_the_end_of_every_stretch_calibrates_and_what_stands_before_picks_the_iterate():
    held, picking = _split([50, 25], QuantileConfig(calibration=0.2))
    np.testing.assert_array_equal(np.flatnonzero(held), [*range(40, 50), *range(70, 75)])
    np.testing.assert_array_equal(np.flatnonzero(picking), [*range(32, 40), *range(66, 70)])
    held, picking = _split([50], QuantileConfig(levels=(0.5,), calibration=0.2))  # a median is not calibrated
    assert not held.any()
    np.testing.assert_array_equal(np.flatnonzero(picking), range(40, 50))


def test_the_split_is_in_time_whatever_the_generator(monkeypatch):
    seen = []

    def spy(network, train, validation, *rest):
        seen.append((train[0].copy(), validation[0].copy()))

    monkeypatch.setattr("learning.quantile._descend", spy)
    x = np.arange(100.0)[:, None]
    for seed in (0, 1):
        fit_quantiles(x, x, stretches=[60, 40], rng=np.random.default_rng(seed))
    for train, validation in seen:
        np.testing.assert_array_equal(train[:, 0], [*range(38), *range(60, 86)])
        np.testing.assert_array_equal(validation[:, 0], [*range(38, 48), *range(86, 92)])


def test_the_median_alone_is_that_of_the_quantiles():
    network = QuantileNetwork(3, 2, (0.1, 0.5, 0.9), (8, 8), seed=1)
    network.input_offset.fill_(0.3)
    network.input_lower.fill_(-1.0)
    network.output_scale.fill_(0.2)
    x = (2 * torch.randn(50, 3)).requires_grad_()
    alone, among = network.medians()(x), network(x)[:, 1]
    torch.testing.assert_close(alone, among)
    torch.testing.assert_close(*(torch.autograd.grad(found.square().sum(), x)[0] for found in (alone, among)))
