"""A time limit stops a recursion, and changes nothing else about it."""

import numpy as np
import pytest
from scipy.linalg import expm

from invariant_sets import Polytope, Status, maximal_control_invariant_set
from invariant_sets.engine import invariance
from invariant_sets.engine.inner_sets import predecessor_of
from invariant_sets.engine.local_problem import localise
from invariant_sets.engine.recursion import Limits, iterate
from invariant_sets.maximal_sets import as_limits
from invariant_sets.system_checks import checked_system
from invariant_sets.time_limits import TimeLimitReached
from invariant_sets.tolerances import COARSE


def chain(k, dt):
    """k unit masses between springs, pushed at the last, zero-order hold."""
    K = 2 * np.eye(k) - np.eye(k, k=1) - np.eye(k, k=-1)
    M = np.zeros((2 * k + 1, 2 * k + 1))
    M[:k, k : 2 * k] = np.eye(k)
    M[k : 2 * k, : 2 * k] = np.hstack([-K, -0.05 * np.eye(k)])
    M[2 * k - 1, -1] = 1
    M = expm(M * dt)
    return M[:-1, :-1], M[:-1, -1:]


def problem_of(A, B):
    """The local problem of the largest control invariant set, and where its recursion starts."""
    X = Polytope.from_bounds(-np.ones(len(A)), np.ones(len(A)))
    system, X, U = checked_system(A, B, X, (-0.2, 0.2), None, None)
    problem = localise(system, X, U, invariance._extent(X))
    return problem, invariance._start(problem, X)


def stopping(predecessor, steps):
    """The predecessor, which meets the time limit after so many steps."""
    count = iter(range(steps))

    def rows(target, fresh=None):
        if next(count, None) is None:
            raise TimeLimitReached("after so many steps")
        return predecessor(target, fresh)

    return rows


@pytest.mark.parametrize("stop", [0, 1, 3])
@pytest.mark.parametrize("iterations", [3, 5, 500])
@pytest.mark.parametrize("plant", [(1, 0.3), (2, 0.5)])
def test_a_recursion_that_was_stopped_goes_on_where_it_was(plant, iterations, stop):
    problem, start = problem_of(*chain(*plant))
    limits = Limits(0.0, iterations, 1000)
    whole = iterate(start, predecessor_of(problem), limits)
    stopped = iterate(start, stopping(predecessor_of(problem), stop), limits)
    continued = invariance._continued(problem, stopped, limits)
    assert continued.iterations == whole.iterations <= iterations
    assert continued.converged == whole.converged
    assert continued.limit is whole.limit
    assert np.array_equal(continued.region.F, whole.region.F)
    assert np.array_equal(continued.region.g, whole.region.g)


def test_only_the_fresh_rows_are_asked_for_again():
    problem, start = problem_of(*chain(2, 0.5))
    asked = []

    def rows(target, fresh=None):
        asked.append(None if fresh is None else int(fresh.sum()))
        return predecessor_of(problem)(target, fresh)

    limits = Limits(0.0, 4, 1000)
    iterate(start, rows, limits)
    unbroken = asked.copy()
    asked.clear()
    stopped = iterate(start, stopping(predecessor_of(problem), 2), limits)
    iterate(stopped.region, rows, Limits(0.0, 2, 1000), fresh=stopped.fresh)
    assert asked == unbroken[2:]


@pytest.mark.parametrize("time_limit", [1e-6, 0.05])
def test_the_search_for_a_reserve_ends_before_the_limit_and_is_made_once(time_limit, monkeypatch):
    A, B = chain(3, 0.1)
    seen = []
    feedback_sets = invariance.feedback_sets

    def recorded(problem, region, limits):
        seen.append(limits.deadline.end)
        return feedback_sets(problem, region, limits)

    monkeypatch.setattr(invariance, "feedback_sets", recorded)
    limits = as_limits(COARSE, 500, 1000, time_limit)
    task = invariance.Task(*checked_system(A, B, (-1, 1), (-0.2, 0.2), None, None), limits)
    result = invariance.largest_invariant_set(task)
    assert result.status is Status.TIME_LIMIT
    assert len(seen) <= 1
    assert all(end <= task.limits.deadline.end for end in seen)
    assert result.set.is_empty or result.certificate.holds


def test_a_generous_time_limit_changes_nothing():
    A, B = chain(2, 0.5)
    for iterations in (3, 500):
        free = maximal_control_invariant_set(A, B, (-1, 1), (-0.5, 0.5), max_iterations=iterations)
        limited = maximal_control_invariant_set(A, B, (-1, 1), (-0.5, 0.5), max_iterations=iterations, time_limit=1e4)
        assert limited.status is free.status
        assert limited.iterations == free.iterations
        assert np.array_equal(limited.set.A, free.set.A)
        assert np.array_equal(limited.outer.b, free.outer.b)


def test_a_box_of_too_many_vertices_is_a_status_and_no_error():
    """Of 2²⁰ vertices; the answer lies in the box, and nothing smaller is promised."""
    A, B = chain(10, 0.05)
    X = Polytope.from_bounds(-np.ones(20), np.ones(20))
    result = maximal_control_invariant_set(A, B, X=X, U=(-10.0, 10.0), time_limit=5.0)
    assert result.status is Status.FACET_LIMIT
    assert result.set.is_empty
    np.testing.assert_array_equal(result.outer.bounding_box(), [-np.ones(20), np.ones(20)])
