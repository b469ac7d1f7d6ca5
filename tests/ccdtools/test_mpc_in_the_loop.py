"""Every kind of MPC closes the loop: rate limits, references, previews and offset-free tracking."""

import control
import numpy as np
import pytest

from ccdtools import LinearFeedback, QuadraticObjective, Scenario, compare, simulate
from ccdtools.controllers import Reference
from ccdtools.plants import LinearModel
from invariant_sets import Polytope
from mpc import LinearMPC, OffsetFreeMPC, lqr

A, B = np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.02], [0.2]])
E = np.array([[0.0], [0.2]])
Q, R = np.diag([10.0, 1.0]), [[0.1]]
X, U = Polytope.from_bounds([-5, -5], [5, 5]), Polytope.from_bounds([-3], [3])
PLANT = LinearModel.from_state_space(control.ss(A, B, np.eye(2), 0, 0.2), E=E)
STARTS = np.array([[2.0, 0.0], [-1.0, 1.0], [0.5, -2.0]])
LQR = LinearFeedback(lqr(A, B, Q=Q, R=R)[0], [-3], [3])


def mpc(**options):
    return LinearMPC(A, B, Q=Q, R=R, horizon=10, X=X, U=U, **options)


def test_a_rate_limit_holds_from_the_first_sample_on():
    run = simulate(PLANT, mpc(rate_limit=0.4), x0=STARTS, steps=40)
    steps = np.diff(run.inputs[..., 0], axis=1, prepend=0.0)
    assert np.abs(steps).max() == pytest.approx(0.4, abs=1e-7)
    assert np.abs(run.states[:, -1]).max() < 0.2


def test_the_loop_of_a_rate_limited_controller_is_that_written_by_hand():
    controller = mpc(rate_limit=0.4)
    run = simulate(PLANT, controller, x0=STARTS, steps=8)
    for i, x in enumerate(STARTS):
        u = np.zeros(1)
        for k in range(8):
            u = controller(x, u_prev=u)
            np.testing.assert_allclose(run.inputs[i, k], u, atol=1e-6)
            x = A @ x + B @ u


def test_a_reference_is_followed():
    run = simulate(PLANT, mpc(uses=("reference",)), x0=STARTS, steps=40, reference=[1.5, 0.0])
    np.testing.assert_allclose(run.states[:, -1], np.tile([1.5, 0.0], (3, 1)), atol=1e-3)


def test_a_reference_that_moves_is_seen_coming():
    rows = np.zeros((40, 2))
    rows[20:, 0] = 1.0
    seen = simulate(PLANT, mpc(uses=("reference",)), x0=[0.0, 0.0], steps=40, reference=Reference(rows, [0.0]))
    assert seen.states[0, 19, 0] > 0.05  # it starts before the step
    np.testing.assert_allclose(seen.states[0, -1], [1.0, 0.0], atol=1e-2)


def test_a_preview_of_the_disturbance_lowers_the_cost():
    w = np.zeros((3, 40, 1))
    w[:, 15:20] = [[[2.0]], [[-2.0]], [[3.0]]]
    objective = QuadraticObjective(Q, R)
    blind, ahead = (
        simulate(PLANT, controller, x0=np.zeros((3, 2)), steps=40, disturbance=w).returns(objective)
        for controller in (mpc(), mpc(E=E, uses=("preview",)))
    )
    assert (ahead > 0.9 * blind).all()


@pytest.mark.parametrize("limited", [False, True])
def test_offset_free_tracking_settles_in_spite_of_a_constant_disturbance(limited):
    regulator = mpc(E=E, rate_limit=1.0) if limited else mpc(E=E)
    w = np.tile([[[1.0]], [[-0.7]]], (1, 60, 1))
    controller = OffsetFreeMPC(regulator, [[1.0, 0.0]])
    run = simulate(PLANT, controller, x0=np.zeros((2, 2)), steps=60, disturbance=w, reference=[1.0, 0.0])
    np.testing.assert_allclose(run.states[:, -1, 0], 1.0, atol=1e-3)
    plain = simulate(PLANT, LQR, x0=np.zeros((2, 2)), steps=60, disturbance=w)
    assert (np.abs(plain.states[:, -1, 0]) > 0.05).all()


def test_an_offset_free_controller_learns_nothing_between_simulations():
    controller = OffsetFreeMPC(mpc(E=E), [[1.0, 0.0]])
    options = {"x0": [0.0, 0.0], "steps": 10, "disturbance": np.ones((10, 1)), "reference": [1.0, 0.0]}
    first, again = (simulate(PLANT, controller, **options).states for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert not controller.disturbance.any()


def test_all_of_them_enter_one_comparison():
    rng = np.random.default_rng(0)
    scenario = Scenario(PLANT, STARTS, 0.1 * rng.standard_normal((3, 20, 1)), reference=[0.0, 0.0])
    controllers = {
        "LQR": LQR, "MPC": mpc(), "rate-limited": mpc(rate_limit=0.5), "tracking": mpc(uses=("reference",)),
        "preview": mpc(E=E, uses=("preview",)), "offset-free": OffsetFreeMPC(mpc(E=E), [[1.0, 0.0]]),
        "explicit": mpc().explicit(),
    }  # fmt: skip
    table = compare(controllers, scenario, objective=QuadraticObjective(Q, R), X=X)
    assert [score.controller for score in table] == list(controllers)
    assert all(score.diverged == 0 for score in table)
    assert table["preview"].summary.mean > table["MPC"].summary.mean
    assert table["tracking"].summary.mean == pytest.approx(table["MPC"].summary.mean, rel=1e-6)
    assert table["explicit"].summary.mean == pytest.approx(table["MPC"].summary.mean, rel=1e-6)
