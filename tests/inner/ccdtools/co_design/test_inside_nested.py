"""What test_nested.py claims, seen from inside."""

import casadi as ca
import numpy as np
import pytest
from constrained_plants import CASES

import ccdtools as cc
from ccdtools.co_design.design_controllers import LQR
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.methods.loop_cost import LoopCost
from ccdtools.co_design.methods.riccati_cost import RiccatiCost


def slope_by_differences(cost, v, step=1e-5):
    """Central differences of a cost in the unit box."""
    return np.array([(cost(v + h)[0] - cost(v - h)[0]) / (2 * step) for h in step * np.eye(len(v))])


def spring_plant(unit=1.0):
    """A mass with a nonlinear spring: design stiffness and damping; `unit` scales length and force."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    pull = p[0] * x[0] + 0.3 * x[0] ** 3 / unit**2 + p[1] * x[1]
    space = cc.DesignSpace(["k", "c"], [0.5, 0.1], [4.0, 2.0])
    return cc.Plant(x, u, w, p, ca.vertcat(x[1], -pull + u + w), space, dt=0.1)


def spring_problem(unit=1.0, **changes):
    """Regulation of that mass, its input limits by design, its cost dearer with stiffness."""
    given = {
        "X": ([-3 * unit] * 2, [3 * unit] * 2), "U": lambda p: (-1.5 * unit * p[0], 1.5 * unit * p[0]), "steps": 40,
        "objective": cc.CustomObjective(
            lambda x, u, p: (x[0] ** 2 + 0.2 * p[0] * x[1] ** 2 + 0.1 * u**2 / p[1]) / unit**2 + 0.02 * p[0],
            design_cost=lambda p: p[0] ** 2 + 0.5 * p[1],
        ),
        "scenarios": cc.FixedStart([1.5 * unit, -1.0 * unit], cc.Gaussian([0.4 * unit])),
    }  # fmt: skip
    return cc.CoDesignProblem(cc.discretise(spring_plant(unit)), **(given | changes))


@pytest.mark.quick(5)
@pytest.mark.parametrize("risk", [cc.Mean(), cc.MeanSpread(0.5), cc.CVaR(0.3)])
@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_slope_of_a_closed_loop_is_that_of_central_differences(unit, risk):
    problem = spring_problem(unit, risk=risk)
    cost = LoopCost(problem, LQR, scenario_tensors(problem, 20, np.random.default_rng(0)))
    for v in ([0.3, 0.6], [0.8, 0.2]):
        shown = slope_by_differences(cost, np.array(v))
        assert cost(np.array(v))[1]() == pytest.approx(shown, rel=2e-4, abs=1e-6 * abs(shown).max())


@pytest.mark.parametrize("name", sorted(CASES))
def test_riccati_slope_is_that_of_central_differences(name):
    case = CASES[name]
    problem = case.problem()
    cost = RiccatiCost(problem)
    free = problem.design.allowed.free
    v = np.where(free, 0.4, problem.design.allowed.rounded(problem.design.to_unit(case.start)))
    shown = slope_by_differences(cost, v)
    assert cost(v)[1]()[free] == pytest.approx(shown[free], rel=1e-4, abs=1e-7 * abs(cost(v)[0]))
