"""Unstable plants over long horizons: true statuses, and plans that say what their inputs do."""

from itertools import pairwise

import numpy as np
import pytest
from mpc_problems import random_case
from plan_oracles import promises, verdict
from plants import box

from mpc import LinearMPC, NotStabilisableError, Status


@pytest.mark.long
@pytest.mark.quick(3)
@pytest.mark.parametrize("block", range(4))
def test_random_unstable_plants_keep_every_promise_and_agree_with_the_oracles(block):
    solved = 0
    for i in range(12):
        data, x, signals = random_case(np.random.default_rng([77, block, i]))
        try:
            controller = LinearMPC(**data)
        except NotStabilisableError:
            continue
        plan = controller.solve(x, **signals)
        assert promises(controller, plan, x, signals) == []
        assert verdict(controller, plan, x, signals) == []
        solved += plan.status is Status.SOLVED
    assert solved >= 5


A, B = np.array([[1.5, 0.3], [0.0, 1.3]]), np.array([[0.0], [1.0]])


@pytest.mark.long
@pytest.mark.parametrize("horizon", [5, 16, 17, 19, 22, 25, 40, 70, 100])
def test_a_state_that_cannot_be_brought_back_is_softened_at_every_horizon(horizon):
    mpc = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=horizon, X=box([5, 5]), U=box([1]))
    plan = mpc.solve([2.0, 2.0])
    assert plan.status is Status.SOFTENED
    assert plan.violation == np.abs(plan.states[1:]).max() - 5
    assert plan.residuals.worst <= 1e-6
    np.testing.assert_allclose(plan.inputs[:4], -1.0, atol=1e-6)  # the input that slows the unstable mode most


@pytest.mark.long
@pytest.mark.parametrize("horizon", [20, 60, 100])
def test_without_state_constraints_a_runaway_is_solved_with_the_inputs_at_their_limits(horizon):
    mpc = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=horizon, U=box([1]))
    plan = mpc.solve([20.0, 20.0])
    assert plan.status is Status.SOLVED
    assert np.abs(plan.states).max() > 1e4
    np.testing.assert_allclose(plan.inputs, -1.0, atol=1e-6)


@pytest.mark.parametrize("blocks", [(1, 1, 1, 2, 5, 10, 20, 20, 20, 20), (5,) * 20])
def test_blocks_of_moves_over_a_long_horizon_of_an_unstable_plant(blocks):
    plant = np.array([[1.1, 0.3], [0.0, 1.05]])
    mpc = LinearMPC(plant, B, Q=np.eye(2), R=[[0.1]], horizon=100, X=box([5, 5]), U=box([1]), blocks=blocks)
    plan = mpc.solve([0.1, -0.1])
    assert plan.status is Status.SOLVED
    starts = np.cumsum([0, *blocks])
    for start, end in pairwise(starts):
        np.testing.assert_array_equal(plan.inputs[start:end], np.tile(plan.inputs[start], (end - start, 1)))


@pytest.mark.long
@pytest.mark.parametrize("solver", ["osqp", "clarabel"])
def test_the_forms_with_states_kept_agree_with_the_condensed_one(solver):
    compared = 0
    for i in range(12):
        data, x, signals = random_case(np.random.default_rng([78, i]))
        try:
            dense, kept = LinearMPC(**data), LinearMPC(**data, solver=solver)
        except NotStabilisableError:
            continue
        plan, other = dense.solve(x, **signals), kept.solve(x, **signals)
        assert promises(kept, other, x, signals) == []
        assert other.status is plan.status
        np.testing.assert_allclose(other.inputs[0] / dense.input_extent, plan.inputs[0] / dense.input_extent, atol=1e-3)
        compared += 1
    assert compared >= 8
    assert repr(kept) == f"LinearMPC({kept.nx} states, {kept.nu} inputs, N={kept.horizon}, {solver})"


@pytest.mark.check
def test_a_horizon_too_long_for_dense_matrices_is_solved_with_the_states_kept():
    data = dict(Q=np.eye(2), R=[[0.1]], horizon=2000, X=box([5, 5]), U=box([1]))
    kept = LinearMPC([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], **data, solver="osqp")
    plan = kept.solve([1.0, 0.0])
    assert plan.status is Status.SOLVED
    shorter = LinearMPC([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], **(data | {"horizon": 150}))
    np.testing.assert_allclose(plan.inputs[0], shorter([1.0, 0.0]), atol=1e-4)


# a pendulum of 0.8 m held upright every 0.1 s
PENDULUM = dict(
    A=[[1.09521484375, 0.103125], [1.93359375, 1.09521484375]], B=[[0.02644856770833333], [0.5371093749999999]],
    Q=[1.0, 0.1], R=[0.001], horizon=20, X=([-12.0, -8.0], [12.0, 8.0]), U=(-2.0, 2.0),
)  # fmt: skip


@pytest.mark.parametrize("x", [(2.6, 0.0), (3.0, 0.0), (2.6, -1.0), (1.0, 1.0)])
def test_where_every_step_is_violated_the_condensed_program_finds_the_least_violation(x):
    mpc = LinearMPC(**PENDULUM)
    plan = mpc.solve(x)
    assert plan.status is Status.SOFTENED
    assert plan.solver == "DAQP"  # it was called infeasible, and solved stage by stage, in a hundred times the time
    assert promises(mpc, plan, np.array(x), {}) == []
    assert plan.inputs == pytest.approx(-2.0)  # which holds it back most


def test_softened_plans_of_a_batch_begin_with_the_inputs_of_single_ones():
    mpc = LinearMPC(**PENDULUM)
    states = np.random.default_rng(0).uniform(-1, 1, (40, 2)) * [0.5, 1.5]
    plans = [mpc.solve(x) for x in states]
    assert {plan.status for plan in plans} == {Status.SOLVED, Status.SOFTENED}
    assert mpc(states) == pytest.approx(np.array([plan.inputs[0] for plan in plans]), abs=1e-9)
