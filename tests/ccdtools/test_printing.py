"""What a notebook prints of an object says what it is, in one short line."""

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc
import mpc
from ccdtools.plants.library import pendulum_on_cart
from invariant_sets import AdmissibleInputs, minimal_robust_positively_invariant_set
from mpc.optimal_control import NonlinearMPC, Phase, solve

A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]])
LINEAR = mpc.LinearMPC(A, B, Q=np.eye(2), R=[[1.0]], horizon=3, X=([-1, -1], [1, 1]), U=(-1.0, 1.0))
SHORT = Phase(lambda x, u: u, 1, 1, start=[0], end=[1], stage_cost=lambda u: u**2)

PRINTED = {
    "CustomObjective(": lambda: cc.CustomObjective(lambda x, u, p: x[0] ** 2 + u[0] ** 2),
    "OutputLimits(": lambda: cc.OutputLimits(lambda x, u, p: x[0], [-1.0], [1.0]),
    "DesignLimits(U, 1 numbers)": lambda: limited().U,
    "RandomStarts(3 states, Gaussian": lambda: cc.RandomStarts([[0.0], [1.0], [2.0]], cc.Gaussian([1.0])),
    "Equilibrium(x = [0.0, 0.0, 0.0, 0.0], u = [0.0]": lambda: cc.equilibrium(pendulum_on_cart(), [0.5, 1.0]),
    "Measurement(a matrix, noise: ": lambda: cc.Measurement([[1.0, 0.0]], noise=[0.1]),
    "Previewing(": lambda: cc.Previewing(cc.LinearFeedback([[1.0, 0.0]], [-1.0], [1.0]), 4),
    "Plan(N=3, cost=": lambda: LINEAR.solve([0.1, 0.0]),
    "ParametricQP(": lambda: LINEAR.build(),
    "Partition(": lambda: LINEAR.explicit().partition,
    "PlanSensitivity(N=3, ": lambda: LINEAR.sensitivity([0.1, 0.0]),
    "LQRSensitivity(2 states, 1 inputs, 1 parameters)": lambda: mpc.lqr_sensitivity(
        A, B, Q=np.eye(2), R=[[1.0]], dA=np.eye(2)[:, :, None]
    ),
    "NonlinearMPC(2 states, 1 inputs, N=3, converged)": lambda: NonlinearMPC(
        lambda x, u: ca.DM(A) @ x + ca.DM(B) @ u, 2, 1, Q=np.eye(2), R=[[1.0]], horizon=3
    ),
    "SolutionSensitivity(": lambda: solve(SHORT).sensitivity(),
    "AdmissibleInputs(nx=2, nu=1, 4 rows of S": lambda: AdmissibleInputs(A, B, LINEAR.X, LINEAR.U),
    "SetResult(CONVERGED, bounded set of dimension 1": lambda: minimal_robust_positively_invariant_set(
        [[0.5]], ([-1.0], [1.0])
    ),
}


def limited():
    """A problem whose actuator is its design."""
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")
    plant = cc.Plant(x, u, w, p, x + u + w, cc.DesignSpace(["reach"], [0.1], [1.0]), dt=1.0, continuous=False)
    return cc.CoDesignProblem(
        cc.discretise(plant), X=(-5.0, 5.0), U=lambda p: (-p, p), objective=cc.QuadraticObjective([[1.0]], [[1.0]]),
        scenarios=cc.FixedStart([1.0], cc.Gaussian([0.0])),
    )  # fmt: skip


@pytest.mark.parametrize("start", PRINTED)
def test_an_object_is_printed_in_one_line_that_begins_with_what_it_is(start):
    text = repr(PRINTED[start]())
    assert text.startswith(start)
    assert len(text) < 400
    assert "\n" not in text
