"""Returns in closed loop where some runs diverge."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    Gaussian,
    Plant,
    QuadraticObjective,
    RandomStarts,
    closed_loop_returns,
    discretise,
    simulate,
)
from ccdtools.disturbances import Uniform


class Integral:
    """Feedback of the state and of its sum, which refuses a state that is not finite."""

    def reset(self, runs):
        self.sum = np.zeros((runs, 1))

    def __call__(self, x):
        assert np.isfinite(x).all()
        self.sum += np.clip(x, -1, 1)
        return np.clip(-0.5 * x - 0.1 * self.sum, -1, 1)


@pytest.mark.parametrize("power", [3, 9])
def test_a_run_that_diverges_changes_nothing_of_the_others_under_a_controller_with_memory(power):
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")
    after = x + 0.1 * x**power + 0.3 * p * u + w
    plant = Plant(x, u, w, p, after, DesignSpace(["p"], [0.5], [2.0]), dt=0.1, continuous=False)
    model = discretise(plant, X=(-3, 3), U=(-1, 1))
    problem = CoDesignProblem(model, X=(-3, 3), U=(-1, 1), objective=QuadraticObjective([[1.0]], [[0.1]]), steps=30,
                              scenarios=RandomStarts(Uniform([-3], [3]), Gaussian([0.01])))  # fmt: skip
    found = closed_loop_returns(problem, Integral(), [1.0], np.random.default_rng(0), runs=40)
    assert 0 < found.lost.sum() < 40
    draws = problem.scenarios.sample(1000, 30, np.random.default_rng(0))
    x0, w = (np.asarray(part)[:40] for part in draws)
    for i in np.flatnonzero(~found.lost):
        run = simulate(model, Integral(), x0=x0[i], disturbance=w[i], steps=30, design=[1.0])
        assert found.values[i] == pytest.approx(run.returns(problem.objective)[0], rel=1e-5)
