"""The explanation: what it names is enough, and nothing in it can be spared."""

import numpy as np
import pytest
from online_qp import minimiser
from plants import box, double_integrator
from random_problems import random_plant

from mpc import InputError, LinearMPC


def feasible(problem, theta):
    return minimiser(problem, theta) is not None


def infeasible_cases(count):
    """(controller, state) of infeasible problems, two per plant."""
    seed = found = 0
    while found < count:
        controller, rng = random_plant(seed), np.random.default_rng(7000 + seed)
        seed += 1
        taken = 0
        for x in rng.uniform(-8, 8, size=(30, controller.nx)):
            if taken < 2 and found < count and not controller.solve(x).feasible:
                taken, found = taken + 1, found + 1
                yield controller, x


@pytest.mark.check
def test_two_hundred_infeasible_problems_are_explained():
    cases = 0
    for controller, x in infeasible_cases(200):
        cases += 1
        problem, why = controller.build(), controller.explain(x)
        assert not why.feasible
        assert feasible(problem.without(v.row for v in why.violations), x)
        contradiction = problem.without(set(range(problem.m)) - set(why.conflict_rows))
        assert not feasible(contradiction, x)
        assert str(why).startswith("Infeasible: the least relaxation is x[")
        assert all(v.amount > 0 for v in why.violations)
    assert cases == 200


@pytest.mark.long
def test_nothing_named_can_be_spared():
    for controller, x in infeasible_cases(10):
        problem, why = controller.build(), controller.explain(x)
        rows = [v.row for v in why.violations]
        for spared in rows:
            if len(rows) > 1:
                assert not feasible(problem.without(set(rows) - {spared}), x)
        for left_out in why.conflict_rows:
            kept = set(why.conflict_rows) - {left_out}
            assert feasible(problem.without(set(range(problem.m)) - kept), x)


@pytest.fixture
def integrator():
    A, B = double_integrator()
    return LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=10, X=box([5, 5]), U=box([1]))


def test_prints_as_one_sentence_with_amounts(integrator):
    # x1 after one step is at least 4.9 + 3 - 0.5 = 7.4, then 9.9 - 1 - 1 + ... = 8.9
    text = str(integrator.explain([4.9, 3.0]))
    assert text.startswith("Infeasible: the least relaxation is x[0] <= 5 by 2.4 at step 1, x[0] <= 5 by 3.9 at step 2")
    assert "cannot hold together: u[0] >= -1 (steps 0-1) and x[0] <= 5 (step 2)" in text


@pytest.mark.parametrize("size", [1e12, 1e30, 1e90])
def test_amounts_are_finite_however_far_the_state_is(integrator, size):
    why = integrator.explain([size, 0.0])
    assert {v.constraint.step for v in why.violations} == set(range(1, 11))
    np.testing.assert_allclose([v.amount for v in why.violations], size, rtol=1e-6)
    assert why.conflict


@pytest.mark.long
@pytest.mark.parametrize("horizon", [10, 25, 40, 100])
def test_unstable_plants_over_long_horizons_are_explained(horizon):
    A, B = np.array([[1.5, 0.3], [0.0, 1.3]]), np.array([[0.0], [1.0]])
    unstable = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=horizon, X=box([5, 5]), U=box([1]))
    why = unstable.explain([2.0, 2.0])
    # x1 after two steps is 1.5 (1.5 * 2 + 0.3 * 2) + 0.3 (1.3 * 2 - 1) = 5.88 at best
    assert str(why).startswith("Infeasible: the least relaxation is x[0] <= 5 by 0.88 at step 2")
    assert np.isfinite([v.amount for v in why.violations]).all()


def test_numbers_beyond_any_scale_are_refused(integrator):
    with pytest.raises(InputError, match="too large"):
        integrator.explain([1e308, 1e308])


def test_a_feasible_problem_has_nothing_to_explain(integrator):
    why = integrator.explain([1.0, 0.0])
    assert why.feasible
    assert str(why) == "Feasible: nothing has to give."


def test_inputs_that_contradict_the_rate_limit_are_named():
    A, B = double_integrator()
    limited = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=5, U=box([1]), rate_limit=0.1)
    why = limited.explain([0.0, 0.0], u_prev=[3.0])
    assert "u[0] <= 1 (step 0)" in str(why)
    assert "Δu[0] >= -0.1 (step 0)" in str(why)
    assert limited.solve([0.0, 0.0], u_prev=[3.0]).status.name == "INFEASIBLE"
