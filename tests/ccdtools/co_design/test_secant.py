"""LQR of the linearisation over the visited states, where the tangent at rest is that of another plant."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import ccdtools as cc
from ccdtools import InputError, Nested, codesign
from ccdtools.co_design import stochastic_linearisation
from invariant_sets import Polytope
from mpc import lqr

FORCES = {
    "friction": lambda q, v, u: u - 0.5 * ca.tanh(v / 0.03),
    "input that counts by its square": lambda q, v, u: u * ca.fabs(u) - 0.1 * v,
    "linear": lambda q, v, u: u - q - 0.3 * v,
    "damper of one side": lambda q, v, u: u - q - 2 * ca.fmax(v, 0),
}


def problem(name, start=1.0, noise=0.3, mean=0.0):
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    force = FORCES[name](x[0], x[1], u)
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], (force + w) / p), cc.DesignSpace(["m"], [0.5], [2.0]), dt=0.05)
    return cc.CoDesignProblem(
        cc.discretise(plant, sampling_guard="ignore"), X=Polytope.from_bounds([-3, -6], [3, 6]),
        U=Polytope.from_bounds([-3.0], [3.0]), objective=cc.QuadraticObjective(np.diag([1.0, 0.1]), [[0.1]]),
        scenarios=cc.FixedStart([start, 0.0], cc.Gaussian([noise], mean=[mean])), steps=60, limit_tolerance="off",
    )  # fmt: skip


def test_of_a_linear_plant_it_is_its_matrices():
    own = problem("linear")
    found = stochastic_linearisation(own, [1.0], np.random.default_rng(0))
    A, B, _ = own.model.matrices([1.0])
    np.testing.assert_allclose(found.A, A, atol=1e-8)
    np.testing.assert_allclose(found.B, B, atol=1e-8)
    np.testing.assert_allclose(found.controller.K, lqr(A, B, Q=own.objective.Q, R=own.objective.R)[0], rtol=1e-6)


def test_a_stated_mean_of_the_disturbance_is_its_constant():
    own = problem("linear", mean=0.5)
    found = stochastic_linearisation(own, [1.0], np.random.default_rng(0))
    E = own.model.matrices([1.0])[2]
    np.testing.assert_allclose(found.c, 0.5 * E[:, 0], atol=1e-8)
    np.testing.assert_allclose(found.controller.offset, cc.saturated_lqr(own, [1.0]).offset, rtol=1e-6)


def test_runs_that_are_lost_from_the_start_tell_no_linearisation():
    own = replace(problem("friction"), divergence=0.1)  # they start a third of X away
    with pytest.raises(InputError, match="problem: got numbers after 0 of 0 steps of runs that are not lost"):
        stochastic_linearisation(own, [1.0], np.random.default_rng(0))


def cost_of_one_side(K, offset, runs=1000):
    """Mean cost of an affine law on the damper of one side, from rest under noise, by Heun's rule in NumPy."""
    w = np.random.default_rng(5).standard_normal((60, runs)) * 2.0
    x, total = np.zeros((2, runs)), 0.0

    def rate(x, force):
        return np.stack([x[1], force - x[0] - 2 * np.maximum(x[1], 0)])

    for noise in w:
        u = np.clip(offset - K @ x, -3, 3)
        total = total + 0.1 * u**2
        for _ in range(4):
            first = rate(x, u + noise)
            x = x + 0.05 / 8 * (first + rate(x + 0.05 / 4 * first, u + noise))
        total = total + x[0] ** 2 + 0.1 * x[1] ** 2
    return total.mean()


def test_where_motion_has_a_mean_its_offset_has_nine_tenths_of_what_the_best_one_gains():
    own = problem("damper of one side", start=0.0, noise=2.0)
    found = stochastic_linearisation(own, [1.0], np.random.default_rng(0))
    (K,), (offset,) = found.controller.K, found.controller.offset
    without = cost_of_one_side(K, 0.0)
    best = minimize_scalar(lambda offset: cost_of_one_side(K, offset), bounds=(-3, 3), method="bounded").fun
    assert best < 0.97 * without
    assert cost_of_one_side(K, offset) < without - 0.9 * (without - best)
    assert found.better


def test_dry_friction_damps_less_where_the_loop_goes_than_at_rest():
    own = problem("friction")
    found = stochastic_linearisation(own, [1.0], np.random.default_rng(0))
    assert own.model.matrices([1.0])[0][1, 1] < 0.7 < 0.9 < found.A[1, 1]
    assert found.mean_return > 0.7 * found.tangent_return  # of costs: less than 70 %
    assert found.better


def test_an_input_that_counts_by_its_square_has_a_secant_where_its_tangent_is_nothing():
    found = stochastic_linearisation(problem("input that counts by its square"), [1.0], np.random.default_rng(0))
    assert found.B[1, 0] > 0.02
    assert np.isnan(found.tangent_return)
    assert "tangent at rest returns none, of the secant" in str(found)


@pytest.mark.long
def test_nested_takes_the_secant_where_it_is_better_and_says_both():
    own = problem("friction")
    few = dict(runs=16, starts=1, evaluations=2)
    tangent, auto = (
        codesign(own, method=Nested("lqr", linearisation=kind, **few), rng=np.random.default_rng(0), design=[1.0])
        for kind in ("tangent", "auto")
    )
    assert auto.closed_loop.summary.mean > 0.8 * tangent.closed_loop.summary.mean
    assert "secant" in auto.criterion
    assert "tangent at rest returns" in auto.notes[-1]
    assert not any("secant" in note for note in tangent.notes)


@pytest.mark.long
def test_nested_has_the_offset_where_motion_has_a_mean():
    own = problem("damper of one side", start=0.0, noise=2.0)
    few = dict(runs=16, starts=1, evaluations=2)
    found = codesign(own, method=Nested("lqr", **few), rng=np.random.default_rng(0), design=[1.0])
    tangent = codesign(own, method=Nested("lqr", linearisation="tangent", **few), rng=np.random.default_rng(0),
                       design=[1.0])  # fmt: skip
    assert found.controller.offset[0] > 0.05
    assert not tangent.controller.offset.any()
    assert found.closed_loop.summary.mean > 0.99 * tangent.closed_loop.summary.mean
    assert tangent.status.name == "WORSE_THAN_BASELINE"
    assert found.status.settled


@pytest.mark.parametrize(("plant", "said"), [("friction", True), ("linear", False)])
def test_a_table_of_methods_says_that_they_stand_on_the_tangent(plant, said):
    one = Nested("lqr", linearisation="tangent", runs=16, starts=1, evaluations=2)
    table = cc.compare_methods(problem(plant), {"one": one}, seed=0, design=[1.0], reference="one")
    assert any("tangent at rest" in line for line in table.verdict) == said


def test_an_unknown_linearisation_is_refused():
    with pytest.raises(InputError, match="linearisation: got 'cosine'"):
        Nested("lqr", linearisation="cosine")
