"""Thresholds of plans that no public call shows: each is tried at a third of it and at three times it."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from mpc.optimal_control import Radau, refinement
from mpc.optimal_control.paths import Path
from mpc.optimal_control.planning import Clock
from mpc.optimal_control.quadratic_planner import QuadraticPlanner
from mpc.optimal_control.refinement import _finer_mesh, _Rounds
from mpc.optimal_control.solution_sensitivity import _acting, _once_each


def acting(rooms, multipliers):
    """Verdicts of the first of several upper bounds: whether it acts, whether it is weak."""
    active, weak = _acting(np.full(len(rooms), -np.inf), np.array(rooms), np.array(multipliers), np.ones(len(rooms)))
    return active[0], weak[0]


@pytest.mark.parametrize(("beside", "weak"), [(3e-7, True), (3e-6, False)])
def test_a_bound_that_is_met_without_a_force_is_weak(beside, weak):
    assert acting([beside], [1e-3 * beside]) == (False, weak)


@pytest.mark.parametrize(("beside", "weak"), [(3e-4, True), (3e-3, False)])
def test_bounds_within_the_blur_of_an_interior_point_are_weak(beside, weak):
    others = 5  # each leaves the product 1e-8: a distance of 1e-4 where a unit force moves a value by one
    assert acting([beside] + [1e-1] * others, [1e-8 / beside] + [1e-7] * others) == (False, weak)


@pytest.mark.parametrize(("turned", "left"), [(3e-9, 1), (3e-8, 2)])
def test_rows_that_agree_in_eight_digits_are_one(turned, left):
    rows = np.array([[1.0, 0.0], [1.0, turned]])
    assert len(_once_each(csr_matrix(rows))) == left


def cut(first, errors, inputs):
    """Intervals of the mesh that refinement to 1e-4 makes of two, the first of them of the given length."""
    part = SimpleNamespace(scheme=Radau(3), mesh=np.array([0, first, 1.0]), phase=SimpleNamespace(discrete=False))
    phase = SimpleNamespace(part=part, stages=SimpleNamespace(inputs=np.array(inputs)))
    return np.sum(_finer_mesh(phase, np.array(errors), np.zeros(2), np.zeros(2, dtype=bool), 1e-4) <= first)


@pytest.mark.parametrize(("length", "shorter"), [(3e-4, False), (3e-3, True)])
def test_the_place_of_a_jump_is_looked_for_to_a_tenth_of_the_root_of_the_tolerance(length, shorter):
    jump = [[[0.0], [1.0]], [[1.0], [1.0]]]
    assert (cut(length, [0, 0], jump) > 2) == shorter


@pytest.mark.parametrize(("length", "shorter"), [(3e-10, False), (3e-9, True)])
def test_intervals_are_as_short_as_they_may_be(length, shorter):
    level = [[[0.0], [0.0]], [[1.0], [1.0]]]
    assert (cut(length, [1e4, 0], level) > 2) == shorter


@pytest.mark.parametrize(("excess", "meshes"), [(3e-3, 2), (3e-2, 1)])
def test_a_limit_that_a_finer_mesh_leaves_as_passed_is_jumped_over(excess, meshes, monkeypatch):
    passed = SimpleNamespace(
        excess=excess, mesh_error=0.0, solved_on_mesh=True, program=SimpleNamespace(problem=None),
        phases=[SimpleNamespace(part=SimpleNamespace(scheme=None))],
    )  # fmt: skip
    made = []
    monkeypatch.setattr(refinement, "build", lambda *a, **k: SimpleNamespace(lower=[]))
    rounds = _Rounds({}, 1e-4, "dynamics", 10, Clock(np.inf), None)
    monkeypatch.setattr(rounds, "_meshes", lambda solution: [])
    monkeypatch.setattr(rounds, "_jumps", lambda solution: [])
    monkeypatch.setattr(rounds, "solved", lambda program, start: made.append(start) or passed)
    _, reason = rounds.refined(passed)
    assert "missed as much as the one before" in reason
    assert len(made) == meshes


@pytest.mark.parametrize(("violation", "chosen"), [(0.002, "found"), (0.02, "other")])
def test_a_violation_costs_a_hundred_times_what_the_other_plan_does(violation, chosen):
    found = SimpleNamespace(solver="found", cost=1.0, over=violation)
    planner = SimpleNamespace(
        _plan=lambda sample, path, status: SimpleNamespace(solver="other", cost=2.0, over=0.0),
        _total=lambda plan, given, price: plan.cost + price * plan.over, _linear_law=lambda x, given: None,
    )  # fmt: skip
    sample = SimpleNamespace(x=None, first=Path(np.zeros((2, 1)), np.zeros((1, 1))), given={})
    assert QuadraticPlanner._best(planner, sample, found).solver == chosen


@pytest.mark.parametrize(("less", "better"), [(3e-7, False), (3e-6, True)])
def test_a_law_does_better_than_a_plan_by_more_than_rounding(less, better, monkeypatch):
    monkeypatch.setattr("mpc.optimal_control.quadratic_planner.rounding_of_cost", lambda law, given: 0.0)
    planner = SimpleNamespace(law=None, _total=lambda path, given, price: 5.0 - 5 * less * (path == "law"))
    sample = SimpleNamespace(x=None, given=None, dear=None)
    assert QuadraticPlanner._cheaper(planner, sample, "law", "plan") == better
