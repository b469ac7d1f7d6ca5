"""Holding other inputs, or learning from scratch, finds what no small change of a policy reaches."""

from dataclasses import replace

import numpy as np
import pytest
from mass_and_wall import CASES, DESIGN

from ccdtools import LearnedPolicy, closed_loop_returns
from ccdtools.co_design.held_inputs import better_by_holding
from ccdtools.co_design.imitation import first_policy, policy_from_scratch
from ccdtools.statistics import paired_difference
from learning.warm_start import CloningConfig

WALL = CASES[2]  # behind which lies the optimum, 2.3 % above LQR, and above whose way there is no slope


def clone(stated):
    """Return a policy that imitates LQR."""
    options = {"expert": "lqr", "samples": 300, "cloning": CloningConfig(steps=1000)}
    return first_policy(stated, np.array(DESIGN), np.random.default_rng(0), **options).agent


@pytest.mark.check
def test_a_policy_that_does_not_use_the_wall_is_worse_than_inputs_that_are_held():
    stated = WALL.problem()
    agent = clone(stated)
    gain = better_by_holding(stated, LearnedPolicy(agent, DESIGN), np.random.default_rng(1), work=600_000)
    assert gain.ci95[0] > 0
    assert 0.3 < gain.mean < 1.4  # the optimum returns 1.26 more


@pytest.mark.slow
def test_a_policy_from_scratch_learns_to_use_it():
    stated = WALL.problem()
    other = policy_from_scratch(stated, np.array(DESIGN), np.random.default_rng(2))
    before, after = (
        closed_loop_returns(stated, LearnedPolicy(one, DESIGN), DESIGN, np.random.default_rng(5), runs=2000)
        for one in (clone(stated), other)
    )
    assert paired_difference(after.values, before.values).ci95[0] > 0


@pytest.mark.check
def test_without_a_wall_nothing_is_better_than_lqr():
    stated = replace(WALL, wall=-1e3, force=20.0).problem()
    agent = clone(stated)
    gain = better_by_holding(stated, LearnedPolicy(agent, DESIGN), np.random.default_rng(1), work=600_000)
    assert gain.mean < 0.25  # of 50: that of the imitation
