"""Co-design: the design moves the right way, stays in its box, and the best iterate is what comes back."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from ccdtools import CoDesignConfig, InputError, Learned, LearnedPolicy, codesign, simulate
from learning import PPOConfig

TINY = CoDesignConfig(
    iterations=12, runs=16, pathwise_runs=32, evaluation_runs=100, evaluate_every=3, design_rate=0.1, starts=1,
    ppo=PPOConfig.warm(learning_rate=1e-4, kl_limit=0.005, passes=1, critic_only=2),
)  # fmt: skip


@pytest.fixture(scope="module")
def problem(illustrative):
    """Return the illustrative example over a shorter horizon."""
    return replace(illustrative.problem(), steps=40)


@pytest.fixture(scope="module")
def result(problem, illustrative, clone):
    """Return one short co-design from p = 1."""
    return codesign(problem, agent=clone(illustrative), design=[1.0], rng=np.random.default_rng(0), config=TINY)


def run(problem, agent, design=(1.0,), seed=0, judge=None, method="pathwise", **changes):
    config = replace(TINY, **({"iterations": 3, "evaluate_every": 1} | changes))
    return codesign(
        problem, agent=agent, design=design, rng=np.random.default_rng(seed), config=config, judge=judge, method=method
    )


def same(a, b):
    return all(torch.equal(x, y) for x, y in zip(a.state_dict().values(), b.state_dict().values()))


@pytest.mark.check
def test_the_design_moves_towards_more_authority_and_a_better_return(result):
    assert result.design[0] > 1.8
    assert result.history.model_return[-1] > result.history.model_return[0] + 15  # −73 at p = 1, −25 at the bound


@pytest.mark.long
def test_the_best_evaluated_iterate_is_returned(result):
    history = result.history
    assert not history.diverged[1:].any()
    best = np.argmax(history.model_return)
    np.testing.assert_allclose(result.design, history.design[best], rtol=1e-6)


def test_history_has_a_row_per_evaluation(result, problem):
    np.testing.assert_array_equal(result.history.iteration, [0, 3, 6, 9, 12])
    np.testing.assert_array_equal(result.history.env_steps, result.history.iteration * 32 * 40)
    assert result.history.design.shape == (5, 1)
    assert (result.history.std > 0).all()


def test_the_gradients_were_checked_before_the_first_move(result):
    assert result.gradients is not None
    assert result.gradients.cosine("pathwise") > 0.99


def test_the_policy_returned_is_a_controller_at_the_design_found(result, problem, illustrative):
    np.testing.assert_array_equal(result.policy.design, result.design)
    trajectory = simulate(
        problem.model, result.policy, x0=np.tile(illustrative.x0, (200, 1)), steps=40, design=result.design,
        disturbance=illustrative.disturbance, rng=np.random.default_rng(3),
    )  # fmt: skip
    assert trajectory.returns(problem.objective).mean() == pytest.approx(result.history.model_return.max(), rel=0.05)


@pytest.mark.long
def test_a_design_that_only_gets_worse_gives_back_the_start(problem, illustrative, clone):
    # A hasty rate in the wrong direction: the first iterate stays the best.
    agent = clone(illustrative)
    hasty = {"method": "pathwise+ppo", "policy_rate": 10.0, "design_rate": 1e-9}
    wrecked = run(problem, agent, design=[3.0], iterations=2, **hasty)
    history = wrecked.history
    assert not (history.model_return[1:] >= history.model_return[0]).any()
    x = np.random.default_rng(0).uniform(-2, 2, (50, 2))
    np.testing.assert_allclose(wrecked.policy(x), LearnedPolicy(agent, [3.0])(x), atol=1e-5)
    np.testing.assert_allclose(wrecked.design, [3.0])


@pytest.mark.check
def test_the_agent_passed_in_is_not_changed(problem, illustrative, clone):
    agent = clone(illustrative)
    before = copy.deepcopy(agent)
    found = run(problem, agent)
    assert same(agent, before)
    assert found.agent is not agent
    assert all(parameter.grad is None for parameter in agent.parameters())


@pytest.mark.long
def test_a_frozen_design_stays_and_needs_no_gradient_check(problem, illustrative, clone):
    found = run(problem, clone(illustrative), design=[1.7], design_rate=0.0)
    told = next(line for line in found.describe() if line.startswith("gain on the model: "))
    assert told.endswith(" by learning")
    assert "moving" not in told
    np.testing.assert_allclose(found.design, [1.7], rtol=1e-6)
    np.testing.assert_allclose(found.history.design, 1.7, rtol=1e-6)
    assert found.gradients is None


@pytest.mark.check
@pytest.mark.parametrize("gradient", ["pathwise", "network_input"])
@pytest.mark.parametrize("method", ["pathwise", "ppo", "pathwise+ppo"])
def test_the_design_stays_in_its_bounds_whatever_the_rate(problem, illustrative, clone, gradient, method):
    config = replace(TINY, iterations=3, evaluate_every=1, design_rate=2.0, design_gradient=gradient)
    learned = Learned(by=method, agent=clone(illustrative), config=config)
    free = replace(problem, limit_tolerance="off")
    found = learned.run(free, np.array([2.9]), np.random.default_rng(0))
    assert (found.history.design >= 0.5).all()
    assert (found.history.design <= 3.0).all()
    assert len(np.unique(found.history.design)) > 1


@pytest.mark.check
def test_active_bounds_are_named(problem, illustrative, clone):
    found = run(problem, clone(illustrative), design=[3.0], design_rate=0.01)
    assert any("by moving the design under the first policy, " in line for line in found.describe())
    assert found.active_bounds == {"p": "upper"}
    np.testing.assert_array_equal(found.design, [3.0])


@pytest.mark.check
def test_the_generator_decides(problem, illustrative, clone):
    a, b = (run(problem, clone(illustrative), seed=5) for _ in range(2))
    np.testing.assert_array_equal(a.design, b.design)
    np.testing.assert_array_equal(a.history.model_return, b.history.model_return)
    assert same(a.agent, b.agent)


@pytest.mark.check
def test_iterates_are_scored_on_the_judge(problem, illustrative, clone):
    calm = replace(problem, scenarios=type(problem.scenarios)([0.0, 0.0], illustrative.disturbance))
    found = run(problem, clone(illustrative), judge=calm, iterations=1)
    assert (found.history.model_return > -10).all()  # −73 from the problem's own start


@pytest.mark.check
def test_the_front_door_passes_everything_on(problem, illustrative, clone):
    config = replace(TINY, iterations=1)
    a = codesign(problem, agent=clone(illustrative), design=[1.0], rng=np.random.default_rng(1), config=config)
    b = codesign(problem, agent=clone(illustrative), design=[1.0], rng=np.random.default_rng(1), config=config)
    np.testing.assert_array_equal(a.history.model_return, b.history.model_return)


@pytest.mark.check
def test_bad_arguments_are_refused(problem, illustrative, suspension, clone):
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="method: got 'magic', expected"):
        codesign(problem, agent=clone(illustrative), design=[1.0], rng=rng, method="magic")
    with pytest.raises(InputError, match="design: got p = 5"):
        codesign(problem, agent=clone(illustrative), design=[5.0], rng=rng)
    with pytest.raises(InputError, match="agent: got 6 inputs, expected 2 states and 1 design parameters"):
        codesign(problem, agent=clone(suspension), design=[1.0], rng=rng)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"design_gradient": "magic"}, "design_gradient: got 'magic', expected one of pathwise, network_input"),
        ({"iterations": 0}, "iterations: got 0, expected a whole number, at least 1"),
        ({"runs": 0}, "runs: got 0"),
        ({"pathwise_runs": -1}, "pathwise_runs: got -1"),
        ({"evaluate_every": 0}, "evaluate_every: got 0"),
        ({"evaluation_runs": 0}, "evaluation_runs: got 0"),
        ({"design_rate": -0.1}, r"design_rate: got -0.1, expected a number ≥ 0"),
        ({"policy_rate": float("nan")}, r"policy_rate: got nan, expected a number ≥ 0"),
    ],
)
def test_configurations_that_make_no_sense_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        CoDesignConfig(**options)
