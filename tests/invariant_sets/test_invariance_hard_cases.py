"""Invariant sets where the textbook recursion is slow, flat, unbounded, empty or disturbed."""

import numpy as np
import pytest
from scipy.optimize import linprog

from invariant_sets import Polytope, Status, maximal_control_invariant_set, predecessor_set

box = Polytope.from_bounds
ONE = box([-1], [1])
ROTATION = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])

CASES = {
    "double integrator": ([[1, 1], [0, 1]], [[0.5], [1]], box([-5, -5], [5, 5]), ONE),
    "negative unstable": ([[-1.5, 0.2], [0, 0.4]], [[1], [1]], box([-9, -9], [9, 9]), box([-1], [3])),
    "complex unstable": (1.3 * ROTATION, [[0], [1]], box([-50, -50], [50, 50]), ONE),
    "jordan unstable": ([[1.4, 1], [0, 1.4]], [[0], [1]], box([-50, -50], [50, 50]), ONE),
    "two real unstable": ([[1.2, 0], [0, 1.5]], [[1], [1]], box([-50, -50], [50, 50]), ONE),
    "two unstable, tight": ([[1.2, 0], [0, 1.5]], [[1], [1]], box([-1, -1], [1, 1]), ONE),
    "barely unstable": ([[1.001, 0.1], [0, 0.9]], [[0.1], [1]], box([-500, -500], [500, 500]), ONE),
    "stable uncontrollable": ([[1.2, 0.3], [0, 0.5]], [[1], [0]], box([-1, -1], [1, 1]), ONE),
    "no input, stable": ([[0.9, 0.3], [0, 0.5]], [[1], [1]], box([-1, -1], [1, 1]), box([0], [0])),
    "weak input": ([[2.0, 0], [0, 0.5]], [[1e-6], [1]], box([-5, -5], [5, 5]), ONE),
    "millions": ([[1.3, 1e6], [0, 0.5]], [[0.2e6], [1]], box([-1e7, -10], [1e7, 10]), ONE),
    "millionths": ([[1.3, 1e-6], [0, 0.5]], [[0.2e-6], [1]], box([-1e-5, -10], [1e-5, 10]), ONE),
    "origin outside": ([[0.5]], [[1.0]], box([1.5], [10]), ONE),
    "origin on the border": ([[2.0, 0.1], [0, 0.5]], [[1], [0.3]], box([0, -1], [5, 1]), box([-1], [0])),
    "two inputs": (
        [[1.1, 0.3, 0], [0, 1.2, 0.4], [0.2, 0, 0.9]],
        [[1, 0], [0, 1], [1, 1]],
        box([-5] * 3, [5] * 3),
        box([-1, -1], [1, 1]),
    ),
    "unbounded inputs": ([[1.2, 0.5], [0, 0.8]], [[0.5], [1]], box([-5, -5], [5, 5]), Polytope([[1.0]], [1.0])),
    "repeated rows": (
        [[1.3, 1], [0, 0.5]],
        [[0.2], [1]],
        Polytope(np.tile(np.vstack([np.eye(2), -np.eye(2)]), (3, 1)), 10 * np.ones(12)),
        ONE,
    ),
}


def violation_by_highs(A, B, C, U, noise):
    """Return the worst vertex's violation, relative to the bounding box; written without the package's solvers."""
    F = np.vstack([C.A, C.A_eq, -C.A_eq])
    size = np.abs(F) @ np.ptp(C.vertices, axis=0)
    size[size < 1e-12] = 1.0  # equalities
    g = np.concatenate([C.b, C.b_eq, -C.b_eq]) - np.max(F @ noise.T, axis=1)
    half = (np.abs(U.vertices).max() if U.is_bounded else 1.0) or 1.0
    H, h = np.vstack([U.A, U.A_eq, -U.A_eq]), np.concatenate([U.b, U.b_eq, -U.b_eq])
    worst = -np.inf
    for x in C.vertices:
        rows = np.block([[F @ B / size[:, None], -np.ones((len(F), 1))], [H / half, np.zeros((len(H), 1))]])
        right = np.r_[(g - F @ A @ x) / size, h / half]
        answer = linprog(np.r_[np.zeros(B.shape[1]), 1], A_ub=rows, b_ub=right, bounds=(None, None))
        assert answer.status == 0
        worst = max(worst, answer.x[-1])
    return worst


@pytest.mark.long
@pytest.mark.quick(16)
@pytest.mark.parametrize("name", CASES)
def test_converged_sets_are_invariant_and_nearly_maximal(name, rng):
    A, B, X, U = CASES[name]
    A, B = np.array(A, float), np.array(B, float)
    result = maximal_control_invariant_set(A, B, X, U)
    C, outer = result.set, result.outer
    assert result.status is Status.CONVERGED
    assert result.certificate.gap <= 1e-7
    assert violation_by_highs(A, B, C, U, np.zeros((1, len(A)))) <= 1e-8
    assert C.is_subset(outer, 1e-9)
    assert C.is_subset(X, 1e-9)
    middle = C.vertices.mean(axis=0)
    if U.is_bounded:  # one more step, by the lifted elimination that the recursion does not use
        before = predecessor_set(A, B, C, U, X=X).set
        assert C.is_subset(before, 1e-8)
        assert before.is_subset(C.affine_map((1 + 1e-6) * np.eye(C.dim), -1e-6 * middle), 1e-7)
    assert outer.is_subset(C.affine_map((1 + 1e-6) * np.eye(C.dim), -1e-6 * middle), 1e-7)


@pytest.mark.parametrize("name", ["negative unstable", "double integrator", "two unstable, tight", "two inputs"])
def test_states_just_outside_cannot_be_kept(name):
    """From a state 2 % outside, no input sequence stays in X for ever: checked over 60 steps with one LP."""
    A, B, X, U = CASES[name]
    A, B = np.array(A, float), np.array(B, float)
    n, m, N = len(A), np.array(B).shape[1], 60
    C = maximal_control_invariant_set(A, B, X, U).set
    for inside, factor in ((True, 0.999), (False, 1.02)):
        verdicts = []
        for v in C.vertices[:8]:
            middle = C.vertices.mean(axis=0)
            x = middle + factor * (v - middle)
            rows, right = [], []
            free, forced = x, np.zeros((n, N * m))
            for k in range(N):
                forced = A @ forced
                forced[:, k * m : (k + 1) * m] = B
                free = A @ free
                rows.append(X.A @ forced)
                right.append(X.b - X.A @ free)
            rows.append(np.kron(np.eye(N), U.A))
            right.append(np.tile(U.b, N))
            answer = linprog(np.zeros(N * m), A_ub=np.vstack(rows), b_ub=np.concatenate(right), bounds=(None, None))
            verdicts.append(answer.status == 0 and X.contains(x))
        assert all(verdicts) if inside else not any(verdicts)


@pytest.mark.parametrize("u_high", [0.5, 2])
@pytest.mark.parametrize("u_low", [-1, 0, -0.2])
@pytest.mark.parametrize("lam", [1.25, -1.25, 3.0, -2.0])
def test_interval_of_one_unstable_mode_is_exact(lam, u_low, u_high):
    C = maximal_control_invariant_set([[lam]], [[1.0]], box([-100], [100]), box([u_low], [u_high])).set
    lower, upper = C.bounding_box()
    powers = lam ** -np.arange(1.0, 400)
    ends = -powers[:, None] * [u_low, u_high]
    assert upper[0] == pytest.approx(ends.max(axis=1).sum(), abs=1e-6)
    assert lower[0] == pytest.approx(ends.min(axis=1).sum(), abs=1e-6)


@pytest.mark.parametrize("lam", [1.3, 1.8])
def test_complex_pair_is_bounded_by_its_support_function(lam, rng):
    A, B = lam * ROTATION, np.array([0.0, 1.0])
    C = maximal_control_invariant_set(A, B[:, None], box([-50, -50], [50, 50]), ONE).set
    directions = rng.normal(size=(20, 2))
    exact = np.zeros(20)
    back = np.eye(2)
    for _ in range(300):
        back = back @ np.linalg.inv(A)
        exact += np.abs(directions @ back @ B)
    np.testing.assert_allclose(C.support(directions), exact, rtol=1e-6)


def test_flat_sets_are_solved_on_their_own_plane():
    A, B = np.array([[1.2, 0.3, 0], [0.1, 0.5, 0.2], [0, 0.1, 1.1]]), np.array([[1.0, 0], [1, 1], [0, 1]])
    U = box([-1, -1], [1, 1])
    result = maximal_control_invariant_set(A, B, box([-1, 0, -1], [1, 0, 1]), U)
    assert (result.status, result.set.affine_dim) == (Status.CONVERGED, 2)
    assert violation_by_highs(A, B, result.set, U, np.zeros((1, 3))) <= 1e-8
    # on x2 = 0 the input must cancel 0.1 x1 + 0.2 x3, which leaves x1+ = 1.1 x1 − 0.2 x3 − v, x3+ = 1.1 x3 + v
    A2, B2 = np.array([[1.1, -0.2], [0, 1.1]]), np.array([[-1.0], [1.0]])
    joint = np.array([[-0.1, -0.2], [0.1, 0.2]])
    reference = box([-1, -1], [1, 1])
    for _ in range(400):  # plain recursion with u = (−0.1 x1 − 0.2 x3 − v, v)
        lifted = reference.preimage(np.hstack([A2, B2])).intersection(
            Polytope(np.vstack([np.column_stack([joint, [-1, 1]]), [[0, 0, 1], [0, 0, -1]]]), np.ones(4))
        )
        smaller = lifted.projection([0, 1]).intersection(reference).minimal()
        if reference.is_subset(smaller, 1e-11):
            break
        reference = smaller
    assert result.set.projection([0, 2]).volume == pytest.approx(reference.volume, rel=1e-5)


def test_an_unstable_mode_without_input_leaves_only_the_stable_subspace():
    result = maximal_control_invariant_set([[1.2, 0.3], [0, 1.5]], [[1], [0]], box([-1, -1], [1, 1]), ONE)
    assert result.status is Status.CONVERGED
    np.testing.assert_allclose(np.abs(result.set.vertices), [[1, 0], [1, 0]], atol=1e-7)
    point = maximal_control_invariant_set([[2.0]], [[1.0]], box([0], [1]), box([0], [1])).set
    np.testing.assert_allclose(point.vertices, [[0.0]], atol=1e-7)


NOISE = {
    "small": (np.eye(2), box([-0.1, -0.1], [0.1, 0.1])),
    "one channel, not centred": (np.array([[1.0], [0.3]]), box([-0.1], [0.2])),
    "hexagon": (
        np.eye(2),
        Polytope.from_vertices(0.1 * np.array([[1, 0], [0.5, 1], [-0.5, 1], [-1, 0], [-0.5, -1], [0.5, -1]])),
    ),
}


@pytest.mark.parametrize("name", NOISE)
def test_robust_sets_are_invariant_at_every_vertex_of_the_disturbance(name):
    E, W = NOISE[name]
    A, B = np.array([[1.2, 0.5], [0, 0.8]]), np.array([[0.5], [1.0]])
    X = box([-5, -5], [5, 5])
    robust = maximal_control_invariant_set(A, B, X, ONE, E=E, W=W)
    nominal = maximal_control_invariant_set(A, B, X, ONE)
    assert robust.status is Status.CONVERGED
    assert robust.certificate.gap <= 1e-7
    assert violation_by_highs(A, B, robust.set, ONE, W.vertices @ E.T) <= 1e-9
    assert robust.set.is_subset(nominal.outer)
    assert robust.set.volume < 0.999 * nominal.set.volume
    assert robust.set.is_subset(robust.outer)


def test_robust_interval_is_exact():
    """|x| <= s is robust for x+ = 2x + u + w, |w| <= r, iff 2s − 1 + r <= s and s >= r."""
    for r, half in ((0.0, 1.0), (0.3, 0.7), (0.49, 0.51), (0.51, None), (2.0, None)):
        result = maximal_control_invariant_set([[2.0]], [[1.0]], box([-5], [5]), ONE, W=box([-r], [r]))
        if half is None:
            assert result.status is Status.EMPTY
            assert result.set.is_empty
            assert "shrink W" in result.status.advice
        else:
            assert result.set.bounding_box()[1][0] == pytest.approx(half, rel=1e-6)


def test_an_iteration_limit_returns_an_invariant_inner_set_and_advice():
    A, B = np.array([[1.0, 1], [0, 1]]), np.array([[0.5], [1.0]])
    X, U = box([-25, -5], [25, 5]), box([-0.1], [0.1])
    limited = maximal_control_invariant_set(A, B, X, U, max_iterations=3)
    full = maximal_control_invariant_set(A, B, X, U)
    assert limited.status is Status.ITERATION_LIMIT
    assert "max_iterations" in limited.status.advice
    assert limited.certificate.gap > 1e-3
    assert violation_by_highs(A, B, limited.set, U, np.zeros((1, 2))) <= 1e-9
    assert not limited.set.is_empty
    assert limited.set.is_subset(full.outer)
    assert full.set.is_subset(limited.outer)


def test_a_facet_limit_says_so_and_still_returns_an_invariant_set():
    A, B = np.diag([1.3, 1.5, 1.8]), np.ones((3, 1))
    result = maximal_control_invariant_set(A, B, box([-9] * 3, [9] * 3), ONE, max_facets=60)
    assert result.status is Status.FACET_LIMIT
    assert "max_facets" in result.status.advice
    assert violation_by_highs(A, B, result.set, ONE, np.zeros((1, 3))) <= 1e-9


def test_a_marginal_mode_without_input_is_not_called_invariant():
    A = np.array([[np.cos(1), -np.sin(1)], [np.sin(1), np.cos(1)]])
    result = maximal_control_invariant_set(A, np.zeros((2, 1)), box([-1, -1], [1, 1]), ONE, max_iterations=60)
    assert result.status in (Status.ITERATION_LIMIT, Status.FACET_LIMIT)
    assert result.set.is_empty
    assert np.pi < result.outer.volume < 1.01 * np.pi  # the true set, a disc, lies inside


def test_unbounded_constraints():
    everything = Polytope(np.zeros((0, 2)), [])
    result = maximal_control_invariant_set([[1, 1], [0, 1]], [[0], [1]], everything, ONE)
    assert result.status is Status.CONVERGED
    assert result.set.contains([1e9, -1e9])
    strip = Polytope([[1.0, 0], [-1, 0]], [1, 1])  # the free direction is unstable, and nothing asks it to stay
    result = maximal_control_invariant_set([[0.5, 0], [0, 2]], [[0], [1]], strip, ONE)
    assert result.status is Status.CONVERGED
    assert result.set.contains([0.99, 1e9])
    assert not result.set.contains([1.01, 0])
    result = maximal_control_invariant_set([[1.2, 1], [0, 0.5]], [[0], [1]], strip, ONE)  # becomes bounded
    assert result.status is Status.CONVERGED
    assert (
        violation_by_highs(np.array([[1.2, 1], [0, 0.5]]), np.array([[0.0], [1]]), result.set, ONE, np.zeros((1, 2)))
        <= 1e-9
    )
    half = maximal_control_invariant_set(
        [[1, 1], [0, 1]], [[0], [1]], Polytope([[1.0, 0]], [1.0]), ONE, max_iterations=12
    )
    assert half.status is Status.OUTER_ONLY
    assert half.set.is_empty


@pytest.mark.parametrize("factor", [0.5, 0.9, 1.0])
def test_a_half_space_with_infinitely_many_facets_is_an_outer_set_and_no_exception(factor):
    A, B, half = factor * np.array([[0.8, 0.5], [0.5, 0.6]]), np.array([[0.5], [1]]), Polytope([[1.0, 0]], [5.0])
    result = maximal_control_invariant_set(A, B, half, ONE)
    # Where facets become finer than the tolerance, an invariant set may be found, which is then not called maximal.
    assert result.status in (Status.OUTER_ONLY, Status.NOT_MAXIMAL)
    assert result.set.is_empty is (result.status is Status.OUTER_ONLY)
    if not result.set.is_empty:
        F, g = result.set.A, result.set.b
        for x in result.set.intersection(Polytope.from_bounds([-100, -100], [100, 100])).vertices:
            rows = np.c_[F @ B, -np.ones(len(F))]
            best = linprog([0, 1], A_ub=rows, b_ub=g - F @ A @ x, bounds=[(-1, 1), (None, None)])
            assert best.x[1] <= 1e-8 * 100
        assert result.set.is_subset(result.outer)
    boxed = half.intersection(Polytope.from_bounds([-100, -100], [100, 100]))
    assert maximal_control_invariant_set(A, B, boxed, ONE).set.is_subset(result.outer)


@pytest.mark.long
@pytest.mark.quick(7)
@pytest.mark.parametrize("seed", range(12))
def test_random_systems(seed):
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.5, 1.3) / np.abs(np.linalg.eigvals(A)).max()
    unstable = np.sum(np.abs(np.linalg.eigvals(A)) > 1)
    B = rng.normal(size=(n, m))
    scale = 10 ** rng.uniform(-3, 3, n)
    A, B = A * scale[:, None] / scale, B * scale[:, None]
    X, U = box(-scale * rng.uniform(1, 3, n), scale * rng.uniform(1, 3, n)), box(-np.ones(m), rng.uniform(0.2, 2, m))
    result = maximal_control_invariant_set(A, B, X, U, max_facets=300)
    assert violation_by_highs(A, B, result.set, U, np.zeros((1, n))) <= 1e-8
    assert result.set.is_subset(result.outer)
    if result.status is Status.ITERATION_LIMIT:  # a slow mode: |λ| = 1.019 needs about 1000 steps
        assert result.iterations >= 500
        assert np.min(np.abs(np.abs(np.linalg.eigvals(A)) - 1)) < 0.02
    else:
        assert result.status is Status.CONVERGED or (unstable > 1 and result.status is Status.FACET_LIMIT)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_singular_or_uncontrolled_rest_is_not_lost_to_rounding(scale):
    """Unstable modes without input leave a line; what remains there is zero but for rounding."""
    for A in ([[-0.5, 1.0], [0.5, -1.0]], [[0.5, 0, -1.32], [1.9, -0.5, -0.4], [1.515, 0, -0.5]]):
        n = len(A)
        s = scale ** np.arange(n)
        A = np.array(A) * s[:, None] / s
        result = maximal_control_invariant_set(A, np.zeros((n, 1)), box(-s, 2 * s), ONE)
        assert (result.status, result.set.affine_dim) == (Status.CONVERGED, 1)
        assert (
            violation_by_highs(
                A / s[:, None] * s, np.zeros((n, 1)), result.set.affine_map(np.diag(1 / s)), ONE, np.zeros((1, n))
            )
            <= 1e-8
        )


def test_needed_rows_survive_between_two_inputs():
    """A random two-input robust case on which an outside redundancy test dropped rows: checked at every vertex."""
    A = np.array([[0.37, -0.11, -0.97], [0.89, -0.02, 2.91], [1.21, 0.26, 0.05]])
    B = np.array([[-0.78, 0.08], [-1.23, 0.36], [3.17, -1.28]])
    X, U = box([-2.2, -2.2, -2.9], [2.3, 3.0, 1.2]), box([-0.73, -0.88], [0.26, 1.76])
    W = box([-0.02] * 3, [0.03] * 3)
    result = maximal_control_invariant_set(A, B, X, U, W=W)
    assert result.status is Status.CONVERGED
    assert violation_by_highs(A, B, result.set, U, W.vertices) <= 1e-9
