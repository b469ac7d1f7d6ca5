"""What test_status.py claims, seen from inside."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_plants import clone_of, mass

from ccdtools import QuadraticObjective
from ccdtools.co_design.design_gradients import Differences
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.feasible import DesignRegion, measured_slope
from ccdtools.co_design.result import CoDesignStatus


@pytest.fixture(scope="module")
def mass_and_clone():
    """Return the mass and a rough clone of its LQR."""
    problem = mass()
    return problem, clone_of(problem)


def test_a_bound_is_named_only_where_the_return_rises_across_it(mass_and_clone):
    problem, agent = mass_and_clone
    differences = Differences(problem, agent, scenario_tensors(problem, 64, np.random.default_rng(0)))
    region = DesignRegion(problem.design, np.array([0.5]))
    at_the_light_end, at_the_heavy_end = (measured_slope(differences, torch.tensor([v]), region) for v in (0.0, 1.0))
    for slope in (at_the_light_end, at_the_heavy_end):  # the optimum lies inside: nothing rises across
        assert slope.promises(0.01)
        assert not slope.rises_across_bounds(0.01)
    objective = problem.objective
    upwards = replace(problem, objective=Reversed(objective.Q, objective.R))
    slope = measured_slope(replace(differences, problem=upwards), torch.tensor([1.0]), region)
    assert slope.rises_across_bounds(0.01)
    assert not slope.promises(0.01)
    nothing = replace(slope, across=np.zeros(1), across_error=np.zeros(1))
    assert not nothing.rises_across_bounds(0.0)


class Reversed(QuadraticObjective):
    """What costs becomes a gain, and the other way round."""

    def rewards(self, x_next, u, x=None, p=None):
        return -super().rewards(x_next, u)


def test_every_status_has_advice():
    assert all(len(status.advice) > 20 for status in CoDesignStatus)
