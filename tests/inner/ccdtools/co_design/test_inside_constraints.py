"""What test_constraints.py claims, seen from inside."""

import numpy as np
import pytest
import torch
from constrained_plants import CASES

from ccdtools.co_design.feasible import DesignRegion, FeasibleSlope
from ccdtools.co_design.landscape import Landscape, valleys


@pytest.mark.check
def test_the_landscape_is_lowest_where_a_constraint_is_broken_and_its_valleys_are_feasible():
    case = CASES["a forbidden disc"]
    problem = case.problem()
    inside, outside = problem.design.to_unit([[1.5, 0.9], [2.9, 2.8]])
    returns = Landscape(problem, np.random.default_rng(0), runs=20).returns([inside, outside])
    assert returns[0] == -np.inf
    assert np.isfinite(returns[1])
    found = valleys(problem, case.start, rng=np.random.default_rng(0))
    assert all(problem.design.feasible(valley.design) for valley in found)
    assert case.cost(found[0].design) <= 1.02 * case.best(4)[1]


@pytest.mark.long
def test_every_combination_of_a_few_whole_numbers_is_a_valley_and_the_best_comes_first():
    case = CASES["teeth"]
    found = valleys(case.problem(), case.start, rng=np.random.default_rng(0))
    assert {valley.design[1] for valley in found} == {1, 2, 3, 4, 5, 6}
    assert case.cost(found[0].design) <= 1.02 * case.best(4)[1]


def region(name):
    """The region of a start of a case, and a feasible point on an edge of its constraints."""
    space = CASES[name].problem().design
    return DesignRegion(space, space.to_unit(CASES[name].start))


@pytest.mark.parametrize("name", ["a curved budget in other units", "a forbidden disc", "two budgets"])
def test_the_cost_of_a_point_outside_has_the_gradient_that_differences_show(name, rng):
    held = region(name)

    def cost(u):
        return float(np.exp(-3 * u[0]) - 0.7 * u[1] + u[0] * u[1])

    def slope(u):
        return np.array([-3 * np.exp(-3 * u[0]) + u[1], -0.7 + u[0]])

    def at(v):
        u = held.nearest(v)
        added, gradient = held.extended(v, u, slope(u))
        return cost(u) + added, gradient, slope(u) @ (v - u)

    checked = 0
    while checked < 8:
        v = rng.random(2)
        limits = held.space.allowed.limits
        if limits.violation(v) < 0.02 or at(v)[2] > -1e-3:  # inside, or where the cost rises towards the outside
            continue
        h = 1e-6
        moves = h * np.eye(2)
        differences = [(at(v + move)[0] - at(v - move)[0]) / (2 * h) for move in moves]
        np.testing.assert_allclose(at(v)[1], differences, rtol=2e-3, atol=2e-3)
        checked += 1


def test_a_point_inside_is_left_as_it_is_and_one_outside_is_pulled_back():
    held = region("a mass budget")
    inside = held.space.to_unit([1.0, 1.0])
    np.testing.assert_array_equal(held.nearest(inside), inside)
    added, gradient = held.extended(inside, inside, np.array([1.0, 2.0]))
    assert added == 0
    np.testing.assert_array_equal(gradient, [1, 2])
    v = np.array([0.7, 0.7])
    u = held.nearest(v)
    added, gradient = held.extended(v, u, np.zeros(2))
    assert added == pytest.approx(0.5 * 10 * np.sum((v - u) ** 2))
    np.testing.assert_allclose(gradient, 10 * (v - u))


def slope_at(name, design, b, error=0.0, free=None):
    """What constraints leave of a slope that is the same in every run, but for its errors."""
    space = CASES[name].problem().design
    noise = np.random.default_rng(0).normal(size=(400, space.dim))
    by_run = np.asarray(b) + error * (noise - noise.mean(axis=0))
    free = space.allowed.free if free is None else free
    return FeasibleSlope.within(by_run, space.to_unit(design), space.allowed, free)


def test_a_slope_straight_across_an_active_constraint_promises_nothing_and_names_it():
    across = slope_at("a mass budget", [1.75, 1.75], [2.0, 2.0])
    assert not across.promises(1e-6)
    assert across.rises_across_bounds(0.1)
    np.testing.assert_allclose(across.mean, 0, atol=1e-12)
    inward = slope_at("a mass budget", [1.75, 1.75], [-2.0, -2.0])
    assert inward.promises(0.1)
    assert not inward.rises_across_bounds(1e-6)


def test_a_slope_along_an_active_constraint_is_still_to_be_followed():
    along = slope_at("a mass budget", [1.75, 1.75], [3.0, 1.0])
    np.testing.assert_allclose(along.mean, [1, -1])
    assert along.promises(0.05)
    assert not slope_at("a mass budget", [1.75, 1.75], [3.0, 1.0], error=50.0).promises(0.05)


def test_in_a_corner_of_two_constraints_nothing_is_left_to_follow():
    corner = slope_at("two budgets", [1.0, 2.5], [2.0, 1.0])
    assert not corner.promises(1e-6)
    assert corner.rises_across_bounds(0.05)
    assert len(corner.edges) == 2


def test_held_entries_have_no_gradient():
    space = CASES["a fixed entry"].problem().design
    held = DesignRegion(space, space.to_unit([0.6, 4.9, 2.0]))
    np.testing.assert_array_equal(held.masked(torch.ones(3)).numpy(), [1, 1, 0])
    assert not held.whole_box
