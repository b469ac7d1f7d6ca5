"""The online controller against independent solvers, and what it does when the problem is infeasible."""

import pickle
from itertools import pairwise

import control
import cvxpy as cp
import numpy as np
import pytest
from plants import SUSPENSION, box, double_integrator, suspension

from mpc import InputError, LinearMPC, NotConvexError, Status, lqr


def reference_plan(mpc, x0, *, terminal=None, rate=None, u_prev=None, x_ref=0.0, w=None, blocks=()):
    """The same problem with states kept, solved tightly by Clarabel through CVXPY."""
    N = mpc.horizon
    x, u = cp.Variable((N + 1, mpc.nx)), cp.Variable((N, mpc.nu))
    half = lambda M: np.linalg.cholesky(M + 1e-15 * np.trace(M) * np.eye(len(M))).T  # noqa: E731
    target = np.broadcast_to(x_ref, (N, mpc.nx))
    cost = cp.sum_squares((x[:N] - target) @ half(mpc.Q).T) + cp.sum_squares(u @ half(mpc.R).T)
    cost += cp.sum_squares(half(mpc.P) @ (x[N] - x_ref))
    constraints = [x[0] == x0]
    for k in range(N):
        push = 0 if w is None else mpc.E @ w[k]
        constraints.append(x[k + 1] == mpc.A @ x[k] + mpc.B @ u[k] + push)
        constraints.append(mpc.U.A @ u[k] <= mpc.U.b)
        constraints.append(mpc.X.A @ x[k + 1] <= mpc.X.b)
        if rate is not None:
            constraints.append(cp.abs(u[k] - (u[k - 1] if k else u_prev)) <= rate)
    starts = np.cumsum([0, *blocks])
    constraints += [u[k] == u[a] for a, b in pairwise(starts) for k in range(a + 1, b)]
    if terminal is not None:
        constraints.append(terminal.A @ x[N] <= terminal.b)
    problem = cp.Problem(cp.Minimize(cost), constraints)
    problem.solve(cp.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11)
    return problem.status, u.value, problem.value


@pytest.fixture(scope="module")
def integrator():
    A, B = double_integrator()
    return LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=10, X=box([5, 5]), U=box([1]))


def test_agrees_with_an_independent_solver(integrator):
    rng = np.random.default_rng(0)
    feasible = 0
    for x in rng.uniform(-5, 5, size=(12, 2)):
        plan = integrator.solve(x)
        status, u, cost = reference_plan(integrator, x)
        assert plan.feasible == (status == "optimal")
        if plan.feasible:
            feasible += 1
            np.testing.assert_allclose(plan.inputs, u, atol=2e-5)
            assert plan.cost == pytest.approx(cost, rel=1e-7)
            assert plan.residuals.worst < 1e-9
    assert feasible >= 4


def test_plan_satisfies_model_and_constraints(integrator):
    plan = integrator.solve([3.0, -1.5])
    A, B = integrator.A, integrator.B
    np.testing.assert_allclose(plan.states[1:], plan.states[:-1] @ A.T + plan.inputs @ B.T)
    assert np.abs(plan.inputs).max() <= 1 + 1e-9
    assert np.abs(plan.states[1:]).max() <= 5 + 1e-9
    stage = np.sum(plan.states[:-1] ** 2) + 0.1 * np.sum(plan.inputs**2)
    assert plan.cost == pytest.approx(stage + plan.states[-1] @ integrator.P @ plan.states[-1])


def test_unconstrained_is_the_regulator():
    A, B, _ = suspension()
    mpc = LinearMPC(A, B, Q=SUSPENSION["Q"], R=SUSPENSION["R"], horizon=5)
    K, P = lqr(A, B, Q=SUSPENSION["Q"], R=SUSPENSION["R"])
    x = np.array([0.01, -0.1, 0.02, 0.3])
    np.testing.assert_allclose(mpc(x), -K @ x, rtol=1e-8)
    assert mpc.solve(x).cost == pytest.approx(x @ P @ x)


@pytest.mark.long
def test_suspension_in_SI_units_agrees_with_an_independent_solver():
    A, B, _ = suspension()
    mpc = LinearMPC(A, B, horizon=20, **SUSPENSION)
    x = np.array([-0.1, -1.0, -0.1, -0.5])
    for _ in range(5):
        plan = mpc.solve(x)
        assert plan.status is Status.SOLVED
        _, u, _ = reference_plan(mpc, x)
        assert np.abs(plan.inputs[0] - u[0]).max() <= 1e-3 * 1000
        x = A @ x + B @ plan.inputs[0]


def test_long_horizon_of_an_unstable_plant():
    A, B = np.array([[1.8, 0.5], [0.0, 1.2]]), np.array([[0.0], [1.0]])
    mpc = LinearMPC(A, B, Q=np.eye(2), R=[[1.0]], horizon=60, X=box([5, 5]), U=box([1]))
    plan = mpc.solve([0.05, 0.02])
    assert plan.feasible
    assert plan.residuals.worst < 1e-9
    K, _ = lqr(A, B, Q=np.eye(2), R=[[1.0]])
    np.testing.assert_allclose(plan.inputs[0], -K @ [0.05, 0.02], rtol=1e-7)


def test_batches_equal_single_calls_in_any_order(integrator):
    X = np.random.default_rng(1).uniform(-3, 3, size=(20, 2))
    single = np.array([integrator(x) for x in X[::-1]])[::-1]
    np.testing.assert_allclose(integrator(X), single, atol=1e-8)
    assert integrator(X[:0]).shape == (0, 1)
    assert len(integrator.solve_many(X)) == 20


def test_infeasible_states_get_the_least_relaxation(integrator):
    plan = integrator.solve([4.9, 3.0])
    assert plan.status is Status.SOFTENED
    # x1 after one step is at least 4.9 + 3 - 0.5 = 7.4, so 2.4 over the bound at best, and 4.4 one step later
    assert plan.violation == pytest.approx(4.4, rel=1e-3)
    assert np.abs(plan.inputs).max() <= 1 + 1e-9


@pytest.mark.parametrize("size", [1e1, 1e3, 1e8, 1e150, 1e300])
def test_every_finite_state_gets_a_finite_admissible_input(integrator, size):
    for direction in np.random.default_rng(2).normal(size=(10, 2)):
        u = integrator(size * direction)
        assert np.isfinite(u).all()
        assert np.abs(u).max() <= 1 + 1e-6


@pytest.mark.parametrize("horizon", [8, 10, 12, 15, 18])
def test_unstable_plants_over_longer_horizons_get_their_relaxation(horizon):
    A, B = np.array([[1.5, 0.3], [0.0, 1.3]]), np.array([[0.0], [1.0]])
    mpc = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=horizon, X=box([5, 5]), U=box([1]))
    plan = mpc.solve([2.0, 2.0])
    assert plan.status is Status.SOFTENED
    assert plan.violation == pytest.approx(np.abs(plan.states[1:]).max() - 5, rel=1e-5)
    np.testing.assert_allclose(plan.inputs[:2], -1.0, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("horizon", [10, 30, 60])
def test_a_plan_that_no_solver_could_finish_still_describes_what_its_inputs_do(horizon):
    A, B = np.array([[1.5, 0.3], [0.0, 1.3]]), np.array([[0.0], [1.0]])
    mpc = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=horizon, X=box([5, 5]), U=box([1]))
    target = np.array([0.5, 0.0])
    plan = mpc.solve([2.0, 2.0], x_ref=target)  # cannot be brought back: x grows to 1e4 and more
    assert plan.status in (Status.SOFTENED, Status.INACCURATE)
    assert np.abs(plan.inputs).max() <= 1 + 1e-9
    np.testing.assert_allclose(plan.states[1:], plan.states[:-1] @ A.T + plan.inputs @ B.T, rtol=1e-6, atol=1e-6)
    error = plan.states - target
    stage = np.sum(error[:-1] ** 2) + 0.1 * np.sum(plan.inputs**2)
    assert plan.cost == pytest.approx(stage + error[-1] @ mpc.P @ error[-1], rel=1e-6)
    assert plan.violation == pytest.approx(np.abs(plan.states[1:]).max() - 5, rel=1e-6)


def test_an_unstabilisable_plant_with_its_own_terminal_weight_never_raises():
    mpc = LinearMPC([[1.2, 0.0], [0.0, 0.5]], [[0.0], [1.0]], Q=[1, 1], R=[1], P=np.eye(2), horizon=4, X=box([1, 1]),
                    U=box([1]))  # fmt: skip
    for x in ([0.1, 0.1], [5.0, 5.0], [1e250, -1e250]):
        assert np.abs(mpc(x)).max() <= 1 + 1e-9


def test_everything_at_once():
    A, B, E = suspension()
    mpc = LinearMPC(A, B, E=E, horizon=8, rate_limit=300.0, blocks=(1, 1, 2, 4), **SUSPENSION)
    w, x = 0.2 * np.random.default_rng(4).normal(size=(8, 1)), np.array([-0.02, -0.3, -0.05, -0.2])
    target = np.array([0.0, 0.0, 0.01, 0.0])
    plan = mpc.solve(x, u_prev=[100.0], x_ref=target, w=w)
    _, u, _ = reference_plan(mpc, x, rate=300.0, u_prev=np.array([100.0]), x_ref=target, w=w, blocks=(1, 1, 2, 4))
    np.testing.assert_allclose(plan.inputs, u, atol=1e-2)


def test_closed_loop_from_outside_the_feasible_set_recovers(integrator):
    x = np.array([5.5, 1.0])
    for _ in range(40):
        x = integrator.A @ x + integrator.B @ integrator(x)
    assert np.abs(x).max() < 1e-3


def test_a_state_space_goes_in():
    A, B = double_integrator()
    mpc = LinearMPC(control.ss(A, B, np.eye(2), 0, 1.0), Q=[1, 1], R=[0.1], horizon=10, X=box([5, 5]), U=box([1]))
    reference = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=10, X=box([5, 5]), U=box([1]))
    np.testing.assert_allclose(mpc([2.0, 0.5]), reference([2.0, 0.5]))


def test_terminal_set_and_rate_limit():
    A, B = double_integrator()
    data = dict(Q=np.eye(2), R=[[0.1]], horizon=6, X=box([5, 5]), U=box([1]))
    mpc = LinearMPC(A, B, **data, rate_limit=0.4, terminal_set=box([0.1, 0.1]))
    plan = mpc.solve([1.0, 0.2], u_prev=[0.3])
    _, u, _ = reference_plan(mpc, np.array([1.0, 0.2]), terminal=box([0.1, 0.1]), rate=0.4, u_prev=np.array([0.3]))
    np.testing.assert_allclose(plan.inputs, u, atol=1e-6)
    assert np.abs(np.diff(np.concatenate([[0.3], plan.inputs[:, 0]]))).max() <= 0.4 + 1e-8


def test_terminal_equality_and_the_origin():
    A, B = double_integrator()
    mpc = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=6, X=box([5, 5]), U=box([1]), terminal_set=box([0, 0]))
    for x in ([0.0, 0.0], [1.0, 0.0], [2.0, -1.0]):
        plan = mpc.solve(x)
        assert plan.status is Status.SOLVED
        np.testing.assert_allclose(plan.states[-1], 0.0, atol=1e-9)
    assert mpc([0.0, 0.0]) == pytest.approx(0.0, abs=1e-9)


def test_preview_and_reference():
    A, B, E = suspension()
    mpc = LinearMPC(A, B, E=E, horizon=8, **SUSPENSION)
    w = np.random.default_rng(3).normal(size=(8, 1)) * 0.3
    plan = mpc.solve([0.0, 0.1, 0.0, 0.2], w=w)
    _, u, cost = reference_plan(mpc, np.array([0.0, 0.1, 0.0, 0.2]), w=w)
    np.testing.assert_allclose(plan.inputs, u, atol=1e-2)
    assert plan.cost == pytest.approx(cost, rel=1e-6)
    np.testing.assert_allclose(plan.states[1], A @ plan.states[0] + B @ plan.inputs[0] + E @ w[0])
    target = np.array([0.0, 0.0, 0.05, 0.0])
    _, u, _ = reference_plan(mpc, np.zeros(4), x_ref=target)
    np.testing.assert_allclose(mpc.solve(np.zeros(4), x_ref=target).inputs, u, atol=1e-2)


def test_blocked_moves_are_held():
    A, B = double_integrator()
    mpc = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=10, X=box([5, 5]), U=box([1]), blocks=(1, 2, 7))
    inputs = mpc.solve([2.0, 0.0]).inputs[:, 0]
    assert inputs[1] == pytest.approx(inputs[2])
    np.testing.assert_allclose(inputs[3:], inputs[3])
    assert mpc.build().nz == 3


def test_soft_constraints_trade_violation_for_cost():
    A, B = double_integrator()
    data = dict(Q=np.eye(2), R=[[0.1]], horizon=10, X=box([5, 5]), U=box([1]))
    hard, soft = LinearMPC(A, B, **data), LinearMPC(A, B, **data, soft=(1e4, 1e4))
    np.testing.assert_allclose(soft([3.0, -1.0]), hard([3.0, -1.0]), atol=1e-7)
    plan = soft.solve([4.9, 3.0])
    assert plan.status is Status.SOLVED
    assert plan.violation == pytest.approx(np.abs(plan.states[1:]).max() - 5)
    assert soft.solve([3.0, -1.0]).violation == pytest.approx(0, abs=1e-9)
    squares = LinearMPC(A, B, **data, soft=(0.0, 1e4)).solve([4.9, 3.0])
    assert squares.violation == pytest.approx(4.4, abs=0.1)  # the least largest violation of a step


def test_another_design_takes_a_new_model():
    A, B, _ = suspension()
    A2, B2, _ = suspension(ks=1e4, cs=3000.0)
    moved = LinearMPC(A, B, horizon=10, **SUSPENSION).with_model(A2, B2)
    x = np.array([-0.1, -1.0, -0.1, -0.5])
    np.testing.assert_allclose(moved(x), LinearMPC(A2, B2, horizon=10, **SUSPENSION)(x), rtol=1e-9)


def test_another_design_keeps_a_terminal_weight_that_was_given_and_takes_a_state_space():
    A, B = double_integrator()
    given = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=5, P=3 * np.eye(2), U=box([1]))
    moved = given.with_model(control.ss(0.9 * A, B, np.eye(2), 0, 1.0))
    np.testing.assert_array_equal(moved.A, 0.9 * A)
    np.testing.assert_array_equal(moved.P, 3 * np.eye(2))
    np.testing.assert_array_equal(given.with_model(A, B, P=np.eye(2)).P, np.eye(2))


def test_a_batch_with_a_rate_limit_takes_one_last_input_per_state():
    A, B = double_integrator()
    limited = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=5, U=box([1]), rate_limit=0.1)
    X, last = np.array([[1.0, 0.0], [-2.0, 0.5], [0.5, 0.5]]), np.array([[0.9], [-0.4], [0.0]])
    each = [limited(x, u_prev=u) for x, u in zip(X, last)]
    np.testing.assert_allclose(limited(X, u_prev=last), each)
    np.testing.assert_allclose(limited(X[0], u_prev=0.9), each[0])  # one input: a number will do
    with pytest.raises(InputError, match=r"u_prev: got shape \(2, 1\), expected \(3, 1\)"):
        limited(X, u_prev=last[:2])


def empty_interval():
    interval = box([1.0])
    interval.b = np.array([-1.0, -1.0])  # u <= -1 and u >= 1
    return interval


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"horizon": 0}, InputError, "horizon: got 0, expected a whole number, at least 1"),
        ({"horizon": 2.5}, InputError, r"got 2\.5"),
        ({"horizon": np.nan}, InputError, "got nan"),
        ({"horizon": np.inf}, InputError, "got inf"),
        ({"horizon": None}, InputError, "got nothing"),
        ({"Q": "large"}, InputError, "Q: got 'large', expected an array of real numbers"),
        ({"Q": [[1, 0], [1]]}, InputError, r"Q: got \[\[1, 0\], \[1\]\], expected an array of real numbers"),
        ({"Q": 1j * np.eye(2)}, InputError, "Q: got complex numbers, expected an array of real"),
        ({"X": np.eye(2)}, InputError, "X: got an array .*, expected|X: got \\[\\[1.*, expected a Polytope"),
        ({"X": box([5, 5, 5])}, InputError, r"X.A: got shape \(6, 3\), expected \(any, 2\)"),
        ({"U": box([np.nan])}, InputError, r"U.b: got nan at index \(0,\), expected finite"),
        ({"U": empty_interval()}, InputError, "U: got an empty set"),
        ({"P": -np.eye(2)}, NotConvexError, "P: got a negative direction"),
        ({"Q": [0, 0], "R": [0], "P": np.zeros((2, 2))}, NotConvexError, "Hessian: got a condensed one with the"),
        ({"blocks": (3, 3)}, InputError, "sum to the horizon 10"),
        ({"blocks": (np.nan, 10)}, InputError, "sum to the horizon 10"),
        ({"blocks": (2.5, 7.5)}, InputError, "sum to the horizon 10"),
        ({"blocks": 9}, InputError, "sum to the horizon 10"),
        ({"rate_limit": -1.0}, InputError, "rate_limit: got .*, expected positive"),
        ({"rate_limit": [1.0, 2.0]}, InputError, r"rate_limit: got shape \(2,\), expected \(1,\)"),
        ({"soft": (-1.0, 1.0)}, InputError, "soft: got .*linear >= 0"),
        ({"soft": (1.0, 0.0)}, InputError, "soft: got .*quadratic > 0"),
        ({"E": np.ones((3, 1))}, InputError, "E: got shape"),
    ],
)
def test_bad_controllers_are_refused(change, error, message):
    A, B = double_integrator()
    data = dict(Q=np.eye(2), R=[[0.1]], horizon=10, X=box([5, 5]), U=box([1])) | change
    with pytest.raises(error, match=message):
        LinearMPC(A, B, **data)


@pytest.mark.parametrize(
    ("x", "signals", "message"),
    [
        ([1.0], {}, r"x: got shape \(1,\), expected \(2,\)"),
        ([1.0, np.nan], {}, "x: got nan at index"),
        ([1.0, np.inf], {}, "x: got inf at index"),
        ([1.0, 0.0], {"w": [1.0]}, "no disturbance matrix E"),
        ([1.0, 0.0], {"u_prev": [1.0]}, "u_prev: got a last input, expected none"),
        ([1.0, 0.0], {"x_ref": [np.nan, 0.0]}, "x_ref: got nan at"),
        ([1.0, 0.0], {"x_ref": np.zeros((3, 2))}, "x_ref: got shape"),
        ([1.0, 0.0], {"x_ref": "origin"}, "x_ref: got 'origin', expected an array of real numbers"),
        ([1.0, 1j], {}, r"x: got \[1.0, 1j\]"),
    ],
)
def test_bad_states_are_refused(integrator, x, signals, message):
    for ask in (integrator.solve, integrator, integrator.explain):
        with pytest.raises(InputError, match=message):
            ask(x, **signals)


def test_a_pickled_controller_works_elsewhere(integrator):
    integrator([3.0, -1.0])
    copy = pickle.loads(pickle.dumps(integrator))
    np.testing.assert_array_equal(copy([3.0, -1.0]), integrator([3.0, -1.0]))


def test_unknown_signals_and_a_missing_last_input_are_refused(integrator):
    with pytest.raises(InputError, match="unknown signal 'ref'"):
        integrator.solve_many([[1.0, 0.0]], ref=[1.0])
    limited = LinearMPC(integrator.A, integrator.B, Q=[1, 1], R=[1], horizon=3, rate_limit=0.1)
    with pytest.raises(InputError, match="u_prev: got nothing, expected the last input"):
        limited([1.0, 0.0])
    assert repr(limited) == "LinearMPC(2 states, 1 inputs, N=3, 3 variables, 6 constraints)"


def test_singular_R_alone_is_legal():
    A, B = double_integrator()
    assert LinearMPC(A, B, Q=np.eye(2), R=[[0.0]], horizon=5, U=box([1])).solve([1.0, 0.0]).feasible


def test_an_input_that_its_limits_hold_leaves_the_optimum_of_the_others():
    rng = np.random.default_rng(43)
    A, B, size = rng.normal(size=(2, 2)), rng.normal(size=(2, 2)), np.array([1e5, 0.1])
    A, held = 0.9 * A / np.abs(np.linalg.eigvals(A)).max(), [0.0, 0.1]
    stated = {"Q": np.eye(2), "horizon": 6, "P": 5 * np.eye(2)}
    both = LinearMPC(A, B / size, R=np.diag(0.1 / size**2), U=(np.negative(held), held), **stated)
    one = LinearMPC(A, B[:, 1:] / 0.1, R=10.0, U=(-0.1, 0.1), **stated)
    for x in rng.normal(size=(60, 2)) * 10.0 ** rng.integers(-2, 2, (60, 1)):
        plan = both.solve(x)
        assert plan.status is Status.SOLVED
        assert plan.cost == pytest.approx(one.solve(x).cost, rel=1e-6)
