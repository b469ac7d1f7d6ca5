"""What test_comparison.py claims, seen from inside."""

import control
import numpy as np
import pytest

from ccdtools import PID, Scenario, baselines, compare, simulate
from ccdtools.comparison.comparison import step_times
from ccdtools.statistics import summarise

DESIGN = [2.0]


@pytest.fixture(scope="module")
def controllers(illustrative):
    return baselines(illustrative.problem(), DESIGN, rng=np.random.default_rng(0))


@pytest.fixture(scope="module")
def scenario(illustrative):
    x0, w = illustrative.problem().scenarios.sample(120, 40, np.random.default_rng(1))
    return Scenario(illustrative.model, x0, w)


def scored(study, controllers, scenario, **options):
    problem = study.problem()
    scores = compare(
        controllers, scenario, design=DESIGN, objective=problem.objective, X=problem.X, limit=problem.limit, **options
    )
    return {score.controller: score for score in scores}


@pytest.fixture(scope="module")
def scores(illustrative, controllers, scenario):
    return scored(illustrative, controllers, scenario)


@pytest.mark.check
def test_differences_are_paired_on_the_same_runs(illustrative, scores, controllers, scenario):
    problem = illustrative.problem()

    def returns(name, n):
        run = simulate(
            scenario.plant, controllers[name], x0=scenario.x0[:n], steps=40, disturbance=scenario.disturbance[:n],
            design=DESIGN,
        )  # fmt: skip
        return run.returns(problem.objective)

    difference = returns("MPC", 100) - returns("LQR", 100)
    score = scores["MPC"].paired_to_lqr
    assert score.mean == pytest.approx(difference.mean())
    assert score.ci95 == pytest.approx(summarise(difference).ci95)
    unpaired = summarise(returns("MPC", 100)).ci95
    assert score.ci95[1] - score.ci95[0] < 0.5 * (unpaired[1] - unpaired[0])


def test_timing_a_controller_leaves_it_ready_for_one_run():
    controller = PID([[1.0]], [0.0], [1.0], [0.0], dt=1.0, lower=[-9e9], upper=[9e9])
    scenario = Scenario(control.ss([[0.5]], [[1.0]], [[1.0]], 0, True), [1.0], np.zeros((5, 0)))
    assert (step_times(controller, np.array([[1.0], [0.5]]), scenario) > 0).all()
    assert controller(np.array([1.0])) == pytest.approx([-1.0])
