"""A filter behind any controller: what it keeps, what it passes on, and what it counts."""

import copy
import pickle

import control
import numpy as np
import pytest

import ccdtools as cc
from ccdtools.controllers import Filtered
from invariant_sets import AdmissibleInputFamily, AdmissibleInputs, Polytope
from mpc import LinearMPC

A = np.array([[1.0, 0.1], [0.0, 1.0]])
B = np.array([[0.005], [0.1]])
X = Polytope.from_bounds([-2.0, -0.5], [2.0, 0.5])
U = Polytope.from_bounds([-1.0], [1.0])
MODEL = cc.LinearModel.from_state_space(control.ss(A, B, np.eye(2), 0, 0.1))
GREEDY = cc.LinearFeedback([[20.0, 1.0]], [-1.0], [1.0])


@pytest.fixture(scope="module")
def admissible():
    from invariant_sets import maximal_control_invariant_set

    return AdmissibleInputs(A, B, maximal_control_invariant_set(A, B, X, U).set, U)


def run(controller, steps=80, x0=((-1.5, 0.0), (1.0, 0.2)), **options):
    return cc.simulate(MODEL, controller, x0=x0, steps=steps, **options)


def test_without_disturbance_the_filter_keeps_X_where_the_controller_alone_does_not(admissible):
    safe = Filtered(GREEDY, admissible)
    assert cc.excursions(run(GREEDY).states, X).peak.min() > 0.1
    assert cc.excursions(run(safe).states, X).peak.max() == 0
    assert 0 < safe.counts.changed < safe.counts.inputs == 160
    assert safe.counts.helpless == 0
    assert "of 160 inputs changed" in str(safe.counts)


def test_what_is_admissible_passes_unchanged(admissible, rng):
    calm = cc.LinearFeedback([[0.1, 0.5]], [-1.0], [1.0])
    x = admissible.S.sample(50, rng=rng) * 0.3
    safe = Filtered(calm, admissible)
    np.testing.assert_array_equal(safe(x), calm(x))
    np.testing.assert_array_equal(safe(x[0]), calm(x[0]))
    assert safe.counts.changed == 0
    assert safe.counts.inputs == 51


def test_a_state_outside_the_set_gets_the_least_harmful_input_and_is_counted(admissible):
    safe = Filtered(GREEDY, admissible)
    assert safe(np.array([0.0, 0.9])) == pytest.approx([-1.0])
    assert safe.counts.helpless == 1


def test_lost_states_pass_as_nan(admissible):
    u = Filtered(GREEDY, admissible)(np.array([[np.nan, 0.0], [0.0, 0.0]]))
    assert np.isnan(u[0, 0])
    assert u[1, 0] == pytest.approx(0.0)


def test_memory_of_the_other_controller_is_its_own_and_the_counts_are_shared(admissible):
    pid = cc.PID([[1.0, 0.0]], [20.0], [0.5], [1.0], dt=0.1, lower=[-1.0], upper=[1.0])
    safe = Filtered(pid, admissible)
    first = run(safe, 40)
    between = safe.counts
    again = run(safe, 40)
    np.testing.assert_array_equal(first.states, again.states)
    assert (between.inputs, safe.counts.inputs) == (80, 160)


def test_a_controller_that_opens_a_loop_is_filtered_in_it(admissible):
    from mpc import OffsetFreeMPC

    nominal = LinearMPC(A, B, Q=np.eye(2), R=[[0.1]], horizon=5, X=X, U=U, uses=("reference",))
    safe = Filtered(OffsetFreeMPC(nominal, C=np.eye(2)), admissible)
    inputs = run(safe, 10, reference=[0.0, 0.0]).inputs
    assert np.isfinite(inputs).all()
    assert safe.counts.inputs == 20


def test_copies_and_pickles_do_the_same(admissible):
    safe = Filtered(GREEDY, admissible)
    x = np.array([[-1.0, 0.49], [0.3, 0.1]])
    for again in (copy.deepcopy(safe), pickle.loads(pickle.dumps(safe))):
        np.testing.assert_array_equal(again(x), safe(x))
        assert repr(again) == repr(safe)


def test_it_stands_in_a_comparison_and_its_timing_is_not_counted(admissible):
    scenario = cc.Scenario(MODEL, np.tile([-1.5, 0.0], (3, 1)), np.zeros((3, 30, 0)))
    safe = Filtered(GREEDY, admissible)
    table = cc.compare({"LQR": GREEDY, "safe": safe}, scenario, X=X,
                       objective=cc.QuadraticObjective(np.eye(2), [[0.1]]))  # fmt: skip
    assert table["safe"].depth_worst == 0 < table["LQR"].depth_peak
    assert safe.counts.inputs == 90


def test_a_policy_keeps_its_design_behind_the_filter(illustrative, clone):
    problem = illustrative.problem()
    safe = cc.Filtered(cc.LearnedPolicy(clone(illustrative), [2.0]), cc.admissible_inputs(problem, [2.0]))
    log = cc.deploy(illustrative.model, safe, [2.0], np.zeros((20, 2)), x0=[-2.0, -2.0])
    assert cc.excursions(log.states, problem.X).peak.max() == 0
    with pytest.raises(cc.InputError, match="the design of the policy"):
        cc.deploy(illustrative.model, safe, [2.5], np.zeros((20, 2)), x0=[-2.0, -2.0])


def test_wrong_arguments_are_named(admissible, illustrative):
    with pytest.raises(cc.InputError, match="controller: got 3, expected a callable"):
        Filtered(3, admissible)
    with pytest.raises(cc.InputError, match=r"admissible: got .*, expected an AdmissibleInputs. Use admissible_inputs"):
        Filtered(GREEDY, X)
    with pytest.raises(cc.InputError, match=r"controller: got inputs of shape \(2,\), expected \(1,\)"):
        Filtered(lambda x: np.zeros((*x.shape[:-1], 2)), admissible)(np.zeros(2))
    with pytest.raises(cc.InputError, match="design: got"):
        cc.admissible_inputs(illustrative.problem(), [9.0])
    assert len(AdmissibleInputFamily([admissible]).filters) == 1
