"""What test_filtered.py claims, seen from inside."""

import control
import numpy as np
import pytest

import ccdtools as cc
from ccdtools.controllers import Filtered
from ccdtools.controllers.signals import needs_of
from invariant_sets import AdmissibleInputs, Polytope
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


def test_what_the_other_controller_needs_is_passed_on(admissible):
    options = {"Q": np.eye(2), "R": [[0.1]], "horizon": 5, "X": X, "U": U}
    limited = LinearMPC(A, B, rate_limit=[0.2], uses=("reference",), **options)
    safe = Filtered(limited, admissible)
    assert needs_of(safe) == {"last_input", "reference"}
    assert safe.horizon == 5
    states = run(safe, 15, reference=[0.5, 0.0]).states
    np.testing.assert_allclose(states, run(limited, 15, reference=[0.5, 0.0]).states, atol=1e-6)
    assert needs_of(Filtered(GREEDY, admissible)) == frozenset()
    assert not hasattr(Filtered(GREEDY, admissible), "loop")
