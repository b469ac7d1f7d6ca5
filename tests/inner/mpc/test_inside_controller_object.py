"""What test_controller_object.py claims, seen from inside."""

import control
import numpy as np
from plants import box, double_integrator

from mpc import lqr
from mpc.problem import MPCProblem

A, B = double_integrator()
DATA = dict(Q=np.eye(2), R=[[0.1]], horizon=10, X=box([5, 5]), U=box([1]))


def test_a_problem_can_be_stated_inspected_and_built_without_a_solver():
    problem = MPCProblem(control.ss(A, B, np.eye(2), 0, 1.0), **DATA)
    assert (problem.nx, problem.nu, problem.nw) == (2, 1, 0)
    np.testing.assert_array_equal(problem.row_units["state"], 5.0)
    moved = problem.with_model(0.5 * A, B)
    assert type(moved) is MPCProblem
    assert moved.given_P is None
    np.testing.assert_allclose(moved.P, lqr(0.5 * A, B, Q=np.eye(2), R=[[0.1]])[1])
