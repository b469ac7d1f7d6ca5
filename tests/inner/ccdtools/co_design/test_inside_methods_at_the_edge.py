"""What test_methods_at_the_edge.py claims, seen from inside."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from small_plants import mass

import ccdtools as cc
import mpc
from ccdtools.co_design.design_controllers import LQR
from ccdtools.co_design.design_search import DesignCost, DesignPoint, best_design, confirmed, status_of
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.limits import StateLimitPenalty
from ccdtools.co_design.methods.learned_cost import LearnedCost
from ccdtools.co_design.methods.loop_cost import LoopCost
from ccdtools.co_design.result import CoDesignStatus


class Cliff(DesignCost):
    """A cost that falls towards the larger mass up to where it ends: differences there say nothing of its slope."""

    words = "a cliff"

    def __init__(self, problem):
        self.problem = problem
        self.rows = []

    def __call__(self, v):
        value = 2.0 - v[0] if v[0] <= 0.5 else np.inf
        self.rows.append((1, 1, np.ones(1), 1.0, 0.0, 0.0))
        return value, lambda: np.array([-1.0 if v[0] < 0.4 else np.nan])

    def controller(self, p):
        return cc.Passive(1)


@pytest.mark.parametrize("constraints", [{}, {"constraints": lambda p: p - 9}])
def test_a_design_whose_slope_is_unknown_is_not_called_an_optimum(constraints):
    problem = mass()
    space = cc.DesignSpace(["m"], [0.0], [1.0], **constraints)
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], -2 * x[0] - (1 + p) * x[1] + u + w), space, dt=0.1)
    problem = replace(problem, model=cc.discretise(plant))
    start = np.array([0.45])
    rng = np.random.default_rng(0)
    found = best_design(problem, lambda v: Cliff(problem), start, rng, name="cliff", starts=1, evaluations=50)
    assert found.status.name == "GRADIENT_UNTRUSTED"
    assert found.multipliers == {}
    assert np.isnan(found.slope)


def test_differences_across_the_end_of_a_cost_confirm_no_slope():
    def ended(v):
        return 2.0 - v[0] if v[0] <= 0.5 else np.inf, lambda: np.array([-1.0])

    space = cc.DesignSpace(["m"], [0.0], [1.0])
    assert confirmed(ended, space, np.array([0.4]), size=1.0)
    assert not confirmed(ended, space, np.array([0.5]), size=1.0)


def test_the_way_to_a_cheaper_design_ends_where_there_is_no_controller():
    problem = mass()

    class Gap(LoopCost):
        def seen(self, v):
            if v[0] < 0.9:
                return super().seen(v)
            raise mpc.NotStabilisableError("no regulator", 1.0)

    cost = Gap(problem, LQR, scenario_tensors(problem, 4, np.random.default_rng(0)))
    first, cheaper = np.array([0.85]), np.array([1.0])
    plain = cost(first)[0]
    kept = DesignPoint(first, plain, np.zeros(1), penalty=StateLimitPenalty(problem))
    assert 0.85 <= cost.nearer(kept, cheaper).v[0] < 0.9


def test_policies_trained_anew_are_not_blamed_on_their_slope():
    problem = mass()
    cost = LearnedCost(problem, None, (np.zeros((1, 2)), np.zeros((1, 1, 1))), np.random.default_rng(0))
    end = DesignPoint(np.array([0.5]), 1.0, np.array([1.0]), spent=True)
    assert status_of(cost, problem.design, end, rest=1.0, held=False) is CoDesignStatus.BUDGET_SPENT
