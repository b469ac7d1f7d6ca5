"""Policy iteration by rollouts finds what no small change of a policy reaches."""

from dataclasses import replace

import numpy as np
import pytest
from mass_and_wall import CASES, DESIGN

from ccdtools import LearnedPolicy, closed_loop_returns
from ccdtools.co_design.imitation import first_policy
from ccdtools.co_design.rollouts import better_by_plans, improved
from learning.warm_start import CloningConfig

WALL = CASES[2]  # behind which lies the optimum, 2.3 % above LQR, and above whose way there is no slope


def clone(stated):
    """Return a policy that imitates LQR."""
    options = {"expert": "lqr", "samples": 300, "cloning": CloningConfig(steps=1000)}
    return first_policy(stated, np.array(DESIGN), np.random.default_rng(0), **options).agent


def test_a_policy_that_does_not_use_the_wall_is_worse_than_inputs_that_are_held():
    stated = WALL.problem()
    agent = clone(stated)
    gain = better_by_plans(stated, LearnedPolicy(agent, DESIGN), np.random.default_rng(1), work=600_000)
    assert gain.ci95[0] > 0
    assert 0.3 < gain.mean < 1.4  # the optimum returns 1.26 more


@pytest.mark.check
def test_rounds_of_rollouts_learn_to_use_it():
    stated = WALL.problem()
    agent = clone(stated)
    other = improved(stated, agent, np.array(DESIGN), np.random.default_rng(2), rounds=4)
    before, after = (
        closed_loop_returns(stated, LearnedPolicy(one, DESIGN), DESIGN, np.random.default_rng(5), runs=2000)
        for one in (agent, other)
    )
    assert (after.values - before.values).mean() > 0.6


def test_without_a_wall_nothing_is_better_than_lqr():
    stated = replace(WALL, wall=-1e3, force=20.0).problem()
    agent = clone(stated)
    gain = better_by_plans(stated, LearnedPolicy(agent, DESIGN), np.random.default_rng(1), work=600_000)
    assert gain.mean < 0.25  # of 50: that of the imitation
