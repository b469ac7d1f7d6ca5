"""Odd but legitimate sets and plants: right answers with a true status."""

import numpy as np
import pytest
from set_plants import STABLE, A, B, U, W, X, illustrative

from invariant_sets import (
    AdmissibleInputs,
    ParametricSet,
    Polytope,
    Status,
    controllable_set,
    maximal_control_invariant_set,
    maximal_positively_invariant_set,
    predecessor_set,
    reachable_set,
)

box = Polytope.from_bounds
EMPTY = Polytope.empty(2)


def all_invariance(X, U=U, A=A):
    """Return the results of every function of (A, B, X, U) on these sets."""
    return {
        "control": maximal_control_invariant_set(A, B, X, U, max_iterations=60),
        "robust": maximal_control_invariant_set(A, B, X, U, W=W, max_iterations=60),
        "positive": maximal_positively_invariant_set(0.5 * np.asarray(A), X, max_iterations=60),
        "predecessor": predecessor_set(A, B, X, U),
        "controllable": controllable_set(A, B, X, U, X, 2),
        "reachable": reachable_set(A, B, X, U, 2),
    }


def assert_clean(result):
    """Check that nothing is NaN and that what is called invariant passed its check."""
    for Q in (result.set, result.outer):
        assert np.isfinite(Q.A).all()
        assert np.isfinite(Q.b).all()
        assert np.isfinite(Q.b_eq).all()
    assert not np.isnan(result.certificate.violation)
    assert not np.isnan(result.certificate.gap)
    assert result.set.is_empty or result.certificate.holds
    assert result.set.is_subset(result.outer, 1e-8)


def test_an_empty_X_gives_empty_sets_and_says_so():
    for result in all_invariance(EMPTY).values():
        assert_clean(result)
        assert (result.status, result.set.is_empty) == (Status.EMPTY, True)
    u, admissible = AdmissibleInputs(A, B, EMPTY, U).project([0.0, 0.0], [0.3])
    assert not admissible
    assert U.contains(u)
    assert not ParametricSet(illustrative, EMPTY, U).contains([0.0, 0.0], [1.0])


@pytest.mark.long
@pytest.mark.parametrize(
    "unbounded",
    [
        Polytope(np.zeros((0, 2)), []),
        Polytope([[1.0, 0]], [1.0]),
        Polytope([[1.0, 0], [-1, 0]], [1, 1]),
        Polytope([[1.0, 1], [-1, 1]], [1, 1]),
    ],
)
def test_an_unbounded_X_gives_a_checked_set_or_none(unbounded):
    for result in all_invariance(unbounded).values():
        assert_clean(result)
    u, admissible = AdmissibleInputs(A, B, unbounded, U).project([0.0, 0.0], [0.3])
    assert admissible
    assert u[0] == pytest.approx(0.3)


def test_an_X_without_the_origin():
    away = box([3, 3], [5, 5])
    results = all_invariance(away)
    for result in results.values():
        assert_clean(result)
    assert results["control"].status is Status.EMPTY  # no equilibrium with |u| <= 1 in there
    around = maximal_control_invariant_set([[1.1]], [[1.0]], box([2], [8]), U)
    assert around.set.bounding_box()[0][0] == pytest.approx(2)
    assert around.set.bounding_box()[1][0] == pytest.approx(8)


def test_no_input_at_all():
    still = box([0], [0])
    for result in all_invariance(X, still).values():
        assert_clean(result)
    result = maximal_control_invariant_set([[0.9, 0.5], [0, 0.8]], B, X, still)
    alone = maximal_positively_invariant_set([[0.9, 0.5], [0, 0.8]], X)
    assert result.set.equals(alone.set, 1e-7)
    u, _ = AdmissibleInputs(A, B, X, still).project([0.1, 0.1], [0.7])
    np.testing.assert_array_equal(u, [0.0])


def test_a_stabilisable_but_uncontrollable_pair():
    A2, B2 = [[1.2, 0.3], [0, 0.5]], [[1.0], [0]]
    result = maximal_control_invariant_set(A2, B2, X, U)
    assert_clean(result)
    assert result.status is Status.CONVERGED
    assert result.set.volume > 1


def test_inputs_without_limits_that_act_alike_are_as_one():
    A, b = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
    one = maximal_control_invariant_set(A, b, X, (-1e20, 1e20))
    two = maximal_control_invariant_set(A, np.hstack([b, 2 * b]), X, (-1e20, 1e20))
    assert one.status is two.status is Status.CONVERGED
    assert two.set.equals(one.set, 1e-7)


def test_duplicate_rows_change_nothing():
    double = Polytope(np.vstack([X.A, X.A, 2 * X.A]), np.r_[X.b, X.b, 2 * X.b])
    for name, result in all_invariance(double).items():
        assert_clean(result)
        assert result.set.equals(all_invariance(X)[name].set, 1e-8)
        assert len(result.set.b) == len(result.set.minimal().b)


def test_a_disturbance_too_large_leaves_the_empty_set_and_says_so():
    large = box([-3, -3], [3, 3])
    for result in (
        maximal_control_invariant_set(A, B, X, U, W=large),
        maximal_positively_invariant_set(STABLE, box([-1, -1], [1, 1]), W=large),
        controllable_set(A, B, X, U, box([-1, -1], [1, 1]), 2, W=large),
    ):
        assert_clean(result)
        assert (result.status, result.set.is_empty) == (Status.EMPTY, True)
        assert "shrink W" in result.status.advice


@pytest.mark.parametrize("limit", [1, 2, 5])
def test_an_iteration_limit_is_a_status_with_advice(limit):
    A2, B2 = [[1.0, 1], [0, 1]], [[0.5], [1.0]]
    for result in (
        maximal_control_invariant_set(A2, B2, box([-50, -5], [50, 5]), box([-0.1], [0.1]), max_iterations=limit),
        maximal_positively_invariant_set([[0.99, 0.1], [-0.1, 0.98]], X, max_iterations=limit),
    ):
        assert_clean(result)
        assert result.status is Status.ITERATION_LIMIT
        assert "max_iterations" in result.status.advice


@pytest.mark.parametrize("growth", [1e17, 1e150])
def test_plants_that_leave_at_once_have_a_status_and_no_traceback(growth):
    result = maximal_control_invariant_set(growth * A, B, X, U)
    assert_clean(result)


def test_a_time_limit_holds_for_any_number_of_steps():
    for call in (
        lambda: controllable_set(A, B, X, U, X, 10**9, time_limit=0.2),
        lambda: reachable_set(STABLE, B, X, U, 10**9, X=X, time_limit=0.2),
    ):
        result = call()
        assert result.status is Status.TIME_LIMIT
        assert result.set.is_subset(result.outer, 1e-8)


@pytest.mark.parametrize("e", [0.0, 0.1])
@pytest.mark.parametrize(
    "units", [np.ones(5), [1, 1e-7, 10, 1e3, 1e-8], [1e8, 1e-8, 1e8, 1e-8, 1e8], [2, 3e-7, 6, 5e2, 2e-8]]
)
def test_what_has_no_end_tells_no_length(units, e):
    """A narrow cone cut by an equality: each of its four rows is met at its only vertex."""
    A = np.array([[-0.141, 0.247, -0.106, -2.196, 0.607], [-0.587, 1.056, 0.235, 1.172, -0.542],
                  [-1.064, 1.093, 0.15, -0.946, -0.884], [0.202, -0.001, 0.734, 0.73, -1.357]])  # fmt: skip
    E = np.array([[-0.853, 1.322, -0.576, 1.407, 1.203]])
    b = np.array([0.56, 0.46, 0.82, 0.37])
    P = Polytope(A / units, b, E / units, [e])
    np.testing.assert_allclose(P.support(A / units), b, rtol=1e-10)
    vertex = np.linalg.solve(np.vstack([A, E]), [*b, e])
    assert P.contains(vertex * units)
    assert not P.is_bounded
