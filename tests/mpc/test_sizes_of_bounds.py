"""What size the bounds have decides what is near, equal and infeasible: one odd bound, or a far optimum, does not."""

import numpy as np
import pytest
from plants import box
from random_problems import problem_of
from slow_exploration import solve_slowly

from invariant_sets import Polytope
from mpc import InputError, LinearMPC, MPQPStatus, solve_mpqp

ONE = Polytope.from_bounds([-1.0], [1.0])


def least_norm(G, w, S, theta_set=ONE, f=None, H=None):
    """The partition of min ½ z'Hz + f'z, Gz <= w + S θ."""
    n = G.shape[1]
    f = np.zeros(n) if f is None else np.asarray(f, dtype=float)
    H = np.eye(n) if H is None else H
    return solve_mpqp(problem_of(H, np.zeros((n, S.shape[1])), f, G, np.asarray(w, dtype=float), S), theta_set)


def at(partition, theta):
    """z of the law at a parameter; None where there is no region."""
    point = np.atleast_1d(theta)
    t = (point - partition.centre) / partition.half
    rows = partition.scaled_rows
    outside = np.maximum.reduceat(rows[:, :-1] @ t - rows[:, -1], partition.offsets[:-1])
    r = int(outside.argmin())
    return partition.law[r] @ np.append(point, 1.0) if outside[r] <= 1e-7 else None


@pytest.mark.parametrize("rounded", [0.0, 1e-30, 0.1 + 0.2 - 0.3, 1e-12])
@pytest.mark.parametrize("solve", [solve_mpqp, solve_slowly])
def test_a_bound_that_is_zero_but_for_rounding_leaves_no_parameter_out(rounded, solve):
    G = np.vstack([np.eye(3), -np.eye(3), -np.ones((1, 3))])
    S = np.zeros((7, 1))
    S[-1] = -1.0
    w = np.concatenate([np.ones(3), np.full(3, rounded), [0.5]])
    problem = problem_of(np.eye(3), np.zeros((3, 1)), np.zeros(3), G, w, S)
    partition = solve(problem, Polytope.from_bounds([-1.0], [4.0]))
    assert partition.status is MPQPStatus.COMPLETE
    for theta in np.linspace(-0.9, 3.4, 20):
        np.testing.assert_allclose(at(partition, theta), np.full(3, max(theta - 0.5, 0.0) / 3), atol=1e-9)


@pytest.mark.parametrize("bound", [1e-3, 1e-5, 1e-7, 1e-9])
def test_one_small_bound_makes_nothing_infeasible(bound):
    """z1 + z2 <= 1 with z1, z2 >= ½ leaves one point for both, whatever bounds z3."""
    G = np.zeros((7, 4))
    G[0, :2] = 1.0
    G[1, 0] = G[2, 1] = G[4, 2] = G[6, 3] = -1.0
    G[3, 2] = G[5, 3] = 1.0
    S = np.zeros((7, 1))
    S[5] = 0.5
    partition = least_norm(G, [1.0, -0.5, -0.5, bound, 1.0, 0.2, 1.0], S)
    assert partition.status is MPQPStatus.COMPLETE
    np.testing.assert_allclose(at(partition, -0.9), [0.5, 0.5, 0.0, -0.25], atol=1e-8)
    np.testing.assert_allclose(at(partition, 0.9), [0.5, 0.5, 0.0, 0.0], atol=1e-8)


@pytest.mark.parametrize("unit", [1e-12, 1e-9, 1e-8, 1e-6, 1.0, 1e9])
def test_the_unit_of_the_variables_does_not_matter(unit):
    g = np.array([[0.3, 0.6, 0.9]])
    G = np.vstack([np.eye(3), -np.eye(3), -g])
    S = np.zeros((7, 1))
    S[-1] = -unit
    w = unit * np.concatenate([np.ones(3), np.zeros(3), [0.2]])
    partition = least_norm(G, w, S, Polytope.from_bounds([-1.0], [1.5]))
    plain = least_norm(G, w / unit, S / unit, Polytope.from_bounds([-1.0], [1.5]))
    assert (partition.status, len(partition)) == (MPQPStatus.COMPLETE, len(plain))
    np.testing.assert_allclose(at(partition, 1.2) / unit, at(plain, 1.2), atol=1e-8)


@pytest.mark.parametrize(("far", "width"), [(1e5, 1e-5), (1e6, 1e-5), (1e8, 1e-4), (1e9, 1e-2)])
def test_a_slab_is_no_equality_however_far_the_optimum_is(far, width):
    G = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    partition = least_norm(G, [width, 0.0, 1.0, 1.0], np.array([[0.0], [0.0], [1.0], [0.0]]), f=[far, -1.0])
    assert partition.status is MPQPStatus.COMPLETE
    np.testing.assert_allclose(at(partition, 0.5), [0.0, 1.0], atol=1e-3 * width)


@pytest.mark.parametrize("far", [1e6, 1e9, 1e10])
def test_rows_that_differ_in_the_parameter_are_no_duplicates_however_far_the_optimum_is(far):
    partition = least_norm(np.ones((2, 1)), [1.0, 1.0], np.array([[1.0], [-1.0]]), f=[-far])
    if partition.status is MPQPStatus.COMPLETE:
        np.testing.assert_allclose(at(partition, 0.5), [0.5], atol=1e-5)
    else:
        assert partition.status is MPQPStatus.INACCURATE
    assert far > 1e8 or partition.status is MPQPStatus.COMPLETE


@pytest.mark.parametrize(("far", "width"), [(1e3, 1e-5), (1e4, 1e-6), (1e5, 1e-5), (1e6, 1e-4)])
def test_a_law_lies_on_the_face_that_the_cost_asks_for_or_is_not_given(far, width):
    from scipy.optimize import linprog

    rng = np.random.default_rng(5)
    E = rng.normal(size=(2, 3))
    E /= np.linalg.norm(E, axis=1)[:, None]
    G = np.vstack([np.eye(3), -np.eye(3), E, -E])
    w = np.concatenate([np.ones(6), [width, width, 0.0, 0.0]])
    S = np.zeros((10, 1))
    S[6:8], S[8:] = 0.1, -0.1
    f = rng.normal(size=3)
    f *= far / np.linalg.norm(f)
    partition = least_norm(G, w, S, f=f)
    if partition.status is MPQPStatus.COMPLETE:
        right = w + 0.37 * S[:, 0]
        exact = linprog(f, G, right, bounds=[(None, None)] * 3, method="highs").x  # a vertex: the optimum is far
        np.testing.assert_allclose(at(partition, 0.37), exact, atol=0.1 * width)
    else:
        assert partition.status is MPQPStatus.INACCURATE


def test_rows_without_a_bound_are_left_out():
    G, S = np.vstack([np.eye(2), -np.eye(2)]), np.zeros((4, 1))
    cost = 3 * np.ones((2, 1))
    open_ended = solve_mpqp(problem_of(np.eye(2), cost, np.zeros(2), G, np.array([np.inf, 1.0, 1.0, 1.0]), S), ONE)
    without = solve_mpqp(problem_of(np.eye(2), cost, np.zeros(2), G[1:], np.ones(3), S[1:]), ONE)
    assert open_ended.status is MPQPStatus.COMPLETE
    assert len(open_ended) == len(without)
    assert {i for act in open_ended.active_sets for i in act} == {1, 2, 3}
    np.testing.assert_allclose(at(open_ended, -0.9), at(without, -0.9))


@pytest.mark.parametrize("name", ["w", "f", "G", "S", "F", "H"])
@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_data_that_are_not_finite_are_refused_by_name(name, value):
    data = {"H": np.eye(2), "F": np.ones((2, 1)), "f": np.zeros(2), "G": np.eye(2), "w": np.ones(2)}
    data["S"] = np.zeros((2, 1))
    data[name].flat[0] = value
    with pytest.raises(InputError, match=rf"problem: got {value} in {name} at \[0"):
        solve_mpqp(problem_of(*(data[key] for key in ("H", "F", "f", "G", "w", "S"))), ONE)


@pytest.mark.parametrize("constant", [-1e-17, -1e-15])
def test_a_row_of_zeros_with_a_rounded_bound_excludes_nothing(constant):
    G = np.vstack([np.eye(2), -np.eye(2), np.zeros((1, 2))])
    assert least_norm(G, [1.0, 1.0, 1.0, 1.0, constant], np.zeros((5, 1))).status is MPQPStatus.COMPLETE


def test_an_mpc_with_an_implied_equality_and_a_tiny_limit_has_a_law():
    U = Polytope([[1, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], [1, -0.5, -0.5, 1e-6, 1])
    A, B = np.array([[1, 0.1], [0, 1]]), np.array([[0, 0, 0], [0.1, -0.1, 0.1]])
    mpc = LinearMPC(A, B, Q=np.eye(2), R=np.eye(3), horizon=3, X=box([5.0, 5.0]), U=U)
    partition = solve_mpqp(mpc.build(), Polytope.from_bounds([-1.0, -0.5], [1.0, 0.5]))
    assert partition.status is MPQPStatus.COMPLETE


@pytest.mark.parametrize("unlimited", [1e7, 1e8, 4e8, 1e12])
def test_states_without_a_limit_that_matters_leave_the_limits_of_an_input_as_they_are(unlimited):
    """Most rows say 1e8; the limits of 0.05 and the rates of 0.02 are neither repeated rows nor equalities."""
    A, B = np.array([[1, 0.1, 0], [0, 1, 0.1], [0, 0, 0.9]]), np.array([[0], [0], [0.5]])
    half = np.array([1.0, 1.0, 1.0, 0.05])

    def law(X):
        mpc = LinearMPC(A, B, Q=np.eye(3), R=1.0, horizon=3, X=X, U=(-0.05, 0.05), P=np.eye(3), rate_limit=0.02)
        return solve_mpqp(mpc.build(), Polytope.from_bounds(-half, half))

    without, with_rows = law(None), law((-unlimited, unlimited))
    assert with_rows.status is MPQPStatus.COMPLETE
    assert len(with_rows) == len(without)
    for theta in np.random.default_rng(0).uniform(-1, 1, (40, 4)) * half:
        np.testing.assert_allclose(at(with_rows, theta)[0], at(without, theta)[0], atol=1e-7)


@pytest.mark.parametrize("rounded", [0.0, 1e-300, 0.1 + 0.2 - 0.3, 1e-16, 1e-13, 1e-9])
def test_most_bounds_may_be_zero_but_for_rounding(rounded):
    G = np.vstack([-np.eye(3), -np.ones((1, 3))])
    allocated = least_norm(G, [rounded, rounded, rounded, 0.2], np.array([[0.0], [0.0], [0.0], [-1.0]]))
    assert allocated.status is MPQPStatus.COMPLETE
    for theta in np.linspace(-0.9, 0.95, 12):
        np.testing.assert_allclose(at(allocated, theta), np.full(3, max(theta - 0.2, 0.0) / 3), atol=1e-8)
    wanted = np.random.default_rng(0).normal(size=(3, 2))
    G = np.vstack([-np.eye(3), np.ones((1, 3))])
    w, S = np.array([rounded, rounded, rounded, 1.0]), np.zeros((4, 2))
    square = Polytope.from_bounds([-1.0, -1.0], [1.0, 1.0])
    nearest = solve_mpqp(problem_of(np.eye(3), -wanted, np.zeros(3), G, w, S), square)
    assert (nearest.status, len(nearest)) == (MPQPStatus.COMPLETE, 6)


@pytest.mark.parametrize("small", [1e-3, 1e-5, 1e-7])
def test_one_large_variable_beside_many_small_ones_makes_nothing_infeasible(small):
    n = 10
    G = np.vstack([np.eye(n), -np.eye(n), np.eye(n)[:1] + np.eye(n)[1:2], -np.eye(n)[2:3]])
    w = np.concatenate([np.full(9, small), [1.0], np.full(9, small), [-0.5], [small], [0.2 * small]])
    w[n : n + 2] = -small / 2  # with z1 + z2 <= small that is an implied equality
    S = np.zeros((len(w), 1))
    S[-1] = 0.5 * small
    partition = least_norm(G, w, S)
    assert partition.status is MPQPStatus.COMPLETE
    np.testing.assert_allclose(at(partition, -0.3)[[0, 1, 9]], [small / 2, small / 2, 0.5], rtol=1e-6)


@pytest.mark.parametrize("width", [1e-7, 1e-5])
def test_a_nearly_locked_input_with_a_far_optimum_keeps_its_law_and_says_how_sure_it_is(width):
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005, 0.003], [0.1, 0.05]])
    limit = 1e-3
    U = Polytope.from_bounds([0.3 * limit, -limit], [(0.3 + width) * limit, limit])
    mpc = LinearMPC(A, B, Q=np.eye(2), R=0.01 * np.eye(2), horizon=3, U=U)
    partition = solve_mpqp(mpc.build(), Polytope.from_bounds([-1.0, -1.0], [1.0, 1.0]))
    assert partition.status in (MPQPStatus.COMPLETE, MPQPStatus.INACCURATE)
    assert len(partition)
    for theta in np.random.default_rng(0).uniform(-1, 1, (20, 2)):
        z = at(partition, theta)
        assert z is None or np.abs(z[0] - 0.3 * limit) <= 1.1 * width * limit


@pytest.mark.parametrize("gentle", [1.0, 100.0])
@pytest.mark.parametrize("rounded", [0.0, 0.1 + 0.2 - 0.3, 1e-12, 1e-10])
def test_an_input_of_one_sign_with_a_rounded_lower_bound_has_a_complete_law(gentle, rounded):
    A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]])
    mpc = LinearMPC(A, B, Q=np.eye(2), R=gentle, horizon=3, U=([-rounded], [1.0]))
    partition = solve_mpqp(mpc.build(), Polytope.from_bounds([-0.1, -0.1], [0.1, 0.1]))
    assert (partition.status, len(partition)) == (MPQPStatus.COMPLETE, 6)


@pytest.mark.parametrize(("dt", "limit"), [(1e-3, 1e-4), (5e-4, 1e-3), (1e-4, 1e-2)])
def test_an_input_that_is_weak_beside_the_states_is_not_silently_taken_for_locked(dt, limit):
    """Two triple integrators, sampled fast: the rows of the states dwarf those of the second input."""
    A = np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]])
    B = np.array([[dt**3 / 6], [dt**2 / 2], [dt]])
    A, B = np.kron(np.eye(2), A), np.kron(np.eye(2), B)
    mpc = LinearMPC(A, B, Q=np.eye(6), R=1e-2, horizon=3, U=([-1.0, -limit], [1.0, limit]), X=(-3.0, 3.0), P=np.eye(6))
    partition = solve_mpqp(mpc.build(), Polytope.from_bounds(-np.ones(6), np.ones(6)))
    assert partition.status is not MPQPStatus.INFEASIBLE
    if partition.status is MPQPStatus.COMPLETE:
        for theta in np.random.default_rng(0).uniform(-1, 1, (10, 6)):
            np.testing.assert_allclose(at(partition, theta)[1], mpc(theta)[1], atol=1e-3 * limit)
