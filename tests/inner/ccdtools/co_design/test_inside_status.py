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


@pytest.mark.parametrize("constraints", [None, lambda p: p[0] - 99.0], ids=["a box", "constraints"])
def test_a_whole_number_is_held_by_a_bound_that_the_return_rises_across_alone(mass_and_clone, constraints):
    problem, agent = mass_and_clone
    space = replace(problem.design, integer=problem.design.names, constraints=constraints)
    whole = replace(problem, model=problem.model.within(space))
    objective = problem.objective
    scenarios = scenario_tensors(problem, 64, np.random.default_rng(0))
    for one, rises in ((whole, False), (replace(whole, objective=Reversed(objective.Q, objective.R)), True)):
        region = DesignRegion(space, np.array([1.0]))
        slope = measured_slope(Differences(one, agent, scenarios), torch.tensor([1.0]), region)
        assert not slope.promises(1e-6)
        assert slope.rises_across_bounds(0.01) == rises


class Reversed(QuadraticObjective):
    """What costs becomes a gain, and the other way round."""

    def rewards(self, x_next, u, x=None, p=None):
        return -super().rewards(x_next, u)


def test_every_status_has_advice():
    assert all(len(status.advice) > 20 for status in CoDesignStatus)
