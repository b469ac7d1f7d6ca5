"""What test_long_horizons.py claims, seen from inside."""

import numpy as np
import pytest
from plants import box

from mpc import LinearMPC
from mpc.condensing import condense
from mpc.dense_qp import DenseQP
from mpc.feedback import stabilising_feedback
from mpc.rollout import spread_signals
from mpc.stages import StagewiseQP
from mpc.stagewise import solve_stagewise

A, B = np.array([[1.5, 0.3], [0.0, 1.3]]), np.array([[0.0], [1.0]])


@pytest.mark.parametrize("extra", [{}, {"soft": (10.0, 1e3)}, {"rate_limit": 0.3}, {"blocks": (1, 2, 3, 6)}], ids=str)
def test_the_stagewise_solver_agrees_with_the_dense_one(extra):
    mpc = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=12, X=box([5, 5]), U=box([1]), **extra)
    x = np.array([0.4, -0.1])
    signals = {"x_ref": [0.1, 0.0]} | ({"u_prev": [0.1]} if "rate_limit" in extra else {})
    given = spread_signals(mpc, signals)
    stagewise = StagewiseQP(mpc, x, given, mpc.soft)
    found = solve_stagewise(stagewise.stages, stagewise.start, stagewise.first_guess(np.zeros((12, 1))))
    inputs, _ = stagewise.plan(found.states, found.variables, x)
    qp = condense(mpc, tuple(sorted(given)))
    theta = np.concatenate([x if name == "x" else given[name] for name, _ in qp.parameters])
    dense = DenseQP(qp.H, qp.G).solve(*qp.at(theta))
    assert found.converged
    np.testing.assert_allclose(inputs, qp.inputs(dense.z, theta), atol=1e-6)


@pytest.mark.parametrize(("growth", "condensed_as_it_is"), [(300.0, True), (3000.0, False)])
def test_a_plan_that_grows_far_is_stated_in_deviations_from_a_feedback(growth, condensed_as_it_is):
    controller = LinearMPC([[growth**0.05]], [[1.0]], Q=1.0, R=1.0, horizon=20, U=(-1, 1))
    assert (stabilising_feedback(controller) is None) == condensed_as_it_is
