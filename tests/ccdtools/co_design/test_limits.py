"""State limits in the co-design: idle where they do not bind, kept where they do, and said where they are not."""

import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc
from invariant_sets import Polytope
from learning import CloningConfig, NetworkConfig, fit_actor_critic
from mpc import LinearMPC

QUICK = {"iterations": 8, "pathwise_runs": 16, "evaluation_runs": 64, "evaluate_every": 2}


def rail(limit=0.5, **changes):
    """A mass on a rail with light friction: its speed is limited, and the start is far enough to reach the limit."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    space = cc.DesignSpace(["m"], [0.5], [3.0], units=["kg"])
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], (u - 0.1 * x[1]) / p + w), space, dt=0.1)
    stated = cc.CoDesignProblem(
        cc.discretise(plant), X=Polytope.from_bounds([-2, -limit], [2, limit]), U=Polytope.from_bounds([-1], [1]),
        objective=cc.QuadraticObjective(np.diag([1, 0.1]), [[0.05]]),
        scenarios=cc.FixedStart([-1.5, 0.0], cc.Gaussian([0.1])), steps=60,
    )  # fmt: skip
    return replace(stated, **changes)


@pytest.fixture(scope="module")
def agent():
    problem = rail()
    data = cc.expert_dataset(problem, samples=60, rng=np.random.default_rng(0))
    return fit_actor_critic(
        data.inputs, data.actions, data.values, rng=np.random.default_rng(0), action_bounds=problem.input_bounds,
        input_bounds=problem.observation_bounds, network=NetworkConfig((24, 24)), config=CloningConfig(steps=800),
    )  # fmt: skip


def designed(problem, agent, **options):
    config = cc.CoDesignConfig(**(QUICK | options))
    return cc.codesign(problem, agent=agent, design=[1.5], rng=np.random.default_rng(2), config=config)


@pytest.mark.check
def test_a_limit_that_binds_is_kept_about_as_by_mpc_and_not_without_the_penalty(agent):
    problem = rail()
    iterations = {"iterations": 40, "evaluate_every": 4}
    kept = designed(problem, agent, **iterations)
    free = designed(replace(problem, limit_tolerance="off"), agent, **iterations)
    x0, w = problem.scenarios.sample(40, problem.steps, np.random.default_rng(9))

    def peak(controller, design):
        run = cc.Scenario(problem.model, x0, w).run(controller, design=design, limit=problem.limit)
        return cc.excursions(run.states[:, 1:], problem.X).peak.mean()

    A, B, _ = problem.model.matrices(kept.design)
    mpc = LinearMPC(A, B, Q=problem.objective.Q, R=problem.objective.R, horizon=20, X=problem.X, U=problem.U)
    assert kept.limits.kept
    assert peak(kept.policy, kept.design) <= 1.5 * peak(mpc, kept.design)
    assert peak(free.policy, free.design) > 0.5
    assert free.design[0] < 1.2 > kept.design[0]  # both move the design, away from the heavy start


@pytest.mark.long
def test_a_tolerance_that_cannot_be_met_is_said_with_its_cure(agent):
    rough = cc.FixedStart([-1.5, 0.4], cc.Gaussian([3.0]))  # noise beyond what the input can brake
    result = designed(rail(limit_tolerance=(0.0, 0.0), scenarios=rough), agent)
    assert not result.limits.kept
    text = str(result.limits)
    assert text.startswith("state limits not kept: ")
    assert "(asked for)" in text
    assert "deploy with the filter" in text
    assert pickle.loads(pickle.dumps(result.limits)) == result.limits


@pytest.mark.parametrize(
    "value", ["never", 0.1, (0.1,), (-0.1, 0.1), (0.1, float("nan")), (2.0, 0.1), (True, 0.1), None]
)
def test_a_tolerance_of_another_kind_is_refused(value):
    with pytest.raises(cc.InputError, match=r"limit_tolerance: got .*, expected mpc, off, or"):
        rail(limit_tolerance=value)


def test_a_tolerance_may_be_of_numpy():
    assert rail(limit_tolerance=np.array([0.1, 0.2])).limit_tolerance == (0.1, 0.2)


def test_the_clone_of_the_projected_expert_leaves_X_no_further_than_noise_carries_it(agent):
    problem = rail()
    x0, w = problem.scenarios.sample(30, problem.steps, np.random.default_rng(9))
    run = cc.Scenario(problem.model, x0, w).run(cc.LearnedPolicy(agent, [1.5]), design=[1.5], limit=problem.limit)
    assert cc.excursions(run.states[:, 1:], problem.X).peak.mean() < 0.1  # 0.76 where LQR takes over outside X_fea


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_whole_co_design_keeps_the_limit_as_mpc_does_at_no_loss(seed):
    problem = rail()
    rng = np.random.default_rng(seed)
    data = cc.expert_dataset(problem, samples=200, rng=rng)
    agent = fit_actor_critic(
        data.inputs, data.actions, data.values, rng=rng, action_bounds=problem.input_bounds,
        input_bounds=problem.observation_bounds,
    )  # fmt: skip
    found = cc.codesign(problem, agent=agent, design=[1.5], rng=rng)
    A, B, _ = problem.model.matrices(found.design)
    mpc = LinearMPC(A, B, Q=problem.objective.Q, R=problem.objective.R, horizon=20, X=problem.X, U=problem.U)
    x0, w = problem.scenarios.sample(60, problem.steps, np.random.default_rng(9))
    table = cc.compare(
        {"LQR": cc.saturated_lqr(problem, found.design), "MPC": mpc, "learned": found.policy},
        cc.Scenario(problem.model, x0, w), design=found.design, objective=problem.objective, X=problem.X,
    )  # fmt: skip
    assert table["learned"].depth_peak <= 1.5 * table["MPC"].depth_peak
    assert table["learned"].violations <= 1.5 * table["MPC"].violations
    assert table["learned"].summary.mean >= 1.02 * table["MPC"].summary.mean
    assert "LQR" not in table["learned"].further_outside_than
