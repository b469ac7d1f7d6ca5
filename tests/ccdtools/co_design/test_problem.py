"""A co-design problem that fits together, and many that do not."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignConfig,
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    Learned,
    Plant,
    QuadraticObjective,
    RandomStarts,
    closed_loop_returns,
    codesign,
    discretise,
    saturated_lqr,
)
from ccdtools.co_design import DesignVectorEnv, EpisodeEnv
from ccdtools.plants import LinearModel
from invariant_sets import Polytope


def test_a_fixed_start_repeats_the_state_and_draws_the_disturbance(illustrative, rng):
    x0, w = FixedStart([1.0, 2.0], illustrative.disturbance).sample(3, 5, rng)
    np.testing.assert_array_equal(x0, [[1, 2]] * 3)
    assert w.shape == (3, 5, 2)
    assert not np.array_equal(w[0], w[1])


@pytest.mark.parametrize("starts", [FixedStart([1.0, 0.0]), RandomStarts([[1.0, 0.0], [0.5, 0.0]])])
def test_a_plant_without_a_disturbance_needs_none(starts, illustrative):
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    plant = Plant(x, u, ca.SX(0, 1), p, ca.vertcat(x[1], p * u), illustrative.model.design, dt=0.1)
    problem = replace(illustrative.problem(), model=discretise(plant), scenarios=starts)
    law = saturated_lqr(problem, [1.0])
    assert not closed_loop_returns(problem, law, [1.0], rng=np.random.default_rng(0), runs=4).lost.any()
    with pytest.raises(InputError, match="scenarios: got disturbances of shape"):
        replace(illustrative.problem(), scenarios=starts)


def test_limits_follow_from_the_boxes(illustrative):
    problem = illustrative.problem()
    np.testing.assert_allclose(problem.state_scale, [10, 5])
    np.testing.assert_allclose(problem.limit, [1e4, 5e3])
    np.testing.assert_allclose(problem.input_bounds, [[-1], [1]])
    lower, upper = problem.observation_bounds
    np.testing.assert_allclose(lower, [-10, -5, 0.5])
    np.testing.assert_allclose(upper, [10, 5, 3])
    assert problem.design.names == ("p",)


def test_a_redundant_row_leaves_a_box_a_box(illustrative):
    U = Polytope(np.array([[1.0], [-1.0], [1.0]]), np.array([1.0, 1.0, 5.0]))
    assert isinstance(replace(illustrative.problem(), U=U), CoDesignProblem)


def test_limits_of_a_problem_may_be_given_by_their_bounds(illustrative):
    problem = replace(illustrative.problem(), X=([-10.0, -5.0], [5.0, 2.0]), U=(-1, 1))
    assert problem.X.equals(Polytope.from_bounds([-10, -5], [5, 2]))
    assert problem.U.equals(Polytope.from_bounds([-1], [1]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"X": Polytope.from_bounds([-1] * 3, [1] * 3)}, "X: got dimension 3, expected 2"),
        ({"U": Polytope.from_bounds([-1] * 2, [1] * 2)}, "U: got dimension 2, expected 1"),
        ({"X": Polytope(np.array([[1.0, 0.0]]), np.array([1.0]))}, "X: got an unbounded set"),
        ({"X": (-1.0, np.inf)}, "X: got an unbounded set"),
        ({"U": (False, True)}, r"U\[0\]: got False, expected an array of real numbers, not True or False"),
        ({"U": 1.0}, r"U: got 1.0, expected a Polytope or bounds \(lower, upper\)"),
        ({"objective": QuadraticObjective(np.eye(3), [[1]])}, r"Q: got shape \(3, 3\), expected \(2, 2\)"),
        ({"objective": QuadraticObjective(np.eye(2), np.eye(2))}, r"R: got shape \(2, 2\), expected \(1, 1\)"),
        ({"steps": 0}, "steps: got 0, expected a whole number, at least 1"),
    ],
)
def test_problems_that_do_not_fit_together_are_refused(illustrative, changes, message):
    with pytest.raises(InputError, match=message):
        replace(illustrative.problem(), **changes)


def test_inputs_must_have_independent_bounds(illustrative):
    problem = illustrative.problem()
    A, B, _ = problem.model.matrices([1.0])
    two = LinearModel(problem.model.symbols, ca.DM(A), ca.DM(np.hstack([B, B])), ca.DM(np.eye(2)), 1.0, problem.design)
    diamond = Polytope(np.array([[1.0, 1], [1, -1], [-1, 1], [-1, -1]]), np.ones(4))
    with pytest.raises(InputError, match="U: got a set that is not a box, expected independent bounds"):
        replace(problem, model=two, U=diamond, objective=QuadraticObjective(np.eye(2), np.eye(2)))


@pytest.mark.long
@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("fixed", [False, True])
def test_a_plant_without_a_design_is_a_task_of_control_alone(fixed):
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    p, space = (ca.SX.sym("m"), DesignSpace(["m"], [1.0], [1.0])) if fixed else (ca.SX(0, 1), DesignSpace([], [], []))
    plant = Plant(x, u, w, p, ca.vertcat(x[1], ca.sin(x[0]) + u + w), space, dt=0.05)
    box, U = ([-3, -6], [3, 6]), (-5, 5)
    problem = CoDesignProblem(
        discretise(plant, X=box, U=U), X=box, U=U, steps=20, objective=QuadraticObjective(np.eye(2), [[0.1]]),
        scenarios=RandomStarts(Gaussian([0.3, 0.3]), Gaussian([0.3])),
    )  # fmt: skip
    config = CoDesignConfig(iterations=4, runs=8, pathwise_runs=8, evaluation_runs=20, evaluate_every=2)
    found = codesign(problem, method=Learned(config=config), rng=np.random.default_rng(0))
    law = saturated_lqr(problem, space.lower)
    env = EpisodeEnv(problem, space.lower, runs=4, rng=np.random.default_rng(0))
    assert env.reset().shape == (4, 2 + len(space.lower))
    assert DesignVectorEnv(problem, 3, space.lower).reset(seed=0)[0].shape == (3, 2)
    learned, regulator = (
        closed_loop_returns(problem, one, space.lower, rng=np.random.default_rng(1), runs=50).values.mean()
        for one in (found.controller, law)
    )
    assert learned > 1.01 * regulator
    with pytest.raises(InputError, match=r"method: got 'nested', expected one of .* nothing to design"):
        codesign(problem, method="nested", rng=np.random.default_rng(0))


def test_a_start_outside_X_and_inputs_without_zero_are_refused(illustrative):
    problem = illustrative.problem()
    with pytest.raises(InputError, match=r"scenarios.x0: got \[9.0, 0.0\], which is outside X, expected a state"):
        replace(problem, scenarios=FixedStart([9.0, 0.0], illustrative.disturbance))
    with pytest.raises(InputError, match="U: got a set without the origin, expected one that holds the input 0"):
        replace(problem, U=Polytope.from_bounds([0.5], [1.0]))


class Absolute(QuadraticObjective):
    """Rewards of its own."""

    def rewards(self, x_next, u, x=None, p=None):
        return -abs(x_next).sum(-1)


NOTHING = {"Q": np.zeros((2, 2)), "R": [[0.0]]}


@pytest.mark.parametrize(
    "objective",
    [
        QuadraticObjective(**NOTHING),
        QuadraticObjective(**NOTHING, S=np.zeros((2, 1))),
        CustomObjective(lambda x, u, p: ca.SX(3.0)),
        CustomObjective(lambda x, u, p: x[0] - x[0], lambda x, p: 0 * x[1], Q=np.eye(2), R=[[1.0]]),
    ],
)
def test_an_objective_that_nothing_changes_is_refused(illustrative, objective):
    with pytest.raises(InputError, match="objective: got one that costs the same whatever is done"):
        replace(illustrative.problem(), objective=objective)


@pytest.mark.parametrize(
    "objective",
    [
        QuadraticObjective(Q=np.zeros((2, 2)), R=[[1.0]]),
        QuadraticObjective(Q=1e-12 * np.eye(2), R=[[0.0]]),
        QuadraticObjective(**NOTHING, design_cost=lambda p: p[0]),
        Absolute(**NOTHING),
        CustomObjective(lambda x, u, p: p[0]),
        CustomObjective(lambda x, u, p: ca.SX(0.0), lambda x, p: ca.sumsqr(x)),
    ],
)
def test_an_objective_of_which_anything_can_be_changed_is_taken(illustrative, objective):
    assert replace(illustrative.problem(), objective=objective).objective.judges(2, 1, 1)
