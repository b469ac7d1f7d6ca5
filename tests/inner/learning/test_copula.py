"""Joint draws from conditional quantiles: distribution and correlation of what they were fitted to."""

import numpy as np
import pytest
import torch
from scipy.stats import ks_2samp, norm, spearmanr

from learning import fit_copula, load, save
from learning.exceptions import InputError
from learning.quantile import QuantileNetwork

LEVELS = (0.1, 0.5, 0.9)


def constant_network(inputs, outputs, levels=LEVELS):
    """Quantiles that depend on nothing: 0, and log 2 from one level to the next."""
    network = QuantileNetwork(inputs, outputs, levels, (4,))
    for parameter in network.parameters():
        torch.nn.init.zeros_(parameter)
    return network


def drawn(copula, network, inputs, seed=0):
    """Draws (n, m) at inputs (n, d)."""
    at = torch.tensor(inputs, dtype=torch.float32)
    uniform = torch.tensor(np.random.default_rng(seed).random((len(at), copula.outputs)), dtype=torch.float32)
    with torch.no_grad():
        return copula.draw(network(at), network.clipped(at), uniform).double().numpy()


def fitted(targets, inputs=None):
    """A network of constant quantiles with the copula of targets (n, m)."""
    x = np.zeros((len(targets), 1)) if inputs is None else inputs
    network = constant_network(x.shape[1], targets.shape[1])
    return network, fit_copula(network, x, targets)


# ── margins ──


def test_draws_have_the_distribution_of_the_samples_in_their_tails_too():
    rng = np.random.default_rng(0)
    y = np.stack([3e-4 * rng.standard_t(5, 6000), rng.exponential(size=6000) ** 1.5], axis=1)
    network, copula = fitted(y)
    draws = drawn(copula, network, np.zeros((20000, 1)))
    for i, samples in enumerate(y.T):
        assert ks_2samp(draws[:, i], samples).statistic < 0.025
        assert draws[:, i].std() == pytest.approx(samples.std(), rel=0.06)
        assert np.quantile(draws[:, i], 0.999) == pytest.approx(np.quantile(samples, 0.999), rel=0.2)


def test_the_score_of_a_draw_is_the_normal_score_of_its_uniform():
    y = np.random.default_rng(1).exponential(size=(3000, 1))
    network, copula = fitted(y)
    uniform = np.linspace(0.01, 0.99, 99)[:, None]
    quantiles = network.predict(np.zeros((99, 1)))
    with torch.no_grad():
        value = copula.draw(torch.tensor(quantiles), torch.zeros(99, 1), torch.tensor(uniform))
    shifted = copula.shifted(torch.tensor(quantiles), torch.zeros(99, 1)).numpy()
    np.testing.assert_allclose(copula.scores(shifted, value.numpy()), norm.ppf(uniform), atol=2e-3)


def test_wide_quantiles_have_tails_of_their_own():
    rng = np.random.default_rng(2)
    x = rng.uniform(-1, 1, (8000, 1))
    heavy = np.where(x < 0, rng.standard_t(3, (8000, 1)), 4 * rng.uniform(-1, 1, (8000, 1)))  # wide, but without tails
    network = constant_network(1, 1)
    network.gap_network.skip = torch.nn.Linear(1, 2, bias=False)
    torch.nn.init.constant_(network.gap_network.skip.weight, 2.0)
    copula = fit_copula(network, x, heavy)
    for side in (-0.8, 0.8):
        near = np.abs(x[:, 0] - side) < 0.2
        spread = drawn(copula, network, np.full((20000, 1), side)).std()
        assert spread == pytest.approx(heavy[near].std(), rel=0.15)


def test_the_mean_of_the_draws_follows_that_of_the_samples():
    rng = np.random.default_rng(3)
    x = rng.standard_normal((6000, 2)) * [1.0, 1e3]
    y = 0.3 * x[:, :1] - 2e-4 * x[:, 1:] + rng.exponential(size=(6000, 1))  # the network knows of neither
    network, copula = fitted(y, x)
    for point in ([1.0, 0.0], [0.0, 1500.0], [-1.0, -500.0]):
        mean = drawn(copula, network, np.tile(point, (40000, 1))).mean()
        assert mean == pytest.approx(0.3 * point[0] - 2e-4 * point[1] + 1.0, abs=0.06)


def test_inputs_that_repeat_each_other_give_a_bounded_shift():
    rng = np.random.default_rng(4)
    signal = rng.standard_normal((3000, 1))
    x = np.hstack([signal, -5 * signal + 1e-9 * rng.standard_normal((3000, 1)), np.ones((3000, 1))])
    _, copula = fitted(signal + rng.standard_normal((3000, 1)), x)
    assert copula.slope.abs().max() < 1.0
    assert copula.slope[2].item() == 0.0


# ── correlation between outputs ──


def test_outputs_that_one_signal_drives_are_drawn_together():
    signal = np.random.default_rng(5).laplace(size=(4000, 1))
    network, copula = fitted(signal * [1.0, -3.0, 1e-4])
    draws = drawn(copula, network, np.zeros((5000, 1)))
    np.testing.assert_allclose(np.corrcoef(draws.T), np.outer([1, -1, 1], [1, -1, 1]), atol=2e-3)


def test_the_rank_correlation_of_the_draws_is_that_of_the_samples():
    rng = np.random.default_rng(6)
    normal = rng.standard_normal((6000, 2)) @ np.linalg.cholesky([[1.0, 0.6], [0.6, 1.0]]).T
    y = np.stack([np.exp(normal[:, 0]), normal[:, 1] ** 3], axis=1)
    network, copula = fitted(y)
    draws = drawn(copula, network, np.zeros((20000, 1)))
    assert spearmanr(draws)[0] == pytest.approx(spearmanr(y)[0], abs=0.03)


def test_draws_stay_in_the_subspace_of_the_samples():
    # Each quantile is learned with an error of its own; what is left across the one signal is that of the samples.
    rng = np.random.default_rng(13)
    signal = rng.standard_normal((4000, 1))
    network = constant_network(1, 2)
    network.median_network.skip = torch.nn.Linear(1, 2, bias=False)
    torch.nn.init.zeros_(network.median_network.skip.weight)
    network.median_network.skip.weight.data[0, 0] = 0.3
    x = rng.uniform(-1, 1, (4000, 1))
    copula = fit_copula(network, x, np.hstack([signal, 2 * signal]))
    draws = drawn(copula, network, x)
    assert (draws[:, 1] - 2 * draws[:, 0]).std() < 1e-3
    assert draws[:, 0].std() == pytest.approx(1.0, rel=0.05)


# ── the object ──


def test_draws_are_differentiable_in_the_quantiles_and_the_inputs():
    rng = np.random.default_rng(9)
    x = rng.uniform(-1, 1, (3000, 1))
    network = constant_network(1, 2)
    copula = fit_copula(network, x, (1 + x) * rng.standard_normal((3000, 2)))
    quantiles = torch.tensor(network.predict(x[:4]) + 0.01 * rng.standard_normal((4, 1, 2)), requires_grad=True)
    inputs = torch.tensor(x[:4], requires_grad=True)
    uniform = torch.tensor(rng.random((4, 2)))
    assert torch.autograd.gradcheck(lambda q, i: copula.draw(q, i, uniform), (quantiles, inputs))


def test_a_copula_comes_back_from_its_file_as_it_was(tmp_path):
    network, copula = fitted(np.random.default_rng(10).standard_normal((4000, 2)) @ [[1.0, 0.5], [0.0, 1.0]])
    save(tmp_path / "copula.safetensors", copula)
    again, _ = load(tmp_path / "copula.safetensors")
    zeros = np.zeros((50, 1))
    np.testing.assert_array_equal(drawn(again, network, zeros), drawn(copula, network, zeros))


def test_an_output_that_never_changes_is_drawn_as_it_is():
    y = np.random.default_rng(11).standard_normal((500, 2)) * [1.0, 0.0]
    network, copula = fitted(y)
    draws = drawn(copula, network, np.zeros((500, 1)))
    assert np.isfinite(draws).all()
    np.testing.assert_allclose(draws[:, 1], 0.0, atol=1e-5)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fit_copula(None, np.zeros((30, 1)), np.zeros((30, 1))), "network: got nothing, expected an object of"),
        (lambda: fit_copula(constant_network(1, 1), np.zeros((30, 1)), np.zeros((29, 1))), "targets: got shapes"),
        (lambda: fit_copula(constant_network(1, 1), np.zeros((30, 1)), np.full((30, 1), np.nan)), "not finite"),
        (lambda: fit_copula(constant_network(2, 1), np.zeros((30, 1)), np.zeros((30, 1))), "targets: got 1 and 1"),
    ],
)  # fmt: skip
def test_samples_that_fit_no_network_are_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_a_network_of_one_level_is_refused():
    network = constant_network(1, 1)
    network.levels = (0.5,)
    with pytest.raises(InputError, match="network: got a single level, expected at least three"):
        fit_copula(network, np.zeros((30, 1)), np.zeros((30, 1)))
