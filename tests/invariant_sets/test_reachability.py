"""Predecessor, controllable and reachable sets."""

import numpy as np
import pytest
from scipy.optimize import linprog

from invariant_sets import Polytope, Status, controllable_set, predecessor_set, reachable_set

box = Polytope.from_bounds
A, B = np.array([[1.0, 1], [0, 1]]), np.array([[0.5], [1.0]])
X, U, ORIGIN = box([-5, -5], [5, 5]), box([-1], [1]), box([0, 0], [0, 0])


@pytest.mark.long
def test_predecessor_contains_exactly_the_states_with_a_good_input(rng):
    S = Polytope.from_vertices([[1, 0], [0, 1], [-1, 0], [0, -1]])
    W = box([-0.1, -0.1], [0.1, 0.2])
    for noise, arguments in (([[0.0, 0.0]], {}), (W.vertices, {"W": W})):
        result = predecessor_set(A, B, S, U, **arguments)
        assert result.status is Status.CONVERGED
        for x in rng.uniform(-3, 3, (150, 2)):
            right = S.b - S.A @ A @ x - (S.A @ np.transpose(noise)).max(axis=1)
            feasible = linprog([0], A_ub=S.A @ B, b_ub=right, bounds=[(-1, 1)]).status == 0
            assert result.set.contains(x, tol=1e-7) == feasible


def test_predecessor_of_a_singular_system_is_everything_or_nothing():
    zero = np.zeros((2, 2))
    assert predecessor_set(zero, B, box([-1, -1], [1, 1]), U).set.contains([1e6, -1e6])
    assert predecessor_set(zero, B, box([3, 3], [4, 4]), U).status is Status.EMPTY


@pytest.mark.parametrize("steps", [1, 2, 3, 6])
def test_controllable_to_the_origin_is_the_zonotope_of_the_inputs(steps, rng):
    result = controllable_set(A, B, box([-99, -99], [99, 99]), U, ORIGIN, steps)
    D = rng.normal(size=(30, 2))
    powers = [np.linalg.matrix_power(np.linalg.inv(A), k) @ B for k in range(1, steps + 1)]
    np.testing.assert_allclose(result.set.support(D), sum(np.abs(D @ G).sum(axis=1) for G in powers), atol=1e-7)


@pytest.mark.parametrize("steps", [1, 2, 3, 6])
def test_reachable_from_the_origin_is_the_zonotope_of_inputs_and_disturbances(steps, rng):
    W = box([-0.1, -0.2], [0.1, 0.2])
    result = reachable_set(A, B, ORIGIN, U, steps, W=W)
    D = rng.normal(size=(30, 2))
    exact = sum(
        np.abs(D @ np.linalg.matrix_power(A, k) @ np.hstack([B, np.diag([0.1, 0.2])])).sum(axis=1) for k in range(steps)
    )
    np.testing.assert_allclose(result.set.support(D), exact, atol=1e-7)
    assert result.certificate.violation <= 1e-9


def test_zero_steps_is_the_set_itself_within_the_constraints():
    wide = box([-9, -1], [1, 1])
    assert controllable_set(A, B, X, U, wide, 0).set.equals(wide.intersection(X))
    assert reachable_set(A, B, wide, U, 0, X=X).set.equals(wide.intersection(X))


@pytest.mark.long
def test_constraints_hold_on_the_way(rng):
    narrow = box([-5, -0.5], [5, 0.5])
    result = controllable_set(A, B, narrow, U, ORIGIN, 4)
    assert result.set.is_subset(narrow)
    assert result.set.is_subset(controllable_set(A, B, X, U, ORIGIN, 4).set)
    for x in result.set.sample(20, rng=rng):
        for S in (controllable_set(A, B, narrow, U, ORIGIN, k).set for k in (3, 2, 1, 0)):
            answer = linprog(
                [0],
                A_ub=np.vstack([S.A @ B, S.A_eq @ B, -S.A_eq @ B]),
                b_ub=np.r_[S.b - S.A @ A @ x, S.b_eq - S.A_eq @ A @ x, S.A_eq @ A @ x - S.b_eq] + 1e-8,
                bounds=[(-1, 1)],
            )
            assert answer.status == 0
            x = A @ x + B @ answer.x


def test_two_inputs_and_three_states(rng):
    A3, B3 = rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    U3 = Polytope.from_vertices([[1, 0], [-1, 1], [-1, -1]])
    S = box([-1] * 3, [1] * 3)
    result = predecessor_set(A3, B3, S, U3)
    for x in rng.uniform(-3, 3, (100, 3)):
        feasible = (
            linprog(
                [0, 0], A_ub=np.vstack([S.A @ B3, U3.A]), b_ub=np.r_[S.b - S.A @ A3 @ x, U3.b], bounds=(None, None)
            ).status
            == 0
        )
        assert result.set.contains(x, tol=1e-7) == feasible


def test_no_steps_ask_nothing_of_the_inputs():
    A = np.array([[1.0, 0.1], [0.0, 1.0]])
    B = np.array([[0.0], [0.1]])
    start = Polytope.from_bounds([-1, -1], [1, 1])
    nothing = Polytope.empty(1)
    for result in (reachable_set(A, B, start, nothing, 0), controllable_set(A, B, start, nothing, start, 0)):
        assert result.status is Status.CONVERGED
        assert result.set.equals(start)
    for result in (reachable_set(A, B, start, nothing, 1), controllable_set(A, B, start, nothing, start, 1)):
        assert result.status is Status.EMPTY
        assert result.set.is_empty


def test_what_is_found_before_the_time_limit_is_reached_under_a_disturbance_that_is_never_zero():
    W = box([0.5, 0.5], [0.6, 0.7])
    found = reachable_set(A, B, box([-1, -1], [1, 1]), U, 3, W=W, time_limit=1e-9)
    assert found.status is Status.TIME_LIMIT
    assert found.set.affine_dim == 2
    assert found.set.is_subset(reachable_set(A, B, box([-1, -1], [1, 1]), U, 3, W=W).set)


def test_a_system_without_inputs_is_stated_without_them():
    S = box([-1, -1], [1, 2])
    assert predecessor_set(A, None, S, None).set.equals(S.preimage(A))
    assert reachable_set(A, None, S, None, 2).set.equals(S.affine_map(A @ A))


def test_what_is_found_before_the_time_limit_can_be_steered_to_the_target(rng):
    A, B = 0.5 * rng.standard_normal((4, 4)), rng.standard_normal((4, 2))
    steps = 12
    found = controllable_set(A, B, ([-9.0] * 4, [9.0] * 4), ([-1.0] * 2, [1.0] * 2), ([-1.0] * 4, [1.0] * 4), steps,
                             time_limit=0.5)  # fmt: skip
    assert found.status is Status.TIME_LIMIT
    assert found.is_bounded
    assert "TIME_LIMIT, bounded set of dimension 4" in repr(found)
    forced = [np.zeros((4, 2 * steps))]
    free = [np.eye(4)]
    for k in range(steps):
        forced.append(A @ forced[-1])
        forced[-1][:, 2 * k : 2 * k + 2] += B
        free.append(A @ free[-1])
    M = np.vstack([sign * F for F in forced[1:] for sign in (1, -1)])
    ends = np.repeat([9.0] * (steps - 1) + [1.0], 8)
    for x in found.set.vertices[::20]:
        drift = np.concatenate([sign * (F @ x) for F in free[1:] for sign in (1, -1)])
        assert linprog(np.zeros(2 * steps), M, ends - drift + 1e-7, bounds=(-1, 1)).status == 0
