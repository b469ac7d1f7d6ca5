"""The QP solver behind everything: scaled, checked independently, with a second solver behind it."""

import numpy as np
import pytest
from plants import SUSPENSION, box, double_integrator, suspension
from random_problems import feasible_state, hard_controller

from mpc import LinearMPC, Status, dense_qp
from mpc.dense_qp import DenseQP


def relative_kkt(problem, theta, z, y):
    """KKT residual computed from the QP as the user sees it, each row relative to its largest term."""
    q, b = problem.at(theta)
    terms = [problem.H * z, q[:, None], problem.G.T * y]
    size = np.maximum.reduce([np.abs(t).max(axis=1) for t in terms])
    stationarity = np.abs(problem.H @ z + q + problem.G.T @ y) / size
    room = np.maximum(np.abs(problem.G * z).max(axis=1), np.abs(b))
    primal = np.maximum(problem.G @ z - b, 0) / room
    push = y * np.abs(problem.G / np.sqrt(np.diag(problem.H))).max(axis=1)  # multipliers in comparable units
    dual = np.maximum(-push, 0) / max(np.abs(push).max(), np.finfo(float).tiny)
    slackness = np.abs(push * (problem.G @ z - b)) / room / max(np.abs(push).max(), np.finfo(float).tiny)
    return max(stationarity.max(), primal.max(), dual.max(), slackness.max())


@pytest.mark.long
@pytest.mark.quick(2)
@pytest.mark.parametrize("kind", ["plain"] * 4 + ["scaled", "degenerate"])
def test_five_hundred_random_problems_meet_the_optimality_conditions(kind, request):
    block = request.node.callspec.indices["kind"]
    count = 100 if kind == "plain" else 50  # 400 + 50 badly scaled + 50 nearly degenerate
    for i in range(count):
        rng = np.random.default_rng([block, i])
        controller, sx = hard_controller(rng, kind)
        x, plan = feasible_state(rng, controller, sx)
        assert plan.status is Status.SOLVED
        assert plan.residuals.worst <= 1e-6
        problem = controller.build()
        result = DenseQP(problem.H, problem.G).solve(*problem.at(x))
        assert relative_kkt(problem, x, result.z, result.multipliers) <= 1e-6


def test_a_spoilt_first_solver_is_caught_and_the_second_asked(monkeypatch):
    monkeypatch.setattr(dense_qp, "DAQP_ITERATIONS", 2)
    A, B, _ = suspension()
    controller = LinearMPC(A, B, horizon=20, **SUSPENSION)
    plan = controller.solve([-0.1, -1.0, -0.1, -0.5])
    assert plan.solver == "Clarabel"
    assert plan.status is Status.SOLVED
    monkeypatch.undo()
    tight = LinearMPC(A, B, horizon=20, **SUSPENSION).solve([-0.1, -1.0, -0.1, -0.5])
    assert tight.solver == "DAQP"
    np.testing.assert_allclose(plan.inputs, tight.inputs, atol=1e-3)


def test_when_both_solvers_fail_the_plan_says_so_and_stays_admissible(monkeypatch):
    monkeypatch.setattr(dense_qp, "DAQP_ITERATIONS", 2)
    monkeypatch.setattr(DenseQP, "_clarabel", lambda self, q, b: (0 * q, 0 * b, False))
    A, B = double_integrator()
    plan = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=10, X=box([5, 5]), U=box([1])).solve([-4.5, 0.0])
    assert plan.status is Status.INACCURATE
    assert "Rescale" in plan.status.advice
    assert np.abs(plan.inputs).max() <= 1


def test_strided_arrays_are_copied_before_daqp_sees_them():
    # daqp 0.11 reads a strided bound as if it were contiguous, without a word
    rng = np.random.default_rng(0)
    M = rng.normal(size=(6, 6))
    H, G, q, b = M @ M.T + np.eye(6), rng.normal(size=(12, 6)), 5 * rng.normal(size=6), rng.uniform(0.1, 1, 12)
    plain = DenseQP(H, G).solve(q, b)
    strided = DenseQP(np.asfortranarray(H), np.repeat(G, 2, axis=0)[::2])
    for _ in range(2):
        again = strided.solve(np.repeat(q, 3)[::3], np.repeat(b, 2)[::2])
        np.testing.assert_allclose(again.z, plain.z, atol=1e-12)


def test_warm_start_does_not_change_the_answer():
    A, B, E = suspension()
    warm = LinearMPC(A, B, horizon=20, **SUSPENSION)
    x, rng = np.array([-0.1, -1.0, -0.1, -0.5]), np.random.default_rng(1)
    for _ in range(20):
        u = warm(x)
        np.testing.assert_allclose(u, LinearMPC(A, B, horizon=20, **SUSPENSION)(x), atol=1e-6)
        x = A @ x + B @ u + E[:, 0] * 0.3 * rng.normal()
