"""The environment that PPO sees."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ccdtools.co_design.differentiable_model import Stepper
from ccdtools.co_design.environment import EpisodeEnv


@pytest.fixture
def env(illustrative):
    problem = replace(illustrative.problem(), steps=4)
    return EpisodeEnv(problem, torch.tensor([2.0]), runs=3, rng=np.random.default_rng(0))


def test_observations_are_states_and_design(env):
    np.testing.assert_allclose(env.reset(), [[-3.5, -2.0, 2.0]] * 3)


def test_a_step_is_a_step_of_the_model(env):
    env.reset()
    u = torch.tensor([[0.5], [-0.5], [0.0]])
    w = env._w[:, 0].clone()
    following, successor, reward, terminated, truncated = env.step(u)
    x, _, expected = Stepper.at(env.problem, torch.tensor([2.0]))(env._x0, torch.zeros(3, 2), u, w)
    torch.testing.assert_close(successor[:, :2], x)
    torch.testing.assert_close(following, successor)
    torch.testing.assert_close(reward, expected)
    assert not terminated.any()
    assert not truncated.any()


def test_the_time_limit_truncates_and_restarts_with_fresh_disturbances(env):
    first = env.reset()
    old = env._w.clone()
    for _ in range(3):
        _, _, _, _, truncated = env.step(torch.zeros(3, 1))
        assert not truncated.any()
    following, successor, _, terminated, truncated = env.step(torch.zeros(3, 1))
    assert truncated.all()
    assert not terminated.any()
    torch.testing.assert_close(following, first)
    assert not torch.isclose(successor, first).all()
    assert not torch.equal(env._w, old)


def test_a_divergence_terminates_and_restarts_only_that_run(env):
    env.reset()
    env._x = torch.tensor([[-3.5, -2.0], [9.9e3, 0.0], [-3.5, -2.0]])
    following, successor, _, terminated, truncated = env.step(torch.tensor([[0.0], [9e3], [0.0]]))
    assert terminated.tolist() == [False, True, False]
    assert not truncated.any()
    assert successor[1, 1] > 5e3
    torch.testing.assert_close(following[1], torch.tensor([-3.5, -2.0, 2.0]))
    torch.testing.assert_close(following[[0, 2]], successor[[0, 2]])


def test_a_divergence_at_the_time_limit_is_a_termination(env):
    env.reset()
    for _ in range(3):
        env.step(torch.zeros(3, 1))
    env._x = torch.full((3, 2), 9e3)
    _, _, _, terminated, truncated = env.step(torch.zeros(3, 1))
    assert terminated.all()
    assert not truncated.any()


def test_a_moved_design_is_seen_in_dynamics_and_observations(env):
    env.move(torch.tensor([3.0], requires_grad=True))
    assert (env.reset()[:, 2] == 3.0).all()
    w = env._w[:, 0].clone()
    _, successor, _, _, _ = env.step(torch.ones(3, 1))
    expected = torch.tensor([-3.5, -2.0]) @ torch.tensor([[0.8, 0.5], [0.5, 0.6]]) + torch.tensor([0.5, 3.0]) + w
    torch.testing.assert_close(successor[:, :2], expected)
    assert not successor.requires_grad
