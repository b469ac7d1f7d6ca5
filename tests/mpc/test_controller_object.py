"""The controller as an object: copies, threads, signals of a closed loop, and how sets and weights may be given."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from plants import box, double_integrator

from invariant_sets import Polytope
from mpc import InputError, LinearMPC, NotConvexError, NotStabilisableError, OffsetFreeMPC, lqr

A, B = double_integrator()
DATA = dict(Q=np.eye(2), R=[[0.1]], horizon=10, X=box([5, 5]), U=box([1]))


@pytest.mark.parametrize("extra", [{}, {"solver": "osqp"}, {"E": np.eye(2), "soft": (1.0, 1e3)}], ids=str)
def test_copies_answer_like_the_original(extra):
    controller = LinearMPC(A, B, **DATA, **extra)
    u = controller([3.0, -1.0])
    for twin in (copy.deepcopy(controller), pickle.loads(pickle.dumps(controller))):
        np.testing.assert_allclose(twin([3.0, -1.0]), u, atol=1e-9)
        assert repr(twin) == repr(controller)
    qp = pickle.loads(pickle.dumps(controller.build()))
    np.testing.assert_array_equal(qp.H, controller.build().H)
    loop = copy.deepcopy(OffsetFreeMPC(controller, [[1.0, 0.0]]).loop(1))
    assert np.isfinite(loop([1.0, 0.0], x_ref=[0.0, 0.0], u_prev=[0.0])).all()


@pytest.mark.parametrize(
    "error",
    [
        InputError("x", "1", "2", "Pass 2."),
        NotConvexError("Q", "-1", "Q ⪰ 0", eigenvalue=-1.0),
        NotStabilisableError("(A, B): got 1.1, expected less.", 1.1 + 0j),
    ],
    ids=lambda e: type(e).__name__,
)
def test_errors_pickle_with_their_data(error):
    twin = pickle.loads(pickle.dumps(error))
    assert str(twin) == str(error)
    assert vars(twin) == vars(error)


@pytest.mark.check
@pytest.mark.parametrize("solver", ["daqp", "osqp"])
def test_one_controller_answers_many_threads(solver):
    controller = LinearMPC(A, B, **DATA, solver=solver)
    states = np.random.default_rng(0).uniform(-3, 3, size=(60, 2))
    alone = np.array([LinearMPC(A, B, **DATA, solver=solver)(x) for x in states])
    with ThreadPoolExecutor(8) as pool:
        together = np.array(list(pool.map(controller, np.tile(states, (5, 1)))))
    np.testing.assert_allclose(together, np.tile(alone, (5, 1)), atol=1e-6)


def test_needs_say_what_a_loop_hands_over():
    assert LinearMPC(A, B, **DATA).needs == frozenset()
    assert LinearMPC(A, B, **DATA, rate_limit=0.1).needs == {"last_input"}
    assert LinearMPC(A, B, **DATA, E=np.eye(2), uses=("reference", "preview")).needs == {"reference", "preview"}
    assert OffsetFreeMPC(LinearMPC(A, B, **DATA), [[1.0, 0.0]]).needs == {"reference"}
    assert OffsetFreeMPC(LinearMPC(A, B, **DATA), [[1.0, 0.0]]).loop(3).needs == {"reference", "last_input"}


def test_a_batch_takes_signals_of_its_own_for_each_state():
    controller = LinearMPC(A, B, **DATA, E=np.eye(2), rate_limit=0.5)
    rng = np.random.default_rng(1)
    X, last, w = rng.uniform(-1, 1, (3, 2)), rng.uniform(-0.5, 0.5, (3, 1)), 0.1 * rng.normal(size=(3, 10, 2))
    ref = np.repeat(rng.uniform(-1, 1, (3, 1, 2)), 11, axis=1)
    each = [controller(x, u_prev=u, w=v, x_ref=r) for x, u, v, r in zip(X, last, w, ref)]
    np.testing.assert_allclose(controller(X, u_prev=last, w=w, x_ref=ref), each, atol=1e-9)


def test_a_loop_of_offset_free_controllers_leaves_no_offset_in_any_run():
    loop = OffsetFreeMPC(LinearMPC(A, B, **DATA), [[1.0, 0.0]]).loop(3)
    pushes = np.array([[0.0, 0.1], [0.05, 0.0], [0.0, -0.1]])
    for _ in range(2):  # the second time from the start again
        x, u = np.zeros((3, 2)), np.zeros((3, 1))
        loop.reset(3)
        for _ in range(80):
            u = loop(x, x_ref=[2.0, 0.0], u_prev=u)
            x = 0.97 * x @ A.T + 1.1 * u @ B.T + pushes
        np.testing.assert_allclose(x[:, 0], 2.0, atol=1e-5)


def test_weights_may_be_numbers_and_sets_may_be_bounds():
    short = LinearMPC(A, B, Q=1.0, R=0.1, horizon=10, X=([-5, -5], [5, 5]), U=(-1, 1))
    np.testing.assert_allclose(short([3.0, -1.0]), LinearMPC(A, B, **DATA)([3.0, -1.0]))
    one_sided = LinearMPC(A, B, Q=1, R=1, horizon=3, X=([-np.inf, -1.0], np.inf))
    assert one_sided.state_rows[0].tolist() == [[0.0, -1.0]]
    assert isinstance(short.U, Polytope)
    K, _ = lqr(A, B, Q=1.0, R=0.1)
    np.testing.assert_allclose(K, lqr(A, B, Q=np.eye(2), R=[[0.1]])[0])


def test_no_weight_at_all_is_legal_where_nothing_has_to_be_stabilised():
    K, P = lqr(0.5 * np.eye(2), [[1.0], [0.0]], Q=0.0, R=1.0)
    np.testing.assert_allclose(K, 0.0, atol=1e-12)
    np.testing.assert_allclose(P, 0.0, atol=1e-12)
    K, _ = lqr([[2.0]], [[1.0]], Q=0.0, R=1.0)
    assert K[0, 0] == pytest.approx(1.5)  # the least energy that stabilises: the eigenvalue 2 goes to 1/2
    with pytest.raises(NotStabilisableError, match="Q: got no weight on the mode at eigenvalue 1, on the unit circle"):
        lqr(A, B, Q=0.0, R=1.0)


def test_the_target_says_when_no_steady_state_exists():
    stuck = LinearMPC([[1.0, 0.0], [0.0, 0.5]], [[0.0], [1.0]], Q=1.0, R=1.0, horizon=5, P=np.eye(2), U=(-1, 1),
                      X=([-5, -5], [5, 5]), E=np.eye(2))  # fmt: skip
    controller = OffsetFreeMPC(stuck, [[0.0, 1.0]], disturbance=[0.3, 0.1])  # nothing balances the first push
    with pytest.raises(InputError, match=r"no steady state in X and U .* drifts by"):
        controller.target([0.5])
    best = controller.nearest_target([0.5])
    assert not best.steady
    np.testing.assert_allclose(best.drift, [0.3, 0.0], atol=1e-6)
    np.testing.assert_allclose(best.state[1], 0.5, atol=1e-4)
    assert np.isfinite(controller([0.0, 0.0], [0.5])).all()
    balanced = OffsetFreeMPC(stuck, [[0.0, 1.0]], disturbance=[0.0, 0.1]).nearest_target([0.5])
    assert balanced.steady
    np.testing.assert_allclose(balanced.state[1], 0.5, atol=1e-6)


@pytest.mark.parametrize("steps", [10, 20, 40, 60])
def test_a_target_that_is_reached_to_the_last_digit_is_no_conflict(steps):
    # every input at its limit brings the integrator exactly onto the bound: 0.1 summed up, not multiplied
    x = float(np.sum(np.full(steps, 0.1)))
    data = dict(Q=1.0, R=1.0, horizon=steps, U=(-0.1, 0.1))
    exact = LinearMPC([[1.0]], [[1.0]], **data, terminal_set=(-1.0, 0.0))
    for start in (x, np.nextafter(x, 10.0), x + 1e-12):
        assert exact.explain([start]).feasible
        assert exact.solve([start]).feasible
    why = exact.explain([x + 1e-3])
    assert len(why.conflict) == steps + 1
    assert not exact.solve([x + 1e-3]).feasible
