"""Wrong calls of what stands behind the API: each is refused in one line that names the argument."""

from dataclasses import replace

import control
import numpy as np
import pytest
from refusals import assert_refused

import ccdtools as cc
from ccdtools.co_design.design_gradients import check_gradients
from ccdtools.comparison.pid_tuning import tuned_pid
from ccdtools.statistics import paired_difference, summarise
from ccdtools.twin.discrepancy import Discrepancy, TwinPlant
from ccdtools.twin.replay import Replay
from ccdtools.twin.residuals import residuals
from ccdtools.vehicles.roads import generate_road, generate_speed
from learning import ActorCritic, NetworkConfig
from learning.quantile import QuantileNetwork

STUDY = cc.load_study("illustrative")
PROBLEM = STUDY.problem()
MODEL = PROBLEM.model
P0 = STUDY.p0
AGENT = ActorCritic(*PROBLEM.observation_bounds, *PROBLEM.input_bounds, config=NetworkConfig((4,)))
LTI = control.ss([[0.5]], [[1.0]], [[1.0]], 0, 1.0)
NETWORK = QuantileNetwork(5, 2, (0.1, 0.5, 0.9), (4,))
LOG = cc.simulate(
    MODEL, cc.saturated_lqr(PROBLEM, P0), x0=np.zeros((2, 2)), steps=40, disturbance=STUDY.disturbance, design=P0,
    rng=np.random.default_rng(0),
)  # fmt: skip


def rng():
    return np.random.default_rng(0)


CALLS = {
    "a road of negative length": (lambda: generate_road(-1.0, rng=rng()), "length"),
    "a speed without a generator": (lambda: generate_speed(5.0, rng=None), "rng"),
    "a PID tuned in 0 runs": (lambda: tuned_pid(PROBLEM, P0, rng=rng(), runs=0), "runs"),
    "gradients of nobody": (lambda: check_gradients(PROBLEM, None, P0, rng=rng()), "agent"),
    "gradients from a seed": (lambda: check_gradients(PROBLEM, AGENT, P0, rng=0), "rng"),
    "gradients of step 0": (lambda: check_gradients(PROBLEM, AGENT, P0, rng=rng(), step=0), "step"),
    "gradients of 0 runs": (lambda: check_gradients(PROBLEM, AGENT, P0, rng=rng(), runs=0), "runs"),
    "gradients outside the box": (lambda: check_gradients(PROBLEM, AGENT, [99.0], rng=rng()), "design"),
    "a log of another plant": (lambda: residuals(cc.LinearModel.from_state_space(LTI), LOG), "log"),
    "a log of another dt": (lambda: residuals(MODEL, replace(LOG, dt=0.2)), "log"),
    "a discrepancy weight of another size": (lambda: Discrepancy(NETWORK, np.eye(3)), "weight"),
    "a discrepancy of unknown noise": (lambda: Discrepancy(NETWORK, np.eye(2), noise="white"), "noise"),
    "a discrepancy of nothing": (lambda: Discrepancy(None, np.eye(2)), "network"),
    "a twin plant of another size": (
        lambda: TwinPlant(cc.LinearModel.from_state_space(LTI), Discrepancy(NETWORK, np.eye(2))),
        "discrepancy",
    ),
    "a replay of nothing": (lambda: Replay(()), "logs"),
    "a replay that is too long": (lambda: Replay((residuals(MODEL, LOG),)).sample(1, 99, rng()), "steps"),
    "a summary of a table": (lambda: summarise(np.zeros((2, 2))), "values"),
    "a summary of text": (lambda: summarise("12"), "values"),
    "pairs of two lengths": (lambda: paired_difference([1.0], [1.0, 2.0]), "a, b"),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_wrong_call_from_inside_is_refused_in_one_line_that_names_the_argument(name):
    assert_refused(*CALLS[name])
