"""Thresholds that no public call shows: each is tried at a third of it and at three times it."""

from dataclasses import replace

import numpy as np
import pytest
from random_problems import problem_of
from scipy.optimize import OptimizeWarning, linprog

from mpc import LinearMPC, SensitivityStatus
from mpc.dense_qp import DenseQP
from mpc.explicit.scaled_qp import scale_parameters, scale_qp
from mpc.riccati import _Regulation, lqr
from mpc.rollout import rollout
from mpc.sensitivities.along_plan import sensitivity_of
from mpc.sensitivities.changes import as_changes, linear_model
from mpc.tolerances import LP_OPTIONS


@pytest.mark.parametrize(("beside", "solver"), [(3e-8, "DAQP"), (3e-7, "Clarabel")])
def test_the_second_solver_is_asked_where_the_first_misses_the_optimum(beside, solver, monkeypatch):
    monkeypatch.setattr(DenseQP, "_daqp", lambda self, q, b: (-q * (1 + beside), 0 * b, 1))
    result = DenseQP(np.eye(2), np.eye(2)).solve(np.array([-1.0, -2.0]), np.array([5.0, 5.0]))
    assert result.solver == solver
    np.testing.assert_allclose(result.z, [1, 2], rtol=1.1 * beside)


def test_the_linear_programs_are_solved_as_exactly_as_highs_can():
    program = {"c": [1.0], "A_ub": [[-1.0]], "b_ub": [1.0], "bounds": (None, None)}
    assert linprog(**program, options=LP_OPTIONS).x == [-1.0]  # without a warning
    with pytest.raises(OptimizeWarning, match="Invalid option"):
        linprog(**program, options={name: value / 3 for name, value in LP_OPTIONS.items()})


@pytest.mark.parametrize(("off", "last"), [(3e-5, False), (3e-4, True)])
def test_newton_steps_of_the_riccati_equation_end_where_the_last_says_nothing(off, last):
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
    K, P = lqr(A, B, Q=np.eye(2), R=1.0)
    regulation = _Regulation(A, B, np.eye(2), np.eye(1), np.zeros((2, 1)))
    turned = np.array([[1 + off, 0.0], [0.0, 1.0]]) @ np.linalg.cholesky(P).T
    missed = np.abs(regulation._refined(turned)[0] - K).max()
    assert (missed < 1e-12) == last  # one step more squares what the first leaves


@pytest.mark.parametrize("first", [1e-3, 1e-2, 1e-1])
def test_newton_steps_go_on_while_the_distance_from_the_unit_circle_halves(first):
    # a mode on the circle that costs 1e-10 of the other: the scalar Riccati equation has its optimum in closed form
    cost, axes = 1e-10, np.array([[1.0, 1.0], [-1.0, 1.0]]) / np.sqrt(2)
    A, Q, K = (axes @ np.diag(values) @ axes.T for values in ([1.0, 0.5], [cost, 1.0], [first, 0.2]))
    regulation = _Regulation(A, np.eye(2), Q, np.eye(2), np.zeros((2, 2)))
    found, _ = regulation._refined(regulation._root_of(K))
    price = (cost + np.sqrt(cost**2 + 4 * cost)) / 2
    margin = 1 - np.abs(np.linalg.eigvals(A - found)).max()
    assert margin == pytest.approx(price / (1 + price), rel=0.01)


@pytest.mark.parametrize(("size", "met"), [(3.0, True), (30.0, False)])
def test_a_bound_much_larger_than_the_way_to_the_optimum_says_nothing_of_sizes(size, met):
    # z of least (z1 + t - 1)² + (z2 + t)², |z1| <= 0.001 and |z2| <= size
    sides, bounds = np.vstack([np.eye(2), -np.eye(2)]), np.tile([1e-3, size], 2)
    problem = problem_of(np.eye(2), np.ones((2, 1)), np.array([-1.0, 0.0]), sides, bounds, np.zeros((4, 1)))
    far = scale_qp(problem, scale_parameters(([-1.0], [1.0]), 1)).far
    assert (far < 1) == met


@pytest.mark.parametrize(("off", "status"), [(3e-3, "SMOOTH"), (3e-2, "UNSOLVED")])
def test_derivatives_are_taken_at_a_plan_that_is_nearly_the_optimum(off, status):
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
    controller = LinearMPC(A, B, Q=np.eye(2), R=0.1, horizon=10, U=(-1, 1))
    x = np.array([0.3, 0.1])
    plan = controller.solve(x)
    inputs = plan.inputs.copy()
    inputs[-1] += off
    moved = replace(plan, inputs=inputs, states=rollout(controller, x, inputs, {}))
    changes = as_changes(controller, {})
    found = sensitivity_of(controller, linear_model(controller, {}, changes.model), changes, moved, {})
    assert found.status is SensitivityStatus[status]
