"""Bounds that stand for no limit at all say nothing of the size of a state, and hide no violation of another row."""

import cvxpy as cp
import numpy as np
import pytest
from plants import double_integrator

from invariant_sets import Polytope
from mpc import InfeasibleError, InputError, LinearMPC, MPQPStatus, Status


def integrator(X, **options):
    return LinearMPC(np.array([[1.0]]), np.array([[0.1]]), Q=1.0, R=1.0, horizon=2, U=(-1.0, 1.0), X=X, **options)


@pytest.mark.parametrize("unlimited", [3.0, 1e4, 1e6, 1e8, 1e12])
@pytest.mark.parametrize(("x", "over"), [(0.85, 0.0), (0.92, 0.02), (1.03, 0.13), (1.5, 0.6), (2.9, 2.0)])
def test_a_terminal_set_that_cannot_be_met_is_said_beside_any_limit_of_the_states(unlimited, x, over):
    plan = integrator((-unlimited, unlimited), terminal_set=(-0.7, 0.7)).solve([x])
    assert plan.violation == pytest.approx(over, abs=2e-8)
    assert plan.status is (Status.SOFTENED if over else Status.SOLVED)


@pytest.mark.parametrize("unlimited", [3.0, 1e4, 1e6, 1e8, 1e12])
def test_a_state_that_must_not_be_negative_is_kept_so_beside_any_upper_limit(unlimited):
    mpc = integrator(([0.0], [unlimited]))
    below = mpc.solve([-0.5])
    assert below.status is Status.SOFTENED
    assert below.violation == pytest.approx(0.4)
    above = mpc.solve([0.05])
    assert above.status is Status.SOLVED
    assert above.states.min() >= -1e-7


def test_the_unit_of_the_states_does_not_matter_beside_no_limit():
    for unit in (1e-6, 1.0, 1e6):
        mpc = LinearMPC(
            np.array([[1.0]]), np.array([[0.1 / unit]]), Q=unit**2, R=1.0, horizon=2, U=(-1.0, 1.0),
            X=(-1e9 / unit, 1e9 / unit), terminal_set=(-0.7 / unit, 0.7 / unit),
        )  # fmt: skip
        assert mpc.solve([0.85 / unit]).status is Status.SOLVED
        plan = mpc.solve([1.5 / unit])
        assert plan.status is Status.SOFTENED
        assert plan.violation * unit == pytest.approx(0.6)


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_the_unit_of_an_input_without_limit_does_not_change_the_price_of_a_soft_limit(unit):
    mpc = LinearMPC(
        np.array([[0.98]]), np.array([[0.1 * unit]]), Q=1.0, R=0.1 * unit**2, P=1.0, horizon=20, X=([0.0], [10.0]),
        soft=(0.0, 100.0),
    )  # fmt: skip
    plan = mpc.solve([1.0], x_ref=[-1.0])
    assert plan.status is Status.SOLVED
    assert plan.cost == pytest.approx(21.585, abs=1e-3)
    assert plan.violation == pytest.approx(0.49528, abs=1e-5)


def test_the_price_of_a_soft_limit_is_that_of_the_extent_of_its_set_whatever_the_horizon_and_the_inputs():
    for horizon in (2, 20):
        for U in (None, (-1.0, 1.0), (-100.0, 100.0)):
            mpc = LinearMPC(
                np.array([[0.98]]),
                np.array([[0.1]]),
                Q=1.0,
                R=0.1,
                horizon=horizon,
                U=U,
                X=([0.0], [10.0]),
                soft=(0.0, 100.0),
            )
            plan = mpc.solve([-0.5])
            regulation = (
                np.sum(plan.states[:-1] ** 2) + 0.1 * np.sum(plan.inputs**2) + plan.states[-1] @ mpc.P @ plan.states[-1]
            )
            outside = np.maximum(-plan.states[1:, 0], 0.0) / 10.0
            assert plan.cost == pytest.approx(regulation + 100.0 * np.sum(outside**2))


@pytest.mark.parametrize("solver", ["daqp", "clarabel"])
@pytest.mark.parametrize("zero", [0.0, 5.5e-17, 1e-14])
def test_a_zero_bound_that_was_rounded_is_a_zero_bound(solver, zero):
    mpc = LinearMPC(
        np.array([[0.9]]), np.array([[0.1]]), Q=1.0, R=0.1, horizon=10, U=([-zero], [1.0]), X=([-zero], [10.0]),
        soft=(1.0, 10.0), solver=solver,
    )  # fmt: skip
    plan = mpc.solve([-0.5])
    assert plan.status is Status.SOLVED
    np.testing.assert_allclose(plan.inputs[:2, 0], [1.0, 0.83445], atol=1e-4)


@pytest.mark.parametrize("unlimited", [3.0, 1e3, 1e6, 1e9])
def test_a_rate_limit_says_how_far_the_inputs_move_beside_any_limit_of_theirs(unlimited):
    mpc = LinearMPC(
        np.array([[1.0]]), np.array([[0.1]]), Q=1.0, R=1.0, horizon=2, U=(-unlimited, unlimited), rate_limit=1.0,
        X=(-1e6, 1e6), terminal_set=(-0.7, 0.7),
    )  # fmt: skip
    plan = mpc.solve([1.5], u_prev=[0.0])
    assert plan.status is Status.SOFTENED
    assert plan.violation == pytest.approx(0.5)
    np.testing.assert_allclose(plan.inputs[:, 0], [-1.0, -2.0], atol=1e-6)


@pytest.mark.quick(14)
@pytest.mark.parametrize("solver", ["daqp", "clarabel", "osqp"])
@pytest.mark.parametrize("inputs", ["bounded", "free"])
@pytest.mark.parametrize("small", [1.0, 1e-2, 1e-4])
def test_every_solver_finds_the_optimum_beside_limits_that_say_nothing_and_from_small_states(solver, inputs, small):
    rng = np.random.default_rng(11)
    for _ in range(6):
        A = rng.normal(size=(3, 3))
        A *= 0.97 / np.abs(np.linalg.eigvals(A)).max()
        B = rng.normal(size=(3, 1))
        mpc = LinearMPC(
            A, B, Q=np.eye(3), R=0.1, horizon=6, X=([-2.0, 0.0, -1e7], [2.0, 1e7, 1e7]),
            U=None if inputs == "free" else (-1, 1), solver=solver,
        )  # fmt: skip
        x = small * rng.uniform(0.1, 0.4, 3)
        plan = mpc.solve(x)
        oracle = cvxpy_plan(mpc, x)
        if oracle is None:
            assert plan.status is Status.SOFTENED
        else:
            assert plan.status is Status.SOLVED
            np.testing.assert_allclose(plan.inputs / small, oracle / small, atol=1e-4)


def cvxpy_plan(mpc, x):
    """Inputs by another solver in units of the state, or None where there are none."""
    unit = float(np.abs(x).max())
    X, U = cp.Variable((mpc.horizon + 1, mpc.nx)), cp.Variable((mpc.horizon, mpc.nu))
    (H, h), (G, g) = mpc.state_rows, mpc.input_rows
    near = h < 1e5
    limits = [X[0] == x / unit, X[1:] == X[:-1] @ mpc.A.T + U @ mpc.B.T, X[1:] @ H[near].T <= h[near] / unit]
    limits += [g / unit >= U @ G.T] if len(g) else []
    cost = cp.sum_squares(X[:-1]) + 0.1 * cp.sum_squares(U) + cp.quad_form(X[-1], cp.psd_wrap(mpc.P))
    problem = cp.Problem(cp.Minimize(cost), limits)
    problem.solve(solver=cp.CLARABEL, canon_backend=cp.SCIPY_CANON_BACKEND)
    return None if "infeasible" in problem.status else U.value * unit


SCALAR = {"A": np.array([[0.9]]), "B": np.array([[1.0]]), "Q": 1.0, "R": 1.0, "horizon": 10}
UNSTABLE = {"A": np.array([[1.5, 0.3], [0.0, 0.9]]), "B": np.array([[0.2], [1.0]]), "Q": 1.0, "R": 0.1, "X": (-5, 5)}
CART = {"A": np.array([[1, 0.1], [0, 1]]), "B": np.array([[0.005], [0.1]]), "Q": 1.0, "R": 0.1, "horizon": 20}
CART |= {"X": (-5, 5)}
KNOWN = {  # problem, state, references, first input: of the condensed problem in natural units
    "inputs to 1e5": (SCALAR | {"X": (-2, 2), "U": (-1e5, 1e5)}, [1.0], {}, -0.5376666),
    "inputs to 1e9": (SCALAR | {"X": (-2, 2), "U": (-1e9, 1e9)}, [1.0], {}, -0.5376666),
    "states from 0 to 1e9": (SCALAR | {"X": ([0.0], [1e9])}, [1.0], {"x_ref": [-2.0]}, -0.9),
    "all to 1e9, with a reference": (
        SCALAR | {"X": ([0.0], [1e9]), "U": (-1e9, 1e9)}, [1.0], {"x_ref": [-0.5]}, -0.7576513
    ),
    "free, with a reference": (SCALAR | {"X": (-1.0, 1e7)}, [1.0], {"x_ref": [-2.0]}, -1.6117438),
    "free and weak": (SCALAR | {"B": np.array([[1e-6]]), "X": (-2, 2)}, [1.0], {}, -4.7368421e-6),
    "free and unstable": (UNSTABLE | {"horizon": 50}, [0.5, 0.4], {}, -1.9402535),
    "free and unstable for long": (UNSTABLE | {"horizon": 200}, [0.5, 0.4], {}, -1.9402535),
    "small beside a linear price": (CART | {"U": (-1, 1), "soft": (1000.0, 10.0)}, [1e-3, 0.0], {}, -0.00258570),
    "at the origin": (CART | {"U": (-1, 1)}, [0.0, 0.0], {}, 0.0),
}  # fmt: skip


@pytest.mark.parametrize("solver", ["daqp", "clarabel", "osqp"])
@pytest.mark.parametrize("name", KNOWN)
def test_first_inputs_that_are_known(solver, name):
    problem, x, references, first = KNOWN[name]
    plan = LinearMPC(**problem, solver=solver).solve(x, **references)
    assert plan.status is Status.SOLVED
    assert plan.inputs[0, 0] == pytest.approx(first, rel=1e-5, abs=1e-12)


def test_every_solver_says_the_same_of_a_problem_that_gives():
    for X in (([-1.0], [1.0]), ([0.0], [1e7])):
        problem = SCALAR | {"A": np.array([[1.2]]), "B": np.array([[0.1]]), "X": X, "U": (-1, 1)}
        plans = [LinearMPC(**problem, solver=solver).solve([-0.9]) for solver in ("daqp", "clarabel", "osqp")]
        assert {plan.status for plan in plans} == {Status.SOFTENED}
        for plan in plans[1:]:
            np.testing.assert_allclose(plan.inputs, plans[0].inputs, atol=1e-6)
            assert plan.violation == pytest.approx(plans[0].violation, rel=1e-6)


@pytest.mark.parametrize("limit", [10.0, 1e6, 1e12, 1e19, 1e100, 1e300, np.inf])
@pytest.mark.parametrize("x", [0.0, 1e-9, 0.1])
def test_a_softened_plan_is_that_of_least_squares_whatever_the_limits_that_are_not_met(x, limit):
    """Two steps of a double integrator to a position of at least 1 at a speed of at most 0.2."""
    A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
    plan = LinearMPC(A, B, Q=1.0, R=1.0, horizon=2, X=([1, -0.2], [3, 0.2]), U=(-limit, limit)).solve([x, 0])
    assert plan.status is Status.SOFTENED
    u, violation = cp.Variable(2), cp.Variable(2)
    position = x + np.array([[0.5, 0.0], [1.5, 0.5]]) @ u
    speed = cp.abs(np.array([[1.0, 0.0], [1.0, 1.0]]) @ u)
    rows = [1 - position <= violation, (speed - 0.2) / 0.2 <= violation]
    least = cp.Problem(cp.Minimize(cp.sum_squares(violation)), rows).solve(solver="CLARABEL")
    inputs = plan.inputs[:, 0]
    reached = np.maximum(1 - plan.states[1:, 0], (np.abs(np.cumsum(inputs)) - 0.2) / 0.2)
    assert (reached**2).sum() == pytest.approx(least, rel=1e-4)


@pytest.mark.parametrize("solver", ["daqp", "clarabel", "osqp"])
def test_wide_inputs_do_not_spoil_the_least_violation(solver):
    """Double integrator outside X: the violation hardly depends on limits of the inputs that are never met."""
    A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
    problem = {"A": A, "B": B, "Q": 1.0, "R": 1.0, "horizon": 10, "X": (-5, 5), "solver": solver}
    for x in ([12.0, 3.0], [6.0, 5.0]):
        plans = [LinearMPC(**problem, U=(-limit, limit)).solve(x) for limit in (1e3, 1e4, 1e5, 1e6)]
        assert {plan.status for plan in plans} == {Status.SOFTENED}
        for plan in plans[1:]:
            assert plan.violation == pytest.approx(plans[0].violation, rel=1e-3)


@pytest.mark.parametrize("bound", [1e7, 5e8, 1e12, 1e30, 1e300, np.inf])
def test_a_state_without_a_limit_leaves_the_default_law_as_it_is(bound):
    A, B = double_integrator()
    options = dict(Q=np.eye(2), R=[[1.0]], horizon=3, U=(-1, 1))
    plain = LinearMPC(A, B, **options, X=([-5, -50], [5, 50])).explicit()
    found = LinearMPC(A, B, **options, X=([-5, -bound], [5, bound])).explicit()
    assert found.status is MPQPStatus.COMPLETE
    assert len(found.regions) == len(plain.regions)
    states = np.random.default_rng(0).uniform([-5, -4], [5, 4], size=(100, 2))
    for x in states:
        assert found(x) == pytest.approx(plain(x), abs=1e-9)


@pytest.mark.parametrize("bound", [1e6, 1e7, 1e8, 1e9])
def test_a_law_on_a_set_beside_which_the_limits_are_rounding_is_not_called_complete(bound):
    A, B = double_integrator()
    controller = LinearMPC(A, B, Q=np.eye(2), R=[[1.0]], horizon=3, U=(-1, 1))
    try:
        law = controller.explicit(Polytope.from_bounds([-bound] * 2, [bound] * 2))
    except InfeasibleError:
        return
    x = np.array([0.5, 0.2])
    right = law(x) == pytest.approx(controller.solve(x).inputs[0], abs=1e-9)
    assert right or law.status is MPQPStatus.INACCURATE


@pytest.mark.parametrize("unlimited", [1e12, 1e15, 1e20])
def test_a_law_of_states_beside_which_the_inputs_are_nothing_says_what_to_choose(unlimited):
    mpc = integrator((-unlimited, unlimited))
    with pytest.raises(InputError, match="one that is not nothing beside `theta_set`"):
        mpc.explicit()
    law = mpc.explicit((-2.0, 2.0))
    assert law.status is MPQPStatus.COMPLETE
    np.testing.assert_allclose(law([0.3]), mpc([0.3]), atol=1e-9)


@pytest.mark.parametrize("soft", [None, (1.0, 10.0)])
def test_a_polygon_by_sines_is_one(soft):
    """A sine of 1e-16 told a size of 7e15: soft violations had next to no price, hard ones were twice as large."""
    angles = np.arange(6) * np.pi / 3
    rows = np.column_stack([np.cos(angles), np.sin(angles)])
    plans = [
        LinearMPC([[1, 0.1], [0, 1]], [[0], [0.1]], Q=np.eye(2), R=[[0.1]], horizon=20, U=([-3], [3]), soft=soft,
                  X=Polytope(H, np.ones(6))).solve([1.2, -1])
        for H in (rows, np.where(np.abs(rows) < 1e-12, 0, rows))
    ]  # fmt: skip
    assert plans[0].violation == pytest.approx(plans[1].violation, rel=1e-6)
    assert plans[0].cost == pytest.approx(plans[1].cost, rel=1e-6)
