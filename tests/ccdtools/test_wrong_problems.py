"""Wrong objectives, problems, co-designs, deployments and twins."""

from functools import partial

import casadi as ca
import numpy as np
import pytest
from refusals import assert_refused
from right_calls import (
    AGENT,
    BOX,
    INPUTS,
    LOG,
    LQR,
    LTI,
    MODEL,
    P0,
    POLICY,
    PROBLEM,
    P,
    U,
    X,
    agent,
    codesign,
    dataset,
    plant,
    problem,
    rng,
    update,
)

import ccdtools as cc
from invariant_sets import Polytope
from learning import PPOConfig

OTHER = cc.DesignSpace(["k", "c"], [1.0, 0.1], [9.0, 1.0])
quadratic = partial(cc.QuadraticObjective, np.eye(2), [[0.1]])
ROAD = np.zeros((1, 9, 1))


class NotTorch(cc.QuadraticObjective):
    """An objective that works on arrays alone."""

    def rewards(self, x_next, u, x=None, p=None):
        return -np.abs(np.asarray(x_next)).sum(axis=-1)


CALLS = {
    # objectives and problems
    "Q not square": (lambda: cc.QuadraticObjective(np.ones((2, 3)), [[1]]), "Q"),
    "Q negative": (lambda: cc.QuadraticObjective([[-1]], [[1]]), "Q"),
    "Q text": (lambda: cc.QuadraticObjective("eye", [[1]]), "Q"),
    "R negative": (lambda: cc.QuadraticObjective([[1]], [[-1]]), "R"),
    "S of another size": (lambda: cc.QuadraticObjective(np.eye(2), [[1]], S=[[1, 0]]), "S"),
    "S too large": (lambda: cc.QuadraticObjective(np.eye(2), [[1]], S=[[2], [0]]), "S"),
    "design cost a number": (lambda: cc.QuadraticObjective([[1]], [[1]], design_cost=3.0), "design_cost"),
    "design cost of two values": (lambda: problem(objective=quadratic(design_cost=lambda p: p)), "design_cost"),
    "design cost that fails": (lambda: problem(objective=quadratic(design_cost=lambda p: p.mass)), "design_cost"),
    "design cost of an entry that is not there": (
        lambda: problem(objective=quadratic(design_cost=lambda p: p[9])),
        "design_cost",
    ),
    "design cost of other symbols": (lambda: problem(objective=quadratic(design_cost=lambda p: P[0])), "design_cost"),
    "episode of no steps": (lambda: cc.QuadraticObjective([[1]], [[1]], episode=0), "episode"),
    "stage cost an expression": (lambda: cc.CustomObjective(X[0] ** 2), "stage_cost"),
    "stage cost of x alone": (lambda: problem(objective=cc.CustomObjective(lambda x: x[0])), "stage_cost"),
    "stage cost a function of two": (lambda: cc.CustomObjective(ca.Function("l", [X, U], [U[0]])), "stage_cost"),
    "stage cost that falls from rest": (
        lambda: problem(objective=cc.CustomObjective(lambda x, u, p: u[0] ** 2 - x[0] ** 2)),
        "objective.stage_cost",
    ),
    "terminal cost of two values": (
        lambda: problem(objective=cc.CustomObjective(lambda x, u, p: u[0] ** 2, lambda x, p: x)),
        "terminal_cost",
    ),
    "Q without R": (lambda: cc.CustomObjective(lambda x, u, p: u[0], Q=np.eye(2)), "Q, R"),
    "outputs of a plant without any": (lambda: cc.output_objective(plant(), weights=[1.0]), "plant"),
    "R nothing": (lambda: cc.QuadraticObjective([[1]], None), "R"),
    "R NaN": (lambda: cc.QuadraticObjective([[1]], [[np.nan]]), "R"),
    "a problem of a plant": (lambda: problem(model=plant()), "model"),
    "a problem of a StateSpace": (lambda: problem(model=LTI), "model"),
    "X a list of three": (lambda: problem(X=[[-2, -2], [0, 0], [2, 2]]), "X"),
    "X of another dimension": (lambda: problem(X=INPUTS), "X"),
    "X unbounded": (lambda: problem(X=Polytope(np.eye(2), [1, 1])), "X"),
    "X without the origin": (lambda: problem(X=Polytope.from_bounds([1, 1], [2, 2])), "X"),
    "U bounds that are truths": (lambda: problem(U=(False, True)), "U[0]"),
    "U swapped with X": (lambda: problem(X=INPUTS, U=BOX), "X"),
    "Q of another size": (lambda: problem(objective=cc.QuadraticObjective(np.eye(3), [[1]])), "objective.Q"),
    "R of another size": (lambda: problem(objective=cc.QuadraticObjective(np.eye(2), np.eye(2))), "objective.R"),
    "an objective that is a tuple": (lambda: problem(objective=(np.eye(2), np.eye(1))), "objective"),
    "steps 2.5": (lambda: problem(steps=2.5), "steps"),
    "steps True": (lambda: problem(steps=True), "steps"),
    "steps 0": (lambda: problem(steps=0), "steps"),
    "scenarios a disturbance": (lambda: problem(scenarios=cc.Gaussian([0.1])), "scenarios"),
    "scenarios nothing": (lambda: problem(scenarios=None), "scenarios"),
    "x0 of another width": (lambda: problem(scenarios=cc.FixedStart([1.0], cc.Gaussian([0.1]))), "scenarios"),
    "w of another width": (lambda: problem(scenarios=cc.FixedStart([1, 0], cc.Gaussian([1, 1]))), "scenarios"),
    "a start of NaN": (lambda: cc.FixedStart([np.nan, 0], cc.Gaussian([0.1])), "x0"),
    "a start without a disturbance": (lambda: cc.FixedStart([1, 0], None), "disturbance"),
    "a start with a class": (lambda: cc.FixedStart([1, 0], cc.Gaussian), "disturbance"),
    "a discrepancy of text": (lambda: problem(discrepancy="learned"), "discrepancy"),
    # co-design
    "a dataset of a model": (lambda: dataset(problem=MODEL), "problem"),
    "a dataset of 2.5 samples": (lambda: dataset(samples=2.5), "samples"),
    "a dataset from a seed": (lambda: dataset(rng=0), "rng"),
    "a dataset of gamma 2": (lambda: dataset(gamma=2), "gamma"),
    "a dataset of an unknown expert": (lambda: dataset(expert="pid"), "expert"),
    "a dataset of -1 designs": (lambda: dataset(designs=-1), "designs"),
    "a dataset of horizon 0": (lambda: dataset(expert="mpc", horizon=0), "horizon"),
    "a dataset of sets in a list": (lambda: dataset(sets=[BOX]), "sets"),
    "sets of a model": (lambda: cc.feasible_sets(MODEL), "problem"),
    "co-design of a model": (lambda: codesign(problem=MODEL), "problem"),
    "co-design from a seed": (lambda: codesign(rng=0), "rng"),
    "co-design from nothing": (lambda: codesign(rng=None), "rng"),
    "co-design by an unknown method": (lambda: codesign(method="magic"), "method"),
    "co-design by a dictionary": (lambda: codesign(config={"iterations": 5}), "config"),
    "co-design of a policy": (lambda: codesign(agent=POLICY), "agent"),
    "nested co-design of an agent": (lambda: codesign(method="nested"), "agent"),
    "co-design by a class": (lambda: codesign(method=cc.Nested), "method"),
    "nested co-design with an unknown controller": (lambda: cc.Nested("pid"), "inner"),
    "simultaneous co-design of nothing": (lambda: cc.Simultaneous("nothing"), "unknowns"),
    "sequential design by nothing": (lambda: cc.Sequential("price"), "criterion"),
    "a search by an unknown library": (lambda: cc.Search("scipy"), "library"),
    "co-design of an agent without designs": (lambda: codesign(agent=agent(2)), "agent"),
    "co-design of an agent of another U": (lambda: codesign(agent=agent(action=5.0)), "agent"),
    "co-design of an agent of other designs": (
        lambda: codesign(agent=agent(lower=[-2, -2, 1.9, 0.4], upper=[2, 2, 2.1, 0.6])),
        "agent",
    ),
    "co-design outside the box": (lambda: codesign(design=[9.0, 0.5]), "design"),
    "co-design with a judge of nothing": (lambda: codesign(judge=MODEL), "judge"),
    "co-design of arrays alone": (
        lambda: codesign(problem=problem(objective=NotTorch(np.eye(2), [[0.1]]))),
        "objective",
    ),
    "iterations 2.5": (lambda: cc.CoDesignConfig(iterations=2.5), "iterations"),
    "a rate of NaN": (lambda: cc.CoDesignConfig(design_rate=np.nan), "design_rate"),
    "a rate of text": (lambda: cc.CoDesignConfig(policy_rate="fast"), "policy_rate"),
    "a PPO of nothing": (lambda: cc.CoDesignConfig(ppo=None), "ppo"),
    "gamma 2": (lambda: PPOConfig(gamma=2), "gamma"),
    "co-design by a config of 0": (lambda: codesign(config=0), "config"),
    "a judge of other designs": (lambda: codesign(judge=problem(model=cc.discretise(plant(design=OTHER)))), "judge"),
    # deployment and twin
    "a deployment of a matrix": (lambda: cc.deploy(MODEL, np.eye(2), P0, np.zeros((5, 1)), x0=[0, 0]), "controller"),
    "a deployment at another design": (
        lambda: cc.deploy(MODEL, POLICY, [3.0, 0.5], np.zeros((5, 1)), x0=[0, 0]),
        "design",
    ),
    "a deployment on nothing": (lambda: cc.deploy(MODEL, LQR, P0, None, x0=[0, 0]), "disturbance"),
    "a deployment on a sampler": (lambda: cc.deploy(MODEL, LQR, P0, cc.Gaussian([0.1]), x0=[0, 0]), "disturbance"),
    "updates -1": (lambda: cc.OnlineConfig(updates=-1), "updates"),
    "held out 1.5": (lambda: cc.OnlineConfig(held_out=1.5), "held_out"),
    "training nothing": (lambda: cc.OnlineConfig(training=None), "training"),
    "an updated deployment of a policy": (
        lambda: cc.deploy_and_update(PROBLEM, MODEL, POLICY, P0, x0=[[0, 0]], disturbance=ROAD, rng=rng()),
        "agent",
    ),
    "an updated deployment from a seed": (
        lambda: cc.deploy_and_update(PROBLEM, MODEL, AGENT, P0, x0=[[0, 0]], disturbance=ROAD, rng=1),
        "rng",
    ),
    "a twin of a plant": (lambda: cc.DigitalTwin(plant()), "model"),
    "a twin of logs in text": (lambda: cc.DigitalTwin(MODEL, logs="logs"), "logs"),
    "a twin of trajectories": (lambda: cc.DigitalTwin(MODEL, logs=(LOG,)), "logs"),
    "a twin of an unknown discrepancy": (lambda: cc.DigitalTwin(MODEL, discrepancy=AGENT), "discrepancy"),
    "a twin of an array": (lambda: update(log=np.zeros((5, 2))), "log"),
    "a twin weight of another size": (lambda: update(weight=np.eye(3)), "weight"),
    "a twin weight that is negative": (lambda: update(weight=-np.eye(2)), "weight"),
    "a twin weight of nothing": (lambda: update(weight=None), "weight"),
    "a twin from a seed": (lambda: update(rng=0), "rng"),
    "a twin that tests on all": (lambda: update(held_out=1.0), "held_out"),
    "a twin of a dictionary": (lambda: update(config={"steps": 3}), "config"),
    "a twin of 0 blocks": (lambda: update(blocks=0), "blocks"),
    "innovations of an untaught twin": (lambda: cc.DigitalTwin(MODEL).innovations(), "twin"),
    "an updated problem of an untaught twin": (lambda: cc.updated_problem(PROBLEM, cc.DigitalTwin(MODEL)), "twin"),
    "an updated problem of a log": (lambda: cc.updated_problem(PROBLEM, LOG), "twin"),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_wrong_call_is_refused_in_one_line_that_names_the_argument(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_refused(*CALLS[name])
