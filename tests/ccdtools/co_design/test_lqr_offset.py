"""LQR of problems whose disturbance has a stated mean."""

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    Plant,
    QuadraticObjective,
    closed_loop_returns,
    codesign,
    discretise,
    expert_dataset,
    saturated_lqr,
)
from ccdtools.disturbances import Stacked, Sum, Uniform

BOX = DesignSpace(["m"], [0.5], [4.0], ["kg"])


def carriage(disturbance, start=(0.3, 0.0)):
    """Mass with two motors on a windy slope, heavier ones at a price."""
    x, u, w, m = ca.SX.sym("x", 2), ca.SX.sym("u", 2), ca.SX.sym("w"), ca.SX.sym("m")
    plant = Plant(x, u, w, m, [x[1], (u[0] + 0.5 * u[1] + w - 0.5 * x[1] - x[0]) / m], BOX, dt=0.05)
    objective = QuadraticObjective(np.diag([20.0, 1.0]), np.diag([0.05, 0.1]), design_cost=lambda p: 0.5 * p[0])
    return CoDesignProblem(
        discretise(plant), X=(-5, 5), U=(-20, 20), objective=objective, scenarios=FixedStart(start, disturbance),
        limit_tolerance="off",
    )  # fmt: skip


def cost_at_rest(problem, law, p, drift):
    """Cost of a step where the loop of a law settles, by plain matrices; the offset is varied."""
    A, B, E = problem.model.matrices(p)
    Q, R = problem.objective.Q, problem.objective.R

    def cost(offset):
        x = np.linalg.solve(np.eye(2) - A + B @ law.K, B @ offset + E @ drift)
        u = offset - law.K @ x
        return x @ Q @ x + u @ R @ u

    return cost


def test_a_stated_mean_is_met_by_the_offset_that_costs_least():
    problem, p = carriage(Gaussian([0.3], mean=[2.0])), np.array([1.3])
    law = saturated_lqr(problem, p)
    cost = cost_at_rest(problem, law, p, np.array([2.0]))
    best = minimize(cost, np.zeros(2), tol=1e-12)
    assert np.abs(best.x).min() > 0.3
    assert law.offset == pytest.approx(best.x, rel=1e-4)
    assert cost(law.offset) < 0.5 * cost(np.zeros(2))


def test_its_gain_is_that_without_a_mean_and_without_a_mean_it_has_no_offset():
    p = np.array([1.3])
    with_mean, without = (saturated_lqr(carriage(Gaussian([0.3], mean=[mean])), p) for mean in (2.0, 0.0))
    assert np.array_equal(with_mean.K, without.K)
    assert not without.offset.any()


def test_a_drawn_disturbance_whose_mean_nothing_states_is_not_offset():
    class Unstated:
        def sample(self, runs, steps, rng):
            return rng.uniform(0.0, 1.0, (runs, steps, 1))

    assert not saturated_lqr(carriage(Unstated()), [1.3]).offset.any()


def test_sums_and_stacks_state_the_means_of_their_terms():
    one, other = Gaussian([0.3], mean=[2.0]), Uniform([0.0], [1.0])
    assert Sum((one, other)).mean == pytest.approx([2.5])
    assert Stacked((one, other)).mean == pytest.approx([2.0, 0.5])
    offsets = [saturated_lqr(carriage(w), [1.3]).offset for w in (Sum((one, other)), Gaussian([0.3], mean=[2.5]))]
    assert offsets[0] == pytest.approx(offsets[1])


@pytest.mark.long
def test_nested_lqr_finds_the_best_design_with_the_offset():
    problem = carriage(Gaussian([0.3], mean=[3.0]))
    found = codesign(problem, method="nested", rng=np.random.default_rng(0))

    def returned(p):
        law = saturated_lqr(problem, p)
        return closed_loop_returns(problem, law, p, np.random.default_rng(5), runs=200).summary.mean

    grid = [returned([m]) for m in np.linspace(0.5, 4.0, 36)]
    assert returned(found.design) > max(grid) - 1e-3 * abs(max(grid))
    assert found.controller.offset == pytest.approx(saturated_lqr(problem, found.design).offset)


def test_expert_data_have_the_offset_too():
    problem = carriage(Gaussian([0.3], mean=[2.0]))
    data = expert_dataset(problem, samples=16, rng=np.random.default_rng(0), sets="lqr")
    laws = [saturated_lqr(problem, row[2:]) for row in data.inputs]
    assert len({law.offset[0] for law in laws}) > 10
    np.testing.assert_allclose(data.actions, [law(row[:2]) for law, row in zip(laws, data.inputs)], atol=1e-9)
