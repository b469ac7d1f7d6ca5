"""What test_worst_case.py claims, seen from inside."""

from dataclasses import replace

import numpy as np
import pytest
import uncertain_plants
from uncertain_plants import MASSES, exact_costs, problem

from ccdtools import FixedStart, Gaussian, Mean, RandomStarts, WorstCase
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.landscape import Landscape
from ccdtools.disturbances import Cases, Constant, Mixture, Stacked, Sum, Uniform
from ccdtools.disturbances.combinations import cases_in
from mpc import lqr


def test_cases_are_found_wherever_their_order_is_kept():
    two, three = Cases.of([0, 1]), Cases.of([0, 1, 2])
    noise = Gaussian([1.0])
    assert cases_in(noise) == 1
    assert cases_in(Stacked((noise, two))) == 2
    assert cases_in(Stacked((two, Constant(three)))) == 6
    assert cases_in(Sum((two, three))) == 6
    assert cases_in(Cases((two, noise))) == 4
    assert cases_in(Mixture((two, noise))) == 1
    assert WorstCase().over(FixedStart([0.0], Stacked((noise, three)))).cases == 3
    assert WorstCase().over(RandomStarts(Cases((Uniform([0], [1]), Uniform([1], [2]))), three)).cases == 6
    w = Cases((two, Cases.of([5, 6]))).sample(8, 1, np.random.default_rng(0)).ravel()
    np.testing.assert_array_equal(w, [0, 5, 1, 6, 0, 5, 1, 6])


def lqr_costs(own, k):
    """Exact costs of the nominal LQR at a spring."""
    A, B, _ = own.model.matrices([k])
    return exact_costs(k, lqr(A, B, Q=uncertain_plants.Q, R=[[uncertain_plants.R]])[0][0])


@pytest.mark.parametrize("unit", [1.0, 1e5])
def test_the_landscape_is_that_of_the_worst_mass(unit):
    own = problem(WorstCase(smoothing=0), unit=unit)
    V = np.array([[0.02], [0.2], [0.6], [1.0]])
    exact = np.array([lqr_costs(own, k).max() for k in own.design.from_unit(V)[:, 0]])
    found = Landscape(own, np.random.default_rng(0), runs=1500).returns(V)
    np.testing.assert_allclose(-found / unit, exact, rtol=0.06)


def test_every_case_is_met_however_few_runs_are_asked_for():
    """The last mass is the worst: with two runs of three cases it would not be seen."""
    own = problem(WorstCase(smoothing=0))
    x0, w = scenario_tensors(own, 2, np.random.default_rng(0))
    assert len(x0) == len(w) == len(MASSES)
    mean = replace(own, risk=Mean())
    assert len(scenario_tensors(mean, 2, np.random.default_rng(0))[0]) == 2
