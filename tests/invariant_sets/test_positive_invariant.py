"""Largest admissible and smallest robust positively invariant sets."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from invariant_sets import (
    Polytope,
    Status,
    maximal_control_invariant_set,
    maximal_positively_invariant_set,
    minimal_robust_positively_invariant_set,
)

box = Polytope.from_bounds
A = np.array([[0.9, 0.4], [-0.3, 0.8]])
X = box([-1, -1], [1, 2])


def stays(A, C, noise):
    """Return the worst relative violation of A C ⊕ noise ⊆ C, from vertices and products alone."""
    successors = (C.vertices @ A.T)[:, None] + noise[None]
    size = np.abs(C.A) @ np.ptp(C.vertices, axis=0)
    return ((successors.reshape(-1, C.dim) @ C.A.T - C.b) / size).max()


def test_largest_set_is_invariant_and_what_leaves_it_leaves_the_constraints(rng):
    result = maximal_positively_invariant_set(A, X)
    assert result.status is Status.CONVERGED
    assert stays(A, result.set, np.zeros((1, 2))) <= 1e-9
    x = X.sample(3000, rng=rng)
    safe, y = np.ones(len(x), bool), x
    for _ in range(200):
        y = y @ A.T
        safe &= X.contains(y)
    np.testing.assert_array_equal(result.set.contains(x, tol=1e-7), safe)
    assert 0 < safe.sum() < len(x)


def test_output_admissible_set_of_a_feedback_respects_states_and_inputs(rng):
    A2, B2 = np.array([[1.0, 1], [0, 1]]), np.array([[0.5], [1.0]])
    P = solve_discrete_are(A2, B2, np.eye(2), np.eye(1))
    K = -np.linalg.solve(np.eye(1) + B2.T @ P @ B2, B2.T @ P @ A2)
    X2, U2 = box([-5, -5], [5, 5]), box([-1], [1])
    C = np.vstack([np.eye(2), K])
    result = maximal_positively_invariant_set(A2 + B2 @ K, X2.cartesian_product(U2), C=C)
    assert result.status is Status.CONVERGED
    assert stays(A2 + B2 @ K, result.set, np.zeros((1, 2))) <= 1e-9
    assert np.abs(result.set.vertices @ K.T).max() == pytest.approx(1, rel=1e-6)
    assert result.set.is_subset(maximal_control_invariant_set(A2, B2, X2, U2).outer)


def test_an_observable_output_bounds_the_set_and_an_unobservable_one_does_not():
    assert maximal_positively_invariant_set(A, box([-1], [1]), C=[[1, 0]]).set.is_bounded
    free = maximal_positively_invariant_set(np.diag([0.5, 0.6]), box([-1], [1]), C=[[1, 0]])
    assert free.status is Status.CONVERGED
    assert not free.set.is_bounded


@pytest.mark.parametrize("decades", [0, 3, 6, 9])
def test_units_of_the_states_do_not_decide_what_an_output_sees(decades):
    units = np.array([10.0**decades, 1.0])
    shift = np.array([[0.0, 2.0], [0.0, 0.0]])  # the output sees the second state at the first step already
    result = maximal_positively_invariant_set(shift * units[:, None] / units, box([-1], [1]), C=[[0.6, -0.7]] / units)
    assert result.status is Status.CONVERGED
    assert result.set.is_bounded
    assert np.ptp(result.set.vertices / units, axis=0) == pytest.approx([2 / 0.6 + 2 * 0.7 / 0.6 / 1.2, 2 / 1.2])


def test_disturbed_set_is_robust_at_every_vertex_of_W_and_smaller():
    W = box([-0.05, -0.05], [0.05, 0.05])
    result = maximal_positively_invariant_set(A, X, W=W)
    assert result.status is Status.CONVERGED
    assert stays(A, result.set, W.vertices) <= 1e-9
    assert result.set.is_subset(maximal_positively_invariant_set(A, X).outer)


def partial_sum_support(A, W, D, terms=400):
    total, directions = np.zeros(len(D)), np.array(D)
    for _ in range(terms):
        total += (directions @ W.T).max(axis=1)
        directions = directions @ A
    return total


NOISE = {
    "box": (np.eye(2), box([-0.1, -0.2], [0.1, 0.2])),
    "not centred": (np.eye(2), box([1.0, 1.0], [1.1, 1.2])),
    "one channel": (np.array([[1.0], [0.5]]), box([-0.1], [0.1])),
    "one channel, not centred": (np.array([[1.0], [0.5]]), box([0.1], [0.3])),
    "triangle": (np.eye(2), Polytope.from_vertices([[0, 0], [0.1, 0], [0, 0.2]])),
}


@pytest.mark.parametrize("eps", [0.3, 1e-2])
@pytest.mark.parametrize("name", NOISE)
def test_smallest_set_is_robust_and_exceeds_the_true_one_by_at_most_eps(name, eps, rng):
    E, W = NOISE[name]
    result = minimal_robust_positively_invariant_set(A, W, E=E, eps=eps)
    noise = W.vertices @ E.T
    assert result.status is Status.CONVERGED
    assert stays(A, result.set, noise) <= 1e-9
    D = np.vstack([rng.normal(size=(40, 2)), result.set.A])
    rest = np.linalg.solve(np.eye(2) - A, noise.mean(axis=0))
    if name == "triangle":  # the excess is counted about the centre of the largest ball
        rest = np.linalg.solve(np.eye(2) - A, W.body.centre)
    exact = partial_sum_support(A, noise, D) - D @ rest
    mine = result.set.support(D) - D @ rest
    assert (mine >= exact * (1 - 1e-9)).all()
    assert (mine <= exact * (1 + eps) + 1e-9).all()
    assert result.certificate.gap <= eps


def test_smallest_set_of_a_scalar_system_is_the_geometric_series():
    result = minimal_robust_positively_invariant_set([[0.5]], box([-1], [2]), eps=1e-6)
    np.testing.assert_allclose(result.set.bounding_box(), [[-2], [4]], rtol=1e-5)


def test_smallest_set_is_flat_where_the_noise_never_goes_and_a_point_without_noise():
    flat = minimal_robust_positively_invariant_set(np.diag([0.5, 0.6]), box([-1], [1]), E=[[1], [0]])
    assert flat.set.affine_dim == 1
    assert flat.set.support([1, 0]) == pytest.approx(2, rel=2e-2)
    point = minimal_robust_positively_invariant_set(A, box([1, 1], [1, 1]))
    np.testing.assert_allclose(point.set.vertices[0], np.linalg.solve(np.eye(2) - A, [1, 1]))


def test_a_facet_limit_returns_a_robust_set_and_the_excess_reached():
    A3 = np.array([[0.7, 0.3, 0], [-0.2, 0.6, 0.2], [0, 0.1, 0.5]])
    W = box([-0.1] * 3, [0.1] * 3)
    result = minimal_robust_positively_invariant_set(A3, W, eps=1e-4, max_facets=300)
    assert result.status is Status.FACET_LIMIT
    assert stays(A3, result.set, W.vertices) <= 1e-9
    assert result.certificate.gap > 1e-4


def test_caps_too_small_for_any_robust_set_are_a_status_and_no_exception():
    result = minimal_robust_positively_invariant_set(
        [[0.5, 99], [0, 0.5]], box([-1, -1], [1, 1]), max_iterations=1, max_facets=4
    )
    assert result.status in (Status.ITERATION_LIMIT, Status.FACET_LIMIT)
    assert result.set.is_empty
    assert not result.certificate.holds


def test_at_the_time_limit_the_set_is_robust_and_not_the_smallest_or_empty():
    A4 = 0.4 * np.random.default_rng(0).standard_normal((4, 4))
    W = box([-1.0] * 4, [1.0] * 4)
    found = minimal_robust_positively_invariant_set(A4, W, eps=1e-6, time_limit=0.3)
    assert found.status is Status.TIME_LIMIT
    if not found.set.is_empty:
        assert stays(A4, found.set, W.vertices) <= 1e-9
        assert found.certificate.gap > 1e-6
