"""The landscape of saturated LQR: exact where nothing saturates, and its valleys told apart."""

import numpy as np
import pytest
from small_plants import best_design, exact_return, mass, two_valleys

from ccdtools.co_design.landscape import Landscape, valleys


def test_the_landscape_is_the_exact_return_where_nothing_saturates():
    problem = mass()
    V = np.linspace(0, 1, 5)[:, None]
    expected = [exact_return(problem, design) for design in problem.design.from_unit(V)]
    np.testing.assert_allclose(Landscape(problem, np.random.default_rng(0), runs=3000).returns(V), expected, rtol=0.02)


def test_the_same_scenarios_make_it_a_smooth_function():
    landscape = Landscape(mass(), np.random.default_rng(0), runs=20)
    V = 0.5 + np.linspace(0, 1e-3, 11)[:, None]
    J = landscape.returns(V)
    np.testing.assert_allclose(np.diff(J), np.diff(J).mean(), rtol=0.15)
    np.testing.assert_array_equal(landscape.returns(V), J)


def test_designs_that_lqr_cannot_stabilise_are_the_lowest(illustrative):
    from dataclasses import replace

    import casadi as ca

    problem = illustrative.problem()
    model = replace(problem.model, B=problem.model.B * ca.fmax(problem.model.symbols - 1.0, 0.0))
    J = Landscape(replace(problem, model=model), np.random.default_rng(0)).returns([[0.0], [1.0]])
    assert J[0] == -np.inf
    assert np.isfinite(J[1])


@pytest.mark.check
def test_a_landscape_of_one_valley_has_one():
    problem = mass()
    design, _ = best_design(problem)
    (valley,) = valleys(problem, [3.0], rng=np.random.default_rng(0))
    assert abs(valley.design[0] - design[0]) < 0.05 * 2.8


@pytest.mark.check
def test_both_valleys_are_found_the_better_first():
    problem = two_valleys()
    design, _ = best_design(problem)
    found = valleys(problem, [0.05], rng=np.random.default_rng(0))
    np.testing.assert_allclose([valley.design[0] for valley in found], [0.8, 0.25], atol=0.02)
    assert abs(found[0].design[0] - design[0]) < 0.02
    assert found[0].lqr_return > found[1].lqr_return
    assert [valley.given for valley in found] == [False, True]
    assert [valley.given for valley in valleys(problem, [0.75], rng=np.random.default_rng(0))] == [True, False]


@pytest.mark.check
def test_of_the_suspension_the_only_valley_is_the_corner(suspension):
    (valley,) = valleys(suspension.problem(), suspension.p0, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(valley.design, [1e4, 3000])
    assert valley.given


@pytest.mark.check
def test_the_generator_decides():
    a, b = (valleys(two_valleys(), [0.05], rng=np.random.default_rng(3)) for _ in range(2))
    assert repr(a) == repr(b)
