"""Identities of set operations, both ways, on families in two to six dimensions."""

import numpy as np
import pytest
from set_families import FAMILIES, cut_cube, flat, needle, random_rows, rotation, simplex

from invariant_sets import Polytope

DIMENSIONS = [2, 3, 4, 5, 6]
every_family = pytest.mark.parametrize("family", FAMILIES, ids=lambda f: f.__name__)
every_dimension = pytest.mark.parametrize("n", DIMENSIONS)


def directions(rng, P, count=30):
    """Return directions scaled to the set, so that needles are tested across as well as along."""
    extent = np.ptp(P.vertices, axis=0)
    extent = np.where(extent > 0, extent, 1.0)
    return rng.normal(size=(count, P.dim)) / extent


def assert_same_support(h, k, scale=1.0, rel=1e-6):
    np.testing.assert_allclose(h, k, rtol=rel, atol=rel * scale)


@pytest.mark.long
@pytest.mark.quick(38)
@every_family
@every_dimension
def test_vertices_and_inequalities_describe_one_set(family, n, rng):
    P = family(rng, n)
    again = Polytope.from_vertices(Polytope(P.A, P.b, P.A_eq, P.b_eq).vertices)
    assert again.affine_dim == P.affine_dim
    assert P.is_subset(again, 1e-7)
    assert again.is_subset(P, 1e-7)
    assert again.volume == pytest.approx(P.volume, rel=1e-6)


@every_family
@every_dimension
def test_minimal_is_the_same_set_without_a_row_to_spare(family, n, rng):
    P = family(rng, n)
    M = P.minimal()
    assert M.equals(P, 1e-7)
    assert len(M.b) <= len(P.b)
    assert M.affine_dim == n - len(M.b_eq)
    for i in range(len(M.b)):
        others = np.arange(len(M.b)) != i
        width = M.support(M.A[i]) + M.support(-M.A[i])
        without = Polytope(np.vstack([M.A[others], M.A[i]]), np.append(M.b[others], M.b[i] + width), M.A_eq, M.b_eq)
        assert without.support(M.A[i]) > M.b[i] + 1e-9 * width


@every_dimension
def test_rows_repeated_or_only_touching_are_removed(n, rng):
    from set_families import repeated_rows

    assert len(repeated_rows(rng, n).minimal().b) == len(cut_cube(rng, n).minimal().b)


@every_family
@every_dimension
def test_support_and_contains_agree_with_the_vertices(family, n, rng):
    P = family(rng, n)
    V, D = P.vertices, directions(rng, P)
    fresh = Polytope(P.A, P.b, P.A_eq, P.b_eq)
    assert_same_support(fresh.support(D), (D @ V.T).max(axis=1))
    weights = rng.dirichlet(np.ones(len(V)), 50)
    assert P.contains(weights @ V).all()
    beyond = V.mean(axis=0) + 1.01 * (V - V.mean(axis=0))
    assert not P.contains(beyond).any()


@every_family
@pytest.mark.parametrize("n", [2, 3, 4])
def test_support_of_a_minkowski_sum_is_the_sum_of_supports(family, n, rng):
    P = family(rng, n)
    Q = simplex(rng, n).affine_map(np.diag(np.ptp(P.vertices, axis=0) + 1e-9 * np.ptp(P.vertices)))
    S = P.minkowski_sum(Q)
    D = directions(rng, S)
    assert_same_support(S.support(D), P.support(D) + Q.support(D))


@pytest.mark.parametrize("n", [5, 6])
def test_minkowski_sum_in_higher_dimensions(n, rng):
    P, Q = cut_cube(rng, n), Polytope.from_vertices(np.vstack([np.zeros(n), 0.3 * rng.normal(size=n)]))
    S = P.minkowski_sum(Q)
    D = directions(rng, S)
    assert_same_support(S.support(D), P.support(D) + Q.support(D))
    assert S.pontryagin_difference(Q).equals(P, 1e-7)


@every_family
@pytest.mark.parametrize("n", [2, 3, 4])
def test_difference_then_sum_stays_inside_and_sum_then_difference_returns(family, n, rng):
    P = family(rng, n)
    W = P.affine_map(0.1 * np.eye(n), -0.1 * P.vertices.mean(axis=0))
    D = P.pontryagin_difference(W)
    assert not D.is_empty
    assert D.minkowski_sum(W).is_subset(P, 1e-7)
    assert P.minkowski_sum(W).pontryagin_difference(W).equals(P, 1e-6)


@pytest.mark.long
@pytest.mark.quick(25)
@pytest.mark.parametrize("n", [2, 3, 4, 5])
@pytest.mark.parametrize("family", FAMILIES)
def test_difference_of_a_set_with_itself_is_one_point(family, n, rng):
    P = family(rng, n)
    difference = P.pontryagin_difference(P)
    assert difference.affine_dim == 0
    assert np.allclose(difference.vertices, 0, atol=1e-9 * np.ptp(P.vertices, axis=0).max())
    larger = P.minkowski_sum(P)  # the other order: nothing fits
    assert P.pontryagin_difference(larger).is_empty or P.affine_dim == 0


def test_difference_of_boxes_is_flat_where_they_are_equally_wide():
    third = 1 / 3
    P = Polytope.from_bounds([-0.1, -1], [0.2, 1]).affine_map([[third, 0.7], [-0.7, third]])
    Q = Polytope.from_bounds([-0.1, -0.25], [0.2, 0.5]).affine_map([[third, 0.7], [-0.7, third]])
    difference = P.pontryagin_difference(Q)
    assert difference.affine_dim == 1
    assert difference.equals(Polytope.from_vertices(np.array([[0, -0.75], [0, 0.5]]) @ [[third, -0.7], [0.7, third]]))


def test_difference_with_a_larger_set_is_empty_and_with_nothing_is_everything():
    P, Q = Polytope.from_bounds([-1, -1], [1, 1]), Polytope.from_bounds([-2, 0], [2, 0])
    assert P.pontryagin_difference(Q).is_empty
    nothing = Polytope.empty(2)
    assert P.pontryagin_difference(nothing).contains([1e9, -1e9])
    assert Q.pontryagin_difference(P).is_empty


@every_family
@every_dimension
def test_affine_map_moves_the_support_and_preimage_undoes_it(family, n, rng):
    P = family(rng, n)
    M = rotation(rng, n) @ np.diag(rng.uniform(0.5, 2, n)) if family is not needle else np.diag(rng.uniform(0.5, 2, n))
    c = rng.normal(size=n)
    Q = P.affine_map(M, c)
    D = directions(rng, Q)
    assert_same_support(Q.support(D), P.support(D @ M) + D @ c)
    assert Q.preimage(M, c).equals(P, 1e-6)
    assert Q.volume == pytest.approx(abs(np.linalg.det(M)) * P.volume, rel=1e-5)


@every_family
@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
def test_singular_map_gives_the_image_of_the_points(family, n, rng):
    P = family(rng, n)
    M = np.zeros((n, n))
    M[: n // 2] = np.eye(n)[: n // 2]
    Q = P.affine_map(M, np.ones(n))
    assert Q.affine_dim == min(n // 2, P.affine_dim)
    assert Q.contains(P.vertices @ M.T + 1, tol=1e-7).all()
    D = directions(rng, P)
    assert_same_support(Q.support(D), P.support(D @ M) + D.sum(axis=1))


def test_preimage_of_a_singular_map_is_a_cylinder():
    P = Polytope.from_bounds([-1, -1], [1, 1]).preimage([[1, 0, 0], [1, 0, 0]])
    assert P.dim == 3
    assert not P.is_bounded
    assert P.contains([[0.5, 1e6, -1e6], [1.5, 0, 0]]).tolist() == [True, False]


@every_family
@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
def test_projection_has_the_support_of_the_whole_set(family, n, rng):
    P = family(rng, n)
    kept = [n - 1, 0]
    Q = P.projection(kept)
    D = directions(rng, Q)
    lifted = np.zeros((len(D), n))
    lifted[:, kept] = D
    assert_same_support(Q.support(D), P.support(lifted))


def test_projection_of_an_unbounded_set_keeps_what_is_bounded():
    P = Polytope([[1.0, 1, 0], [-1, 1, 0], [0, -1, 0], [0, 0, 1]], [1, 1, 0, 4])
    Q = P.projection([0, 1])
    assert Q.volume == pytest.approx(1.0)
    assert not P.projection([2]).is_bounded


@every_family
@pytest.mark.parametrize("n", [2, 3, 4])
def test_slice_contains_exactly_the_points_of_the_set(family, n, rng):
    P = family(rng, n)
    point = P.vertices.mean(axis=0)
    cut = P.slice([0], [point[0]])
    assert cut.contains(point[1:], tol=1e-7)
    if not cut.is_empty and cut.affine_dim == n - 1:
        y = cut.sample(40, rng=rng)
        assert P.contains(np.column_stack([np.full(40, point[0]), y]), tol=1e-7).all()
        beyond = cut.vertices + 0.01 * (cut.vertices - cut.vertices.mean(axis=0))
        assert not P.contains(np.column_stack([np.full(len(beyond), point[0]), beyond])).any()


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_intersection_is_in_both_and_product_multiplies_volumes(n, rng):
    P, Q = random_rows(rng, n), simplex(rng, n).affine_map(np.eye(n), -3 * np.ones(n))
    both = P.intersection(Q)
    assert both.is_subset(P)
    assert both.is_subset(Q)
    x = rng.uniform(-1, 1, (500, n))
    np.testing.assert_array_equal(both.contains(x), P.contains(x) & Q.contains(x))
    segment = Polytope.from_bounds([2], [5])
    assert P.cartesian_product(segment).volume == pytest.approx(3 * P.volume, rel=1e-9)
    assert P.cartesian_product(segment).projection(np.arange(n)).equals(P, 1e-7)


@every_family
@every_dimension
def test_scaling_scales_the_volume_and_reflects(family, n, rng):
    P = family(rng, n)
    assert P.scale(-2).volume == pytest.approx(2**n * P.volume, rel=1e-6)
    assert P.scale(-1).scale(-1).equals(P)
    assert P.scale(0).affine_dim == 0


@every_dimension
def test_chebyshev_ball_touches_facets_and_crosses_none(n, rng):
    P = random_rows(rng, n)
    centre, radius = P.chebyshev_ball()
    slack = (P.b - P.A @ centre) / np.linalg.norm(P.A, axis=1)
    assert slack.min() == pytest.approx(radius, rel=1e-7)
    for step in 1e-3 * np.vstack([np.eye(n), -np.eye(n)]):  # no neighbouring centre has a larger ball
        assert ((P.b - P.A @ (centre + step)) / np.linalg.norm(P.A, axis=1)).min() <= radius + 1e-9


def test_chebyshev_ball_of_a_flat_set_has_no_radius_and_of_a_half_space_no_end():
    assert Polytope.from_bounds([0, 0], [1, 0]).chebyshev_ball()[1] == 0.0
    assert Polytope([[1.0, 0]], [1.0]).chebyshev_ball()[1] == np.inf


def test_subset_and_equality_see_a_difference_of_a_millionth(rng):
    P = random_rows(rng, 3)
    larger = P.affine_map(1.000001 * np.eye(3))
    assert P.is_subset(larger)
    assert not larger.is_subset(P)
    assert not P.equals(larger)
    assert P.equals(larger, tol=1e-5)


def test_empty_set_passes_through_every_operation():
    empty, P = Polytope.empty(2), Polytope.from_bounds([0, 0], [1, 1])
    results = [
        empty.intersection(P),
        empty.cartesian_product(P),
        empty.minkowski_sum(P),
        P.minkowski_sum(empty),
        empty.pontryagin_difference(P),
        empty.affine_map(np.ones((3, 2))),
        empty.preimage(np.ones((2, 3))),
        empty.projection([0]),
        empty.slice([0], [0.5]),
        empty.scale(2),
        empty.scale(0),
        empty.minimal(),
    ]
    assert all(result.is_empty for result in results)
    assert empty.is_subset(P)
    assert not P.is_subset(empty)
    assert empty.equals(Polytope([[1, 0], [-1, 0]], [2, -3]))
    assert empty.support([1, 0]) == -np.inf
    assert not empty.contains([0.5, 0.5])
    assert (empty.affine_dim, empty.is_bounded) == (-1, True)


@every_dimension
def test_samples_are_inside_and_their_mean_is_the_centroid(n, rng):
    P = simplex(rng, n)
    x = P.sample(4000, rng=rng)
    assert P.contains(x).all()
    barycentric = np.linalg.solve(np.vstack([P.vertices.T, np.ones(n + 1)]), np.column_stack([x, np.ones(len(x))]).T)
    # uniform on a simplex: every barycentric coordinate is Beta(1, n)
    np.testing.assert_allclose(barycentric.mean(axis=1), 1 / (n + 1), atol=0.02)
    below = (barycentric < 0.1).mean(axis=1)
    np.testing.assert_allclose(below, 1 - 0.9**n, atol=0.05)


def test_samples_of_a_flat_set_stay_on_it(rng):
    P = flat(rng, 4)
    assert P.contains(P.sample(200, rng=rng)).all()


def test_repr_and_html_say_what_the_set_is():
    P = Polytope.from_bounds([0, 0], [1, 2])
    assert repr(P) == "Polytope(dim=2, 4 inequalities)"
    assert "[0, 2]" in P._repr_html_()
    assert "<td>True</td>" in Polytope.empty(1)._repr_html_()


def test_rows_of_a_box_in_twenty_dimensions_are_sorted_out_without_its_million_vertices(rng):
    """Doubled rows, looser ones and one that only touches a corner go; the box stays."""
    n = 20
    half = rng.uniform(0.5, 2.0, n)
    box = Polytope.from_bounds(-half, half)
    A = np.vstack([box.A, box.A, box.A, np.ones((1, n))])
    b = np.concatenate([box.b, box.b, 1.5 * box.b, [half.sum()]])
    found = Polytope(A, b).minimal()
    assert found.A.shape == (2 * n, n)
    np.testing.assert_allclose(found.bounding_box(), [-half, half], rtol=1e-9)
