"""Behaviour cloning."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from learning import CloningConfig, NetworkConfig, fit_actor_critic
from learning.exceptions import InputError

K = np.array([[0.6, -0.3]])
SHORT = CloningConfig(steps=600, batch=256, learning_rate=1e-2)


def data(n=2000, seed=0):
    x = np.random.default_rng(seed).uniform(-2, 2, (n, 2))
    u = np.clip(-x @ K.T, -1, 1)
    return x, u, -3.0 * (x**2).sum(axis=1) - 20


def cloned(x, u, v, **options):
    options = {"config": SHORT, "network": NetworkConfig((16, 16)), "rng": np.random.default_rng(1)} | options
    return fit_actor_critic(x, u, v, action_bounds=([-1], [1]), **options)


@pytest.fixture(scope="module")
def clone_of_a_linear_law():
    return cloned(*data())


@pytest.mark.long
def test_cloning_reproduces_a_saturated_linear_law(clone_of_a_linear_law):
    x, u, _ = data(seed=5)
    with torch.no_grad():
        own = clone_of_a_linear_law.action(clone_of_a_linear_law.latent(torch.tensor(x, dtype=torch.float32))).numpy()
    assert np.sqrt(np.mean((own - u) ** 2)) < 0.02
    assert np.abs(own).max() <= 1.0


def test_cloning_reproduces_the_value_with_its_sign_and_units(clone_of_a_linear_law):
    x, _, v = data(seed=5)
    with torch.no_grad():
        own = clone_of_a_linear_law.value(torch.tensor(x, dtype=torch.float32)).numpy()
    assert 1 - np.var(own - v) / np.var(v) > 0.99
    assert (own < 0).all()


def test_the_value_scale_is_that_of_the_data(clone_of_a_linear_law):
    _, _, v = data()
    assert clone_of_a_linear_law.value_offset.item() == pytest.approx(np.median(v), rel=1e-5)
    assert clone_of_a_linear_law.value_scale.item() == pytest.approx(np.std(v), rel=1e-5)


def test_unknown_values_are_left_out_of_the_critic_only():
    x, u, v = data(400)
    v[::2] = np.nan
    agent = cloned(x, u, v, config=CloningConfig(steps=50))
    assert all(torch.isfinite(p).all() for p in agent.parameters())
    assert agent.value_scale.item() == pytest.approx(np.nanstd(v), rel=1e-5)


def test_a_critic_that_nothing_is_known_for_is_refused():
    x, u, _ = data(400)
    with pytest.raises(InputError, match="values: got 400 of which none is finite, expected at least one known return"):
        cloned(x, u, np.full(400, np.nan), config=CloningConfig(steps=5))


def test_the_same_generator_gives_the_same_clone():
    x, u, v = data(100)
    short = CloningConfig(steps=5)
    a, b = (cloned(x, u, v, rng=np.random.default_rng(3), config=short) for _ in range(2))
    torch.testing.assert_close(a.state_dict(), b.state_dict())


def test_the_range_of_the_data_normalises_unless_another_is_given():
    x, u, v = data(300)
    one = CloningConfig(steps=1)
    own = cloned(x, u, v, config=one)
    np.testing.assert_allclose(own.observation_offset + own.observation_scale, x.max(axis=0), rtol=1e-5)
    given = cloned(x, u, v, config=one, input_bounds=([-10, -10], [10, 10]))
    np.testing.assert_allclose(given.observation_scale, [10, 10])


def test_a_constant_feature_does_not_divide_by_zero():
    x, u, v = data(300)
    agent = cloned(np.hstack([x, np.full((300, 1), 7.0)]), u, v, config=CloningConfig(steps=5))
    assert agent.observation_scale[2].item() == 1.0
    assert torch.isfinite(agent.latent(torch.zeros(1, 3))).all()


def test_cloning_leaves_the_data_and_the_global_generator_alone():
    x, u, v = data(100)
    before = x.copy(), u.copy(), v.copy()
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    cloned(x, u, v, config=CloningConfig(steps=2))
    assert torch.equal(torch.rand(1), expected)
    for own, old in zip((x, u, v), before):
        np.testing.assert_array_equal(own, old)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x, u, v: (x[:-1], u, v), r"inputs, actions, values: got shapes \(9, 2\), \(10, 1\), \(10,\)"),
        (lambda x, u, v: (x[:0], u[:0], v[:0]), "inputs, actions, values: got shapes"),
        (lambda x, u, v: (x, u[:, 0], v), "expected .n, n_obs., .n, nu., .n,."),
        (lambda x, u, v: (np.where(x > 0, np.nan, x), u, v), "inputs, actions: got values that are not finite"),
        (lambda x, u, v: (x, u + np.inf, v), "inputs, actions: got values that are not finite"),
    ],
)
def test_bad_data_is_refused_in_one_line(change, message):
    with pytest.raises(InputError, match=message):
        cloned(*change(*data(10)))


@pytest.mark.parametrize(("width", "scale"), [(0.3e-9, 1.0), (3e-9, 1.5e-9)])
def test_a_feature_is_constant_that_varies_by_less_than_a_billionth(width, scale):
    x = 1 + width * np.linspace(0, 1, 40)[:, None]
    agent = fit_actor_critic(x, 0 * x, x[:, 0], action_bounds=([-1.0], [1.0]), rng=np.random.default_rng(0),
                             config=CloningConfig(steps=1))  # fmt: skip
    assert agent.observation_scale.item() == pytest.approx(scale, rel=1e-3)


def test_fits_load_no_compiler():
    """An optimiser of PyTorch loads one where it is made, which takes longer than many a fit."""
    code = """
import sys, numpy as np
from learning import CloningConfig, QuantileConfig, fit_actor_critic, fit_quantiles
x, rng = np.random.default_rng(0).uniform(-1, 1, (60, 2)), np.random.default_rng(1)
few = CloningConfig(steps=2)
fit_actor_critic(x, x[:, :1], x[:, 0], action_bounds=([-1], [1]), rng=rng, config=few)
fit_quantiles(x, x, rng=rng, config=QuantileConfig(steps=2))
print([name for name in sys.modules if name.startswith("torch._dynamo")])
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout == "[]\n"
