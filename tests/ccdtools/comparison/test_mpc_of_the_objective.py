"""MPC that minimises an objective of the user's own."""

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize

from ccdtools import (
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Plant,
    discretise,
    nonlinear_mpc,
)
from mpc import lqr

GAIN = np.array([2.0])


def cost(x, u, p):
    """Two wells, of which LQR knows the one at rest."""
    return 0.4 * x[0] ** 2 * (x[0] - 1) ** 2 + 0.05 * x[0] + 0.01 * u[0] ** 2


def wells(unit=1.0, lower=-3.0):
    """An integrator in any unit of length, whose cost is that of its metres."""
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")
    box = DesignSpace(["gain"], [1.0], [3.0])
    plant = Plant(x, u, w, p, x + 0.1 * unit * p * u + w, box, 0.1, continuous=False)
    return CoDesignProblem(
        discretise(plant), X=(lower * unit, 3 * unit), U=(-0.2, 0.2), steps=20, limit_tolerance="off",
        objective=CustomObjective(lambda x, u, p: cost(x / unit, u, p), Q=[[0.01 / unit**2]], R=[[0.01]]),
        scenarios=FixedStart([0.9 * unit], Gaussian([0.01 * unit])),
    )  # fmt: skip


@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_the_plan_is_the_optimum_of_the_objective(unit):
    problem = wells(unit)
    plan = nonlinear_mpc(problem, GAIN, horizon=8, cost="objective").solve([0.9 * unit])
    _, P = lqr([[1.0]], [[0.2]], Q=[[0.01]], R=[[0.01]])

    def total(inputs):
        x, value = 0.9, 0.0
        for u in inputs:
            value += float(cost([x], [u], GAIN))
            x += 0.2 * u
        return value + P[0, 0] * x**2

    best = min(
        (minimize(total, np.full(8, first), bounds=[(-0.2, 0.2)] * 8, tol=1e-12) for first in (-0.2, 0.0, 0.2)),
        key=lambda found: found.fun,
    )
    assert plan.cost == pytest.approx(best.fun, rel=1e-6)
    np.testing.assert_allclose(plan.inputs[:, 0], best.x, atol=1e-4)
    by_weights = nonlinear_mpc(problem, GAIN, horizon=8).solve([0.9 * unit])
    assert total(by_weights.inputs[:, 0]) > best.fun * 1.01


def test_limits_of_states_are_kept():
    free, held = (
        nonlinear_mpc(wells(lower=lower), GAIN, horizon=8, cost="objective").solve([0.0]) for lower in (-3.0, -0.03)
    )
    assert free.states.min() < -0.04
    assert held.status.name == "SOLVED"
    assert held.states.min() == pytest.approx(-0.03, abs=1e-6)


def test_another_cost_is_named():
    with pytest.raises(InputError, match=r"cost: .* weights"):
        nonlinear_mpc(wells(), GAIN, cost="economic")
