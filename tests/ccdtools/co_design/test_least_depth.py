"""How far a start forces every controller outside X: by hand, and before anything is trained."""

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc
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


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
@pytest.mark.parametrize("steps", [1, 2, 3])
def test_the_least_depth_of_a_scalar_plant_is_that_of_full_input(steps, scale):
    expected = (1 - 0.5) * 2**steps + 0.5 - 1  # x_k = 2 x_{k−1} − 0.5 from 1
    assert cc.least_depth(doubling(scale=scale), [1.0], steps=steps) == pytest.approx(expected, rel=1e-6)


def test_several_starts_are_averaged():
    class Two:
        def sample(self, runs, steps, rng):
            return np.array([[1.0], [0.0]])[np.arange(runs) % 2], np.zeros((runs, steps, 1))

    from dataclasses import replace

    problem = replace(doubling(), scenarios=Two())
    assert cc.least_depth(problem, [1.0], steps=1) == pytest.approx(0.25)


def test_wrong_arguments_are_named():
    with pytest.raises(cc.InputError, match=r"x0: got shape \(2,\)"):
        cc.least_depth(doubling(), [1.0], x0=[0.0, 0.0])
    with pytest.raises(cc.InputError, match="design: got"):
        cc.least_depth(doubling(), [9.0])
    with pytest.raises(cc.InputError, match="steps: got 0"):
        cc.least_depth(doubling(), [1.0], steps=0)
