"""The policy of outputs that a co-design begins with imitates LQG in closed loop."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import ccdtools as cc
from ccdtools.co_design import history_problem
from ccdtools.co_design.measured import observed
from ccdtools.co_design.output_history import warm_start_of_outputs
from ccdtools.controllers import History


def beside_lqg(known, length, p):
    """Return of the first policy at a design, beside that of LQG, in parts of it."""
    agent = warm_start_of_outputs(history_problem(known, length), known, np.random.default_rng(0))
    x0, w = known.scenarios.sample(200, known.steps, np.random.default_rng(7))
    scenario = cc.Scenario(known.model, x0, np.array(w), output=known.measurement, seed=5)
    laws = History(cc.LearnedPolicy(agent, p), length), observed(known, cc.saturated_lqr(known, p), p)
    mine, its = (scenario.run(law, design=p).returns(known.objective).mean() for law in laws)
    return (mine - its) / abs(its)


@pytest.mark.check
def test_at_a_corner_of_the_box_where_its_own_inputs_are_not_those_of_lqg():
    own = cc.load_study("mass_chain").problem()
    C = np.eye(own.model.nx)[::2]
    known = replace(own, measurement=cc.Measurement(C, noise=C @ np.ravel(own.state_scale) / 50))
    assert beside_lqg(known, 16, known.design.lower) > -0.05


@pytest.mark.check
def test_of_a_damper_whose_lqg_does_nothing():
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("k")
    plant = cc.Plant(x, u, w, p, [x[1], -p * x[0] - (1 + 0.9 * u) * x[1] + w], cc.DesignSpace(["k"], [1], [4]), dt=0.1)
    box = ([-4, -4], [4, 4])
    known = cc.CoDesignProblem(
        cc.discretise(plant, X=box, U=(-1, 1)), X=box, U=(-1, 1), steps=40, limit_tolerance="off",
        objective=cc.QuadraticObjective(np.eye(2), [[0.1]]), scenarios=cc.FixedStart([1, 0], cc.Gaussian([1.0])),
        measurement=cc.Measurement([[1.0, 0.0]], noise=[0.05]),
    )  # fmt: skip
    assert abs(beside_lqg(known, 6, known.design.centre)) < 0.02
