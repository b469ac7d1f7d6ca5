"""The search of one start, and what a cost by differences is spared."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from small_plants import mass

import ccdtools as cc
from ccdtools.co_design.design_controllers import DesignLaw
from ccdtools.co_design.design_search import descend
from ccdtools.co_design.methods.loop_cost import LoopCost


class Valley:
    """A curved valley of two parameters, and how often its value and its slope were asked for."""

    def __init__(self):
        self.values = self.slopes = 0

    def value(self, v):
        self.values += 1
        return float(30 * (v[1] - v[0] ** 2) ** 2 + (0.8 - v[0]) ** 2 + 0.3 * np.sin(9 * v[0]))

    def slope(self, v):
        self.slopes += 1
        bend = v[1] - v[0] ** 2
        return np.array([-120 * bend * v[0] - 2 * (0.8 - v[0]) + 2.7 * np.cos(9 * v[0]), 60 * bend])

    def __call__(self, v):
        return self.value(v), lambda: self.slope(v)


SPACE = cc.DesignSpace(["a", "b"], [0.0, 0.0], [1.0, 1.0])


@pytest.mark.parametrize("start", [[0.1, 0.9], [0.5, 0.5], [0.9, 0.0]])
def test_a_dear_slope_is_asked_for_only_where_a_step_was_taken(start):
    cost = Valley()
    one = descend(cost, SPACE, np.array(start), size=1.0, evaluations=200)
    assert one.cost == Valley().value(one.v)
    np.testing.assert_array_equal(one.slope, Valley().slope(one.v))
    assert cost.slopes < cost.values
    known = minimize(Valley().value, start, method="Nelder-Mead", bounds=[(0, 1)] * 2, tol=1e-12)
    if np.abs(known.x - one.v).max() < 0.1:  # in the same hollow
        assert one.cost == pytest.approx(known.fun, abs=1e-8)


def test_the_best_point_has_its_slope_when_the_evaluations_run_out():
    cost = Valley()
    found = descend(cost, SPACE, np.array([0.1, 0.9]), size=1.0, evaluations=3)
    assert found.spent
    assert cost.values == 3
    np.testing.assert_array_equal(found.slope, Valley().slope(found.v))


def test_a_lost_run_costs_no_program():
    problem = mass()
    seen = []

    def watched(problem, p):
        return lambda x: (seen.append(x.copy()), np.zeros((len(x), problem.model.nu)))[1]

    x0 = torch.zeros(3, problem.model.nx, dtype=torch.float64)
    x0[1] = 10 * torch.as_tensor(problem.limit)
    cost = LoopCost(problem, DesignLaw("watched", watched), (x0, torch.zeros(3, problem.steps, problem.model.nw)))
    cost(np.full(problem.design.dim, 0.5))
    assert all((np.abs(x) <= problem.limit).all() for x in seen)
    assert cost.rows[-1][-1] == pytest.approx(1 / 3)


@pytest.mark.check
def test_mpc_does_not_search_from_a_design_that_loses_its_runs(illustrative):
    # from (−3.5, −2) a weak actuator loses the unstable plant; hours of programs without solution would be in the way
    own = illustrative.problem()
    found = cc.codesign(own, method=cc.Nested("mpc", runs=8), rng=np.random.default_rng(0), design=[0.55])
    assert found.design == pytest.approx([3.0])  # known: the bound
    assert found.closed_loop.lost_share == 0
    assert found.history.diverged.max() == 0
