"""One vocabulary of errors: what any of the four packages refuses, one handler catches, by the same rules."""

import casadi as ca
import numpy as np
import pytest

import ccdtools
import invariant_sets
import learning
import mpc
from ccdtools import InputError
from invariant_sets import Polytope, reachable_set
from mpc import LinearMPC, lqr, solve_mpqp
from mpc.optimal_control import Phase

A = np.array([[1.0, 0.1], [0.0, 1.0]])
B = np.array([[0.0], [0.1]])
BOX = Polytope.from_bounds([-1, -1], [1, 1])
STATED = LinearMPC(A, B, Q=1.0, R=1.0, horizon=3, X=BOX, U=(-1, 1))
RNG = np.random.default_rng(0)


def feedback(gain):
    return ccdtools.LinearFeedback(gain, [-1], [1])


BOOLEANS = {
    "A of lqr": lambda: lqr(A > 0, B, Q=1.0, R=1.0),
    "Q of LinearMPC": lambda: LinearMPC(A, B, Q=[True, 2.0], R=1.0, horizon=3),
    "U of LinearMPC": lambda: LinearMPC(A, B, Q=1.0, R=1.0, horizon=3, U=(False, True)),
    "x of a controller": lambda: STATED([True, 0.0]),
    "A of a reachable set": lambda: reachable_set(A > 0, B, BOX, (-1, 1), 3),
    "A of a polytope": lambda: Polytope([[True, 1.0]], [1.0]),
    "bounds of a polytope": lambda: Polytope.from_bounds([False], [True]),
    "a point": lambda: BOX.contains(np.array([True, False])),
    "inputs of a fit": lambda: learning.fit_quantiles(np.ones((30, 1)) > 0, np.ones((30, 1)), rng=RNG),
    "bounds of a design": lambda: ccdtools.DesignSpace(["k"], [False], [True]),
    "a gain": lambda: feedback([[True, 0.0]]),
    "a start": lambda: ccdtools.FixedStart([True, 0.5], ccdtools.Gaussian([0.1])),
    "horizon": lambda: LinearMPC(A, B, Q=1.0, R=1.0, horizon=True),
}
WHOLE_FLOATS = {
    "horizon": lambda: LinearMPC(A, B, Q=1.0, R=1.0, horizon=10.0),
    "blocks": lambda: LinearMPC(A, B, Q=1.0, R=1.0, horizon=3, blocks=[1.0, 2.0]),
    "max_regions": lambda: solve_mpqp(STATED.build(), BOX, max_regions=np.float64(10)),
    "states": lambda: Phase(lambda x, u: u, 1.0, 1, start=[0], end=[1], stage_cost=lambda u: ca.sumsqr(u)),
    "steps of a set": lambda: reachable_set(A, B, BOX, (-1, 1), 3.0),
    "iterations": lambda: invariant_sets.maximal_control_invariant_set(A, B, BOX, (-1, 1), max_iterations=10.0),
    "passes": lambda: learning.PPOConfig(passes=3.0),
    "runs": lambda: ccdtools.CoDesignConfig(runs=10.0),
}


@pytest.mark.parametrize("call", BOOLEANS.values(), ids=BOOLEANS)
def test_a_truth_is_no_number_anywhere(call):
    with pytest.raises(InputError, match=r"got .*(True|False|array|shape).*, expected"):
        call()


@pytest.mark.parametrize("call", WHOLE_FLOATS.values(), ids=WHOLE_FLOATS)
def test_a_count_is_an_int_everywhere(call):
    with pytest.raises(InputError, match=r": got .*\d\.0.*, expected .*whole"):
        call()


def test_the_four_packages_raise_one_class_that_every_base_catches():
    assert mpc.InputError is ccdtools.InputError
    assert mpc.MPCError is not invariant_sets.InvariantSetsError
    for base in (mpc.MPCError, invariant_sets.InvariantSetsError, learning.LearningError, ValueError):
        assert issubclass(InputError, base)
    for own in (mpc.MPCError, invariant_sets.InvariantSetsError, learning.LearningError):
        assert issubclass(own, ccdtools.CCDError)


def test_a_numerical_outcome_of_one_package_is_not_caught_as_that_of_another():
    with pytest.raises(mpc.MPCError) as caught:
        lqr([[2.0, 0.0], [0.0, 0.5]], [[0.0], [1.0]], Q=1.0, R=1.0)
    assert isinstance(caught.value, ccdtools.CCDError)
    assert not isinstance(caught.value, invariant_sets.InvariantSetsError | learning.LearningError | InputError)
