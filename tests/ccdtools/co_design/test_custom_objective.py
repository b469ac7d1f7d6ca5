import copy
import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    discretise,
    saturated_lqr,
    simulate,
)
from ccdtools.co_design import output_objective, previewed_objective

x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
ACCELERATION = -p[0] * x[0] - p[1] * x[1] + u
SPACE = DesignSpace(["k", "c"], [1.0, 0.1], [5.0, 1.0])
PLANT = Plant(x, u, w, p, ca.vertcat(x[1], ACCELERATION + w), SPACE, dt=0.1, outputs=[ACCELERATION, x[0]])
MODEL = discretise(PLANT)
Q, R, S = np.diag([2.0, 0.5]), np.array([[0.3]]), np.array([[0.2], [0.1]])
P0 = np.array([2.0, 0.5])
K = np.array([[1.0, 0.7]])


def problem(objective, steps=30, **changes):
    scenarios = FixedStart([1.0, -0.5], Gaussian([0.2]))
    return CoDesignProblem(MODEL, ([-4, -4], [4, 4]), ([-9], [9]), objective, scenarios, steps, **changes)


def loop(steps=30, runs=4):
    return simulate(
        MODEL, LinearFeedback(K), x0=np.tile([1.0, -0.5], (runs, 1)), steps=steps, disturbance=Gaussian([0.2]),
        design=P0, rng=np.random.default_rng(1),
    )  # fmt: skip


def stage(x, u, p):
    return (1 + p[0]) * x[0] ** 2 + ca.sqrt(1 + x[1] ** 2) - 1 + p[1] * u[0] ** 2 + 0.1 * x[0] * u[0]


def test_the_weights_of_a_custom_cost_are_half_its_hessian_at_rest():
    own = problem(CustomObjective(stage)).weights(P0)
    np.testing.assert_allclose(own.Q, np.diag([3.0, 0.5]), atol=1e-12)
    np.testing.assert_allclose(own.R, [[0.5]])
    np.testing.assert_allclose(own.S, [[0.05], [0.0]], atol=1e-12)


def test_given_weights_take_the_place_of_the_hessian():
    economic = CustomObjective(lambda x, u, p: x[0] - u[0], Q=Q, R=R)
    np.testing.assert_array_equal(problem(economic).weights(P0).Q, Q)
    assert problem(economic).weights(P0).S is None


def test_a_cost_of_outputs_is_the_quadratic_one_of_their_matrices():
    """Acceleration has a feed-through: y = C x + D u, so Q = CᵀWC, S = CᵀWD, R = DᵀWD."""
    own = problem(output_objective(PLANT, weights=[3.0, 2.0], R=0.5)).weights(P0)
    C, D, W = np.array([[-2.0, -0.5], [1.0, 0.0]]), np.array([[1.0], [0.0]]), np.diag([3.0, 2.0])
    for name, expected in {"Q": C.T @ W @ C, "S": C.T @ W @ D, "R": D.T @ W @ D + 0.5}.items():
        np.testing.assert_allclose(getattr(own, name), expected, atol=1e-12)
    run = loop()
    y = run.states[:, :-1] @ C.T + run.inputs @ D.T
    expected = -np.einsum("ntk,kl,ntl->n", y, W, y) - 0.5 * (run.inputs**2).sum((1, 2))
    np.testing.assert_allclose(run.returns(output_objective(PLANT, weights=W, R=[[0.5]])), expected)


def price(p):
    return 3 * p[0] + p[1] ** 2


def test_a_longer_deployment_pays_for_its_design_in_proportion():
    objective = problem(QuadraticObjective(Q, R, design_cost=price)).objective
    plain = QuadraticObjective(Q, R)
    for steps in (15, 30, 300):
        run = loop(steps)
        np.testing.assert_allclose(run.returns(plain) - run.returns(objective), 6.25 * steps / 30)


@pytest.mark.parametrize("twin", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_copies_of_an_objective_of_lambdas_judge_alike(twin):
    own = problem(CustomObjective(lambda x, u, p: stage(x, u, p), design_cost=lambda p: price(p)))
    run = loop()
    np.testing.assert_array_equal(run.returns(twin(own).objective), run.returns(own.objective))


def test_lqr_of_a_cost_of_acceleration_beats_one_that_knows_nothing_of_it():
    own = problem(output_objective(PLANT, weights=[1.0, 2.0], R=0.01))
    blind = replace(own, objective=QuadraticObjective(np.diag([2.0, 0.0]), [[0.01]]))
    returns = [
        simulate(MODEL, saturated_lqr(one, P0), x0=[1.0, 0.0], steps=100, design=P0).returns(own.objective)[0]
        for one in (own, blind)
    ]
    assert returns[0] > 0.9 * returns[1]
    A, B, _ = MODEL.matrices(P0)
    expected = -_optimal_cost(A, B, own.weights(P0), np.array([1.0, 0.0]))
    assert returns[0] == pytest.approx(expected, rel=1e-6)


def _optimal_cost(A, B, weights, x0):
    """x₀ᵀPx₀ by the Riccati recursion itself."""
    P = np.zeros((2, 2))
    for _ in range(5000):
        G = weights.R + B.T @ P @ B
        L = weights.S.T + B.T @ P @ A
        P = weights.Q + A.T @ P @ A - L.T @ np.linalg.solve(G, L)
    return x0 @ P @ x0


@pytest.mark.parametrize("cost", [lambda p: ca.log(p[0] - 2), lambda p: ca.log(p[0] - 1), lambda p: 1 / (p[1] - 0.1)])
def test_a_design_cost_that_is_not_finite_within_the_bounds_is_refused(cost):
    with pytest.raises(InputError, match=r"objective.design_cost: got .* at k = "):
        problem(QuadraticObjective(Q, R, design_cost=cost))


def test_a_cost_that_is_no_regulators_somewhere_within_the_bounds_is_refused():
    def falling(x, u, p):
        return (p[0] - 1.5) * ca.sumsqr(x) + ca.sumsqr(u)

    with pytest.raises(InputError, match="not positive semidefinite at the design"):
        problem(CustomObjective(falling))
    assert problem(CustomObjective(falling, Q=Q, R=R)).weights(SPACE.lower).Q is not None


def test_a_constraint_of_the_design_excuses_a_cost_from_what_it_forbids():
    q = ca.SX.sym("p", 2)
    stiff = DesignSpace(["k", "c"], [1.0, 0.1], [5.0, 1.0], constraints=lambda p: 2 - p[0])
    model = discretise(Plant(x, u, w, q, ca.vertcat(x[1], -q[0] * x[0] - q[1] * x[1] + u + w), stiff, dt=0.1))
    own = replace(problem(QuadraticObjective(Q, R)), model=model, objective=CustomObjective(
        lambda x, u, p: (p[0] - 1.5) * ca.sumsqr(x) + ca.sumsqr(u), design_cost=lambda p: ca.log(p[0] - 1.5)
    ))  # fmt: skip
    assert own.weights(np.array([2.0, 0.5])).Q[0, 0] == pytest.approx(0.5)


def test_a_cost_that_arrays_do_not_have_is_named():
    table = ca.interpolant("table", "linear", [[-5.0, 0.0, 5.0]], [25.0, 0.0, 25.0])
    cost = ca.Function("cost", [y := ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("p", 2)], [table(y[0])])
    with pytest.raises(InputError, match="stage_cost: got the CasADi operations OP_CALL"):
        problem(CustomObjective(cost, Q=Q, R=R))


@pytest.mark.parametrize(
    ("extra", "jumps"),
    [
        (lambda x, u: ca.if_else(ca.fabs(u[0]) > 0.05, 2.0, 0.0), True),  # a fee for every use
        (lambda x, u: ca.if_else(x[0] > 9.0, 2.0, 0.0), False),  # outside X
        (lambda x, u: 100 * ca.fmax(x[0] - 1, 0) ** 2, False),
        (lambda x, u: ca.fabs(u[0]), False),
    ],
)
def test_a_cost_that_jumps_within_the_limits_is_noted(extra, jumps):
    own = problem(CustomObjective(lambda x, u, p: x.T @ x + u[0] ** 2 + extra(x, u), Q=Q, R=R))
    assert own.jump.startswith("the stage cost jumps (") == jumps
    assert (own.jump in own.notes) == jumps


def test_a_terminal_cost_that_jumps_is_noted_behind_sensors_too():
    own = problem(CustomObjective(lambda x, u, p: x.T @ x + u[0] ** 2, lambda x, p: ca.if_else(x[0] > 1, 5.0, 0.0)))
    assert own.jump.startswith("the terminal cost jumps (")
    X, U = (np.full(5, -4.0), np.full(5, 4.0)), own.input_bounds
    assert previewed_objective(own.objective, 3).jump(X, U, (SPACE.lower, SPACE.upper)) == own.jump
