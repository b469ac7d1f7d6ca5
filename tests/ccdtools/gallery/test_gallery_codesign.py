"""The first co-design reaches the independent optimum from the worst corner of the box."""

from dataclasses import replace

import numpy as np
import pytest
from gallery.measure import STUDIES as FILES
from gallery.oracle.cost import linear_return
from gallery.reference import reference, statement

from ccdtools import CoDesignConfig, codesign, saturated_lqr, simulate
from ccdtools.co_design import expert_dataset
from ccdtools.studies import load_study
from learning import CloningConfig, fit_actor_critic

NEAR = 0.005  # of the optimum


def below_the_optimum(name, start, seed, *, samples, cloning, config):
    """How far below the optimum a co-design ends, as a part of it, with its design."""
    study = load_study(FILES / f"{name}.py")
    problem = study.problem()
    rng = np.random.default_rng(seed)
    data = expert_dataset(problem, samples=samples, rng=rng)
    agent = fit_actor_critic(
        data.inputs, data.actions, data.values, action_bounds=problem.input_bounds,
        input_bounds=problem.observation_bounds, rng=rng, config=cloning,
    )  # fmt: skip
    result = codesign(problem, agent=agent, design=start, rng=rng, config=config)
    x0, w = problem.scenarios.sample(1000, study.steps, np.random.default_rng(9))
    learned, lqr = (
        simulate(study.model, controller, x0=x0, steps=study.steps, disturbance=w, design=result.design)
        for controller in (result.policy, saturated_lqr(problem, result.design))
    )
    exact = linear_return(statement(name), result.design)
    gained = (learned.returns(study.objective) - lqr.returns(study.objective)).mean()
    best = reference(name)["returns"][0]
    return (best - exact - gained) / abs(best), result.design


@pytest.mark.check
@pytest.mark.parametrize("name", ["mass_spring_damper"])
def test_a_small_budget_reaches_the_optimum_from_the_worst_corner(name):
    corner = np.array(reference(name)["worst_corner"])
    below, design = below_the_optimum(
        name, corner, 0, samples=150, cloning=replace(CloningConfig(), steps=1200),
        config=CoDesignConfig(pathwise_runs=64, evaluation_runs=300),
    )  # fmt: skip
    assert below < NEAR
    unit = statement(name)
    span = unit.upper - unit.lower
    assert np.abs((design - corner) / span).max() > 0.1  # it had to travel


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    "name", ["servo", "quarter_car", "platform", "chain_of_3", "chain_of_4", "pendulum", "heated_room"]
)
def test_the_default_budget_reaches_the_optimum_from_the_worst_corner(name, seed):
    study = load_study(FILES / f"{name}.py")
    below, _ = below_the_optimum(
        name, np.array(reference(name)["worst_corner"]), seed, samples=study.samples, cloning=CloningConfig(),
        config=CoDesignConfig(),
    )  # fmt: skip
    assert below < NEAR
