"""`Polytope`: construction, questions, degenerate sets."""

import itertools
import math

import numpy as np
import pytest

from invariant_sets import Polytope


def random_polytope(rng, n, rows=None):
    A = rng.normal(size=(rows or 4 * n, n))
    return Polytope(
        np.vstack([A, np.eye(n), -np.eye(n)]),
        np.r_[rng.uniform(0.3, 1, len(A)) * np.linalg.norm(A, axis=1), np.ones(2 * n)],
    )


@pytest.mark.quick(4)
@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
def test_vertices_reconstruct_the_set(n, rng):
    P = random_polytope(rng, n)
    Q = Polytope.from_vertices(P.vertices)
    assert P.contains(Q.vertices, tol=1e-8).all()
    assert Q.contains(P.vertices, tol=1e-8).all()
    assert Q.volume == pytest.approx(P.volume, rel=1e-8)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
def test_minimal_keeps_the_set_and_every_remaining_row_is_needed(n, rng):
    P = random_polytope(rng, n)
    P = Polytope(np.vstack([P.A, 3 * P.A]), np.r_[P.b, 3 * P.b])
    Q = P.minimal()
    assert Q.volume == pytest.approx(P.volume, rel=1e-8)
    for i in range(len(Q.b)):
        rest = np.arange(len(Q.b)) != i
        without = Polytope(np.vstack([Q.A[rest], Q.A[i]]), np.r_[Q.b[rest], Q.b[i] + 1])
        assert without.support(Q.A[i]) > Q.b[i] + 1e-10


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_volume_scales_with_the_units(scale):
    P = Polytope.from_vertices(scale * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]))
    assert P.volume == pytest.approx(scale**3 / 6, rel=1e-12)
    assert len(P.minimal().b) == 4


def test_needle_keeps_its_dimension_and_volume():
    P = Polytope.from_bounds([0, 0, -1e6], [1e-6, 1.0, 1e6])
    assert P.affine_dim == 3
    assert P.volume == pytest.approx(2.0, rel=1e-12)
    assert len(P.vertices) == 8


@pytest.mark.parametrize("n", [2, 3, 5])
@pytest.mark.parametrize("ratio", [1e6, 1e9, 1e12])
def test_a_corner_with_edges_of_any_ratio_is_bounded_and_has_its_volume(n, ratio):
    edges = np.geomspace(1 / np.sqrt(ratio), np.sqrt(ratio), n)
    P = Polytope.from_vertices(np.vstack([np.zeros(n), np.diag(edges)]))
    again = Polytope(P.A, P.b)  # without the vertices that it was made of
    assert again.is_bounded
    assert math.isclose(again.volume, np.prod(edges) / math.factorial(n), rel_tol=1e-9)
    assert np.allclose(np.array(again.bounding_box()) / edges, [np.zeros(n), np.ones(n)], atol=1e-9)
    share = (2 / 3) ** (n - 1)  # of the base, a third of the way up
    base = np.prod(edges[:-1]) / math.factorial(n - 1)
    assert math.isclose(again.slice([n - 1], [edges[-1] / 3]).volume, share * base, rel_tol=1e-9)


def test_equalities_hidden_in_inequalities_are_found():
    P = Polytope([[1, 0], [-1, 0], [0, 1], [0, -1]], [1, -1, 2, 0])
    assert (P.affine_dim, P.volume, P.is_empty) == (1, 0.0, False)
    np.testing.assert_allclose(P.vertices[np.argsort(P.vertices[:, 1])], [[1, 0], [1, 2]], atol=1e-12)
    assert len(P.minimal().b_eq) == 1


def test_point_segment_and_triangle_in_space_are_flat():
    for V, dim in (([[1, 2, 3]], 0), ([[0, 0, 0], [1, 2, 3]], 1), ([[0, 0, 1], [1, 0, 1], [0, 1, 1]], 2)):
        P = Polytope.from_vertices(V)
        assert P.affine_dim == dim
        assert P.contains(V).all()
        assert len(P.vertices) == len(V)


def test_empty_and_unbounded_sets_say_so():
    empty = Polytope.empty(2)
    assert empty.is_empty
    assert empty.vertices.shape == (0, 2)
    assert empty.volume == 0.0
    half = Polytope([[1.0, 0.0]], [1.0])
    assert not half.is_bounded
    np.testing.assert_allclose(half.bounding_box(), ([-np.inf, -np.inf], [1, np.inf]), rtol=1e-12)


def test_contains_is_batched_and_never_accepts_nan():
    P = Polytope.from_bounds([0, 0], [1, 1])
    np.testing.assert_array_equal(P.contains([[0.5, 0.5], [1.5, 0.5], [np.nan, 0.5]]), [True, False, False])
    everything = Polytope(np.zeros((0, 2)), [])
    np.testing.assert_array_equal(everything.contains([[1e300, 0], [np.nan, 0], [np.inf, 0]]), [True, False, False])
    assert P.contains([1.0, 1.0]) is True


def test_samples_lie_inside_and_fill_the_set(rng):
    P = Polytope.from_vertices([[0, 0], [1, 0], [0, 1]])
    S = P.sample(4000, rng=rng)
    assert P.contains(S).all()
    np.testing.assert_allclose(S.mean(axis=0), [1 / 3, 1 / 3], atol=0.02)
    assert (S.sum(axis=1) < 0.5).mean() == pytest.approx(0.25, abs=0.03)


def test_arrays_are_copied_in_and_read_only():
    A, b = np.eye(2), np.ones(2)
    P = Polytope(A, b)
    A[0, 0] = 7
    assert P.A[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        P.A[0, 0] = 2


@pytest.mark.parametrize("n", [5, 6])
def test_volumes_in_many_dimensions_need_no_hull_of_the_vertices(n, rng):
    units = 10.0 ** rng.integers(-6, 7, n)
    box = Polytope.from_bounds(-units, 2 * units)
    assert box.volume == pytest.approx(np.prod(3 * units), rel=1e-9)
    signs = np.array(list(itertools.product([-1.0, 1.0], repeat=n)))
    cross = Polytope(signs / units, np.ones(2**n))
    assert cross.volume == pytest.approx(2**n / math.factorial(n) * np.prod(units), rel=1e-9)


@pytest.mark.parametrize("seed", range(10))
def test_a_point_where_slanted_rows_meet_equals_the_point_itself(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    x = rng.normal(size=n)
    x[0] = 0.0  # a coordinate that is rounding where it has been computed
    A = rng.normal(size=(n, n))
    A = np.vstack([A, -A.sum(axis=0)])
    P = Polytope(A, A @ x)
    assert P.affine_dim == 0
    assert P.equals(Polytope.from_vertices(x[None]))
    assert P.contains(x)
    assert not P.contains(x + 1e-6 * rng.normal(size=n))


def nearly_dependent(d):
    """x2 = 0 and x1 = 1 by two rows d apart in direction, x1 in [0, 1] and x3 in [−1, 1] by rows of their own."""
    return Polytope([[1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1]], [1, 0, 1, 1], [[1, 1, 0], [1, 1 + d, 0]], [1, 1])


@pytest.mark.parametrize("d", [1e-6, 1e-8, 1e-10])
def test_nearly_dependent_equalities_loosen_no_row(d):
    P = nearly_dependent(d)
    assert P.contains([1.0, 0, 0])
    assert P.contains(P.vertices).all()
    assert not P.contains([[1 + 1e-2, 0, 0], [1 + 1e-4, 0, 0], [1 + 1e-6, 0, 0], [1, 0, 1 + 1e-6]]).any()
    assert not Polytope(A_eq=[[1, 1], [1, 1 + d]], b_eq=[1, 1]).contains([1.01, 0])
    box = Polytope.from_bounds([-1, -1, -1], [1, 1, 1])
    assert P.is_subset(box)
    assert not P.is_subset(Polytope.from_bounds([-1, -1, -1], [1 - 1e-3, 1, 1]))
    assert not box.is_subset(P)
    assert P.equals(P.minimal())


def test_nearly_dependent_equalities_of_a_set_do_not_equal_a_point_beside_it():
    P = Polytope(A_eq=[[1, 1], [1, 1 + 1e-8]], b_eq=[1, 1])
    assert P.equals(Polytope.from_vertices([[1.0, 0.0]]))
    assert not P.equals(Polytope.from_vertices([[1 - 1e-4, 1e-4]]))
    assert not P.equals(Polytope.from_vertices([[1 + 1e-4, 0.0]]))


def test_bad_conditioning_of_one_set_loosens_no_row_of_the_other():
    P = nearly_dependent(1e-8)
    for gap in (1e-2, 1e-4):
        other = Polytope.from_bounds([1 + gap, 0, 0], [1 + 2 * gap, 0, 0])
        assert not other.is_subset(P)
        assert not P.is_subset(other)


@pytest.mark.parametrize("seed", range(20))
def test_points_and_flat_boxes_by_opposite_rows_hold_and_equal_themselves_in_any_units(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 6))
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    half = rng.uniform(0.1, 1, n) * (rng.random(n) < 0.5)
    centre = np.round(rng.normal(size=n), 2) * (rng.random(n) < 0.7)
    size = 10.0 ** rng.permutation(np.linspace(-7, 7, n))
    A = np.vstack([Q, -Q]) / size
    P = Polytope(A, np.concatenate([half + Q @ centre, half - Q @ centre]))
    assert P.affine_dim == np.count_nonzero(half)
    assert P.contains(centre * size)
    assert P.contains(P.vertices).all()
    assert P.contains(P.sample(20, rng=rng)).all()
    assert P.equals(P)
    assert P.equals(P.minimal())
    assert P.equals(Polytope.from_vertices(P.vertices))
    if not half.all():
        flat = int(np.argmin(half))
        assert not P.contains((centre + 1e-6 * Q[flat]) * size)


def test_the_rounding_of_a_row_is_that_of_its_data_at_the_point():
    slab = Polytope([[1.0, -1.0], [-1.0, 1.0]], [1.0, 1.0])
    assert slab.contains([1e6 + 1, 1e6])
    assert slab.contains([1e9 + 1 + 1e-4, 1e9])  # 1e-12 of what the row adds up there
    assert not slab.contains([1 + 1e-4, 0])
    assert not slab.contains([[np.inf, 0], [np.inf, np.inf], [np.nan, 0]]).any()
    assert slab.contains([1e9 + 1, 1e9], tol=0)
    assert not slab.contains([1e9 + 1 + 1e-4, 1e9], tol=0)
