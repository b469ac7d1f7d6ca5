"""What counts as rounding and what as data: each threshold lies between two problems."""

from contextlib import nullcontext

import numpy as np
import pytest

from invariant_sets import Polytope
from mpc import InputError, LinearMPC, NotConvexError, NotStabilisableError, OffsetFreeMPC, Status, lqr

A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])


def uncontrolled(**more):
    """Controller of two states of which no input reaches the second, which stays where it is."""
    weights = {"Q": np.diag([1.0, 0.0]), "R": 1.0, "P": np.eye(2)}
    return LinearMPC(np.diag([0.5, 1.0]), [[1.0], [0.0]], **weights, horizon=3, U=(-1, 1), **more)


@pytest.mark.parametrize("miss", [2e-10, 5e-10])
def test_a_weight_may_be_asymmetric_or_negative_by_rounding(miss):
    lqr(A, B, Q=[[1, miss], [0, 1]], R=1.0)
    lqr(A, B, Q=[[1, 1 + miss], [1 + miss, 1]], R=1.0)


def test_a_weight_that_misses_by_more_than_rounding_is_refused():
    for Q in ([[1, 5e-9], [0, 1]], [[1, 1 + 5e-9], [1 + 5e-9, 1]]):
        with pytest.raises(NotConvexError):
            lqr(A, B, Q=Q, R=1.0)


@pytest.mark.parametrize(("over", "status"), [(5e-7, Status.SOLVED), (5e-6, Status.SOFTENED)])
def test_a_limit_counts_as_kept_up_to_a_millionth(over, status):
    controller = uncontrolled(X=([-5, -1], [5, 1]))
    assert controller.solve([0.1, 1 + over]).status is status
    assert controller.explain([0.1, 1 + over]).feasible == (status is Status.SOLVED)


def test_sides_that_cross_by_rounding_leave_a_point():
    crossed = [Polytope([[1.0], [-1.0]], [1.0, -1.0 - by]) for by in (5e-10, 5e-9)]
    LinearMPC([[0.5]], [[1.0]], Q=1, R=1, horizon=2, U=crossed[0])
    with pytest.raises(InputError, match="empty set"):
        LinearMPC([[0.5]], [[1.0]], Q=1, R=1, horizon=2, U=crossed[1])


@pytest.mark.parametrize(("drift", "steady"), [(5e-10, True), (5e-9, False)])
def test_a_target_that_drifts_by_rounding_is_steady(drift, steady):
    controller = OffsetFreeMPC(uncontrolled(), [[1, 0]], disturbance=[0.0, drift])
    assert controller.nearest_target([0.2]).steady == steady


@pytest.mark.parametrize(("bound", "size"), [(5e-14, 1.0), (5e-13, 5e-13)])
def test_a_bound_that_misses_the_origin_by_rounding_has_no_size(bound, size):
    U = Polytope([[1.0], [-1.0]], [1.0, bound])
    assert LinearMPC([[0.5]], [[1.0]], Q=1, R=1, horizon=2, U=U).input_extent == pytest.approx(size)


def test_a_mode_is_reached_or_the_message_says_how_far_not():
    with pytest.raises(NotStabilisableError, match=r"relative strength .*expected >= 1e-07"):
        lqr(np.diag([1.1, 0.5]), [[1e-9], [1.0]], Q=np.eye(2), R=1.0)


@pytest.mark.parametrize(("strength", "reached"), [(1e-8, False), (1e-7, True)])
def test_an_unstable_mode_needs_some_strength_to_be_reached(strength, reached):
    try:
        lqr(np.diag([1.1, 0.5]), [[strength], [1.0]], Q=np.eye(2), R=1.0)
    except NotStabilisableError:
        assert not reached
    else:
        assert reached


@pytest.mark.parametrize(("beyond", "inside"), [(3e-8, True), (4e-7, False)])
def test_a_parameter_beside_the_regions_of_a_law_by_rounding_is_inside(beyond, inside):
    for size in (1.0, 1e6):
        law = LinearMPC([[1.0]], [[1.0]], Q=1.0, R=1.0, horizon=2, X=(-2 * size, 2 * size), U=(-size, size)).explicit()
        assert (law.locate([2 * size * (1 + beyond)]) >= 0) == inside


@pytest.mark.long
def test_limits_that_are_relaxed_by_no_more_than_they_must_leave_a_plan_to_be_found():
    three = np.eye(3) + 0.1 * np.eye(3, k=1)
    regulator = LinearMPC(
        three, [[0], [0], [0.1]], Q=np.eye(3), R=0.01, horizon=200, X=(-np.ones(3), np.ones(3)), U=(-1, 1)
    )
    assert regulator.solve([-1.3, -0.4, -1.1]).status is Status.SOFTENED


def test_limits_that_contradict_each_other_are_passed_by_the_least_to_a_millionth():
    # a held input u leads to 3 + u, then to 3 - u, where 1 is allowed
    A, B = [[0, 1, 0], [0, 0, 1], [0, 0, 0]], [[1], [-2], [0]]
    X, U = ([-1, -9, -9], [1, 9, 9]), (-9, 9)
    held = LinearMPC(A, B, Q=np.zeros((3, 3)), R=1.0, P=np.diag([1, 0, 0]), horizon=2, blocks=(2,), X=X, U=U)
    plan = held.solve([0, 3, 3])
    assert plan.status is Status.SOFTENED
    assert np.abs(plan.inputs).max() < 1e-6


@pytest.mark.parametrize(("inside", "lasts"), [(3e-7, True), (3e-6, False)])
def test_a_mode_that_costs_nothing_and_hardly_decays_is_on_the_unit_circle(inside, lasts):
    with pytest.raises(NotStabilisableError, match="on the unit circle") if lasts else nullcontext():
        lqr(np.diag([1 - inside, 0.5]), [[1.0], [1.0]], Q=np.diag([0.0, 1.0]), R=1.0)


@pytest.mark.parametrize(("size", "computed"), [(3e99, True), (3e100, False)])
def test_states_beyond_what_is_computed_are_not_explained(size, computed):
    controller = LinearMPC(A, B, Q=np.eye(2), R=0.1, horizon=3, X=([-5, -5], [5, 5]), U=(-1, 1))
    with nullcontext() if computed else pytest.raises(InputError, match="too large to explain"):
        assert controller.explain([size, 0.0]).violations[0].amount == pytest.approx(size)


def test_the_cost_of_a_target_moves_its_outputs_by_rounding():
    controller = OffsetFreeMPC(LinearMPC([[0.5]], [[1.0]], Q=1, R=1, horizon=3, U=(-10, 10)), [[1.0]])
    assert controller.nearest_target([1.0]).state[0] == pytest.approx(1.0, abs=2e-8)


@pytest.mark.parametrize(("horizon", "fed"), [(8, False), (12, True)])
def test_predictions_that_grow_more_than_a_thousandfold_are_those_of_a_feedback(horizon, fed):
    H = LinearMPC([[2.0]], [[1.0]], Q=1, R=1, horizon=horizon, U=(-1, 1)).build().H
    beside = np.abs(H - np.diag(np.diag(H))).max() / H.max()
    assert (beside < 1e-9) == fed  # what the feedback of the optimum leaves does not interact
