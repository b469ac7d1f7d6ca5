"""The answer does not depend on units, on the order of rows or states, or on rows that add nothing."""

import numpy as np
import pytest
from mpc_problems import in_other_units
from plants import box

from mpc import LinearMPC, NotStabilisableError, OffsetFreeMPC, Status, lqr


def random_problem(rng):
    """(controller data, state) of a small problem whose state is often infeasible."""
    n, m, N = (int(rng.integers(low, high)) for low, high in ((2, 5), (1, 3), (3, 12)))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.7, 1.3) / np.abs(np.linalg.eigvals(A)).max()
    data = dict(A=A, B=rng.normal(size=(n, m)), Q=np.eye(n), R=0.1 * np.eye(m), horizon=N, X=box(5 * np.ones(n)),
                U=box(np.ones(m)))  # fmt: skip
    if rng.random() < 0.2:
        data["terminal_set"] = box(np.zeros(n))
    if rng.random() < 0.2:
        data["soft"] = (100.0, 1e3)
    return data, rng.uniform(-6, 6, n)


@pytest.mark.long
def test_plans_are_the_same_in_other_units():
    statuses = set()
    for i in range(60):
        rng = np.random.default_rng([3, i])
        data, x = random_problem(rng)
        units = (
            10.0 ** rng.uniform(-8, 8, len(x)),
            10.0 ** rng.uniform(-8, 8, data["B"].shape[1]),
            10.0 ** rng.uniform(-12, 12),
        )
        try:
            plan = LinearMPC(**data).solve(x)
        except NotStabilisableError:
            continue
        other_data, other_x, _ = in_other_units(data, x, {}, units)
        other = LinearMPC(**other_data).solve(other_x)
        assert other.status is plan.status
        np.testing.assert_allclose(other.inputs[0] * units[1], plan.inputs[0], atol=1e-5)
        statuses.add(plan.status)
    assert statuses == {Status.SOLVED, Status.SOFTENED}


@pytest.mark.parametrize("cost", [1e-12, 1e-6, 1e6, 1e12])
def test_small_and_large_costs_keep_the_relaxation(cost):
    A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
    for units in (1.0, 1e-6):
        plan = LinearMPC(A, B / units, Q=cost * np.eye(2), R=[[0.1 * cost]], horizon=10,
                         X=box([5 / units, 5 / units]), U=box([1])).solve([4.9 / units, 3.0 / units])  # fmt: skip
        assert plan.status is Status.SOFTENED
        assert plan.violation * units == pytest.approx(4.4, rel=1e-3)


def test_rows_shuffled_repeated_far_away_or_weakly_redundant_change_nothing():
    for i in range(20):
        rng = np.random.default_rng([4, i])
        data, x = random_problem(rng)
        try:
            plan = LinearMPC(**data).solve(x)
        except NotStabilisableError:
            continue
        X, order = data["X"], rng.permutation(len(data["X"].b))
        more = box(np.ones(len(x)))
        more.A = np.vstack([X.A[order], 3.0 * X.A[:2], X.A[:2], np.ones((1, len(x)))])
        more.b = np.concatenate([X.b[order], 3.0 * X.b[:2], 1e12 * X.b[:2], [X.b[: len(x)].sum()]])
        other = LinearMPC(**(data | {"X": more})).solve(x)
        assert other.status is plan.status
        np.testing.assert_allclose(other.inputs[0], plan.inputs[0], atol=1e-5)


def test_regulators_are_the_same_in_other_units_and_coordinates():
    for i in range(60):
        rng = np.random.default_rng([5, i])
        n, m = int(rng.integers(1, 6)), int(rng.integers(1, 4))
        A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
        Q, R = np.diag(rng.uniform(0.1, 10, n)), np.diag(rng.uniform(0.1, 10, m))
        K, _ = lqr(A, B, Q=Q, R=R)
        sx, su, c = 10.0 ** rng.uniform(-8, 8, n), 10.0 ** rng.uniform(-8, 8, m), 10.0 ** rng.uniform(-12, 12)
        other, _ = lqr(
            A / sx[:, None] * sx, B / sx[:, None] * su, Q=Q * np.outer(sx, sx) / c, R=R * np.outer(su, su) / c
        )
        np.testing.assert_allclose(other * su[:, None] / sx, K, rtol=1e-6, atol=1e-9 * np.abs(K).max())
        T = rng.normal(size=(n, n)) + 3 * np.eye(n)
        sheared, _ = lqr(T @ A @ np.linalg.inv(T), T @ B, Q=np.linalg.inv(T).T @ Q @ np.linalg.inv(T), R=R)
        np.testing.assert_allclose(sheared @ T, K, rtol=1e-5, atol=1e-7 * np.abs(K).max())


def test_expensive_control_is_not_taken_for_an_unstabilisable_pair():
    K, _ = lqr([[1.2]], [[1.0]], Q=1.0, R=1e16)
    assert K[0, 0] == pytest.approx(1.2 - 1 / 1.2, rel=1e-6)  # the limit mirrors the eigenvalue at the unit circle


def test_explanations_and_targets_are_the_same_in_other_units():
    A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
    data = dict(A=A, B=B, Q=np.eye(2), R=[[0.1]], horizon=10, X=box([5, 5]), U=box([1]))
    base = LinearMPC(**data)
    why = base.explain([4.9, 3.0])
    target = OffsetFreeMPC(base, [[1.0, 0.0]], disturbance=[0.05, 0.1]).nearest_target([1.0])
    for units in ((1e-8, 1e8, 1e6, 1e-12), (1e8, 1e-4, 1e-8, 1e12), (1e-7, 1e-7, 1e7, 1.0)):
        sx, su, c = np.array(units[:2]), np.array(units[2:3]), units[3]
        other_data, x, _ = in_other_units(data, np.array([4.9, 3.0]), {}, (sx, su, c))
        other = LinearMPC(**other_data)
        there = other.explain(x)
        assert there.conflict_rows == why.conflict_rows
        assert [v.row for v in there.violations] == [v.row for v in why.violations]
        np.testing.assert_allclose([v.amount for v in there.violations], [v.amount for v in why.violations], rtol=1e-4)
        controller = OffsetFreeMPC(other, [[sx[0], 0.0]], disturbance=np.array([0.05, 0.1]) / sx)
        found = controller.nearest_target([1.0])
        assert found.steady
        np.testing.assert_allclose(found.state * sx, target.state, atol=1e-5)
        np.testing.assert_allclose(found.input * su, target.input, atol=1e-5)


def test_states_in_another_order_change_nothing():
    for i in range(10):
        rng = np.random.default_rng([6, i])
        data, x = random_problem(rng)
        order = rng.permutation(len(x))
        moved = data | {"A": data["A"][np.ix_(order, order)], "B": data["B"][order]}
        try:
            plan = LinearMPC(**data).solve(x)
        except NotStabilisableError:
            continue
        other = LinearMPC(**moved).solve(x[order])
        assert other.status is plan.status
        np.testing.assert_allclose(other.inputs[0], plan.inputs[0], atol=1e-5)
