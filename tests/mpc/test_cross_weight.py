"""The cross weight S: outputs y = Cx + Du weighed through it, against oracles that know the outputs alone."""

import copy

import control
import numpy as np
import pytest
from compiler import needs_compiler
from mpc_problems import crossed_case
from plan_oracles import promises, verdict
from plants import SUSPENSION, box, double_integrator, suspension
from scipy.optimize import minimize
from test_codegen import run_c
from weighted_outputs import law_faults, output_case, output_cost, output_faults, output_plan

from mpc import InputError, LinearMPC, NotConvexError, NotStabilisableError, OffsetFreeMPC, Status, lqr


def outputs_of(rng, n, m):
    """(A, B, C, D): a plant and outputs with feedthrough from every input."""
    A, ny = rng.normal(size=(n, n)), int(rng.integers(m, n + m + 1))
    A *= rng.uniform(0.5, 1.5) / np.abs(np.linalg.eigvals(A)).max()
    return A, rng.normal(size=(n, m)), rng.normal(size=(ny, n)), rng.normal(size=(ny, m))


def weights(C, D, rho=0.0):
    """Q, R and S of the cost |Cx + Du|² + ρ|u|²."""
    return {"Q": C.T @ C, "R": D.T @ D + rho * np.eye(D.shape[1]), "S": C.T @ D}


def body_acceleration():
    """Row (C, D) of the acceleration of the body in the quarter car of `suspension`."""
    ks, cs, ms = 27692.0, 1906.5, 325.0
    return np.array([[0.0, cs / ms, -ks / ms, -cs / ms]]), np.array([[1 / ms]])


@pytest.mark.parametrize("seed", range(20))
def test_the_regulator_agrees_with_dlqr_and_its_N(seed):
    rng = np.random.default_rng(seed)
    A, B, C, D = outputs_of(rng, int(rng.integers(1, 6)), int(rng.integers(1, 4)))
    w = weights(C, D, 10.0 ** rng.uniform(-4, 0))
    K, P = lqr(A, B, **w)
    K_ref, P_ref, _ = control.dlqr(A, B, w["Q"], w["R"], w["S"])
    np.testing.assert_allclose(K, K_ref, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(P, P_ref, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("seed", range(20))
def test_the_regulator_is_that_of_the_plant_whose_input_has_the_cross_term_taken_out(seed):
    rng = np.random.default_rng([1, seed])
    A, B, C, D = outputs_of(rng, int(rng.integers(1, 6)), int(rng.integers(1, 4)))
    w = weights(C, D, 0.01)
    free = np.linalg.solve(w["R"], w["S"].T)
    left = w["Q"] - w["S"] @ free
    K_ref, P_ref = lqr(A - B @ free, B, Q=(left + left.T) / 2, R=w["R"])
    sx, su, c = 10.0 ** rng.uniform(-4, 4, len(A)), 10.0 ** rng.uniform(-4, 4, B.shape[1]), 10.0 ** rng.uniform(-6, 6)
    K, P = lqr(
        A * sx[:, None] / sx, B * sx[:, None] / su, Q=c * w["Q"] / np.outer(sx, sx), R=c * w["R"] / np.outer(su, su),
        S=c * w["S"] / np.outer(sx, su),
    )  # fmt: skip
    np.testing.assert_allclose(K * sx / su[:, None], K_ref + free, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(P * np.outer(sx, sx) / c, P_ref, rtol=1e-6, atol=1e-8)


def test_the_cost_matrix_is_what_the_outputs_sum_to():
    A, B, _ = suspension()
    C, D = body_acceleration()
    C, D = np.vstack([C, [[10.0, 0.0, 0.0, 0.0], [0.0, 0.0, 10.0, 0.0]]]), np.vstack([D, [[0.0], [0.0]]])
    K, P = lqr(A, B, **weights(C, D))
    for x0 in np.eye(4):
        x, cost = x0, 0.0
        for _ in range(2000):
            y = (C - D @ K) @ x
            cost += y @ y
            x = (A - B @ K) @ x
        assert cost == pytest.approx(x0 @ P @ x0, rel=1e-9)


def test_a_singular_R_is_legal_with_a_cross_weight_too():
    A, B = double_integrator()
    B = np.hstack([B, [[1.0], [0.0]]])
    Q, S = np.eye(2), np.array([[0.3, 0.0], [0.1, 0.0]])
    K, P = lqr(A, B, Q=Q, R=[1.0, 0.0], S=S)
    assert np.abs(np.linalg.eigvals(A - B @ K)).max() < 1
    K_ref, P_ref = lqr(A, B, Q=Q, R=[1.0, 1e-10], S=S)
    np.testing.assert_allclose(P, P_ref, atol=1e-8)
    np.testing.assert_allclose(K, K_ref, atol=1e-8)


def test_a_zero_of_the_outputs_on_the_unit_circle_is_refused():
    A, B = double_integrator()
    w = weights(np.array([[0.0, 1.0]]), np.array([[1.0]]))  # u = -x2 costs nothing and leaves x1 where it is
    with pytest.raises(NotStabilisableError, match="S: got a stage cost without weight on the mode of A - BR⁻¹S' at"):
        lqr(A, B, **w)
    K, _ = lqr(A, B, **(w | {"Q": w["Q"] + np.diag([1e-3, 0.0])}))
    assert np.abs(np.linalg.eigvals(A - B @ K)).max() < 1


def test_a_cross_weight_of_zero_is_none():
    A, B = double_integrator()
    data = dict(Q=np.eye(2), R=[[0.1]], horizon=10, X=box([5, 5]), U=box([1]))
    for solver in ("daqp", "osqp", "clarabel"):
        plain, crossed = (LinearMPC(A, B, **data, S=S, solver=solver) for S in (None, np.zeros((2, 1))))
        np.testing.assert_allclose(crossed.P, plain.P, rtol=1e-12)
        np.testing.assert_allclose(crossed.solve([3, -1]).inputs, plain.solve([3, -1]).inputs, atol=1e-8)


@pytest.mark.parametrize("seed", range(24))
def test_every_solver_finds_the_plan_of_least_output_cost_in_any_units(seed):
    rng = np.random.default_rng([11, seed])
    data, outputs, x, signals = output_case(rng)
    units = tuple(10.0 ** rng.uniform(-4, 4, size) for size in (len(x), data["B"].shape[1], None))
    for solver in ("daqp", "osqp", "clarabel"):
        assert output_faults(data, outputs, x, signals, units, solver)[1] == []


@pytest.mark.parametrize("seed", [[1, 2, 974], [1, 2, 428], [0, 2, 392]])
def test_outputs_that_cancel_to_a_small_cost_are_planned_to_as_many_digits(seed):
    rng = np.random.default_rng(seed)  # weights of inputs five powers of ten apart, states that offset them
    data, outputs, x, signals = output_case(rng)
    units = tuple(10.0 ** rng.uniform(-4, 4, size) for size in (len(x), data["B"].shape[1], None))
    for solver in ("daqp", "osqp", "clarabel"):
        assert output_faults(data, outputs, x, signals, units, solver) == (Status.SOLVED, [])


def test_references_enter_the_cross_term():
    A, B = double_integrator()
    C, D = np.array([[1.0, 0.5]]), np.array([[2.0]])
    data = dict(A=A, B=B, **weights(C, D, 0.1), horizon=6, U=box([10]))
    signals = {"x_ref": np.tile([1.0, 0.3], (7, 1)), "u_ref": np.full((6, 1), -0.4)}
    rows = (np.vstack([C, [[0.0, 0.0]]]), np.vstack([D, [[np.sqrt(0.1)]]]))
    controller = LinearMPC(**data)
    plan = controller.solve([0.5, 0.1], **signals)
    inputs, states = output_plan(data, rows, controller.P, np.array([0.5, 0.1]), signals)
    np.testing.assert_allclose(plan.inputs, inputs, atol=1e-7)
    assert plan.cost == pytest.approx(output_cost(data, rows, controller.P, inputs, states, signals))


@pytest.mark.parametrize("seed", range(12))
def test_unstable_plants_over_long_horizons_with_a_cross_weight(seed):
    data, x, signals = crossed_case(np.random.default_rng([12, seed]))
    controller = LinearMPC(**data)
    plan = controller.solve(x, **signals)
    assert promises(controller, plan, x, signals) + verdict(controller, plan, x, signals) == []


@pytest.mark.long
def test_what_runs_away_is_solved_stage_by_stage_with_a_cross_weight():
    A, B, C, D = np.diag([1.4, 0.5]), np.array([[1.0], [1.0]]), np.array([[1.0, 0.2]]), np.array([[0.7]])
    data = dict(A=A, B=B, **weights(C, D, 0.1), horizon=80, U=box([1.0]))
    plan = LinearMPC(**data).solve([10.0, 0.0])
    assert plan.solver == "stagewise"
    assert plan.status is Status.SOLVED
    np.testing.assert_allclose(plan.inputs[:70], -1.0, atol=1e-6)  # nothing holds it: all that the input can


def test_the_condensed_hessian_of_an_unstable_plant_is_block_diagonal_with_a_cross_weight():
    rng = np.random.default_rng(16)
    A, B = np.diag([1.3, 0.8]), rng.normal(size=(2, 2))
    data = dict(A=A, B=B, **weights(rng.normal(size=(3, 2)), rng.normal(size=(3, 2)), 0.1), U=box([1.0, 1.0]))
    for blocks in (None, (1, 3, 6) * 4):
        H = LinearMPC(**data, horizon=40, blocks=blocks).build().H
        beside = H * (1 - np.kron(np.eye(len(H) // 2), np.ones((2, 2))))
        assert np.abs(beside).max() < 1e-8 * np.abs(H).max()


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 2, 3, 4])
def test_the_explicit_law_is_the_plan_of_least_output_cost(seed):
    compared, faults = law_faults(np.random.default_rng([13, seed, 3]))
    assert faults == []
    assert compared > 0


@pytest.mark.long
@needs_compiler
def test_the_c_code_of_a_weighted_body_acceleration_is_the_online_controller(tmp_path):
    A, B, _ = suspension()
    C, D = body_acceleration()
    own = weights(C, D, 1e-8)
    controller = LinearMPC(A, B, **(SUSPENSION | own | {"Q": own["Q"] + np.diag([10.0, 1.0, 50.0, 5.0])}), horizon=3)
    controller.explicit().to_c(tmp_path)
    x = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 4)) * [0.25, 2.5, 0.5, 2.5]
    solved = np.array([plan.status is Status.SOLVED for plan in controller.solve_many(x)])
    u = run_c(tmp_path, x, "double").reshape(50, 2)[:, 0]
    assert solved.sum() > 20
    np.testing.assert_allclose(u[solved], controller(x)[solved, 0], atol=1e-6 * 1000)


def test_a_target_of_least_cost_counts_the_cross_term():
    A, B = np.array([[0.9]]), np.array([[0.1, 0.2]])
    C, D = np.array([[1.0]]), np.array([[2.0, -1.0]])
    mpc = LinearMPC(A, B, **weights(C, D, 0.05), horizon=5, U=box([10, 10]))
    x, u = OffsetFreeMPC(mpc, [[1.0]]).target([1.5])
    cost = lambda v: float(np.sum((1.5 * C[:, 0] + D @ v) ** 2) + 0.05 * v @ v)  # noqa: E731
    steady = {"type": "eq", "fun": lambda v: B[0] @ v - 0.1 * 1.5}
    best = minimize(cost, np.zeros(2), constraints=steady, method="SLSQP", tol=1e-12)
    np.testing.assert_allclose(x, [1.5], atol=1e-6)
    np.testing.assert_allclose(u, best.x, atol=1e-4)


def test_another_design_and_a_copy_keep_the_cross_weight():
    A, B = double_integrator()
    mpc = LinearMPC(A, B, **weights(np.eye(2), np.ones((2, 1)), 0.1), horizon=5, U=box([1]))
    other = mpc.with_model(1.01 * A, B)
    np.testing.assert_allclose(other.P, lqr(1.01 * A, B, Q=mpc.Q, R=mpc.R, S=mpc.S)[1])
    np.testing.assert_array_equal(copy.deepcopy(mpc)([0.2, 0.1]), mpc([0.2, 0.1]))


@pytest.mark.parametrize(
    ("S", "error", "message"),
    [
        ([[0.1, 0.2]], InputError, r"S: got shape \(1, 2\), expected \(2, 1\)"),
        ([0.1, 0.2], InputError, r"S: got shape \(2,\), expected \(2, 1\)"),
        ([[np.nan], [0.0]], InputError, r"S: got nan at index \(0, 0\)"),
        ([[1.1], [0.0]], NotConvexError, r"S: got a stage cost \[Q S; S' R\] with a negative direction"),
        ([[0.0], [1e-20]], NotConvexError, r"S: got .* at index \(1, 0\) where Q\[1, 1\] = 0"),
    ],
)
@pytest.mark.parametrize("size", [1e-8, 1.0, 1e8])
def test_a_bad_cross_weight_is_named_in_any_units(S, error, message, size):
    A, B = double_integrator()
    data = dict(Q=np.diag([size**2, 0.0]), R=[[1.0]], S=size * np.array(S))
    for call in (lambda: lqr(A, B, **data), lambda: LinearMPC(A, B, **data, horizon=5, P=np.eye(2))):
        with pytest.raises(error, match=message):
            call()


def test_a_cross_weight_of_no_numbers_is_refused():
    A, B = double_integrator()
    with pytest.raises(InputError, match=r"S: got '.*, expected numbers of shape"):
        lqr(A, B, Q=np.eye(2), R=[[1.0]], S="x")


def test_outputs_alone_are_a_legal_cost_however_they_round():
    for seed in range(200):
        rng = np.random.default_rng([14, seed])
        n, m, ny = (int(rng.integers(1, 8)) for _ in range(3))
        C = rng.normal(size=(ny, n)) * 10.0 ** rng.uniform(-6, 6, n)
        D = rng.normal(size=(ny, m)) * 10.0 ** rng.uniform(-6, 6, m)
        LinearMPC(0.5 * np.eye(n), np.eye(n, m), **weights(C, D, 1e-3 * (D**2).sum()), P=np.eye(n), horizon=2)
