"""State limits in the co-design: idle where they do not bind, kept where they do, and said where they are not."""

import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch

import ccdtools as cc
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.episodes import Episode
from ccdtools.co_design.limit_tolerance import BESIDE_MPC, FLOOR, Pair, Tolerance, mpc_episodes, tolerance_by_mpc
from ccdtools.co_design.limits import LimitsOutcome, StateLimitPenalty
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


def episodes(fraction, depth, n=4):
    """Episodes with these measures, returning −100 each."""
    full = torch.full((n,), 1.0, dtype=torch.float64)
    return Episode(-100 * full, full < 0, 0.1 * depth * full, depth * full, fraction * full)


@pytest.mark.parametrize("name", ["illustrative", "suspension"])
def test_where_the_limits_never_bind_the_results_are_those_without_limits(name, request, clone):
    study = request.getfixturevalue(name)
    results = []
    for tolerance in ("mpc", "off"):
        problem = replace(study.problem(), limit_tolerance=tolerance)
        config = cc.CoDesignConfig(**QUICK)
        results.append(cc.codesign(problem, agent=clone(study), design=study.p0, rng=np.random.default_rng(1),
                                   config=config))  # fmt: skip
    kept, off = results
    np.testing.assert_array_equal(kept.design, off.design)
    np.testing.assert_array_equal(kept.history.model_return, off.history.model_return)
    assert kept.limits.kept
    assert kept.limits.multipliers == Pair(0.0, 0.0)
    assert off.limits is None


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


def test_the_tolerance_is_a_quarter_more_than_what_mpc_does_there():
    problem = rail()
    scenarios = scenario_tensors(problem, 40, np.random.default_rng(0))
    v = torch.tensor([0.4])
    granted = StateLimitPenalty(problem).updated(episodes(0.5, 0.3), v, scenarios)
    by_mpc = mpc_episodes(problem, v, scenarios)
    assert granted.tolerance.granted.depth == pytest.approx(BESIDE_MPC * float(by_mpc.peak.mean()))
    assert granted.tolerance.granted.fraction == pytest.approx(BESIDE_MPC * float(by_mpc.outside.mean()))
    assert "MPC of the same design" in granted.tolerance.source
    idle = StateLimitPenalty(problem).updated(episodes(0.001, 0.001), v, scenarios)
    assert idle.tolerance.v is None
    assert not idle.active


def test_near_the_design_at_which_mpc_was_measured_the_tolerance_follows_the_design():
    problem = rail()
    scenarios = scenario_tensors(problem, 40, np.random.default_rng(0))
    v = torch.tensor([0.3])
    near = tolerance_by_mpc(problem, v, scenarios)
    there = tolerance_by_mpc(problem, v + 0.06, scenarios)
    assert near.holds_at(v + 0.06)
    assert not near.holds_at(v + 0.2)
    constant = near.granted.fraction - there.granted.fraction
    assert abs(constant) > 0.02 * there.granted.fraction
    assert abs(float(near.at(v + 0.06)[0]) - there.granted.fraction) < 0.3 * abs(constant)


def test_an_mpc_that_loses_every_run_grants_no_more_than_a_network_resolves():
    lost = replace(rail(), scenarios=cc.FixedStart([-1.5, 0.4], cc.Gaussian([1e9])))
    granted = tolerance_by_mpc(lost, torch.tensor([0.3]), scenario_tensors(lost, 40, np.random.default_rng(0)))
    assert granted.granted == Pair(FLOOR, FLOOR)


def test_multipliers_grow_while_the_limits_are_broken_and_fall_to_zero_once_kept():
    penalty = StateLimitPenalty(rail(limit_tolerance=(0.1, 0.05)))
    v = torch.tensor([0.4])
    assert not penalty.active
    values = []
    for _ in range(4):
        penalty = penalty.updated(episodes(0.05, 0.4), v, ())
        values.append(penalty.multipliers.depth)
    assert values == sorted(values)
    assert 0 < values[0] < values[-1]
    assert penalty.multipliers.fraction == 0
    assert penalty.violation(episodes(0.05, 0.4)) == pytest.approx(0.35)
    for _ in range(30):
        penalty = penalty.updated(episodes(0.0, 0.0), v, ())
    assert not penalty.active
    assert penalty.violation(episodes(0.1, 0.05)) == 0


@pytest.fixture
def priced():
    """Return a penalty whose multipliers are not zero, and episodes at which both measures are where they aim."""
    at = torch.tensor([0.4], dtype=torch.float64)
    tolerance = Tolerance(Pair(0.1, 0.05), "made up", at, torch.tensor([[0.0], [2.0]], dtype=torch.float64))
    penalty = replace(StateLimitPenalty(rail()), tolerance=tolerance, v=at, multipliers=Pair(0.2, 0.3), spread=0.25)
    full = torch.ones(2, dtype=torch.float64)
    depth = torch.tensor([0.015, 0.03], dtype=torch.float64)
    return penalty, Episode(-100 * full, full < 0, depth, 0.045 * full, 0.09 * full), at


def test_the_cost_prices_peak_and_mean_depth_in_parts_of_the_return(priced):
    penalty, seen, v = priced
    prices = penalty.prices(seen, v)
    np.testing.assert_allclose(prices.peak, 100 * 0.3 / 0.05)
    np.testing.assert_allclose(prices.depth, 100 * 0.2 / 0.1 / 0.25)
    np.testing.assert_allclose(prices.design, -100 * 0.3 * 0.9 * 2.0)  # a design with more granted has less to pay


def test_the_prices_are_the_slopes_of_the_cost(priced):
    penalty, seen, v = priced
    seen = replace(seen, peak=1.4 * seen.peak)
    prices = penalty.prices(seen, v)
    h = 1e-6
    slopes = [
        (penalty.cost(replace(seen, depth=seen.depth + h), v) - penalty.cost(replace(seen, depth=seen.depth - h), v)),
        (penalty.cost(replace(seen, peak=seen.peak + h), v) - penalty.cost(replace(seen, peak=seen.peak - h), v)),
        (penalty.cost(seen, v + h) - penalty.cost(seen, v - h)),
    ]
    expected = np.array([float(slope) for slope in slopes]) / (2 * h)
    np.testing.assert_allclose([prices.depth, prices.peak, float(prices.design)], expected, rtol=1e-5)


def test_a_tolerance_that_cannot_be_met_is_said_with_its_cure(agent):
    rough = cc.FixedStart([-1.5, 0.4], cc.Gaussian([3.0]))  # noise beyond what the input can brake
    result = designed(rail(limit_tolerance=(0.0, 0.0), scenarios=rough), agent)
    assert not result.limits.kept
    text = str(result.limits)
    assert text.startswith("state limits not kept: ")
    assert "granted (asked for)" in text
    assert "put the filter in service" in text
    assert pickle.loads(pickle.dumps(result.limits)) == result.limits


def test_an_outcome_that_is_kept_says_by_how_much():
    outcome = LimitsOutcome(Pair(0.1, 0.02), Pair(0.12, 0.05), "asked for", Pair(0.0, 0.0))
    assert str(outcome) == (
        "state limits kept: 10.00% of the states outside X, peak depth 0.02; 12.00% and 0.05 granted (asked for)"
    )


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
