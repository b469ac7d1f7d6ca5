"""Right calls of the API, in which a test changes one argument."""

import casadi as ca
import control
import numpy as np

import ccdtools as cc
from ccdtools.co_design import expert_dataset
from invariant_sets import Polytope
from learning import ActorCritic, NetworkConfig

X, U, W, P = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
SPACE = cc.DesignSpace(["k", "c"], [1.0, 0.1], [5.0, 1.0])
RHS = ca.vertcat(X[1], -P[0] * X[0] - P[1] * X[1] + U + W)
P0 = [2.0, 0.5]


def plant(**changes):
    given = {"x": X, "u": U, "w": W, "p": P, "dynamics": RHS, "design": SPACE, "dt": 0.1}
    return cc.Plant(**(given | changes))


MODEL = cc.discretise(plant())
OBJECTIVE = cc.QuadraticObjective(np.eye(2), [[0.1]])
BOX, INPUTS = Polytope.from_bounds([-2, -2], [2, 2]), Polytope.from_bounds([-1], [1])
LQR = cc.LinearFeedback([[1.0, 1.0]], [-1], [1])
LTI = control.ss([[0.5]], [[1.0]], [[1.0]], 0, 1.0)
TF = control.tf([1.0], [1.0, 2.0])


def rng():
    return np.random.default_rng(0)


def problem(**changes):
    given = {
        "model": MODEL, "X": BOX, "U": INPUTS, "objective": OBJECTIVE, "steps": 10,
        "scenarios": cc.FixedStart([1.0, 0.0], cc.Gaussian([0.1])),
    }  # fmt: skip
    return cc.CoDesignProblem(**(given | changes))


PROBLEM = problem()


def agent(n_obs=4, lower=None, upper=None, action=1.0):
    low, high = PROBLEM.observation_bounds
    low, high = (low, high) if n_obs == 4 else (-np.ones(n_obs), np.ones(n_obs))
    return ActorCritic(
        low if lower is None else lower, high if upper is None else upper, [-action], [action],
        config=NetworkConfig((4,)),
    )  # fmt: skip


AGENT = agent()
POLICY = cc.LearnedPolicy(AGENT, P0)
QUICK = cc.CoDesignConfig(iterations=1, runs=2, pathwise_runs=2, evaluation_runs=2)
LOG = cc.simulate(MODEL, LQR, x0=[[1.0, 0.0]] * 2, steps=60, disturbance=cc.Gaussian([0.1]), design=P0, rng=rng())
SCENARIO = cc.Scenario(MODEL, np.ones((3, 2)), np.zeros((3, 5, 1)))


def simulate(**changes):
    given = {"plant": MODEL, "controller": LQR, "x0": [1.0, 0.0], "steps": 5, "design": P0}
    given |= changes
    return cc.simulate(given.pop("plant"), given.pop("controller"), **given)


def codesign(**changes):
    given = {"problem": PROBLEM, "agent": AGENT, "design": P0, "rng": rng(), "config": QUICK}
    given |= changes
    return cc.codesign(given.pop("problem"), **given)


def dataset(**changes):
    given = {"problem": PROBLEM, "samples": 5, "rng": rng()}
    given |= changes
    return expert_dataset(given.pop("problem"), **given)


def update(**changes):
    given = {"log": LOG, "weight": np.eye(2), "rng": rng()}
    given |= changes
    return cc.DigitalTwin(MODEL).update(given.pop("log"), **given)


def compare(**changes):
    given = {"controllers": {"LQR": LQR}, "scenario": SCENARIO, "design": P0, "objective": OBJECTIVE, "X": BOX}
    given |= changes
    return cc.compare(given.pop("controllers"), given.pop("scenario"), **given)
