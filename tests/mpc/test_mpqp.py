"""The partition: counts known from elsewhere, optimality everywhere, no holes, no overlap, and hard cases."""

import numpy as np
import pytest
from online_qp import minimiser
from partitions import integrator, law_is_optimal_on_samples, membership, stacked_integrators
from plants import box, double_integrator, suspension
from random_problems import random_plant
from slow_exploration import solve_slowly

from mpc import InputError, LinearMPC, MPQPStatus, solve_mpqp


def scaled_suspension(N):
    A, B, _ = suspension()
    sx = np.array([0.25, 2.5, 0.5, 2.5])
    return LinearMPC(A * sx / sx[:, None], 1000 * B / sx[:, None], Q=np.eye(4), R=[[0.1]], horizon=N,
                     X=box(np.ones(4)), U=box([1]))  # fmt: skip


# PPOPT 1.6.12 (serial geometric, graph and combinatorial algorithms), pympc and two independent prototypes agree
@pytest.mark.parametrize(
    ("mpc", "regions"),
    [(integrator(2, 0.1), 9), (integrator(5, 0.1), 31), (integrator(10, 0.1), 43), (integrator(20, 0.1), 43),
     (integrator(5, 1.0), 13), (scaled_suspension(3), 43)],
    ids=["DI N=2", "DI N=5", "DI N=10", "DI N=20", "DI N=5 R=1", "suspension N=3"],
)  # fmt: skip
def test_region_counts_agree_with_the_literature_of_solvers(mpc, regions):
    partition = solve_mpqp(mpc.build(), mpc.X)
    assert partition.status is MPQPStatus.COMPLETE
    assert len(partition) == regions


@pytest.mark.long
@pytest.mark.quick(9)
@pytest.mark.parametrize(
    "mpc", [integrator(3, 0.1), integrator(8, 1.0), scaled_suspension(2), scaled_suspension(5),
            *(random_plant(seed) for seed in (2, 3, 6, 8, 11, 12, 14, 19))],
)  # fmt: skip
def test_compiled_and_numpy_explorations_find_the_same_active_sets(mpc):
    fast, slow = (solve(mpc.build(), mpc.X) for solve in (solve_mpqp, solve_slowly))
    assert set(fast.active_sets) == set(slow.active_sets)
    assert len(fast.H) <= len(slow.H)  # the slow one may keep redundant rows of thin regions
    order = [fast.active_sets.index(active) for active in slow.active_sets]
    np.testing.assert_allclose(fast.law[order], slow.law, atol=1e-9)


@pytest.mark.long
@pytest.mark.quick(3)
@pytest.mark.parametrize("seed", range(20))
def test_law_is_optimal_covers_the_feasible_set_and_does_not_overlap(seed):
    mpc = random_plant(seed)
    problem = mpc.build()
    partition = solve_mpqp(problem, mpc.X)
    assert partition.status is MPQPStatus.COMPLETE
    theta = np.random.default_rng(100 + seed).uniform(-5, 5, size=(10_000, mpc.nx))
    inside = np.concatenate([membership(partition, part) for part in np.array_split(theta, 20)])
    region, covered = inside.argmin(axis=1), inside.min(axis=1) <= 1e-7
    # coverage, against the online solver
    online = [minimiser(problem, t) for t in theta]
    feasible = np.array([best is not None for best in online])
    assert np.mean(covered[feasible]) >= 0.9999
    assert not (covered & ~feasible & (inside.min(axis=1) < -1e-6)).any()
    # overlap
    assert np.mean((inside < -1e-6).sum(axis=1) > 1) < 0.01
    # primal
    both = covered & feasible
    law = partition.law[region[both]]
    z = np.einsum("nij,nj->ni", law[:, :, :-1], theta[both]) + law[:, :, -1]
    assert np.abs(z - np.array([best for best, b in zip(online, both) if b])).max() <= 1e-6
    # dual and the other optimality conditions
    multipliers = np.array([partition.multipliers(r) for r in range(len(partition))])[region[both]]
    y = np.einsum("nij,nj->ni", multipliers[:, :, :-1], theta[both]) + multipliers[:, :, -1]
    slack = problem.w + theta[both] @ problem.S.T - z @ problem.G.T
    force = np.maximum(1.0, np.abs(theta[both] @ problem.F.T).max(axis=1))
    assert (np.abs(z @ problem.H + theta[both] @ problem.F.T + y @ problem.G).max(axis=1) / force).max() <= 1e-6
    assert (-slack).max() <= 1e-6
    assert (-y / force[:, None]).max() <= 1e-6
    assert (np.abs(y * slack) / force[:, None]).max() <= 1e-6


@pytest.mark.long
def test_more_than_128_constraints():
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
    mpc = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=25, X=box([5, 5]), U=box([1]))
    problem = mpc.build()
    assert problem.m == 150
    partition = solve_mpqp(problem, mpc.X)
    assert partition.status is MPQPStatus.COMPLETE
    assert any(max(active, default=0) > 128 for active in partition.active_sets)
    law_is_optimal_on_samples(mpc, partition, 500)


def test_duplicate_and_touching_constraints_change_nothing():
    plain = integrator(4, 0.1)
    more = box([5, 5])
    # every row twice in other units, and one row that touches the box in a corner only
    more.A = np.vstack([more.A, 3 * more.A, [[1.0, 1.0]]])
    more.b = np.concatenate([more.b, 3 * more.b, [10.0]])
    A, B = double_integrator()
    doubled = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=4, X=more, U=box([1]))
    partition = solve_mpqp(doubled.build(), plain.X)
    assert len(partition) == len(solve_mpqp(plain.build(), plain.X))
    law_is_optimal_on_samples(doubled, partition, 1000)


@pytest.mark.long
def test_dependent_active_constraints_are_exchanged():
    # three inputs act on two states through dependent rows: many active sets have no full rank
    A = np.array([[1.0, 1.0], [0.0, 1.0]])
    B = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    mpc = LinearMPC(A, B, Q=np.eye(2), R=0.1 * np.eye(3), horizon=2, X=box([2, 2]), U=box([1, 1, 1]))
    partition = solve_mpqp(mpc.build(), mpc.X)
    assert partition.status is MPQPStatus.COMPLETE
    law_is_optimal_on_samples(mpc, partition, 2000)
    assert set(partition.active_sets) == set(solve_slowly(mpc.build(), mpc.X).active_sets)


def symmetric(B, **more):
    data = dict(Q=np.eye(2), R=np.eye(B.shape[1]), horizon=3, X=box([2, 2]), U=box(np.ones(B.shape[1]))) | more
    return LinearMPC(np.eye(2), B, **data)


@pytest.mark.quick(7)
@pytest.mark.parametrize(
    ("mpc", "theta_set"),
    [
        (integrator(5, 0.0), box([5, 5])),
        (integrator(5, 0.1, P=np.zeros((2, 2))), box([5, 5])),
        (integrator(5, 0.1, rate_limit=1.0), box([5, 5, 1])),  # the rate limit coincides with the bounds
        (integrator(5, 0.1, soft=(10.0, 10.0)), box([5, 5])),
        (integrator(5, 0.1, blocks=(1, 1, 3)), box([5, 5])),
        (integrator(5, 0.1, terminal_set=box([0.5, 0.5])), box([5, 5])),
        (integrator(5, 0.1), box([10, 10])),  # states that violate X now
        (stacked_integrators(3), box(5 * np.ones(4))),
        (symmetric(np.eye(2)), box([2, 2])),
        (symmetric(np.eye(2), U=box([1, 1]), terminal_set=box([1, 1])), box([2, 2])),
    ],
    ids=["R=0", "P=0", "rate", "soft", "blocks", "terminal", "larger set", "stacked", "identity", "identity, terminal"],
)
def test_structured_and_degenerate_problems(mpc, theta_set):
    partition = solve_mpqp(mpc.build(), theta_set)
    assert partition.status is MPQPStatus.COMPLETE
    law_is_optimal_on_samples(mpc, partition, 1500)
    spread = np.random.default_rng(1).uniform(-1, 1, size=(1500, partition.problem.nt))
    inside = membership(partition, partition.centre + partition.half * spread)
    assert np.mean((inside < -1e-6).sum(axis=1) > 1) < 0.01


@pytest.mark.parametrize("half", [1e-3, 1e-5])
def test_nearly_flat_terminal_set_gives_thin_regions(half):
    mpc = integrator(4, 0.1, terminal_set=box([half, half]))
    partition = solve_mpqp(mpc.build(), mpc.X)
    assert partition.status is MPQPStatus.COMPLETE
    law_is_optimal_on_samples(mpc, partition, 2000)


@pytest.mark.parametrize("scale", [1e-5, 1e5])
def test_counts_do_not_depend_on_units(scale):
    A, B = double_integrator()
    sx = np.array([scale, 1.0])
    mpc = LinearMPC(A * sx[:, None] / sx, B * sx[:, None] / scale, Q=np.eye(2) / sx**2, R=[[0.1 / scale**2]], horizon=5,
                    X=box(5 * sx), U=box([scale]))  # fmt: skip
    assert len(solve_mpqp(mpc.build(), mpc.X)) == 31


def test_a_reference_left_open_becomes_a_parameter():
    mpc = integrator(3, 0.1)
    fixed = mpc.build("u_ref", "x_ref").fix(u_ref=np.zeros(3), x_ref=np.tile([1.0, 0.0], 4))
    partition = solve_mpqp(fixed, mpc.X)
    x = np.array([-1.0, 0.5])
    z = partition.law[membership(partition, x[None]).argmin()] @ np.append(x, 1)
    np.testing.assert_allclose(fixed.inputs(z, x), mpc.solve(x, x_ref=[1.0, 0.0]).inputs, atol=1e-8)


def test_limits_are_reported_with_advice():
    mpc = integrator(10, 0.1)
    some = solve_mpqp(mpc.build(), mpc.X, max_regions=10)
    assert some.status is MPQPStatus.REGION_LIMIT
    assert len(some) == 10
    assert "max_regions" in some.status.advice
    late = solve_mpqp(random_plant(7).build(), random_plant(7).X, time_limit=1e-6)
    assert late.status is MPQPStatus.TIME_LIMIT
    assert 0 < len(late) < 1400


def test_the_numpy_path_knows_the_same_limits():
    mpc = integrator(5, 0.1)
    assert solve_slowly(mpc.build(), mpc.X, max_regions=5).status is MPQPStatus.REGION_LIMIT
    assert solve_slowly(mpc.build(), mpc.X, time_limit=1e-9).status is MPQPStatus.TIME_LIMIT


@pytest.mark.parametrize("solve", [solve_mpqp, solve_slowly])
def test_an_infeasible_parameter_set_is_a_status(solve):
    far = box([0.5, 0.5])
    far.b = far.b + np.array([100.0, 0.0, -99.0, 0.0])  # x1 around 100
    partition = solve(integrator(3, 0.1).build(), far)
    assert partition.status is MPQPStatus.INFEASIBLE
    assert len(partition) == 0
    assert "explain" in partition.status.advice


def with_bounds(A, b):
    result = box([1.0])
    result.A, result.b = np.array(A, dtype=float), np.array(b, dtype=float)
    return result


@pytest.mark.parametrize(
    ("theta_set", "message"),
    [
        (box([1.0]), r"theta_set.A: got shape \(2, 1\), expected \(any, 2\)"),
        (with_bounds([[1, 0], [-1, 0], [0, 1]], [1, 1, 1]), "theta_set: got a set unbounded in parameter 1"),
        (with_bounds([[1, 0], [-1, 0], [0, 1], [0, -1]], [1, -1, 1, 1]), "parameter 0 in .* empty or flat"),
        (with_bounds([[1, 1], [-1, -1], [1, -1], [-1, 1]], [-1, -1, 1, 1]), "theta_set: got an empty set"),
        (with_bounds([[1, 0], [-1, 0], [0, 1], [0, -1]], [1, 1, 1, np.nan]), "theta_set.b: got nan at index"),
    ],
)
def test_bad_parameter_sets_are_refused(theta_set, message):
    with pytest.raises(InputError, match=message):
        solve_mpqp(integrator(2, 0.1).build(), theta_set)


@pytest.mark.long
def test_terminal_equality_is_eliminated():
    mpc = integrator(6, 0.1, terminal_set=box([0.0, 0.0]))
    problem = mpc.build()
    partition = solve_mpqp(problem, mpc.X)
    assert partition.status is MPQPStatus.COMPLETE
    law_is_optimal_on_samples(mpc, partition, 2000)
    assert set(partition.active_sets) == set(solve_slowly(problem, mpc.X).active_sets)
    centre = np.zeros(2)
    region = int(membership(partition, centre[None]).argmin())
    theta = np.array([1e-3, -2e-3])
    z = partition.law[region] @ np.append(theta, 1)
    y = partition.multipliers(region) @ np.append(theta, 1)
    np.testing.assert_allclose(problem.H @ z + problem.F @ theta + problem.f + problem.G.T @ y, 0, atol=1e-9)
    np.testing.assert_allclose(problem.states(z, theta)[-1], 0, atol=1e-12)
    assert mpc.explicit()([1.0, 0.0]) == pytest.approx(mpc([1.0, 0.0]), abs=1e-9)


def test_an_equality_that_leaves_no_freedom_is_refused_by_name():
    for N, message in ((2, "leaves no input free"), (1, "cannot be met by the inputs")):
        mpc = integrator(N, 0.1, terminal_set=box([0.0, 0.0]))
        with pytest.raises(InputError, match=message):
            solve_mpqp(mpc.build(), mpc.X)


def test_limits_must_be_positive():
    mpc = integrator(2, 0.1)
    with pytest.raises(InputError, match="max_regions: got 0, expected a whole number, at least 1"):
        solve_mpqp(mpc.build(), mpc.X, max_regions=0)
