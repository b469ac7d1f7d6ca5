"""The same set in other words gives the same answers: units, order of rows and states, redundant rows, shears."""

import math

import numpy as np
import pytest
from disguises import BOUNDED, DIMENSION, KINDS, MAPS, SAME_SET, empty, hidden_equality, point, units, with_equality

from invariant_sets import Polytope

every_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda f: f.__name__)
every_n = pytest.mark.parametrize("n", [2, 3, 4])


def directions(rng, rows, n):
    return np.vstack([np.eye(n), -np.eye(n), rows.A[:3], rng.normal(size=(4, n))])


def assert_same(h, k, size):
    h, k = np.atleast_1d(h), np.atleast_1d(k)
    finite = np.isfinite(k)
    np.testing.assert_array_equal(h[~finite], k[~finite])
    np.testing.assert_allclose(h[finite], k[finite], rtol=1e-7, atol=1e-9 * size)


def size_of(h):
    finite = np.abs(h[np.isfinite(h)])
    return max(1.0, finite.max(initial=0.0))


def assert_same_shape(P, Q):
    assert (P.affine_dim, P.is_empty, P.is_bounded) == (Q.affine_dim, Q.is_empty, Q.is_bounded)


@every_kind
@every_n
def test_the_kind_is_recognised(kind, n, rng):
    P = kind(rng, n).polytope
    if kind is empty:
        assert P.is_empty
    elif kind is point:
        assert P.affine_dim == 0
    else:
        assert P.affine_dim == n + DIMENSION.get(kind, 0)
    bounded = {*BOUNDED, with_equality, hidden_equality, point, empty}
    assert P.is_bounded is (kind in bounded)


@every_kind
@every_n
@pytest.mark.parametrize("change", SAME_SET, ids=lambda f: f.__name__)
def test_other_rows_of_the_same_set_change_nothing(kind, n, change, rng):
    rows = kind(rng, n)
    P, Q, D = rows.polytope, change(rng, rows).polytope, directions(rng, rows, n)
    assert_same_shape(P, Q)
    h = P.support(D)
    assert_same(Q.support(D), h, size_of(h))
    if not P.is_empty:
        assert_same(np.r_[Q.bounding_box()], np.r_[P.bounding_box()], size_of(h))
        assert_same(Q.chebyshev_ball()[1], P.chebyshev_ball()[1], 1.0)
        assert P.equals(Q, 1e-8)
    if P.is_bounded:
        assert math.isclose(Q.volume, P.volume, rel_tol=1e-7, abs_tol=1e-300)
        assert len(Q.vertices) == len(P.vertices)


@every_kind
@every_n
@pytest.mark.parametrize("mapping", MAPS, ids=lambda f: f.__name__)
def test_other_units_orders_and_shears_of_the_states_map_the_set(kind, n, mapping, rng):
    rows, M = kind(rng, n), mapping(rng, n)
    P, Q, D = rows.polytope, rows.mapped(np.linalg.inv(M)).polytope, directions(rng, rows, n)
    assert_same_shape(P, Q)
    h = P.support(D)
    assert_same(Q.support(D @ np.linalg.inv(M)), h, size_of(h))
    assert Q.equals(P.affine_map(M), 1e-7)
    assert Q.equals(Q.minimal(), 1e-8)
    assert Q.minimal().affine_dim == P.affine_dim
    if P.is_bounded and not P.is_empty:
        assert math.isclose(Q.volume, abs(np.linalg.det(M)) * P.volume, rel_tol=1e-6, abs_tol=1e-300)
        assert len(Q.vertices) == len(P.vertices)
        assert np.array(Q.contains(P.vertices @ M.T, 1e-7)).all()
        beyond = P.vertices + 0.01 * (P.vertices - P.vertices.mean(axis=0))
        assert P.affine_dim == 0 or not Q.contains(beyond @ M.T).any()


@every_kind
@every_n
def test_units_and_rows_changed_together_change_nothing(kind, n, rng):
    rows, M = kind(rng, n), units(rng, n)
    inverse = np.diag(1 / np.diag(M))
    changed = rows
    for change in SAME_SET:
        changed = change(rng, changed)
    P, Q, D = rows.polytope, changed.mapped(inverse).polytope, directions(rng, rows, n)
    assert_same_shape(P, Q)
    h = P.support(D)
    assert_same(Q.support(D @ inverse), h, size_of(h))


@every_kind
@every_n
def test_operations_do_not_depend_on_units(kind, n, rng):
    rows, M = kind(rng, n), units(rng, n)
    inverse = np.diag(1 / np.diag(M))
    P, Q, D = rows.polytope, rows.mapped(inverse).polytope, directions(rng, rows, n)
    step = 0.1 * rng.normal(size=(n + 1, n))
    W, V = P.from_vertices(step), P.from_vertices(step @ M.T)
    for ours, theirs in (
        (P.minkowski_sum(W), Q.minkowski_sum(V)),
        (P.pontryagin_difference(W), Q.pontryagin_difference(V)),
        (P.intersection(W), Q.intersection(V)),
        (P.scale(-2), Q.scale(-2)),
    ):
        h = ours.support(D)
        assert ours.affine_dim == theirs.affine_dim
        assert_same(theirs.support(D @ inverse), h, size_of(h))
    h = P.projection([n - 1, 0]).support(D[:, [n - 1, 0]])
    kept = np.diag(M)[[n - 1, 0]]
    assert_same(Q.projection([n - 1, 0]).support(D[:, [n - 1, 0]] / kept), h, size_of(h))


@pytest.mark.parametrize("kind", [*BOUNDED, with_equality, hidden_equality, point], ids=lambda f: f.__name__)
@every_n
def test_the_difference_of_a_set_with_itself_is_a_point_in_any_units(kind, n, rng):
    M = units(rng, n)
    P = kind(rng, n).mapped(np.linalg.inv(M)).polytope
    difference = P.pontryagin_difference(P)
    assert difference.affine_dim == 0
    extent = np.maximum(np.ptp(P.vertices, axis=0), 1e-9 * np.abs(P.vertices).max(axis=0))
    assert (np.abs(difference.vertices[0]) <= 1e-7 * extent).all()


def inner_point(P):
    return np.zeros(P.dim) if P.is_empty else P.chebyshev_ball()[0]


@every_kind
@every_n
@pytest.mark.parametrize("change", SAME_SET, ids=lambda f: f.__name__)
def test_slices_preimages_and_products_do_not_depend_on_rows_or_units(kind, n, change, rng):
    rows, M = kind(rng, n), units(rng, n)
    scale = np.diag(M)
    P, Q = rows.polytope, change(rng, rows).mapped(np.diag(1 / scale)).polytope
    x = inner_point(P)
    fixed, free = [n - 1], list(range(n - 1))
    along, W, factors = rng.normal(size=(n, 2)), Polytope.from_bounds([-1, 0], [2, 3]), np.array([1e-7, 1e6])
    D, E, both = rng.normal(size=(6, n - 1)), rng.normal(size=(6, 2)), rng.normal(size=(6, n + 2))
    pairs = [
        (P.slice(fixed, x[fixed]), D, Q.slice(fixed, (scale * x)[fixed]), D / scale[free]),
        (P.preimage(along, x), E, Q.preimage(scale[:, None] * along / factors, scale * x), E / factors),
        (
            P.cartesian_product(W),
            both,
            Q.cartesian_product(W.affine_map(np.diag(factors))),
            both / np.append(scale, factors),
        ),
    ]
    for ours, one, theirs, other in pairs:
        assert_same_shape(ours, theirs)
        h = ours.support(one)
        assert_same(theirs.support(other), h, size_of(h))


@pytest.mark.parametrize("kind", [*BOUNDED, with_equality, hidden_equality, point], ids=lambda f: f.__name__)
@every_n
def test_samples_lie_in_the_set_and_spread_alike_in_any_units_and_rows(kind, n, rng):
    rows, scale = kind(rng, n), np.diag(units(rng, n))
    changed = rows
    for change in SAME_SET:
        changed = change(rng, changed)
    P, Q = rows.polytope, changed.mapped(np.diag(1 / scale)).polytope
    ours, theirs = P.sample(400, rng=rng), Q.sample(400, rng=rng)
    assert Q.contains(theirs).all()
    assert P.contains(theirs / scale, 1e-7).all()
    spread = ours.std(axis=0)
    noise = 1e-9 * (spread.max() + np.abs(ours).max())
    assert (np.abs((theirs / scale).mean(axis=0) - ours.mean(axis=0)) <= 0.4 * spread + noise).all()  # 5.6 deviations
    np.testing.assert_allclose((theirs / scale).std(axis=0), spread, rtol=0.35, atol=noise)
