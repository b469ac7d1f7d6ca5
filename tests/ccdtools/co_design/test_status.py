"""How a co-design ends: at the independent optimum, or with a status that says why not."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from small_plants import best_design, clone_of, exact_return, mass, two_valleys

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    MeanSpread,
    Plant,
    QuadraticObjective,
    Sequential,
    WorstCase,
    codesign,
    discretise,
)
from ccdtools.disturbances import Cases, Stacked
from ccdtools.exceptions import LimitWarning
from invariant_sets import Polytope

SMALL = CoDesignConfig(evaluation_runs=400, iterations=160, pathwise_runs=128)


@pytest.fixture(scope="module")
def mass_and_clone():
    """Return the mass and a rough clone of its LQR."""
    problem = mass()
    return problem, clone_of(problem)


@pytest.fixture(scope="module")
def valleys_and_clone():
    """Return the plant of two valleys and a rough clone of its LQR."""
    problem = two_valleys()
    return problem, clone_of(problem)


def run(problem, agent, design, seed=0, **changes):
    return codesign(
        problem, agent=agent, design=design, rng=np.random.default_rng(seed), config=replace(SMALL, **changes)
    )


@pytest.mark.check
@pytest.mark.parametrize("starts", [1, None])
@pytest.mark.parametrize("design", [0.2, 3.0])
def test_the_independent_optimum_is_reached_from_either_end(mass_and_clone, design, starts):
    problem, agent = mass_and_clone
    best, expected = best_design(problem)
    found = run(problem, agent, [design], starts=starts)
    assert 0.3 < best[0] < 2.9
    assert exact_return(problem, found.design) >= expected - 0.002 * abs(expected)
    assert found.status.name == "CONVERGED"
    policy = found.history.model_return.max()
    assert policy >= expected - 0.02 * abs(expected)  # 400 runs


@pytest.mark.check
def test_from_the_basin_of_the_lesser_valley_the_better_one_is_found_and_the_lesser_one_named(valleys_and_clone):
    problem, agent = valleys_and_clone
    _, expected = best_design(problem)
    trapped = run(problem, agent, [0.05], starts=1)
    assert exact_return(problem, trapped.design) < 1.02 * expected
    found = run(problem, agent, [0.05])
    assert exact_return(problem, found.design) >= expected - 0.002 * abs(expected)
    better, lesser = found.valleys
    np.testing.assert_allclose(lesser.design, trapped.design, atol=0.03)
    np.testing.assert_allclose(better.found, found.design)
    assert (better.given, lesser.given) == (False, True)
    assert lesser.found is not None  # where the co-design from the given design ended, or the one from the hilltop
    assert lesser.found_return <= better.found_return
    assert any("local optimum" in line and "of the given design" in line for line in found.describe())


@pytest.mark.check
def test_a_design_at_a_bound_says_so(illustrative, clone):
    found = run(replace(illustrative.problem(), steps=40), clone(illustrative), [1.0])
    assert found.status.name == "AT_BOUND"
    assert found.status.settled
    assert "bounds" in found.status.advice
    assert found.convergence.slope[0] == 0.0  # what remains points out of the box


@pytest.mark.check
def test_a_budget_that_ends_while_the_return_rises_says_so(mass_and_clone):
    problem, agent = mass_and_clone
    found = run(problem, agent, [3.0], iterations=3, starts=1)
    assert found.status.name == "STILL_IMPROVING"
    assert found.convergence.gain.ci95[0] > 0
    assert "iterations" in found.status.advice


@pytest.mark.check
def test_what_did_the_work_adds_up_to_the_whole_gain(mass_and_clone):
    problem, agent = mass_and_clone
    found = run(problem, agent, [3.0], starts=1)
    gained = found.history.model_return.max() - found.history.model_return[0]
    assert sum(found.gains.values()) == pytest.approx(gained, rel=1e-4)
    assert found.gains["design"] > 5 * found.gains["policy"]
    assert found.method == "pathwise"


class Detached(QuadraticObjective):
    """The reward with the sign of its gradient turned round."""

    def rewards(self, x_next, u, x=None, p=None):
        seen = super().rewards(x_next, u)
        return seen if isinstance(seen, np.ndarray) else 2.0 * seen.detach() - seen


@pytest.mark.check
def test_where_the_gradient_is_wrong_the_design_follows_finite_differences(mass_and_clone):
    problem, agent = mass_and_clone
    _, expected = best_design(problem)
    wrong = replace(problem, objective=Detached(problem.objective.Q, problem.objective.R))
    found = run(wrong, agent, [3.0], starts=1, policy_rate=0.0)
    assert not found.gradients.trusted
    assert found.convergence.by_differences
    assert exact_return(problem, found.design) >= expected - 0.02 * abs(expected)
    assert any("finite differences" in line for line in found.describe())


@pytest.mark.long
def test_runs_that_nothing_can_recover_are_named(illustrative, clone):
    problem = illustrative.problem()
    lost = replace(
        problem, scenarios=FixedStart([-9.0, -5.0], Gaussian([0.1, 0.2])), U=Polytope.from_bounds([-1.0], [1.0])
    )
    with pytest.warns(LimitWarning, match="no controller keeps X"):
        found = run(lost, clone(illustrative), [1.0], iterations=4, starts=1, evaluation_runs=50)
    assert found.status.name == "DIVERGING"
    assert not found.status.settled


@pytest.mark.check
def test_a_design_that_the_judge_finds_level_has_settled_whatever_the_training_model_promises(mass_and_clone):
    judge, agent = mass_and_clone
    best, _ = best_design(judge)
    objective = judge.objective
    problem = replace(judge, objective=QuadraticObjective(Q=objective.Q, R=100 * objective.R))
    assert abs(best_design(problem)[0][0] - best[0]) > 0.1  # the training alone would go elsewhere
    first = run(judge, agent, best, starts=1)
    found = codesign(
        problem, agent=first.agent, design=first.design, rng=np.random.default_rng(1), judge=judge,
        config=replace(SMALL, starts=1),
    )  # fmt: skip
    assert found.status.name == "CONVERGED"
    np.testing.assert_allclose(found.design, first.design, atol=0.05)


@pytest.mark.check
def test_along_the_gradient_through_the_model_nothing_is_explored(mass_and_clone):
    problem, agent = mass_and_clone
    found = run(problem, agent, [1.0], iterations=10, block=10, starts=1)
    np.testing.assert_allclose(found.agent.log_std.exp().detach().numpy(), 0.02, rtol=1e-5)


@pytest.mark.long
@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("risk", "words"),
    [(WorstCase(), "in the worst of 5 cases"), (MeanSpread(3), "in the mean minus 3 times the spread")],
)
def test_a_design_that_its_baseline_beats_in_the_risk_of_the_problem_has_not_settled(risk, words):
    """Trajectories that know the disturbance ahead want a soft spring; in the worst case LQR wants a stiff one."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    dynamics = ca.vertcat(x[1], -p * x[0] - 0.3 * x[1] + u + w[0] + w[1])
    plant = Plant(x, u, w, p, dynamics, DesignSpace(["k"], [0.5], [5.0]), dt=0.1)
    problem = CoDesignProblem(
        discretise(plant), X=(-50, 50), U=(-3, 3), steps=60, risk=risk,
        objective=QuadraticObjective(np.eye(2), [[0.5]], design_cost=lambda p: 30 * p[0]),
        scenarios=FixedStart([1.0, 0.0], Stacked((Gaussian([0.3]), Cases.of([-1.5, 0, 0, 0, 0.2])))),
    )  # fmt: skip
    found = codesign(problem, method=Sequential("open_loop", starts=1), rng=np.random.default_rng(0))
    assert found.status.name == "WORSE_THAN_BASELINE"
    best = max(found.baselines, key=lambda one: one.gain.mean)
    assert words in repr(best)
