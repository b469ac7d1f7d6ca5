"""Sets once got wrong, and random ones against HiGHS; the large table is `benchmarks/adversarial_polytopes.py`."""

import copy
import pickle

import numpy as np
import pytest
from adversarial_polytopes import flat_case, sum_case, support_case, wrong_cases

from invariant_sets import Polytope
from invariant_sets.exceptions import EmptySetError, InputError, NumericalError, TimeLimitError, UnboundedError

box = Polytope.from_bounds


@pytest.mark.check
@pytest.mark.parametrize("decades", [0.0, 8.0])
def test_support_and_bounding_box_agree_with_highs(decades):
    assert wrong_cases(support_case, 60, 5, decades) == []


@pytest.mark.check
@pytest.mark.parametrize("decades", [0.0, 8.0])
def test_sums_and_projections_of_unbounded_sets_have_their_support(decades):
    assert wrong_cases(sum_case, 12, 5, decades) == []


@pytest.mark.parametrize("decades", [0.0, 7.0])
def test_points_and_flat_sets_by_opposite_rows_keep_their_dimension(decades):
    assert wrong_cases(flat_case, 60, 5, decades) == []


def test_opposite_rows_are_an_equality_whatever_their_factors():
    P = Polytope([[1e-9, 3.0], [-2e-12, -6e-3], [1.0, 0]], [1.0, -2e-3, 5])
    assert P.affine_dim == 1
    wider = Polytope([[1.0, 3], [-1, -3], [1, 0]], [1.0, -1 + 1e-6, 5])
    assert wider.affine_dim == 2


def test_a_set_missed_by_less_than_its_length_in_rounding_is_not_empty():
    c, s = np.cos(0.7), np.sin(0.7)
    along, across = np.array([c, s]), np.array([-s, c])
    P = Polytope([along, -along, across, -across], [1e7, 0.0, 0.0, -1e-12])
    assert not P.is_empty
    assert Polytope([along, -along, across, -across], [1.0, 0.0, 0.0, -1e-3]).is_empty


@pytest.mark.long
@pytest.mark.parametrize("k", range(12))
def test_flat_boxes_about_a_corner_at_zero_keep_their_dimension_whatever_the_rounding(k):
    rng = np.random.default_rng((k, 7))
    n = int(rng.integers(2, 6))
    solid = int(rng.integers(1, n + 1))
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    units = 10 ** rng.uniform(-7, 7, n)
    upper = np.where(np.arange(n) < solid, rng.uniform(0.1, 2, n), 0.0)
    right = np.append(upper, np.zeros(n))
    right = np.where(right == 0.0, 1e-19 * rng.normal(size=2 * n), right)  # each row has its own rounding for zero
    P = Polytope(np.vstack([Q.T, -Q.T]) / units, right)
    assert not P.is_empty
    assert P.affine_dim == solid


def test_a_set_without_any_length_but_its_rounding_is_judged_by_that_as_in_any_other_unit():
    for unit in (1.0, 1e-19):
        assert Polytope([[1.0, 0.5], [-1, -0.5], [0, 1], [0, -1]], np.array([1.0, -2, 1, 1]) * unit).is_empty
        assert Polytope([[1.0, 0.5], [-1, -0.5], [0, 1], [0, -1]], np.array([2.0, -1, 1, 1]) * unit).affine_dim == 2


@pytest.mark.parametrize("c", [[0.3, -0.7], [1e6, 0.1], [0.0, 0.0]])
def test_a_corner_moved_to_the_origin_is_one_point_and_not_lost_to_rounding(c):
    c = np.array(c)
    rng = np.random.default_rng(3)
    A = rng.normal(size=(2, 2))
    A = np.vstack([A, -A.sum(axis=0)])
    moved = Polytope(A, A @ c).preimage(rng.normal(size=(2, 2)), c)
    assert moved.affine_dim == 0
    np.testing.assert_allclose(moved.vertices, 0, atol=1e-9)


@pytest.mark.parametrize("far", [1e9, 1e15, 1e100, 1e300])
def test_a_row_far_away_does_not_move_the_set(far):
    np.testing.assert_array_equal(Polytope([[1.0], [-1], [1]], [2, 1, far]).bounding_box(), [[-1], [2]])
    slanted = Polytope([[1, 0.1], [-1, 0], [1, 0.2], [0, 1], [0, -1]], [2, 1, far, 1, 1])
    np.testing.assert_allclose(slanted.bounding_box(), [[-1, -1], [2.1, 1]], rtol=1e-12)
    assert slanted.volume == pytest.approx(6.0)
    half = Polytope([[-1, 0], [0, -1], [1, 1e-3]], [0, 0, far])
    assert half.contains([far / 2, far / 2])
    assert not half.contains([2 * far, 0])


def test_a_slab_has_no_end_along_itself():
    slab = Polytope([[0.13, -0.13, 0.64], [-0.13, 0.13, -0.64]], [1, 0.5])
    np.testing.assert_array_equal(slab.support(np.eye(3)), np.inf)
    np.testing.assert_allclose(slab.support([[0.13, -0.13, 0.64], [-0.26, 0.26, -1.28]]), [1, 1])
    assert not slab.is_bounded


def test_a_slab_by_rows_that_are_parallel_but_for_rounding_is_not_empty():
    rows = np.array([[-2.3005976387607574, -0.6099217056965168], [0.06284084803391919, 0.016660017629549686]])
    b = [1.6093918865053254, 1.6488087232121946, 0.826283958129824, 1.4217956463763852]
    P = Polytope(np.vstack([rows, -rows]), b)
    assert not P.is_empty
    assert not P.is_bounded  # what `contains` allows for rounding holds any distance away
    assert P.contains(1e9 * np.array([-rows[0, 1], rows[0, 0]]))


def test_a_thin_set_in_mixed_units_is_not_flat():
    units = np.array([1e6, 1e-5])
    P = Polytope(np.array([[1, 0], [0.7, 0.7], [-1, 0], [-0.7, -0.7]]) / units, [1, 1e-4, 1, 1e-4])
    assert P.affine_dim == 2
    assert P.volume == pytest.approx(4 * 1e-4 / 0.7 * units.prod())


@pytest.mark.parametrize("unit", [1.0, 1e8, 1e12, 1e15, 1e-12])
def test_equalities_keep_their_rank_in_mixed_units(unit):
    units = np.array([1, 1, unit])
    E = np.array([[1, 1, 0], [1, 1, 1.0]])
    P = Polytope(np.vstack([np.eye(3), -np.eye(3)]) / units, [2] * 6, E / units, [0, 1])
    assert P.affine_dim == 1
    np.testing.assert_allclose(np.sort(P.vertices / units, axis=0), [[-2, -2, 1], [2, 2, 1]], rtol=1e-12)


def test_inequalities_parallel_to_an_equality_say_nothing():
    line = Polytope([[0.3, -0.7], [-0.3, 0.7]], [1, 1], [[0.3, -0.7]], [0.05])
    assert line.support([1, 0]) == np.inf
    assert line.support([0.3, -0.7]) == pytest.approx(0.05)
    assert Polytope([[0.3, -0.7]], [0.04], [[0.3, -0.7]], [0.05]).is_empty


def test_equalities_through_one_another():
    rows = np.array([[1, 2, 3.0], [2, 4, 6], [0.1, 0.2, 0.3]])
    assert Polytope(A_eq=rows, b_eq=rows[:, 0] * 0.1).affine_dim == 2
    assert Polytope(A_eq=rows, b_eq=rows[:, 0] * 0.1 + [0, 1e-3, 0]).is_empty
    assert Polytope(A_eq=np.eye(3), b_eq=[1, 2, 3]).vertices.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("n", [4, 5])
def test_sums_of_unbounded_sets_end(n, rng):
    A = rng.normal(size=(2 * n, n))
    P = Polytope(A[: n + 1], np.ones(n + 1)).minkowski_sum(Polytope(A[n:], np.ones(n)))
    assert not P.is_empty
    line = Polytope([[1.0, 0], [-1, 0]], [0, 0]).minkowski_sum(Polytope([[0, 1.0], [0, -1]], [1, 1]))
    assert len(line.b) == len(line.b_eq) == 0  # a vertical line and a horizontal strip: the plane
    wedge = Polytope([[-1.0, 0], [0, -1]], [0, 0]).minkowski_sum(Polytope([[1.0, -1]], [0]))
    np.testing.assert_allclose(wedge.minimal().A, [[np.sqrt(0.5), -np.sqrt(0.5)]]) if len(wedge.b) else None


@pytest.mark.parametrize("width", [1e-8, 2e-9, 1.1e-9, 1e-9, 9e-10, 1e-10, 1e-11, 1e-13])
@pytest.mark.parametrize("n", [2, 3, 5])
def test_needles_about_the_flatness_bound_are_solid_or_flat_and_never_an_error(width, n, rng):
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    widths = np.r_[np.ones(1), np.full(n - 1, width)]
    P = Polytope(np.vstack([Q, -Q]), np.r_[widths, widths])
    assert 1 <= P.affine_dim <= n
    assert P.is_bounded
    along = Q[0]
    assert P.support(along) == pytest.approx(1, rel=1e-6)
    if width <= 1e-11:
        assert P.affine_dim == 1


def test_membership_is_the_same_before_and_after_the_vertices_are_known(rng):
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0][:, :2]
    for P in (Polytope.from_vertices(rng.normal(size=(8, 2)) @ Q.T), box([0, 0, 0], [1, 1e-6, 1e6])):
        fresh = Polytope(P.A, P.b, P.A_eq, P.b_eq)
        ranges = fresh.ranges.copy()
        again = Polytope(P.A, P.b, P.A_eq, P.b_eq)
        again.vertices  # noqa: B018
        np.testing.assert_array_equal(ranges, again.ranges)
        np.testing.assert_allclose(ranges, P.ranges, rtol=1e-6)


def test_membership_tolerance_is_a_part_of_the_range_of_the_row():
    P = box([0, 0], [1e-6, 1e6])
    for i, extent in enumerate((1e-6, 1e6)):
        x = np.array([0.5e-6, 0.5e6])
        x[i] = extent * (1 + 0.9e-9)
        assert P.contains(x)
        x[i] = extent * (1 + 1.1e-9)
        assert not P.contains(x)
        assert P.contains(x, tol=2e-9)
        x[i] = np.nextafter(extent, 2 * extent)
        assert not P.contains(x, tol=0)
    assert [0.5e-6, 1.0] in P
    assert [2e-6, 1.0] not in P
    assert [np.nan, 1.0] not in P


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda P: pickle.loads(pickle.dumps(P))])
def test_copies_are_the_same_set_and_read_only(copied):
    for P in (box([0, 0], [1, 2]), Polytope.from_vertices(np.eye(3)), Polytope([[1.0, 1]], [1], [[1, 0]], [0.5])):
        _ = P.is_empty
        Q = copied(P)
        assert Q.equals(P)
        assert type(Q) is Polytope
        with pytest.raises(ValueError, match="read-only"):
            Q.A[...] = 0
    for error in (
        InputError("A", 1, 2, "do this"),
        UnboundedError("volume"),
        EmptySetError("sample"),
        NumericalError("The hull", (3, 2), "flat"),
        TimeLimitError("affine_map", 1.0, "large"),
    ):
        again = copied(error)
        assert vars(again) == vars(error)
        assert str(again) == str(error)


def test_a_hull_that_cannot_end_in_time_says_so_and_leaves_an_outer_set(rng):
    n = 8
    P, Q = box(-np.ones(n), np.ones(n)), Polytope.from_vertices(rng.normal(size=(40, n)))
    with pytest.raises(TimeLimitError, match="minkowski_sum does not end within 1 s") as caught:
        P.minkowski_sum(Q, time_limit=1.0)
    D = rng.normal(size=(20, n))
    exact = P.support(D) + Q.support(D)
    outer = caught.value.outer
    assert (outer.support(D) >= exact - 1e-9).all()
    np.testing.assert_allclose(outer.support(np.eye(n)), P.support(np.eye(n)) + Q.support(np.eye(n)), rtol=1e-9)
    with pytest.raises(TimeLimitError, match="from_vertices does not end: a hull of 10575 points") as caught:
        Polytope.from_vertices(rng.normal(size=(10575, n)))
    assert caught.value.outer.dim == n
    assert len(box(-np.ones(10), np.ones(10)).vertices) == 1024
    with pytest.raises(InputError, match="time_limit: got -1"):
        P.minkowski_sum(Q, time_limit=-1)
