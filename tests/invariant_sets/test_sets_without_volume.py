"""Points, segments and bounds that mean "no limit"; the large table is `benchmarks/sets_without_volume.py`."""

import numpy as np
import pytest
from sets_without_volume import CASES, verdict, wrong_cases

from invariant_sets import (
    ParametricSet,
    Polytope,
    Status,
    controllable_set,
    maximal_control_invariant_set,
    predecessor_set,
    reachable_set,
)
from invariant_sets.exceptions import NumericalError

box = Polytope.from_bounds
NO_LIMIT = [1e6, 1e11, 1e12, 1e15, 1e19, 1e30, 1e100, 1e200, 1e300, np.inf]


@pytest.mark.parametrize("name", CASES)
def test_sets_without_volume_are_those_of_exact_rationals(name):
    assert wrong_cases(name, 25, 11) == []


DIFFERENCE = "(P + Q) - Q = P"
NO_LIMIT_ROW = "bounds of 1e6 to 1e300 and inf"


@pytest.mark.quick(6)
@pytest.mark.parametrize(("name", "seed", "k"), [
    (DIFFERENCE, 1, 1065), (DIFFERENCE, 1, 9930), (DIFFERENCE, 2, 2782),  # rounding of far points was taken for a width
    (DIFFERENCE, 1, 6188), (DIFFERENCE, 1, 9349), ("reach of known starts", 1, 2632),  # rows nearly parallel to a hull
    (NO_LIMIT_ROW, 1, 1170), (NO_LIMIT_ROW, 1, 1311), (NO_LIMIT_ROW, 1, 1745),  # a far bound was cut, and made a needle
])  # fmt: skip
def test_what_was_wrong_once_stays_right(name, seed, k):
    assert verdict(CASES[name], seed, k) == ""


def test_a_set_less_itself_is_the_origin_where_slanted_rows_cancel():
    A = [[1, 0, 2], [2, -2, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]
    P = Polytope(A, [1, 1, 0, 3, 3, 1, 3, 2])
    D = P.pontryagin_difference(P)
    assert D.contains(np.zeros(3))
    assert D.affine_dim == 0
    np.testing.assert_allclose(D.vertices, np.zeros((1, 3)), atol=1e-12)


@pytest.mark.parametrize("units", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("away", [0.0, 1000.0])
def test_a_point_and_a_segment_come_back_from_a_sum_with_a_box(units, away):
    W = box([-units, -2 * units], [units, units])
    for V in ([[1.0, 2.0]], [[1.0, 2.0], [3.0, -1.0]]):
        V = units * (np.array(V) + away)
        back = Polytope.from_vertices(V).minkowski_sum(W).pontryagin_difference(W)
        assert back.affine_dim == len(V) - 1
        order = np.argsort(back.vertices[:, 0])
        np.testing.assert_allclose(back.vertices[order], V, rtol=1e-12, atol=1e-12 * units)


def test_a_point_plus_a_point_is_a_point():
    S = Polytope.from_vertices([[1.0, 2.0]]).minkowski_sum(Polytope.from_vertices([[0.5, -3.0]]))
    np.testing.assert_array_equal(S.vertices, [[1.5, -1.0]])
    A = [[1.0, 1.0], [0.0, 1.0]]
    fixed = Polytope.from_vertices([[0.25]])
    reached = reachable_set(A, [[0.5], [1.0]], Polytope.from_vertices([[1.0, 2.0]]), fixed, 2)
    np.testing.assert_allclose(reached.set.vertices, [[5.5, 2.5]])
    plane = box([-np.inf] * 2, [np.inf] * 2)
    led = controllable_set(A, [[0.5], [1.0]], plane, fixed, Polytope.from_vertices([[5.5, 2.5]]), 2)
    np.testing.assert_allclose(led.set.vertices, [[1.0, 2.0]])
    assert reached.status is led.status is Status.CONVERGED


@pytest.mark.parametrize("length", [1e-8, 1e-6, 1e-3])
@pytest.mark.parametrize("distance", [1.0, 1e3, 1e6])
def test_a_short_segment_far_away_has_two_finite_ends(length, distance):
    d = np.array([0.6, 0.8])
    across = np.array([-0.8, 0.6])
    p = distance * np.array([0.28, 0.96])
    S = Polytope(np.array([d, -d, across, -across]), [p @ d + length, -(p @ d), p @ across, -(p @ across)])
    lower, upper = S.bounding_box()
    assert S.is_bounded
    assert np.isfinite([lower, upper]).all()
    error = 1e-12 * distance + 1e-9 * length
    np.testing.assert_allclose(lower, p, rtol=0, atol=error)
    np.testing.assert_allclose(upper, p + length * d, rtol=0, atol=error)


@pytest.mark.parametrize("big", NO_LIMIT)
def test_a_bound_that_says_nothing_leaves_the_largest_invariant_set_as_it_is(big):
    A = [[1.0, 1.0], [0.0, 1.0]]
    result = maximal_control_invariant_set(A, [[0.5], [1.0]], ([-5, -big], [5, big]), ([-1], [1]))
    assert result.status is Status.CONVERGED
    assert result.certificate.holds
    assert result.set.volume == pytest.approx(60.0, rel=1e-6)


@pytest.mark.parametrize("big", [1e3, 1e9, 1e11, 1e15, 1e20, 1e30])
@pytest.mark.parametrize(("A", "B", "X", "volume"), [
    ([[1.2]], [[1.0]], [np.inf], 10.0),
    (np.diag([1.2, -1.5]), [[1.0], [1.0]], [np.inf, np.inf], 27.0),
    (np.diag([1.2, 0.5]), [[1.0], [1.0]], [np.inf, 3.0], 60.0),
])  # fmt: skip
def test_what_inputs_can_hold_of_an_unstable_plant_does_not_vanish_beside_a_far_bound(A, B, X, volume, big):
    X = np.minimum(X, big)
    result = maximal_control_invariant_set(A, B, (-X, X), ([-1], [1]))
    assert result.status is Status.CONVERGED
    assert result.set.volume == pytest.approx(volume, rel=1e-6)


def test_a_strip_too_thin_to_be_seen_beside_a_far_bound_is_not_certified():
    A = [[1.1, 0.3], [0.0, 0.9]]
    for big in (1e3, 1e12):
        result = maximal_control_invariant_set(A, [[0.0], [1.0]], ([-big] * 2, [big] * 2), ([-1], [1]))
        assert result.status is (Status.CONVERGED if big < 1e6 else Status.NOT_CERTIFIED)


@pytest.mark.parametrize("big", [1e15, 1e17, 1e30, 1e100, 1e300])
@pytest.mark.parametrize("A", [
    [[0.5, 1.0], [0.1, 0.8]],
    [[0.07, 0.35, 0.37], [0.06, 0.77, -0.21], [0.11, 0.15, -0.23]],
])  # fmt: skip
@pytest.mark.parametrize("steps", [1, 2])
def test_a_strip_that_ends_where_a_bound_says_no_limit_is_as_wide_as_without_the_bound(A, big, steps):
    n = len(A)
    B = np.ones((n, 1))
    units = 10.0 ** np.arange(n)
    A = np.array(A) * units[:, None] / units
    X = np.append(3.0, np.full(n - 1, big)) * units
    free = np.append(3.0, np.full(n - 1, np.inf)) * units
    result, plain = (controllable_set(A, B, (-w, w), ([-1], [2]), (-w, w), steps) for w in (X, free))
    assert result.status is plain.status is Status.CONVERGED
    assert plain.set.affine_dim == n
    window = box(-9 * units, 9 * units)
    assert result.set.intersection(window).equals(plain.set.intersection(window), 1e-6)


def test_a_strip_whose_end_counts_and_whose_width_is_lost_beside_it_is_not_certified():
    result = predecessor_set(
        [[0.5, 1e3], [0.1, 0.8]],
        [[0.0], [0.0]],
        ([-1e-5, -1e6], [1e-5, 1e6]),
        ([-1], [1]),
        X=([-1e6, -1e6], [1e6, 1e6]),
    )
    assert result.status is Status.NOT_CERTIFIED


def test_a_set_that_only_stays_where_it_is_at_one_point_is_found_in_unequal_units():
    A = [[1.0, -1, -1, 0], [1, -1, -1, 1], [1, 1, 1, 0], [1, -1, 0, 0]]
    w = np.array([1e-3, 1.0, 0.0, 1e-4])
    fixed = Polytope.from_vertices([[0.0]])
    assert maximal_control_invariant_set(A, [[1.0], [-1], [0], [-1]], (-w, w), fixed).status is Status.CONVERGED


def test_a_fixed_input_and_a_state_that_is_forgotten_leave_a_certified_set():
    X = box(-np.ones(4), np.ones(4))
    U = Polytope.from_vertices([[0.0]])
    result = maximal_control_invariant_set(np.diag([1.0, 1.0, 1.0, 0.0]), np.ones((4, 1)), X, U)
    assert result.status is Status.CONVERGED
    assert result.set.equals(X, 1e-7)


def test_a_sum_far_from_the_origin_has_only_corners_for_vertices():
    rng = np.random.default_rng(0)
    for _ in range(30):
        V = rng.integers(-3, 4, (6, 2)) + 1000.0
        P = Polytope.from_vertices(V)
        double = P.minkowski_sum(P)
        assert len(double.vertices) == len(P.vertices)
        assert double.equals(P.scale(2.0))


def test_functions_of_a_design_cannot_change_the_design_of_each_other():
    def spoilt(p):
        p *= 3
        return np.eye(1), np.eye(1)

    with pytest.raises(ValueError, match="read-only"):
        ParametricSet(spoilt, lambda p: ([-p[0]], [p[0]]), ([-1], [1])).at([2.0])


def test_a_volume_beyond_doubles_is_refused_and_a_sum_of_such_sets_is_right():
    P = Polytope.from_vertices([[1e300, 0], [0, 1e300], [-1e300, -1e300]])
    with pytest.raises(NumericalError, match="volume"):
        P.volume  # noqa: B018
    huge = box([-1e305], [1e305])
    np.testing.assert_array_equal(np.sort(huge.minkowski_sum(box([-1], [1])).vertices[:, 0]), [-1e305, 1e305])
