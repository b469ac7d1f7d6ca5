"""A disturbance's stated mean in MPC and sets, as in LQR."""

from dataclasses import replace
from functools import partial

import casadi as ca
import cvxpy as cp
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Plant,
    QuadraticObjective,
    deploy,
    design_sensitivity,
    discretise,
    expert_dataset,
    feasible_sets,
    linear_mpc,
    nonlinear_mpc,
    saturated_lqr,
)  # fmt: skip
from ccdtools.co_design import admissible_inputs
from ccdtools.twin import robust_mpc
from invariant_sets import Polytope, maximal_control_invariant_set
from mpc import LinearMPC, lqr
from mpc.optimal_control import NonlinearMPC

DESIGN, Q, R = [2.0], np.diag([1.0, 0.1]), np.array([[0.05]])
SPACE = DesignSpace(["k"], [0.5], [5.0])


def problem_of(mean=0.4, *, U=(-9.0, 9.0), X=(-9.0, 9.0), swing=False):
    """A spring, or a pendulum, pushed by a disturbance with a mean."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
    back = ca.sin(x[0]) if swing else x[0]
    plant = Plant(x, u, w, p, ca.vertcat(x[1], -p * back - 0.3 * x[1] + u + w), SPACE, dt=0.1)
    return CoDesignProblem(discretise(plant), X=X, U=U, objective=QuadraticObjective(Q, R), steps=100,
                           scenarios=FixedStart([0.5, 0.0], Gaussian([0.01], [mean])))  # fmt: skip


def pushed(problem):
    """A, B and what the mean adds to each step."""
    A, B, E = problem.model.matrices(np.array(DESIGN))
    return A, B, E @ problem.mean_disturbance


@pytest.mark.parametrize("horizon", [1, 7, 20])
def test_mpc_within_its_limits_is_lqr_with_its_offset(horizon):
    problem = problem_of()
    states = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2))
    mpc, law = linear_mpc(problem, DESIGN, horizon=horizon), saturated_lqr(problem, DESIGN)
    assert abs(law.offset[0]) > 0.1
    np.testing.assert_allclose(mpc(states), law(states), atol=1e-7)


@pytest.mark.parametrize("solver", ["daqp", "clarabel"])
def test_mpc_at_its_limits_is_the_program_of_the_affine_model(solver):
    problem = problem_of(U=(-0.6, 0.2), X=([-0.15, -0.5], [1.5, 0.5]))
    A, B, c = pushed(problem)
    weights = problem.objective.weights(np.array(DESIGN), 2, 1)
    K, P = lqr(A, B, Q=weights.Q, R=weights.R)
    ahead = np.linalg.solve((np.eye(2) - A + B @ K).T, P @ c)
    slope = 2 * (A - B @ K).T @ ahead  # x'Px + slope'x is what LQR costs from x on, less a constant
    mpc = replace(linear_mpc(problem, DESIGN, horizon=12), solver=solver)
    for start in ([0.5, 0.0], [0.4, -0.4], [0.1, 0.4]):
        u, x = cp.Variable((12, 1)), cp.Variable((13, 2))
        cost = sum(cp.quad_form(x[k], weights.Q) + cp.quad_form(u[k], weights.R) for k in range(12))
        rules = [x[0] == start, u >= -0.6, u <= 0.2]
        rules += [x[1:] >= np.array([[-0.15, -0.5]]), x[1:] <= np.array([[1.5, 0.5]])]
        rules += [x[k + 1] == A @ x[k] + B @ u[k] + c for k in range(12)]
        cp.Problem(cp.Minimize(cost + cp.quad_form(x[12], P) + slope @ x[12]), rules).solve(solver="CLARABEL")
        plan = mpc.solve(start)
        assert plan.status.name == "SOLVED"
        np.testing.assert_allclose(plan.inputs, u.value, atol=2e-5)
        np.testing.assert_allclose(plan.states, x.value, atol=2e-5)


def test_the_explicit_law_is_the_online_one():
    problem = problem_of(U=(-0.6, 0.2), X=(-1.5, 1.5))
    mpc = linear_mpc(problem, DESIGN, horizon=4)
    law, states = mpc.explicit(), np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    np.testing.assert_allclose(law(states), mpc(states), atol=1e-6)


def test_a_call_with_a_disturbance_or_references_of_its_own_goes_by_them():
    problem = problem_of()
    A, B, c = pushed(problem)
    own = problem.weights(np.array(DESIGN)).keywords()
    plain = LinearMPC(A, B, **own, horizon=5, E=np.eye(2))
    mpc, x = linear_mpc(problem, DESIGN, horizon=5), [0.3, 0.1]
    at = {"x_ref": [0.1, 0.0], "u_ref": [0.2]}
    np.testing.assert_allclose(mpc(x, **at), plain(x, w=c, **at), atol=1e-9)
    np.testing.assert_allclose(mpc(x, w=0 * c, **at), plain(x, **at), atol=1e-9)
    np.testing.assert_allclose(mpc(x, x_ref=[0.1, 0.0]), plain(x, w=c, x_ref=[0.1, 0.0]), atol=1e-9)


def test_what_a_mean_does_not_go_with_is_named():
    problem = problem_of()
    A, B, c = pushed(problem)
    with pytest.raises(InputError, match=r"mean.*without E"):
        LinearMPC(A, B, Q=Q, R=R, horizon=5, mean=c)
    with pytest.raises(InputError, match=r"mean.*\(2,\)"):
        LinearMPC(A, B, Q=Q, R=R, horizon=5, E=np.eye(2), mean=c[:1])


def test_sets_are_those_about_the_rest():
    problem = problem_of(U=(-1.0, 1.0), X=(-1.0, 1.0))
    A, B, c = pushed(problem)
    rest = np.linalg.lstsq(np.hstack([A - np.eye(2), B]), -c, rcond=None)[0]
    X, U = ((-1.0 - at, 1.0 - at) for at in (rest[:2], rest[2:]))
    about = maximal_control_invariant_set(A, B, X, U).set
    found = feasible_sets(problem).result(DESIGN).set
    directions = np.random.default_rng(0).standard_normal((40, 2))
    np.testing.assert_allclose(found.support(directions), about.support(directions) + directions @ rest[:2], atol=1e-6)
    without = feasible_sets(problem_of(0.0, U=(-1.0, 1.0), X=(-1.0, 1.0))).result(DESIGN).set
    assert not found.is_subset(without)

    kept = admissible_inputs(problem, DESIGN)
    corner = found.vertices[np.argmax(found.vertices @ np.ones(2))] * 0.999
    u, possible = kept.project(corner, [1.0])
    assert possible
    assert found.contains(A @ corner + B @ u + c, tol=1e-6)


@pytest.mark.check
def test_the_experts_data_stay_within_the_sets_of_the_pushed_plant():
    problem = problem_of(U=(-1.0, 1.0), X=(-1.0, 1.0))
    data = expert_dataset(problem, samples=40, designs=2, rng=np.random.default_rng(0))
    A, B, _ = problem.model.matrices(data.inputs[:, 2:])
    E = problem.model.matrices(data.inputs[:, 2:])[2]
    after = np.einsum("nij,nj->ni", A, data.inputs[:, :2]) + np.einsum("nij,nj->ni", B, data.actions)
    after += E @ problem.mean_disturbance
    assert (np.abs(after) <= 1 + 1e-6).mean() > 0.98


@pytest.mark.long
def test_nonlinear_mpc_settles_where_the_cost_is_least():
    problem = problem_of(0.4, swing=True)
    law = nonlinear_mpc(problem, DESIGN, horizon=20, iterations=None)
    x, w, p = np.array([0.5, 0.0]), np.array([0.4]), np.array(DESIGN)
    for _ in range(150):
        u = law(x)
        x = np.asarray(problem.model.advance(x, u, w, p))
    np.testing.assert_allclose(problem.model.advance(x, law(x), w, p), x, atol=1e-5)
    angles = np.linspace(0.0, 0.5, 20001)
    inputs = 2.0 * np.sin(angles) - 0.4
    best = np.min(Q[0, 0] * angles**2 + R[0, 0] * inputs**2)
    assert x @ Q @ x + u @ R @ u < 1.001 * best


@pytest.mark.long
@pytest.mark.parametrize("controller", ["lqr", "mpc", "nmpc"])
@pytest.mark.parametrize("swing", [False, True])
def test_slopes_by_the_design_move_the_rest_along(controller, swing):
    problem, x, step = problem_of(0.4, U=(-0.35, 9.0), swing=swing), np.array([-0.4, 0.1]), 1e-5
    found = design_sensitivity(problem, DESIGN, x, controller=controller, horizon=8)
    near = [design_sensitivity(problem, [2.0 + d], x, controller=controller, horizon=8) for d in (step, -step)]
    laws = {"lqr": saturated_lqr, "mpc": linear_mpc, "nmpc": partial(nonlinear_mpc, iterations=None)}
    more, own = ({"horizon": 8}, problem) if controller != "lqr" else ({}, replace(problem, U=(-9.0, 9.0)))
    inputs = [laws[controller](own, [2.0 + d], **more)(x) for d in (step, -step)]
    assert found.cost_by_design[0] == pytest.approx((near[0].cost - near[1].cost) / (2 * step), rel=1e-5)
    assert found.input_by_design[:, 0] == pytest.approx((inputs[0] - inputs[1]) / (2 * step), rel=1e-4, abs=1e-6)
    assert abs(found.input_by_design[0, 0]) > 1e-3 or controller == "mpc"
    still = design_sensitivity(
        problem_of(0.0, U=(-0.35, 9.0), swing=swing), DESIGN, x, controller=controller, horizon=8
    )
    assert abs(found.cost / still.cost - 1) > 0.1


def test_slopes_of_plans_beside_a_mean_are_by_differences_with_and_without_references():
    problem, x, step = problem_of(U=(-9.0, 9.0)), [0.3, 0.0], 1e-6
    A, B, E = problem.model.matrices(np.array(DESIGN))
    dA, dB, dE, dQ = (np.random.default_rng(0).standard_normal((*M.shape, 1)) for M in (A, B, E, Q))
    dQ += dQ.swapaxes(0, 1)

    def law(d):
        changed = [M + d * dM[:, :, 0] for M, dM in ((A, dA), (B, dB), (E, dE), (Q, dQ))]
        return LinearMPC(*changed[:2], Q=changed[3], R=R, horizon=6, E=changed[2], mean=[0.4], X=(-9, 9), U=(-9, 9))

    for refs in ({}, {"x_ref": np.zeros((7, 2)), "u_ref": np.zeros((6, 1))}):
        found = law(0.0).sensitivity(x, dA=dA, dB=dB, dE=dE, dQ=dQ, **refs)
        up, down = (law(d).solve(x, **refs) for d in (step, -step))
        np.testing.assert_allclose(
            found.inputs_by_parameters[:, :, 0], (up.inputs - down.inputs) / (2 * step), atol=1e-4
        )
        assert found.cost_by_parameters[0] == pytest.approx((up.cost - down.cost) / (2 * step), rel=1e-4)


def test_robust_mpc_is_that_about_the_rest():
    problem = problem_of(U=(-1.0, 1.0), X=(-1.0, 1.0))
    A, B, c = pushed(problem)
    W = Polytope.from_bounds(c - np.array([0.01, 0.03]), c + np.array([0.02, 0.03]))
    mpc = linear_mpc(problem, DESIGN, horizon=6, W=W)
    x, u = mpc.rest
    about = LinearMPC(A, B, Q=Q, R=R, horizon=6, W=([-0.01, -0.03], [0.02, 0.03]), X=(-1 - x, 1 - x), U=(-1 - u, 1 - u))
    states = np.random.default_rng(0).uniform(-0.9, 0.9, (40, 2))
    plans, others = mpc.solve_many(states), about.solve_many(states - x)
    assert [plan.status for plan in plans] == [plan.status for plan in others]
    for plan, other in zip(plans, others):
        np.testing.assert_allclose(plan.inputs[0], u + other.inputs[0], atol=1e-6)
    rng, state = np.random.default_rng(1), states[[plan.status.name == "SOLVED" for plan in plans]][0]
    for _ in range(300):
        state = A @ state + B @ mpc(state) + W.vertices[rng.integers(len(W.vertices))]
        assert (np.abs(state) <= 1 + 1e-7).all()
    still = [law(x) for law in (mpc, linear_mpc(problem, DESIGN))]
    np.testing.assert_allclose(still, [u, u], atol=1e-7)


@pytest.mark.check
def test_an_expert_learns_from_starts_about_the_rest():
    problem = problem_of(0.9, U=(-1.0, 1.0), X=(-1.0, 1.0))
    data = expert_dataset(problem, samples=60, sets="lqr", rng=np.random.default_rng(0))
    assert data.sets.lqr == 60
    assert data.diverged == 0.0
    assert data.acceptance > 0.3


def test_a_mean_of_zero_is_none_and_references_need_no_rest():
    A, B, P = np.diag([1.0, 2.0]), np.array([[1.0], [0.0]]), np.eye(2)  # the second state cannot be stabilised
    free = dict(Q=np.eye(2), R=[[1.0]], P=P, horizon=5, E=np.eye(2))
    plain, still = LinearMPC(A, B, **free), LinearMPC(A, B, mean=[0.0, 0.0], **free)
    np.testing.assert_array_equal(still([1.0, 0.5]), plain([1.0, 0.5]))
    pushed = LinearMPC(A, B, mean=[0.1, 0.0], **free)
    w = np.tile([0.1, 0.0], (5, 1))
    np.testing.assert_allclose(
        pushed.solve([1.0, 0.5], x_ref=np.zeros((6, 2))).inputs,
        plain.solve([1.0, 0.5], w=w).inputs, atol=1e-7,
    )  # fmt: skip


def test_an_invariant_terminal_set_is_that_of_the_regulator_about_the_rest():
    A, B, E, mean = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([[0.0], [0.1]]), np.array([[0.0], [0.1]]), [0.4]
    mpc = NonlinearMPC(
        lambda x, u, w: ca.DM(A) @ x + ca.DM(B) @ u + ca.DM(E) @ w, 2, 1, Q=Q, R=R, horizon=10, X=(-1.0, 1.0),
        U=(-0.9, 0.5), terminal_set="invariant", disturbances=1, mean=mean,
    )  # fmt: skip
    K, _ = lqr(A, B, Q=Q, R=R)
    x_rest, u_rest = mpc.problem.rest
    assert abs(u_rest[0]) > 0.05
    corners = mpc.problem.terminal_set.vertices
    for x in corners:
        u = u_rest - K @ (x - x_rest)
        after = A @ x + B @ u + E @ mean
        assert (u >= -0.9 - 1e-7).all()
        assert (u <= 0.5 + 1e-7).all()
        assert mpc.problem.terminal_set.contains(after, 1e-7)


@pytest.mark.check
@pytest.mark.parametrize("errors", ["set", "quantiles", "normal"])
def test_the_controller_of_a_log_settles_where_mpc_does(errors):
    problem = replace(problem_of(0.4, U=(-1.5, 1.5), X=(-1.5, 1.5)), steps=40)
    w = problem.scenarios.disturbance.sample(40, 40, np.random.default_rng(0))
    log = deploy(problem.model, saturated_lqr(problem, DESIGN), DESIGN, w, x0=[0.5, 0.0])
    found = robust_mpc(problem, DESIGN, log, level=0.8, horizon=5, runs=3, errors=errors, rng=np.random.default_rng(0))
    x, u = linear_mpc(problem, DESIGN).rest
    assert abs(u[0]) > 0.2
    np.testing.assert_allclose(found.controller(x), u, atol=1e-6)
    assert found.planned == 1.0
