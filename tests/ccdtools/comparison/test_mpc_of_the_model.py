"""MPC of a problem's own model: linear MPC where that is linear, and better than the linear law where it is not."""

import numpy as np
import pytest

from ccdtools import load_study, nonlinear_mpc, saturated_lqr, simulate
from mpc import LinearMPC


def test_on_a_linear_model_it_is_linear_mpc():
    study = load_study("dc_servo")
    problem, p = study.problem(), study.p0
    A, B, _ = problem.model.matrices(p)
    linear = LinearMPC(
        A, B, **problem.weights(p).keywords(), horizon=15, X=problem.kept_by_mpc(p), U=problem.input_limits(p),
    )  # fmt: skip
    rng = np.random.default_rng(5)
    for x in 0.3 * problem.state_scale * rng.uniform(-1, 1, (4, problem.model.nx)):
        found = nonlinear_mpc(problem, p, horizon=15, iterations=None).solve(x)
        assert found.inputs[0] == pytest.approx(linear.solve(x).inputs[0], abs=1e-5 * np.ptp(problem.input_bounds))


@pytest.mark.long
def test_a_pole_far_from_upright_is_caught_for_less_than_by_lqr():
    study = load_study("pendulum_on_cart")
    problem, p = study.problem(), study.p0
    returns = [
        simulate(study.plant, law, x0=study.x0, steps=150, design=p).returns(problem.objective).mean()
        for law in (nonlinear_mpc(problem, p, horizon=40), saturated_lqr(problem, p))
    ]
    assert returns[0] > returns[1]
