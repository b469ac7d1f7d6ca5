"""What test_least_depth.py claims, seen from inside."""

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc
from ccdtools.co_design.least_depth import unavoidable_depth, warn_of_unavoidable_depth
from invariant_sets import Polytope


def doubling(u_max=0.5, x0=1.0, scale=1.0, steps=20):
    """x⁺ = 2 x + p u in [−1, 1] (times a unit), which no input holds where |x| > p u_max."""
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")
    space = cc.DesignSpace(["p"], [1.0], [4.0])
    plant = cc.Plant(x, u, w, p, 2 * x + p * u * scale + w, space, dt=1.0, continuous=False)
    return cc.CoDesignProblem(
        cc.discretise(plant), X=Polytope.from_bounds([-scale], [scale]), U=Polytope.from_bounds([-u_max], [u_max]),
        objective=cc.QuadraticObjective([[1.0]], [[1.0]]), scenarios=cc.FixedStart([x0 * scale], cc.Gaussian([0.0])),
        steps=steps,
    )  # fmt: skip


def test_what_can_be_kept_has_no_depth():
    assert cc.least_depth(doubling(), [2.0]) == pytest.approx(0.0, abs=1e-6)
    assert cc.least_depth(doubling(), [1.0], x0=[0.5]) == pytest.approx(0.0, abs=1e-6)
    assert unavoidable_depth(doubling(), np.array([2.0])) == (0.0, 0.0)


def test_a_start_that_no_controller_can_hold_is_said_before_training():
    problem = doubling(steps=2)
    with pytest.warns(cc.LimitWarning, match=r"it is left by 1.5 half-widths at least; other designs can keep it"):
        warn_of_unavoidable_depth(problem, np.array([1.0]))
    here, anywhere = unavoidable_depth(doubling(u_max=0.2, steps=2), np.array([1.0]))
    assert (here, anywhere) == pytest.approx((2.4, 0.6))
    with pytest.warns(cc.LimitWarning, match=r"the least over the box of designs is 0\.6"):
        warn_of_unavoidable_depth(doubling(u_max=0.2, steps=2), np.array([1.0]))
