"""Episodes of a problem that step together: PPO learns from scratch in them."""

import numpy as np
import pytest
import torch

from ccdtools import InputError, LearnedPolicy, closed_loop_returns
from ccdtools.co_design import EpisodeEnv
from learning import train


def test_an_agent_from_scratch_learns_a_problem_and_is_its_policy(suspension):
    problem = suspension.problem()
    design = problem.design.centre
    env = EpisodeEnv(problem, design, runs=8, rng=np.random.default_rng(0))
    agent = env.agent(seed=1)
    before = LearnedPolicy(agent, design)
    trained = train(env, agent, iterations=12, steps=problem.steps, generator=torch.Generator().manual_seed(0))
    returns = [
        closed_loop_returns(problem, law, design, rng=np.random.default_rng(1), runs=64).values.mean()
        for law in (before, LearnedPolicy(trained.agent, design))
    ]
    assert returns[1] > returns[0] + 3
    assert LearnedPolicy(trained.agent, problem.design.lower).nx == 4  # the scale of the design is still its box


def test_a_return_is_that_of_the_closed_loop(suspension):
    problem = suspension.problem()
    design = problem.design.centre
    env = EpisodeEnv(problem, design, runs=4, rng=np.random.default_rng(3))
    law = LearnedPolicy(env.agent(seed=2), design)
    observation, total = env.reset(), torch.zeros(4)
    for _ in range(problem.steps):
        u = torch.as_tensor(law(observation[:, : law.nx].double().numpy()), dtype=torch.float32)
        observation, _, reward, *_ = env.step(u)
        total += reward
    expected = closed_loop_returns(problem, law, design, rng=np.random.default_rng(3), runs=4)
    paid = problem.cost_of_design(design)
    np.testing.assert_allclose(total, expected.values + paid, rtol=1e-4)


def test_wrong_calls_name_their_argument(illustrative):
    problem = illustrative.problem()
    rng = np.random.default_rng(0)
    for call, argument in (
        (lambda: EpisodeEnv(3, [1.0], rng=rng), "problem"),
        (lambda: EpisodeEnv(problem, [9.0], rng=rng), "design"),
        (lambda: EpisodeEnv(problem, [1.0], runs=0, rng=rng), "runs"),
        (lambda: EpisodeEnv(problem, [1.0], rng=3), "rng"),
    ):
        with pytest.raises(InputError) as caught:
            call()
        assert caught.value.argument == argument
