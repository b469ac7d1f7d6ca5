"""Co-designs that keep constraints, fixed entries and whole numbers, beside SLSQP on the exact cost of LQR."""

from dataclasses import replace

import numpy as np
import pytest
from constrained_plants import CASES

from ccdtools import CoDesignConfig, InputError, Learned, codesign
from ccdtools.co_design import expert_dataset
from learning import ActorCritic, CloningConfig, NetworkConfig, PPOConfig, fit_actor_critic

SMALL = CoDesignConfig(iterations=160, runs=16, pathwise_runs=48, evaluation_runs=300)
IN_SECONDS = ("a curved budget in other units", "a forbidden disc")
HELD = {"a mass budget", "a curved budget in other units", "two budgets", "a forbidden disc", "a fixed entry", "teeth"}


def untrained(problem, seed=0):
    """An agent that has learned nothing."""
    low, high = problem.observation_bounds
    return ActorCritic(low, high, *problem.input_bounds, config=NetworkConfig((8,)), seed=seed)


def cloned(problem):
    """An agent that imitates LQR roughly, well enough for no other start to be tried."""
    data = expert_dataset(problem, samples=200, sets="lqr", rng=np.random.default_rng(0))
    return fit_actor_critic(
        data.inputs, data.actions, data.values, action_bounds=problem.action_bounds, rng=np.random.default_rng(0),
        input_bounds=problem.observation_bounds, network=NetworkConfig((16,)), config=CloningConfig(steps=600),
    )  # fmt: skip


@pytest.mark.check
@pytest.mark.parametrize(
    "name", [name if name in IN_SECONDS else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
def test_the_design_is_feasible_and_as_good_as_that_of_slsqp_on_the_exact_cost(name):
    case = CASES[name]
    problem = case.problem()
    found = codesign(problem, agent=case.agent(problem), design=case.start, rng=np.random.default_rng(0), config=SMALL)
    _, cost = case.best(4)
    size = np.abs(case.constraints(case.start)).max()
    assert max(case.constraints(found.design)) <= 1e-6 * size
    assert case.cost(found.design) <= 1.005 * cost
    assert (problem.design.violation(found.history.design) <= 1e-6).all()
    assert found.status.settled
    assert (found.design[case.whole] == np.round(found.design[case.whole])).all()
    assert bool(found.active_constraints) == (name in HELD)
    if name in HELD:
        assert found.status.name == "AT_BOUND"
        assert "active constraints" in "\n".join(found.describe())


def test_an_infeasible_first_design_is_refused():
    problem = CASES["a mass budget"].problem()
    with pytest.raises(InputError, match=r"design: got p0 = 4, p1 = 4 with constraint 1 = 4.5, expected constraints"):
        codesign(problem, agent=untrained(problem), design=[4, 4], rng=np.random.default_rng(0))


@pytest.mark.long
@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("method", "gradient"), [("pathwise", "network_input"), ("ppo", "pathwise"), ("pathwise+ppo", "network_input")]
)
def test_whatever_moves_the_design_every_iterate_keeps_what_holds_it(method, gradient):
    case = CASES["a fixed entry"]
    problem = replace(case.problem(), steps=20)
    config = CoDesignConfig(
        iterations=6, block=3, runs=16, pathwise_runs=16, evaluation_runs=20, evaluate_every=1, design_rate=0.5,
        starts=1, design_gradient=gradient, ppo=PPOConfig.warm(learning_rate=1e-4, passes=1, critic_only=0),
    )  # fmt: skip
    learned = Learned(by=method, agent=cloned(problem), config=config)
    found = learned.run(problem, np.array([3.0, 0.3, 2.0]), np.random.default_rng(0))
    assert (problem.design.violation(found.history.design) <= 1e-6).all()
    assert (found.history.design[:, 2] == 2.0).all()
    assert len(np.unique(found.history.design[:, 0])) > 1


@pytest.mark.check
def test_whole_numbers_stay_within_a_start_whatever_moves_the_rest():
    case = CASES["teeth"]
    problem = replace(case.problem(), steps=20)
    for method, gradient in (("pathwise", "pathwise"), ("pathwise+ppo", "network_input")):
        config = CoDesignConfig(iterations=4, runs=16, pathwise_runs=16, evaluation_runs=20, evaluate_every=1,
                                design_rate=0.3, starts=1, design_gradient=gradient)  # fmt: skip
        learned = Learned(by=method, agent=cloned(problem), config=config)
        found = learned.run(problem, np.array([0.5, 3.0]), np.random.default_rng(0))
        assert (found.history.design[:, 1] == 3.0).all()
        assert len(np.unique(found.history.design[:, 0])) > 1
