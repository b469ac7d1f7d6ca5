"""Nothing is called settled before the closed loop of the controller that is handed out was looked at."""

import copy
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
import torch
from small_plants import clone_of, mass

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    CVaR,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    Nested,
    OutputLimits,
    Plant,
    QuadraticObjective,
    codesign,
    discretise,
)
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.policy_check import better_by_search, gradient_of_policy
from ccdtools.co_design.result import CoDesignResult, CoDesignStatus, History
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.exceptions import JumpWarning
from learning import ActorCritic
from mpc import lqr

BEST = 0.357  # kg, of the mass


@pytest.fixture(scope="module")
def problem():
    return mass()


@pytest.fixture(scope="module")
def clone(problem):
    return clone_of(problem)


def gain(problem, m):
    """LQR of a mass, by its matrices."""
    A, B, _ = problem.model.matrices([m])
    return lqr(A, B, Q=problem.objective.Q, R=problem.objective.R)[0]


class Claims:
    """A method that hands out one design and controller, and claims to have converged."""

    name = "claims"

    def __init__(self, design, controller, status=CoDesignStatus.CONVERGED):
        self.given = (np.array([design]), controller, status)

    def run(self, problem, design, rng, *, progress=False):
        one = np.ones(1)
        found, controller, status = self.given
        history = History(one, one, found[None], one, 0 * one, 0 * one)
        return CoDesignResult(design=found, controller=controller, status=status, history=history)


def claimed(problem, design, K, **options):
    controller = LinearFeedback(K, *problem.input_bounds)
    return codesign(problem, method=Claims(design, controller, **options), rng=np.random.default_rng(0))


@pytest.mark.long
def test_where_the_tangent_has_no_lqr_a_claim_falls_below_that_of_the_secant():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = Plant(x, u, w, p, ca.vertcat(x[1], (u * ca.fabs(u) - 0.1 * x[1] + w) / p), DesignSpace(["m"], [0.5], [2]),
                  dt=0.05)  # fmt: skip
    for price in (0.0, 1e5):  # of the design, beside which control costs next to nothing
        own = CoDesignProblem(
            discretise(plant), X=([-3, -6], [3, 6]), U=(-3, 3), steps=60, limit_tolerance="off",
            objective=QuadraticObjective(np.diag([1.0, 0.1]), [[0.1]], design_cost=lambda p, c=price: c * p[0]),
            scenarios=FixedStart([1.0, 0.0], Gaussian([0.3])),
        )  # fmt: skip
        weak = claimed(own, 0.5, [[0.05, 0.05]])
        assert weak.status is CoDesignStatus.WORSE_THAN_BASELINE
        assert weak.baselines[0].name == "LQR of the same design, of its secant"


def test_a_claim_stands_at_the_optimum_and_falls_below_lqr_of_its_own_design(problem):
    assert claimed(problem, BEST, gain(problem, BEST)).status is CoDesignStatus.CONVERGED
    weak = claimed(problem, BEST, 0.3 * gain(problem, BEST))
    assert weak.status is CoDesignStatus.WORSE_THAN_BASELINE
    assert not weak.status.settled
    baseline = weak.baselines[0]
    assert baseline.name == "LQR of the same design"
    assert 0.005 < baseline.gain.ci95[0] < baseline.gain.mean
    assert any("LQR of the same design: +" in line for line in weak.describe())


@pytest.mark.check
def test_a_policy_falls_below_mpc_of_its_own_design_where_the_input_saturates(problem):
    tight = replace(problem, U=(-0.6, 0.6), scenarios=FixedStart([2.0, -1.0], Gaussian([0.1])))
    found = codesign(tight, method=Claims(BEST, LearnedPolicy(clone_of(tight), [BEST])), rng=np.random.default_rng(0))
    assert found.status is CoDesignStatus.WORSE_THAN_BASELINE
    planned = found.baselines[1]
    assert planned.name == "MPC of the same design"
    assert planned.gain.ci95[0] > 0.005


@pytest.mark.check
def test_mpc_is_no_baseline_where_fewer_than_ten_of_its_runs_decide_the_risk(problem):
    tight = replace(problem, U=(-0.6, 0.6), scenarios=FixedStart([2.0, -1.0], Gaussian([0.1])), risk=CVaR(0.1))
    found = codesign(tight, method=Claims(BEST, LearnedPolicy(clone_of(tight), [BEST])), rng=np.random.default_rng(0))
    assert "MPC of the same design" not in [one.name for one in found.baselines]


@pytest.mark.check
def test_a_claim_falls_at_a_design_that_nested_lqr_leaves_for_a_better_one(problem):
    found = claimed(problem, 2.0, gain(problem, 2.0))
    assert found.status is CoDesignStatus.WORSE_THAN_BASELINE
    better = found.baselines[-1]
    assert better.name.startswith("nested LQR")
    assert better.design[0] == pytest.approx(BEST, abs=0.02)


def test_a_claim_falls_where_the_closed_loop_leaves_limits_further_than_was_asked_for(problem):
    tight = replace(problem, X=([-1.01, -1.2], [1.01, 1.2]), limit_tolerance=(0.02, 0.02))
    found = claimed(tight, BEST, gain(problem, BEST))
    assert found.status is CoDesignStatus.LIMITS_BROKEN
    assert found.limits.achieved.depth > 0.02
    assert not found.limits.kept
    assert "does not price the limits" in found.notes[-1]
    free = claimed(replace(tight, limit_tolerance="off"), BEST, gain(problem, BEST))
    assert free.status is CoDesignStatus.CONVERGED


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("inner", "said"), [("riccati", "Nested('mpc')"), ("lqr", "prices the limits: a larger budget")]
)
def test_what_may_keep_broken_limits_fits_the_method(problem, inner, said):
    tight = replace(problem, X=([-1.01, -1.2], [1.01, 1.2]), limit_tolerance=(0.0, 0.0))
    found = codesign(tight, method=Nested(inner, starts=1, runs=50), rng=np.random.default_rng(0))
    assert found.status is CoDesignStatus.LIMITS_BROKEN
    assert said in found.notes[-1]
    assert "budget" not in found.status.advice


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("bounds", [(-1.0, 0.2), (-5.0, 0.2)])
def test_a_claim_falls_where_inputs_are_asked_for_beyond_the_actuator(problem, side, bounds):
    K, (A, B, _) = gain(problem, BEST), problem.model.matrices([BEST])
    start = side * np.array([2.0, -1.0])
    u = np.array([(-K @ np.linalg.matrix_power(A - B @ K, k) @ start).item() for k in range(60)])
    low, high = U = np.sort(side * np.array(bounds))
    tight = replace(problem, U=tuple(U), limit_tolerance="off", scenarios=FixedStart(start, Gaussian([1e-9])))
    unclipped = codesign(tight, method=Claims(BEST, LinearFeedback(K)), rng=np.random.default_rng(0))
    assert unclipped.status is CoDesignStatus.LIMITS_BROKEN
    most = max(u.max() - high, low - u.min()) / ((high - low) / 2)
    assert unclipped.closed_loop.beyond_inputs == pytest.approx(most, rel=1e-6)
    assert any("beyond U" in note for note in unclipped.notes)
    assert "clip them to U" in unclipped.notes[-1]
    assert claimed(tight, BEST, K).closed_loop.beyond_inputs <= 0


def test_a_loop_whose_states_overflow_is_lost_without_a_warning():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    fast = ca.vertcat(x[1] + 0.1 * x[1] ** 3, (u + w) / p + 30 * x[0] ** 3 - x[1] ** 3)
    plant = Plant(x, u, w, p, fast, DesignSpace(["m"], [0.5], [2.0]), dt=0.05)
    own = CoDesignProblem(
        discretise(plant), X=([-3, -6], [3, 6]), U=(-1, 1), steps=60, scenarios=FixedStart([1.0, 0.0], Gaussian([0.3])),
        objective=QuadraticObjective(np.diag([1.0, 0.1]), [[0.1]]),
    )  # fmt: skip
    assert claimed(own, 1.0, [[1.0, 1.0]]).status is CoDesignStatus.DIVERGING
    with pytest.raises(InputError, match=r"controller: got inputs of shape \(\d+, 2\), expected \(\d+, 1\)"):
        claimed(own, 1.0, [[1.0, 1.0], [0.0, 0.0]])


def test_other_statuses_stay_what_the_method_says(problem):
    K = 0.3 * gain(problem, BEST)
    found = claimed(problem, BEST, K, status=CoDesignStatus.BUDGET_SPENT)
    assert found.status is CoDesignStatus.BUDGET_SPENT
    assert found.baselines == ()


def test_a_policy_that_has_not_settled_is_told_beside_lqr(problem):
    policy = LearnedPolicy(ActorCritic(*problem.observation_bounds, *problem.input_bounds, seed=0), [BEST])
    method = Claims(BEST, policy, CoDesignStatus.BUDGET_SPENT)
    found = codesign(problem, method=method, rng=np.random.default_rng(0))
    assert found.status is CoDesignStatus.BUDGET_SPENT
    (lqr,) = found.baselines
    assert lqr.name == "LQR of the same design"
    assert lqr.gain.ci95[0] > 0.005  # nothing was learned
    assert any("beside it, LQR of the same design: +" in line for line in found.describe())


def test_lost_runs_are_told_of_every_method(problem):
    found = claimed(replace(problem, divergence=0.05), BEST, gain(problem, BEST))  # x0 is further out
    assert found.status is CoDesignStatus.DIVERGING


def spoilt(agent, factor=1.0, bias=None):
    """An agent whose last layer is multiplied, or whose bias saturates it wherever it is."""
    other = copy.deepcopy(agent)
    with torch.no_grad():
        for weight in (other.mean_network.head.weight, other.mean_network.head.bias, other.mean_network.skip.weight):
            weight.mul_(factor)
        if bias is not None:
            other.mean_network.head.bias.fill_(bias)
    return other


def drawn(problem, seed, runs=128):
    return scenario_tensors(problem, runs, np.random.default_rng(seed))


def test_the_gradient_of_a_policy_is_that_of_differences_and_none_where_it_saturates(problem, clone):
    check = gradient_of_policy(problem, LearnedPolicy(spoilt(clone, 0.5), [1.0]), drawn(problem, 0))
    assert check.trusted
    assert check.blind == 0
    assert check.cosine("pathwise") > 0.999
    assert np.linalg.norm(check.finite_difference) > 3 * np.linalg.norm(check.finite_difference_error)
    bound = gradient_of_policy(problem, LearnedPolicy(spoilt(clone, bias=50.0), [1.0]), drawn(problem, 0))
    assert bound.blind == 1


@pytest.mark.filterwarnings("ignore::ccdtools.JumpWarning")
def test_the_gradient_of_a_policy_is_not_trusted_where_the_plant_jumps(problem):
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    v = x[1] + 0.1 * (p * u + w)
    after = ca.vertcat(x[0] + 0.1 * v, ca.if_else(x[0] + 0.1 * v > -0.7, v + 1.5, v))
    after[1] -= ca.if_else(x[0] + 0.1 * v > -0.3, 1.5, 0)  # a strip that throws what passes it
    plant = Plant(x, u, w, p, after, DesignSpace(["p"], [0.5], [2.0]), dt=0.1, continuous=False)
    thrown = CoDesignProblem(
        discretise(plant), X=([-6, -6], [6, 6]), U=([-6], [6]), steps=30, limit_tolerance="off",
        objective=QuadraticObjective(np.diag([1.0, 0.1]), [[0.05]]), scenarios=FixedStart([-1.2, 0.3], Gaussian([1.0])),
    )  # fmt: skip
    policy = LearnedPolicy(spoilt(clone_of(problem), 0.05), [1.0])
    check = gradient_of_policy(thrown, policy, drawn(thrown, 0, 2000))
    assert not check.trusted


def test_a_search_over_the_last_layer_improves_half_a_gain_and_not_a_whole_one(problem, clone):
    sets = drawn(problem, 1), drawn(problem, 2)
    half = better_by_search(problem, LearnedPolicy(spoilt(clone, 0.5), [BEST]), *sets)
    assert half.ci95[0] > 0.05
    whole = better_by_search(problem, LearnedPolicy(clone, [BEST]), *sets)
    assert whole.mean < 0.1


@pytest.mark.long
def test_learning_from_a_saturated_policy_starts_again_from_one_that_imitates_lqr(problem, clone, monkeypatch):
    from ccdtools.co_design.methods import learned

    made = []
    monkeypatch.setattr(
        learned, "first_policy", lambda *_, **__: made.append(clone) or SimpleNamespace(agent=clone, samples=1)
    )
    config = CoDesignConfig(iterations=4, block=4, evaluation_runs=64, pathwise_runs=32, starts=1, design_rate=0.0)
    for agent in (clone, spoilt(clone, bias=50.0)):
        found = codesign(problem, agent=agent, design=[1.0], rng=np.random.default_rng(0), config=config)
        assert found.closed_loop.summary.mean > -60  # LQR −51, saturated −1e6
    assert len(made) == 1


@pytest.mark.long
def test_the_gradient_of_the_paper_is_computed_where_it_is_asked_for(problem, clone):
    short = CoDesignConfig(iterations=1, evaluation_runs=64, pathwise_runs=16, starts=1)
    for gradient, known in (("pathwise", False), ("network_input", True)):
        config = replace(short, design_gradient=gradient)
        found = codesign(problem, agent=clone, design=[1.0], rng=np.random.default_rng(0), config=config)
        assert np.isfinite(found.gradients.network_input).all() == known
        assert ("network input" in str(found.gradients)) == known


def test_what_a_lost_run_costs_is_stated():
    """x⁺ = 2 x from 1 without an input: 4 + 16 + 64 + … until 2ᵏ passes the stated half-widths."""
    x, u, w, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = Plant(x, u, w, p, 2 * x + p * u + w, DesignSpace(["p"], [0.5], [2.0]), dt=0.1, continuous=False)
    problem = CoDesignProblem(discretise(plant), X=(-1, 1), U=(-1, 1), objective=QuadraticObjective([[1.0]], [[1.0]]),
                              scenarios=FixedStart([1.0], Gaussian([1e-9])))  # fmt: skip
    for divergence, steps in ((10.0, 4), (1e3, 10)):
        found = claimed(replace(problem, divergence=divergence), 1.0, np.zeros((1, 1)))
        np.testing.assert_allclose(found.closed_loop.values, -sum(4.0**k for k in range(1, steps + 1)), rtol=1e-5)
    with pytest.raises(InputError, match="divergence: got 0, expected a positive number"):
        replace(problem, divergence=0)


@pytest.mark.long
def test_a_design_that_a_priced_limit_of_an_output_holds_has_settled_and_names_it(problem):
    push = OutputLimits(lambda x, u, p: (-2 * x[0] - 0.3 * x[1] + (1 + 0.5 * p[0]) * u[0]) / p[0], -4.0, 4.0)
    held = replace(problem, output_limits=push, limit_tolerance=(0.05, 0.3))
    found = codesign(held, method=Nested("lqr", runs=64, starts=1), design=[1.0], rng=np.random.default_rng(0))
    assert found.status is CoDesignStatus.AT_BOUND
    assert "peak violation of the limits" in found.multipliers
    assert found.limits.kept


def pendulum():
    """A pendulum whose length is the design."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    return Plant(x, u, w, p, ca.vertcat(x[1], -p * ca.sin(x[0]) + u + w), DesignSpace(["p"], [0.5], [2.0]), dt=0.1)


def test_a_model_takes_limits_as_functions_of_the_design():
    with pytest.raises(InputError, match="X: got a function that fails"):
        discretise(pendulum(), X=lambda p: 3)


def test_a_result_remembers_that_the_plant_jumps():
    x, u, w, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = Plant(x, u, w, p, -p * x + u + w + ca.if_else(x > 0.5, 0.2, 0), DesignSpace(["p"], [0.5], [2.0]), dt=0.1)
    with pytest.warns(JumpWarning):
        model = discretise(plant)
    problem = CoDesignProblem(model, X=(-2, 2), U=(-2, 2), steps=5, objective=QuadraticObjective([[1.0]], [[1.0]]),
                              scenarios=FixedStart([0.3], Gaussian([0.1])))  # fmt: skip
    found = codesign(problem, method=Nested("lqr", runs=16, starts=1, evaluations=3), rng=np.random.default_rng(0))
    assert any("jump" in note for note in found.notes)


@pytest.mark.long
def test_limits_are_priced_until_they_are_kept_however_few_evaluations_a_round_has():
    """A spring that grows stiffer costs least at 0.8, where the limits are left; they are kept up to 0.4."""
    low, high = [-1, 0.1, 0.5, 0, 0.3, 0.05], [4, 1, 2, 6, 0.8, 0.15]
    k, d, b, price, noise, dt = np.random.default_rng(30).uniform(low, high)
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    after = ca.vertcat(x[0] + dt * x[1], x[1] + dt * (-(k + 3 * p) * x[0] - d * x[1] + b * (0.5 + p) * u + w))
    plant = Plant(x, u, w, p, after, DesignSpace(["p"], [0.0], [1.0]), dt=0.1, continuous=False)
    room = np.random.default_rng(32).uniform(1.1, 2.5)
    problem = CoDesignProblem(
        discretise(plant), X=(-room, room), U=(-8, 8), steps=50, limit_tolerance=(0.03, 0.1),
        objective=QuadraticObjective(np.diag([4, 0.5]), [[0.3]], design_cost=lambda p: 5 * price * (p[0] + 0.2)),
        scenarios=FixedStart([1.0, -1.0], Gaussian([3 * noise])),
    )  # fmt: skip
    few = Nested("lqr", runs=128, starts=1, evaluations=20)
    found = few.run(problem, np.array([1.0]), np.random.default_rng(3))
    assert found.limits.kept
    assert 0.3 < found.design[0] < 0.6
