"""A plant on which LQR is no expert: a damper between two bounds, whose input does nothing at rest."""

import casadi as ca
import numpy as np
import pytest
import semi_active_damper
import torch

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    FixedStart,
    Gaussian,
    Learned,
    LearnedPolicy,
    Plant,
    closed_loop_returns,
    codesign,
    discretise,
    saturated_lqr,
)  # fmt: skip
from learning import ActorCritic

SPRING = [2e4]


@pytest.mark.check
def test_a_policy_that_begins_with_nothing_to_imitate_passes_the_law_of_engineers():
    problem = semi_active_damper.problem()
    assert np.abs(saturated_lqr(problem, SPRING).K).max() < 1e-9
    few = CoDesignConfig(iterations=120, design_rate=0.0)
    found = codesign(problem, rng=np.random.default_rng(0), design=SPRING, config=few)
    learned, known = (
        closed_loop_returns(problem, law, SPRING, rng=np.random.default_rng(5), runs=200).values.mean()
        for law in (LearnedPolicy(found.agent, SPRING), semi_active_damper.skyhook([5157.0, 604.0]))
    )
    assert learned > 0.96 * known  # both are negative


@pytest.mark.check
def test_a_state_that_the_first_policy_hardly_moves_does_not_hold_up_the_climb():
    x, u, w, p = ca.SX.sym("x", 3), ca.SX.sym("u", 2), ca.SX.sym("w"), ca.SX.sym("k")
    rates = ca.vertcat(x[1], -p * x[0] + u[0] + w, -0.5 * x[2] + u[1])
    plant = Plant(x, u, w, p, rates, DesignSpace(["k"], [1.0], [3.0]), dt=0.1)

    def cost(x, u, p):  # LQR holds the last state at 0, where it ought to follow half the first
        return x[0] ** 2 + x[1] ** 2 + 0.1 * (u[0] ** 2 + u[1] ** 2) + (x[2] - 0.5 * x[0]) ** 2

    problem = CoDesignProblem(
        discretise(plant), X=(-4, 4), U=(-2, 2), objective=CustomObjective(cost, Q=np.eye(3), R=0.1 * np.eye(2)),
        scenarios=FixedStart([1.0, 0.0, 0.0], Gaussian([0.3])), steps=60,
    )  # fmt: skip
    config = CoDesignConfig(design_rate=0.0, iterations=30)
    found = codesign(problem, rng=np.random.default_rng(0), design=[2.0], config=config)
    at_rest = closed_loop_returns(problem, saturated_lqr(problem, [2.0]), [2.0], rng=np.random.default_rng(5), runs=500)
    learned = closed_loop_returns(problem, found.controller, [2.0], rng=np.random.default_rng(5), runs=500)
    assert learned.values.mean() > 0.948 * at_rest.values.mean()  # both are negative


@pytest.mark.check
def test_a_first_policy_that_loses_every_run_leaves_the_weights_finite(illustrative):
    problem = illustrative.problem()
    agent = ActorCritic(*problem.observation_bounds, *problem.input_bounds, imitates=True)
    with torch.no_grad():
        agent.mean_network.skip.weight.fill_(1e3)
    few = CoDesignConfig(iterations=2, block=2, starts=1, evaluation_runs=16, pathwise_runs=16)
    found = Learned(agent=agent, config=few).run(problem, np.array([0.8]), np.random.default_rng(0))
    assert all(torch.isfinite(parameter).all() for parameter in found.agent.parameters())
