"""Sixty ways to call `mpc` wrongly: each is refused by name, none ends in an error from deep inside or in nonsense."""

import control
import numpy as np
import pytest
import scipy.sparse
from plants import box, double_integrator

from mpc import LinearMPC, MPCError, OffsetFreeMPC, lqr, solve_mpqp

A, B = double_integrator()
BASE = dict(A=A, B=B, Q=np.eye(2), R=[[0.1]], horizon=5, X=box([5, 5]), U=box([1]))
TRANSFER = control.tf([1], [1, 1], 0.1)
CONTINUOUS = control.ss(A, B, np.eye(2), 0)

CONTROLLERS = {
    "A is a transfer function": dict(A=TRANSFER, B=None),
    "A is a continuous state space": dict(A=CONTINUOUS, B=None),
    "A and B and a state space": dict(A=control.ss(A, B, np.eye(2), 0, 1.0)),
    "A is a string": dict(A="A"),
    "A is None": dict(A=None),
    "A is an empty list": dict(A=[]),
    "A has an infinite entry": dict(A=[[1, np.inf], [0, 1]]),
    "A is sparse": dict(A=scipy.sparse.eye(2)),
    "A is three-dimensional": dict(A=np.ones((2, 2, 2))),
    "A is a set": dict(A={1, 2}),
    "A holds strings of numbers": dict(A=[["1", "1"], ["0", "1"]]),
    "B is missing": dict(B=None),
    "B is a vector": dict(B=[0.5, 1.0]),
    "B holds None": dict(B=[[None], [1.0]]),
    "Q is negative": dict(Q=-1.0),
    "Q has the wrong size": dict(Q=[1.0, 1.0, 1.0]),
    "Q is NaN": dict(Q=np.nan),
    "Q is a dictionary": dict(Q={"x": 1}),
    "R is not symmetric": dict(B=np.eye(2), R=[[1, 1], [0, 1]], U=None),
    "R is negative": dict(R=-0.1),
    "R is a string": dict(R="small"),
    "horizon is a fraction": dict(horizon=2.5),
    "horizon is True": dict(horizon=True),
    "horizon is negative": dict(horizon=-3),
    "horizon is a string": dict(horizon="10"),
    "horizon is an array": dict(horizon=np.array([3])),
    "horizon needs more memory than there is": dict(horizon=10**6),
    "P is negative": dict(P=[-1.0, 1.0]),
    "P has the wrong size": dict(P=np.eye(3)),
    "X is a number": dict(X=5.0),
    "X is reversed": dict(X=([5, 5], [-5, -5])),
    "X has three bounds": dict(X=(-1, 0, 1)),
    "X has bounds of the wrong size": dict(X=([-1, -1, -1], [1, 1, 1])),
    "X has a NaN bound": dict(X=([-1, np.nan], [1, 1])),
    "X has a bound that is a string": dict(X=("low", "high")),
    "U has the dimension of X": dict(U=box([1, 1])),
    "U is empty": dict(U=(1.0, -1.0)),
    "U is a string": dict(U="-1..1"),
    "terminal_set is a matrix": dict(terminal_set=np.eye(2)),
    "E has the wrong size": dict(E=np.ones((3, 1))),
    "E is a vector": dict(E=[1.0, 0.0]),
    "rate_limit is zero": dict(rate_limit=0.0),
    "rate_limit is NaN": dict(rate_limit=np.nan),
    "rate_limit is a string": dict(rate_limit="slow"),
    "soft is a number": dict(soft=1e4),
    "soft has a negative weight": dict(soft=(-1, 1)),
    "soft is a string": dict(soft="yes"),
    "blocks do not sum to the horizon": dict(blocks=(1, 2)),
    "blocks hold a zero": dict(blocks=(0, 5)),
    "blocks are a string": dict(blocks="12"),
    "uses an unknown signal": dict(uses=("weather",)),
    "uses a preview without E": dict(uses="preview"),
    "uses a number": dict(uses=3),
}


@pytest.mark.parametrize("change", CONTROLLERS.values(), ids=CONTROLLERS)
def test_a_wrong_controller_is_refused(change):
    data = BASE | change
    with pytest.raises(MPCError, match=r"got .*expected"):
        LinearMPC(data.pop("A"), data.pop("B"), **data)


@pytest.fixture(scope="module")
def controller():
    return LinearMPC(**BASE)


STATES = {
    "a wrong size": [1.0],
    "a matrix of the wrong width": np.ones((3, 4)),
    "three dimensions": np.ones((1, 1, 2)),
    "a string": "origin",
    "None": None,
    "NaN": [np.nan, 0.0],
    "strings of numbers": ["1", "2"],
    "a ragged list": [[1.0, 2.0], [1.0]],
    "a dictionary": {"x": 1.0},
    "a number": 3.0,
}


@pytest.mark.parametrize("x", STATES.values(), ids=STATES)
def test_a_wrong_state_is_refused(controller, x):
    asks = [controller, controller.solve, controller.explain]
    if not isinstance(x, np.ndarray):
        asks.append(controller.solve_many)
    for ask in asks:
        with pytest.raises(MPCError, match=r"got .*expected"):
            ask(x)


@pytest.mark.parametrize(
    "signals",
    [{"x_ref": "here"}, {"x_ref": np.ones((2, 2))}, {"u_ref": [np.inf]}, {"w": [1.0]}, {"u_prev": [0.0]}, {"r": [1.0]}],
    ids=str,
)
def test_a_wrong_signal_is_refused(controller, signals):
    for ask in (controller, controller.solve_many, controller.explain):
        with pytest.raises((MPCError, TypeError), match=r"got .*expected|unexpected keyword"):
            ask([[1.0, 0.0]] if ask is controller.solve_many else [1.0, 0.0], **signals)


def test_a_wrong_question_to_the_problem_is_refused(controller):
    qp = controller.build()
    for ask in (
        lambda: controller.build("weather"),
        lambda: controller.build(3),
        lambda: qp.theta(x="here"),
        lambda: qp.theta(y=[1.0, 0.0]),
        lambda: qp.at([1.0]),
        lambda: qp.cost([1.0], [0.0, 0.0]),
        lambda: qp.inputs(np.zeros(4), np.zeros(2)),
        lambda: qp.states(np.zeros(5), None),
        lambda: qp.fix(w=[1.0]),
        lambda: qp.fix(x=[1.0, 2.0, 3.0]),
        lambda: qp.without([1000]),
        lambda: qp.without(["first"]),
        lambda: qp.without(3),
    ):
        with pytest.raises(MPCError, match=r"got .*expected"):
            ask()


def test_a_wrong_regulator_is_refused():
    for call in (
        lambda: lqr(TRANSFER, Q=1, R=1),
        lambda: lqr(CONTINUOUS, Q=1, R=1),
        lambda: lqr(A, B, Q=None, R=1),
        lambda: lqr(A, B, Q=1, R=[1, 1]),
        lambda: lqr(A, None, Q=1, R=1),
        lambda: lqr(np.diag([2.0, 0.5]), [[0.0], [1.0]], Q=1, R=1),
        lambda: lqr([[np.nan]], [[1.0]], Q=1, R=1),
    ):
        with pytest.raises(MPCError, match=r"got .*expected"):
            call()


def test_a_wrong_offset_free_controller_is_refused(controller):
    good = OffsetFreeMPC(controller, [[1.0, 0.0]])
    for call in (
        lambda: OffsetFreeMPC("mpc", [[1.0, 0.0]]),
        lambda: OffsetFreeMPC(controller, [1.0, 0.0]),
        lambda: OffsetFreeMPC(controller, [[1.0, 0.0, 0.0]]),
        lambda: OffsetFreeMPC(controller, [[1.0, 0.0]], gain=2.0),
        lambda: OffsetFreeMPC(controller, [[1.0, 0.0]], gain="half"),
        lambda: OffsetFreeMPC(controller, [[1.0, 0.0]], gain=np.nan),
        lambda: OffsetFreeMPC(controller, [[1.0, 0.0]], disturbance=[1.0]),
        lambda: good.target([1.0, 2.0]),
        lambda: good.target(None),
        lambda: good([1.0, 0.0]),
        lambda: good([1.0], [0.0]),
        lambda: good.observe([1.0, 0.0], [0.0], [np.nan, 0.0]),
        lambda: good.observe([1.0, 0.0], [0.0, 0.0], [1.0, 0.0]),
        lambda: good.loop(0),
        lambda: good.loop(2)([1.0, 0.0], x_ref=[0.0, 0.0]),
    ):
        with pytest.raises(MPCError, match=r"got .*expected"):
            call()


def test_data_that_cannot_be_read_as_numbers_are_refused(controller):
    class Unreadable:
        def __array__(self, *args, **kwargs):
            raise RuntimeError("no array here")

    class NoTime:
        A, B = BASE["A"], BASE["B"]

    options = dict(Q=1.0, R=1.0, horizon=3)
    for ask in (
        lambda: controller([10**400, 0.0]),
        lambda: controller(Unreadable()),
        lambda: LinearMPC(NoTime(), **options),
        lambda: LinearMPC(A, B, **options, U=(np.inf, np.inf)),
        lambda: LinearMPC(A, B, **options, X=(-np.inf, -np.inf)),
        lambda: controller.explicit(parameters=3),
        lambda: controller.explicit(tree_time_limit="long"),
        lambda: solve_mpqp(controller.build(), BASE["X"], max_regions=10**400),
        lambda: controller.explicit().save(""),
        lambda: controller([1.0, 1.0], weather=3),
        lambda: controller.explicit().plot(ax=3),
        lambda: lqr(1e160 * np.asarray(A), B, Q=1.0, R=1.0),
    ):
        with pytest.raises(MPCError, match=r"got .{1,120}expected"):
            ask()


def test_offset_free_control_takes_no_signals_that_it_sets_itself(controller):
    tracking = OffsetFreeMPC(controller, [[1.0, 0.0]])
    for ask in (
        lambda: tracking([1.0, 1.0], [1.0], w=[0.0, 0.0]),
        lambda: tracking.solve([1.0, 1.0], [1.0], x_ref=[1.0, 1.0]),
        lambda: tracking([1.0, 1.0], [1.0], weather=2),
    ):
        with pytest.raises(MPCError, match="none but u_prev"):
            ask()


def test_no_time_limit_can_be_said_in_both_ways(controller):
    for limit in (None, np.inf, 10**400):
        assert len(controller.explicit(time_limit=limit, tree_time_limit=limit)) > 1


def test_what_is_returned_cannot_be_written_to(controller):
    plan = controller.solve([1.0, 1.0])
    target = OffsetFreeMPC(controller, [[1.0, 0.0]]).nearest_target([1.0])
    for array in (plan.inputs, plan.states, target.state, target.input, controller.P, controller.riccati_gain):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0


def test_reprs_fit_two_lines(controller):
    tracking = OffsetFreeMPC(controller, [[1.0, 0.0]])
    for thing in (controller, controller.explain([4.9, 4.9]), tracking, tracking.loop(3), controller.explicit()):
        assert len(repr(thing)) <= 240
        assert " object at " not in repr(thing)
