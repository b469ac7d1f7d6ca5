"""A cost of the design that is the same everywhere is a part of every return, and changes nothing that is done."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from small_plants import clone_of, mass, two_valleys

from ccdtools import CoDesignConfig, Nested, QuadraticObjective, codesign
from ccdtools.co_design.design_gradients import check_gradients
from ccdtools.co_design.landscape import valleys
from invariant_sets import Polytope

PRICES = [0.0, 3e4]
SHORT = CoDesignConfig(iterations=12, pathwise_runs=32, evaluation_runs=64, block=6, evaluate_every=3, starts=1)


@cache
def clone():
    """The same agent for all."""
    return clone_of(mass())


def priced(problem, price):
    """The problem with a cost that every design has."""
    objective = problem.objective
    return replace(problem, objective=QuadraticObjective(objective.Q, objective.R, design_cost=lambda p: price))


def found(problem, price, **options):
    """The result of a short co-design, and its returns without the constant."""
    problem = priced(problem, price)
    agent = clone()
    config = replace(SHORT, **options)
    result = codesign(problem, agent=agent, design=[1.0], rng=np.random.default_rng(0), config=config)
    return result, result.history.model_return + price


@pytest.mark.check
@pytest.mark.parametrize("options", [{}, {"tolerance": 0.02}])
def test_a_climb_is_the_same_whatever_every_design_costs(options):
    (plain, returns), (dear, others) = (found(mass(), price, **options) for price in PRICES)
    assert dear.status is plain.status
    np.testing.assert_array_equal(dear.history.iteration, plain.history.iteration)
    np.testing.assert_allclose(dear.design, plain.design, rtol=1e-4)
    np.testing.assert_allclose(others, returns, rtol=5e-4)  # a climb carries rounding on: 1.5e-4 on one processor


def test_a_search_looks_at_the_same_designs_whatever_every_design_costs():
    looked = [Nested(starts=1).run(priced(mass(), price), np.array([1.0]), np.random.default_rng(0)).history.design
              for price in PRICES]  # fmt: skip
    assert len(looked[0]) == len(looked[1])
    np.testing.assert_allclose(looked[1], looked[0], rtol=1e-5)


@pytest.mark.check
def test_limits_cost_the_same_whatever_every_design_costs():
    """Where X is left, its price is a part of what control costs."""
    tight = replace(mass(), X=Polytope.from_bounds([-1.05, -1.05], [1.05, 1.05]), limit_tolerance=(0.01, 0.01))
    (plain, returns), (dear, others) = (found(tight, price) for price in PRICES)
    assert plain.limits.multipliers.depth > 0
    np.testing.assert_allclose(dear.limits.multipliers.values(), plain.limits.multipliers.values(), rtol=1e-3)
    np.testing.assert_allclose(others, returns, rtol=1e-3)


@pytest.mark.check
def test_the_landscape_has_the_same_hills_whatever_every_design_costs():
    tops = [[valley.design for valley in valleys(priced(two_valleys(), price), [0.2], rng=np.random.default_rng(0))]
            for price in PRICES]  # fmt: skip
    assert len(tops[0]) == 2
    np.testing.assert_allclose(tops[1], tops[0], atol=0.02)


@pytest.mark.long
def test_a_gradient_is_trusted_as_far_as_that_of_what_control_makes():
    checks = [check_gradients(problem, clone(), [1.0], rng=np.random.default_rng(0), runs=64)
              for problem in (priced(mass(), price) for price in PRICES)]  # fmt: skip
    np.testing.assert_allclose(checks[1].scale, checks[0].scale, rtol=1e-4)
