"""A damper whose damping is the input: at rest it does nothing, so that LQR of the tangent holds it at its least."""

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    FixedStart,
    Gaussian,
    Plant,
    closed_loop_returns,
    codesign,
    discretise,
)
from ccdtools.controllers import LinearFeedback


@pytest.mark.long
@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_nested_lqr_is_not_settled_where_a_constant_input_returns_more(unit):
    x, u, w, k = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("k")
    rates = ca.vertcat(x[1], -k * x[0] - (0.1 + u) * x[1] + unit * w)
    plant = Plant(x, u, w, k, rates, DesignSpace(["k"], [1.0], [4.0], ["N/m"]), dt=0.1)
    X, U = ([-4 * unit, -8 * unit], [4 * unit, 8 * unit]), (0.0, 2.0)

    def cost(x, u, p):
        return (x[0] ** 2 + x[1] ** 2) / unit**2

    problem = CoDesignProblem(
        discretise(plant, X=X, U=U, W=(-3, 3)), X=X, U=U, steps=60, limit_tolerance="off",
        objective=CustomObjective(cost, Q=np.eye(2) / unit**2, R=[[1.0]]),
        scenarios=FixedStart([0.0, 0.0], Gaussian([1.0])),
    )  # fmt: skip
    found = codesign(problem, method="nested", rng=np.random.default_rng(0))
    (ahead,) = [one for one in found.baselines if one.name.startswith("a constant input")]
    assert found.status.name == "WORSE_THAN_BASELINE"
    held = LinearFeedback([[0.0, 0.0]], offset=[2.0])
    both = [
        closed_loop_returns(problem, law, found.design, np.random.default_rng(9), runs=400).values.mean()
        for law in (held, found.controller)
    ]
    assert ahead.gain.mean == pytest.approx((both[0] - both[1]) / abs(both[1]), rel=0.1)
