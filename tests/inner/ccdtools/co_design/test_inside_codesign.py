"""What test_codesign.py claims, seen from inside."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from ccdtools import CoDesignConfig, codesign
from ccdtools.co_design.ascent import Ascent
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.iterate import Task
from learning import PPOConfig

TINY = CoDesignConfig(
    iterations=12, runs=16, pathwise_runs=32, evaluation_runs=100, evaluate_every=3, design_rate=0.1, starts=1,
    ppo=PPOConfig.warm(learning_rate=1e-4, kl_limit=0.005, passes=1, critic_only=2),
)  # fmt: skip


@pytest.fixture(scope="module")
def problem(illustrative):
    """Return the illustrative example over a shorter horizon."""
    return replace(illustrative.problem(), steps=40)


def run(problem, agent, design=(1.0,), seed=0, judge=None, method="pathwise", **changes):
    config = replace(TINY, **({"iterations": 3, "evaluate_every": 1} | changes))
    return codesign(
        problem, agent=agent, design=design, rng=np.random.default_rng(seed), config=config, judge=judge, method=method
    )


def ascent(problem, agent, config=TINY, method="pathwise"):
    task = Task(problem, problem, method, config)
    evaluation = scenario_tensors(problem, 20, np.random.default_rng(1))
    return Ascent(task, copy.deepcopy(agent), np.array([1.0]), np.random.default_rng(0), evaluation)


@pytest.mark.parametrize(("method", "trained"), [("pathwise", False), ("ppo", True), ("pathwise+ppo", True)])
def test_only_the_methods_with_ppo_train_the_critic(problem, illustrative, clone, method, trained):
    agent = clone(illustrative)
    moving = ascent(problem, agent, method=method)
    before = copy.deepcopy(moving.agent.value_network.state_dict()).values()
    moving.iterate(0, 12)
    own = moving.agent.value_network.state_dict().values()
    assert any((a != b).any() for a, b in zip(own, before)) == trained


@pytest.mark.long
def test_a_policy_without_its_own_gradient_is_left_to_ppo(problem, illustrative, clone):
    agent = clone(illustrative)
    quiet = {"method": "ppo", "design_rate": 0.0, "iterations": 2}
    still = run(problem, agent, ppo=replace(TINY.ppo, critic_only=9), **quiet)
    torch.testing.assert_close(still.agent.mean_network.state_dict(), agent.mean_network.state_dict())
    x0, w = scenario_tensors(problem, 4, np.random.default_rng(0))
    assert len(x0) == len(w) == 4


def test_the_optimisers_live_as_long_as_the_training(problem, illustrative, clone):
    moving = ascent(problem, clone(illustrative))
    for k in range(3):
        moving.iterate(k, 12)
    assert moving.design_optimiser.state[moving.v]["step"].item() == 3
    (first, *_) = moving.policy_optimiser.state.values()
    assert first["step"].item() == 3


def test_rates_fall_along_a_cosine_unless_they_are_constant(problem, illustrative, clone):
    def rates(**changes):
        config = replace(TINY, **changes)
        moving = ascent(problem, clone(illustrative), config)
        out = []
        for k in (0, 6, 11):
            moving.iterate(k, 12)
            out.append(moving.design_optimiser.param_groups[0]["lr"])
        return out

    np.testing.assert_allclose(rates(), [0.1, 0.05, 0.05 * (1 + np.cos(np.pi * 11 / 12))])
    np.testing.assert_allclose(rates(constant_rates=True), 0.1)


def test_an_infinite_gradient_moves_nothing(problem, illustrative, clone):
    moving = ascent(problem, clone(illustrative))
    before = moving.v.detach().clone()
    for bad in (np.inf, np.nan):
        moving._move_design(torch.tensor([bad]), 1.0)
    assert torch.equal(moving.v.detach(), before)
    moving._move_design(torch.tensor([1e17]), 1.0)
    moving._move_design(torch.tensor([1.0]), 1.0)
    assert 0 < (moving.v.detach() - before).item() < 0.5  # one huge gradient does not inflate Adam's memory
