"""What test_learned.py claims, seen from inside."""

import numpy as np
import pytest
import torch

from ccdtools import DesignSpace, LearnedPolicy, load_policy
from ccdtools.co_design.differentiable_model import observe
from ccdtools.design_limits import DesignLimits
from learning import ActorCritic, NetworkConfig, save
from learning.exceptions import CheckpointError
from learning.quantile import QuantileNetwork


def agent(**options):
    config = NetworkConfig((9, 7), initial_std=0.05, **options)
    return ActorCritic([-1, -2, 1e4], [1, 2, 4e4], [-5.0, 0.0], [5.0, 20.0], config=config, imitates=True, seed=3)


@pytest.mark.parametrize("skip", [True, False])
def test_the_numpy_forward_equals_the_torch_forward(rng, skip):
    net = agent(skip=skip)
    x = 2 * rng.standard_normal((50, 2))
    with torch.no_grad():
        p = torch.tensor([2e4])
        expected = net.action(net.latent(observe(torch.tensor(x, dtype=torch.float32), p))).numpy()
    np.testing.assert_allclose(LearnedPolicy(net, [2e4])(x), expected, rtol=1e-5, atol=1e-5)


def test_in_casadi_a_policy_keeps_bounds_that_depend_on_the_design(rng):
    space = DesignSpace(["p"], [1.0], [3.0])
    limits = DesignLimits.from_function("U", lambda p: (-p[0], 2 * p[0]), 1, "one per input", space)
    net = ActorCritic([-1, 1], [1, 3], *limits.box, config=NetworkConfig((5,)), imitates=True, action_limits=limits)
    policy = LearnedPolicy(net, [1.5])
    x = rng.uniform(-90, 90, (50, 1))
    u = np.array([np.asarray(policy.to_casadi()(row)).ravel() for row in x])
    np.testing.assert_allclose(u, policy(x), rtol=1e-12)
    assert {u.min(), u.max()} == {-1.5, 3.0}


def test_files_that_hold_no_policy_are_refused(tmp_path):
    save(tmp_path / "q", QuantileNetwork(2, 1, (0.1, 0.5, 0.9), (3,)), {"design": [1.0]})
    with pytest.raises(CheckpointError, match="got a QuantileNetwork without a design, expected a saved policy"):
        load_policy(tmp_path / "q")
    save(tmp_path / "a", agent())
    with pytest.raises(CheckpointError, match="got a ActorCritic without a design, expected a saved policy"):
        load_policy(tmp_path / "a")
    with pytest.raises(CheckpointError, match="expected a file written by ccdtools"):
        load_policy(tmp_path / "nothing")
