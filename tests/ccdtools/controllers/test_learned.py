"""A learned policy as a controller, and on disk."""

import subprocess

import casadi as ca
import numpy as np
import pytest
import torch
from compiler import CC, needs_compiler

from ccdtools import InputError, LearnedPolicy, load_policy
from learning import ActorCritic, NetworkConfig


def agent(**options):
    config = NetworkConfig((9, 7), initial_std=0.05, **options)
    return ActorCritic([-1, -2, 1e4], [1, 2, 4e4], [-5.0, 0.0], [5.0, 20.0], config=config, imitates=True, seed=3)


@pytest.fixture
def policy():
    return LearnedPolicy(agent(), [2e4])


def test_one_state_is_a_batch_of_one(policy, rng):
    x = rng.standard_normal((6, 2))
    np.testing.assert_allclose([policy(row) for row in x], policy(x), rtol=1e-13)
    assert policy(x[0]).shape == (2,)
    assert policy(x.reshape(2, 3, 2)).shape == (2, 3, 2)


def test_inputs_stay_within_their_bounds(policy, rng):
    u = policy.sampled(rng)(1000 * rng.standard_normal((1000, 2)))
    assert (u.min(axis=0) >= [-5, 0]).all()
    assert (u.max(axis=0) <= [5, 20]).all()
    assert (u.min(axis=0) == [-5, 0]).all()


@pytest.mark.parametrize("std_network", [False, True])
def test_the_sampled_policy_has_the_mean_and_width_of_the_network(rng, std_network):
    net = agent(std_network=std_network)
    policy = LearnedPolicy(net, [2e4])
    x = np.tile([0.1, 0.1], (20000, 1))
    u, mean = policy.sampled(rng)(x), policy(x[0])
    assert (np.abs((mean - [0, 10]) / [5, 10]) < 0.8).all()  # four deviations from the clip
    np.testing.assert_allclose(u.mean(axis=0), mean, atol=0.02)
    np.testing.assert_allclose(u.std(axis=0), [0.25, 0.5], rtol=0.03)


def test_the_sampled_policy_repeats_with_its_generator(policy):
    x = np.zeros((5, 2))
    a, b = (policy.sampled(np.random.default_rng(7))(x) for _ in range(2))
    np.testing.assert_array_equal(a, b)


def test_the_design_is_part_of_the_observation():
    net = agent()
    assert not np.allclose(LearnedPolicy(net, [1e4])(np.zeros(2)), LearnedPolicy(net, [4e4])(np.zeros(2)))


def test_a_deployed_policy_does_not_see_later_training(policy):
    before = policy(np.ones(2))
    with torch.no_grad():
        policy.agent.mean_network.head.bias.add_(1.0)
    np.testing.assert_array_equal(policy(np.ones(2)), before)
    assert not np.allclose(LearnedPolicy(policy.agent, policy.design)(np.ones(2)), before)


@pytest.mark.parametrize("options", [{}, {"skip": False}, {"std_network": True}], ids=str)
def test_in_casadi_a_policy_gives_its_mean_action(options, rng):
    policy = LearnedPolicy(agent(**options), [3e4])
    function = policy.to_casadi()
    assert (function.name_in(), function.name_out()) == (["x"], ["u"])
    for x in rng.uniform(-3, 3, (50, 2)):
        np.testing.assert_allclose(np.asarray(function(x)).ravel(), policy(x), rtol=1e-12, atol=1e-12)


def test_casadi_differentiates_a_policy(policy):
    x = ca.MX.sym("x", 2)
    slope = np.array(ca.Function("slope", [x], [ca.jacobian(policy.to_casadi()(x), x)])([0.1, 0.2]))
    around = np.array([0.1, 0.2]) + 1e-6 * np.vstack([np.eye(2), -np.eye(2)])
    differences = (policy(around[:2]) - policy(around[2:])).T / 2e-6
    np.testing.assert_allclose(slope, differences, atol=1e-7)


@needs_compiler
def test_the_c_code_of_a_policy_gives_its_mean_action(policy, rng, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    policy.to_casadi().generate("policy.c")
    subprocess.run([CC, "-shared", "-fPIC", "-O1", "policy.c", "-o", "policy.so", "-lm"], check=True)
    compiled = ca.external("policy", "./policy.so")
    for x in rng.uniform(-3, 3, (20, 2)):
        np.testing.assert_allclose(np.asarray(compiled(x)).ravel(), policy(x), rtol=1e-12, atol=1e-12)


@pytest.mark.long
def test_torch_exports_the_agent_of_a_policy_as_its_mean_action(policy, rng):
    x = rng.uniform(-3, 3, (20, 2))
    observations = torch.tensor(np.c_[x, np.full(20, 2e4)], dtype=torch.float32)
    exported = torch.export.export(policy.agent, (observations,)).module()
    np.testing.assert_allclose(exported(observations).detach(), policy(x), rtol=1e-5, atol=1e-5)


def test_a_saved_policy_comes_back_with_its_design(policy, tmp_path, rng):
    policy.save(tmp_path / "policy.safetensors")
    again = load_policy(tmp_path / "policy.safetensors")
    np.testing.assert_array_equal(again.design, [2e4])
    x = rng.standard_normal((5, 2))
    np.testing.assert_array_equal(again(x), policy(x))


def test_a_state_of_the_wrong_size_is_refused(policy):
    with pytest.raises(InputError, match=r"x: got shape \(3,\), expected \(2,\) or \(n, 2\)"):
        policy(np.zeros(3))
    with pytest.raises(InputError, match=r"x: got shape \(\)"):
        policy(0.0)
