"""LQR of the linearisation over the visited states, where the tangent at rest is that of another plant."""

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc
from ccdtools import InputError, Nested, codesign
from ccdtools.co_design import stochastic_linearisation
from invariant_sets import Polytope
from mpc import lqr

FORCES = {
    "friction": lambda q, v, u: u - 0.5 * ca.tanh(v / 0.03),
    "input that counts by its square": lambda q, v, u: u * ca.fabs(u) - 0.1 * v,
    "linear": lambda q, v, u: u - q - 0.3 * v,
}


def problem(name):
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    force = FORCES[name](x[0], x[1], u)
    plant = cc.Plant(x, u, w, p, ca.vertcat(x[1], (force + w) / p), cc.DesignSpace(["m"], [0.5], [2.0]), dt=0.05)
    return cc.CoDesignProblem(
        cc.discretise(plant, sampling_guard="ignore"), X=Polytope.from_bounds([-3, -6], [3, 6]),
        U=Polytope.from_bounds([-3.0], [3.0]), objective=cc.QuadraticObjective(np.diag([1.0, 0.1]), [[0.1]]),
        scenarios=cc.FixedStart([1.0, 0.0], cc.Gaussian([0.3])), steps=60, limit_tolerance="off",
    )  # fmt: skip


def test_of_a_linear_plant_it_is_its_matrices():
    own = problem("linear")
    found = stochastic_linearisation(own, [1.0], np.random.default_rng(0))
    A, B, _ = own.model.matrices([1.0])
    np.testing.assert_allclose(found.A, A, atol=1e-8)
    np.testing.assert_allclose(found.B, B, atol=1e-8)
    np.testing.assert_allclose(found.controller.K, lqr(A, B, Q=own.objective.Q, R=own.objective.R)[0], rtol=1e-6)


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


@pytest.mark.parametrize(("plant", "said"), [("friction", True), ("linear", False)])
def test_a_table_of_methods_says_that_they_stand_on_the_tangent(plant, said):
    one = Nested("lqr", linearisation="tangent", runs=16, starts=1, evaluations=2)
    table = cc.compare_methods(problem(plant), {"one": one}, seed=0, design=[1.0], reference="one")
    assert any("tangent at rest" in line for line in table.verdict) == said


def test_an_unknown_linearisation_is_refused():
    with pytest.raises(InputError, match="linearisation: got 'cosine'"):
        Nested("lqr", linearisation="cosine")
