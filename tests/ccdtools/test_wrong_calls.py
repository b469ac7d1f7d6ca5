"""Wrong calls of the API, as a stranger would make them: each is refused in one line that names the argument."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import casadi as ca
import control
import numpy as np
import pytest
import torch

import ccdtools as cc
from ccdtools.co_design import expert_dataset
from invariant_sets import Polytope
from learning import ActorCritic, NetworkConfig, PPOConfig
from mpc import LinearMPC

OURS = cc.CCDError
X, U, W, P = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
SPACE = cc.DesignSpace(["k", "c"], [1.0, 0.1], [5.0, 1.0])
OTHER = cc.DesignSpace(["k", "c"], [1.0, 0.1], [9.0, 1.0])
RHS = ca.vertcat(X[1], -P[0] * X[0] - P[1] * X[1] + U + W)
P0 = [2.0, 0.5]


def plant(**changes):
    given = {"x": X, "u": U, "w": W, "p": P, "dynamics": RHS, "design": SPACE, "dt": 0.1}
    return cc.Plant(**(given | changes))


MODEL = cc.discretise(plant())
OBJECTIVE = cc.QuadraticObjective(np.eye(2), [[0.1]])
quadratic = partial(cc.QuadraticObjective, np.eye(2), [[0.1]])
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
ROAD = np.zeros((1, 9, 1))


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


class NotTorch(cc.QuadraticObjective):
    """An objective that works on arrays alone."""

    def rewards(self, x_next, u, x=None, p=None):
        return -np.abs(np.asarray(x_next)).sum(axis=-1)


CALLS = {
    # plants and designs
    "x a list": (lambda: plant(x=[1, 2]), "x"),
    "x a torch tensor": (lambda: plant(x=torch.zeros(2)), "x"),
    "x an MX": (lambda: plant(x=ca.MX.sym("x", 2)), "x"),
    "x a row": (lambda: plant(x=ca.SX.sym("x", 1, 2)), "x"),
    "x an expression": (lambda: plant(x=2 * X), "x"),
    "x nothing": (lambda: plant(x=None), "x"),
    "one symbol as x and w": (lambda: plant(w=X[1]), "w"),
    "one symbol as u and w": (lambda: plant(w=U), "w"),
    "one symbol twice in x": (lambda: plant(x=ca.vertcat(X[0], X[0])), "x"),
    "dynamics of another size": (lambda: plant(dynamics=X[0]), "dynamics"),
    "dynamics a string": (lambda: plant(dynamics="x + u"), "dynamics"),
    "dynamics nothing": (lambda: plant(dynamics=None), "dynamics"),
    "dynamics a function": (lambda: plant(dynamics=lambda x, u: x), "dynamics"),
    "dynamics a list of strings": (lambda: plant(dynamics=["x1", "x2"]), "dynamics"),
    "dynamics with foreign symbols": (lambda: plant(dynamics=ca.SX.sym("q", 2)), "dynamics"),
    "dynamics an MX": (lambda: plant(dynamics=ca.MX.sym("q", 2)), "dynamics"),
    "design a list": (lambda: plant(design=[1, 2]), "design"),
    "design nothing": (lambda: plant(design=None), "design"),
    "design a class": (lambda: plant(design=cc.DesignSpace), "design"),
    "design of another size": (lambda: plant(design=cc.DesignSpace(["k"], [1], [2])), "p"),
    "dt zero": (lambda: plant(dt=0), "dt"),
    "dt negative": (lambda: plant(dt=-0.1), "dt"),
    "dt nothing": (lambda: plant(dt=None), "dt"),
    "dt a string": (lambda: plant(dt="0.1"), "dt"),
    "dt NaN": (lambda: plant(dt=np.nan), "dt"),
    "dt a list": (lambda: plant(dt=[0.1]), "dt"),
    "dt True": (lambda: plant(dt=True), "dt"),
    "substeps 2.5": (lambda: plant(substeps=2.5), "substeps"),
    "substeps 0": (lambda: plant(substeps=0), "substeps"),
    "continuous a string": (lambda: plant(continuous="no"), "continuous"),
    "three state names": (lambda: plant(state_names=["a", "b", "c"]), "state_names"),
    "state names one string": (lambda: plant(state_names="ab"), "state_names"),
    "duplicate design names": (lambda: cc.DesignSpace(["k", "k"], [0, 0], [1, 1]), "names"),
    "names one string": (lambda: cc.DesignSpace("kc", [0, 0], [1, 1]), "names"),
    "names numbers": (lambda: cc.DesignSpace([1, 2], [0, 0], [1, 1]), "names"),
    "bounds reversed": (lambda: cc.DesignSpace(["k"], [2], [1]), "lower, upper"),
    "constraints a number": (lambda: cc.DesignSpace(["k"], [1], [2], constraints=3), "constraints"),
    "constraints a comparison": (lambda: cc.DesignSpace(["k"], [1], [2], constraints=lambda p: p < 2), "constraints"),
    "constraints nothing keeps": (lambda: cc.DesignSpace(["k"], [1], [2], constraints=lambda p: p), "constraints"),
    "integer without a number": (lambda: cc.DesignSpace(["k"], [1.2], [1.8], integer=["k"]), "integer"),
    "bounds infinite": (lambda: cc.DesignSpace(["k"], [0], [np.inf]), "upper"),
    "bounds nothing": (lambda: cc.DesignSpace(["k"], None, [1]), "lower"),
    "bounds text": (lambda: cc.DesignSpace(["k"], ["a"], [1]), "lower"),
    "bounds of two lengths": (lambda: cc.DesignSpace(["k"], [0], [1, 2]), "upper"),
    "units too many": (lambda: cc.DesignSpace(["k"], [0], [1], ["N", "m"]), "units"),
    "an empty name": (lambda: cc.DesignSpace([""], [0], [1]), "names"),
    "a design as text": (lambda: SPACE.check("2, 0.5"), "design"),
    "a design as a dictionary": (lambda: SPACE.check({"k": 2}), "design"),
    "a design as nothing": (lambda: SPACE.check(None), "design"),
    "a design outside": (lambda: SPACE.check([9.0, 0.5]), "design"),
    "a design of NaN": (lambda: SPACE.check([np.nan, 0.5]), "design"),
    "unit points of another size": (lambda: SPACE.from_unit([0.5]), "v"),
    "samples of a seed": (lambda: SPACE.latin_hypercube(5, 0), "rng"),
    "samples 2.5": (lambda: SPACE.latin_hypercube(2.5, rng()), "n"),
    "values without names": (lambda: SPACE.from_dict([1, 2]), "values"),
    "describe another size": (lambda: SPACE.describe([1.0]), "p"),
    # models
    "discretise a TransferFunction": (lambda: cc.discretise(TF), "plant"),
    "discretise a model": (lambda: cc.discretise(MODEL), "plant"),
    "discretise arrays": (lambda: cc.discretise(np.eye(2)), "plant"),
    "discretise with a list": (lambda: cc.discretise(plant(), [0.1]), "dt"),
    "an unknown guard": (lambda: cc.discretise(plant(), sampling_guard="off"), "sampling_guard"),
    "a division by zero at a bound": (
        lambda: cc.discretise(plant(dynamics=ca.vertcat(X[1], U / (P[0] - 1)))),
        "design",
    ),
    "a division by zero inside": (
        lambda: cc.discretise(plant(dynamics=ca.vertcat(X[1], U / (P[0] - 1.7)))).matrices([1.7, 0.5]),
        "design",
    ),
    "a model of a TransferFunction": (lambda: cc.LinearModel.from_state_space(TF), "system"),
    "a model of a matrix": (lambda: cc.LinearModel.from_state_space(np.eye(2)), "system"),
    "a model of nothing": (lambda: cc.LinearModel.from_state_space(None), "system"),
    "a continuous model without dt": (
        lambda: cc.LinearModel.from_state_space(control.ss([[1.0]], [[1.0]], [[1.0]], 0)),
        "dt",
    ),
    "E of another size": (lambda: cc.LinearModel.from_state_space(LTI, E=np.ones((3, 1))), "E"),
    "E text": (lambda: cc.LinearModel.from_state_space(LTI, E="E"), "E"),
    "matrices of two designs too wide": (lambda: MODEL.matrices([[1.0, 0.5, 2.0]]), "design"),
    "matrices of nothing": (lambda: MODEL.matrices(), "design"),
    "a design that the model has not": (lambda: cc.LinearModel.from_state_space(LTI).matrices([1.0]), "design"),
    "derivatives of a batch": (lambda: MODEL.derivatives([P0, P0]), "design"),
    # disturbances
    "a negative deviation": (lambda: cc.Gaussian([-1.0]), "std"),
    "a deviation of text": (lambda: cc.Gaussian("0.1"), "std"),
    "a deviation of nothing": (lambda: cc.Gaussian(None), "std"),
    "a mean of another size": (lambda: cc.Gaussian([0.1], mean=[0.0, 1.0]), "mean"),
    "a mean of NaN": (lambda: cc.Gaussian([0.1], mean=[np.nan]), "mean"),
    "uniform bounds reversed": (lambda: cc.Uniform([1.0], [0.0]), "lower, upper"),
    "a sum of unequal widths": (lambda: cc.Sum((cc.Gaussian([0.1]), cc.Uniform([0, 0], [1, 1]))), "terms"),
    "a sum of arrays": (lambda: cc.Sum((np.zeros(3),)), "terms"),
    "a sum of nothing": (lambda: cc.Sum(()), "terms"),
    "a sum of one disturbance alone": (lambda: cc.Sum(cc.Gaussian([0.1])), "terms"),
    "a sample from a seed": (lambda: cc.Gaussian([0.1]).sample(1, 5, 0), "rng"),
    "a sample from nothing": (lambda: cc.Uniform([0], [1]).sample(1, 5, None), "rng"),
    "a sample of -1 runs": (lambda: cc.Gaussian([0.1]).sample(-1, 5, rng()), "runs"),
    "a sample of 2.5 steps": (lambda: cc.Gaussian([0.1]).sample(1, 2.5, rng()), "steps"),
    "an empty recording": (lambda: cc.Recorded([]), "signal"),
    "a recording with NaN": (lambda: cc.Recorded([0.0, np.nan]), "signal"),
    "a recording too short": (lambda: cc.Recorded([0.0, 1.0]).sample(1, 5, rng()), "steps"),
    "an unknown driver": (lambda: cc.GeneratedRoad("sleepy"), "driver"),
    "a road of dt 0": (lambda: cc.GeneratedRoad("mild", 0.0), "dt"),
    "a road from a seed": (lambda: cc.GeneratedRoad().sample(1, 5, 3), "rng"),
    "a missing recording": (lambda: cc.read_disturbance("absent.csv", dt=0.1), "path"),
    "a recording of nothing": (lambda: cc.read_disturbance(None, dt=0.1), "path"),
    "a recording of dt text": (lambda: cc.read_disturbance("absent.csv", dt="0.1"), "dt"),
    "a missing road": (lambda: cc.read_road("absent.csv"), "path"),
    "a missing speed": (lambda: cc.read_speed(7), "path"),
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
    # simulation
    "a plant of a TransferFunction": (lambda: simulate(plant=TF), "plant"),
    "a plant of nothing": (lambda: simulate(plant=None), "plant"),
    "a plant class": (lambda: simulate(plant=cc.Plant), "plant"),
    "more steps than memory": (
        lambda: simulate(plant=LTI, controller=cc.Passive(), x0=[1.0], steps=10**15, design=None),
        "steps",
    ),
    "a torch module as controller": (lambda: simulate(controller=torch.nn.Linear(2, 1)), "controller"),
    "a gain as controller": (lambda: simulate(controller=np.ones((1, 2))), "controller"),
    "a nested list as controller": (lambda: simulate(controller=[[1.0, 1.0]]), "controller"),
    "nothing as controller": (lambda: simulate(controller=None), "controller"),
    "a class as controller": (lambda: simulate(controller=cc.Passive), "controller"),
    "a controller that gives text": (lambda: simulate(controller=lambda x: "u"), "controller"),
    "a controller that gives nothing": (lambda: simulate(controller=lambda x: None), "controller"),
    "a controller of another width": (lambda: simulate(controller=lambda x: np.zeros((1, 3))), "controller"),
    "a controller of NaN": (lambda: simulate(controller=lambda x: np.full((1, 1), np.nan)), "controller"),
    "a controller of another plant": (lambda: simulate(controller=cc.LinearFeedback([[1.0]])), "x"),
    "a policy at another design": (lambda: simulate(controller=POLICY, design=[3.0, 0.5]), "design"),
    "an unknown need": (lambda: simulate(controller=SimpleNamespaceController({"weather"})), "controller.needs"),
    "a reference that is missing": (lambda: simulate(controller=SimpleNamespaceController({"reference"})), "reference"),
    "a reference of another width": (lambda: simulate(reference=[1.0]), "reference.x"),
    "a reference of NaN": (lambda: simulate(reference=[np.nan, 0.0]), "reference.x"),
    "an output of another width": (lambda: simulate(output=np.ones((1, 3))), "output"),
    "a controller without a place for the state": (lambda: simulate(controller=lambda: 3), "controller"),
    "bounds whose range is infinite": (lambda: cc.DesignSpace(["k"], [-1e308], [1e308]), "lower, upper"),
    "active bounds of tol text": (lambda: SPACE.active_bounds(P0, tol="near"), "tol"),
    "active bounds of tol -1": (lambda: SPACE.active_bounds(P0, tol=-1), "tol"),
    "sets zero": (lambda: dataset(sets=0), "sets"),
    "a replay of states": (lambda: cc.replay_problem(PROBLEM, simulate().states, 5), "logs[0]"),
    "a replay of a log and states": (lambda: cc.replay_problem(PROBLEM, [simulate(), simulate().states], 5), "logs[1]"),
    "a replay of no log": (lambda: cc.replay_problem(PROBLEM, None, 5), "logs[0]"),
    "scenarios that hold NaN": (
        lambda: problem(
            scenarios=SimpleNamespace(
                sample=lambda runs, steps, rng: (np.zeros((runs, 2)), np.full((runs, steps, 1), np.nan))
            )
        ),
        "scenarios, disturbances",
    ),
    "simulated steps 2.5": (lambda: simulate(steps=2.5), "steps"),
    "simulated steps 0": (lambda: simulate(steps=0), "steps"),
    "simulated steps text": (lambda: simulate(steps="5"), "steps"),
    "simulated steps nothing": (lambda: simulate(steps=None), "steps"),
    "x0 of one number": (lambda: simulate(x0=1.0), "x0"),
    "x0 too long": (lambda: simulate(x0=[1.0, 0.0, 0.0]), "x0"),
    "x0 of NaN": (lambda: simulate(x0=[np.nan, 0.0]), "x0"),
    "x0 of nothing": (lambda: simulate(x0=None), "x0"),
    "x0 of text": (lambda: simulate(x0=["a", "b"]), "x0"),
    "x0 of complex numbers": (lambda: simulate(x0=[1j, 0]), "x0"),
    "x0 ragged": (lambda: simulate(x0=[[1.0, 0.0], [1.0]]), "x0"),
    "x0 empty": (lambda: simulate(x0=np.zeros((0, 2))), "x0"),
    "x0 with a gradient": (lambda: simulate(x0=torch.zeros(2, requires_grad=True)), "x0"),
    "a disturbance too short": (lambda: simulate(disturbance=np.zeros((3, 1))), "disturbance"),
    "a disturbance too wide": (lambda: simulate(disturbance=np.zeros((5, 2))), "disturbance"),
    "a disturbance of text": (lambda: simulate(disturbance="road.csv"), "disturbance"),
    "a disturbance class": (lambda: simulate(disturbance=cc.Gaussian), "disturbance"),
    "a random disturbance alone": (lambda: simulate(disturbance=cc.Gaussian([0.1])), "rng"),
    "a random disturbance with a seed": (lambda: simulate(disturbance=cc.Gaussian([0.1]), rng=1), "rng"),
    "no design": (lambda: simulate(design=None), "design"),
    "two designs": (lambda: simulate(design=[P0, P0]), "design"),
    "a design for a plant without one": (
        lambda: simulate(plant=LTI, controller=cc.Passive(), x0=[1.0], design=[1.0]),
        "design",
    ),
    "a negative limit": (lambda: simulate(limit=-1.0), "limit"),
    "a limit of text": (lambda: simulate(limit="far"), "limit"),
    "a scenario of 3 starts and 4 disturbances": (
        lambda: cc.Scenario(MODEL, np.ones((3, 2)), np.zeros((4, 5, 1))),
        "disturbance",
    ),
    "a scenario of a number": (lambda: cc.Scenario(MODEL, [1.0, 0.0], 0.5), "disturbance"),
    "a scenario without a plant": (lambda: cc.Scenario(None, [1.0, 0.0], np.zeros((5, 1))), "plant"),
    "rewards of another objective": (lambda: LOG.rewards(cc.QuadraticObjective([[1]], [[1]])), "objective.Q"),
    "rewards of a tuple": (lambda: LOG.rewards((np.eye(2), np.eye(1))), "objective"),
    "a trajectory of unequal lengths": (lambda: replace(LOG, inputs=LOG.inputs[:, 1:]), "states, inputs, disturbances"),
    # controllers
    "a gain of NaN": (lambda: cc.LinearFeedback([[np.nan]]), "K"),
    "a gain of text": (lambda: cc.LinearFeedback("K"), "K"),
    "feedback bounds reversed": (lambda: cc.LinearFeedback([[1.0]], [1.0], [-1.0]), "lower, upper"),
    "feedback bounds of another size": (lambda: cc.LinearFeedback([[1.0]], [-1, -1], [1, 1]), "lower"),
    "passive inputs -1": (lambda: cc.Passive(-1), "nu"),
    "PID gains of another size": (lambda: cc.PID([[1.0]], [1, 2], [0], [0], dt=1.0, lower=-1, upper=1), "kp"),
    "PID of dt 0": (lambda: cc.PID([[1.0]], [1], [0], [0], dt=0, lower=-1, upper=1), "dt"),
    "PID of three states": (lambda: cc.PID([[1.0]], [1], [0], [0], dt=1, lower=-1, upper=1)([1.0, 2, 3]), "x"),
    "a policy of nothing": (lambda: cc.LearnedPolicy(None, P0), "agent"),
    "a policy at NaN": (lambda: cc.LearnedPolicy(AGENT, [np.nan, 0.5]), "design"),
    "a policy outside the box": (lambda: cc.LearnedPolicy(AGENT, [50.0, 0.5]), "design"),
    "a policy of too many parameters": (lambda: cc.LearnedPolicy(AGENT, [2.0] * 9), "design"),
    "a policy drawing from a seed": (lambda: POLICY.sampled(3), "rng"),
    "a policy at a state of NaN": (lambda: POLICY([np.nan, 0.0]), "x"),
    "a policy saved nowhere": (lambda: POLICY.save("missing_folder/policy.safetensors"), "path"),
    "a policy saved to a number": (lambda: POLICY.save(3), "path"),
    "a policy loaded from nowhere": (lambda: cc.load_policy("missing.safetensors"), None),
    "a policy loaded from nothing": (lambda: cc.load_policy(None), "path"),
    "baselines of a plant": (lambda: cc.baselines(plant(), P0, rng=rng()), "problem"),
    "baselines from a seed": (lambda: cc.baselines(PROBLEM, P0, rng=0), "rng"),
    "an LQR outside the box": (lambda: cc.saturated_lqr(PROBLEM, [9.0, 0.5]), "design"),
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
    # comparison and statistics
    "a comparison of a list": (lambda: compare(controllers=[LQR]), "controllers"),
    "a comparison without its baseline": (lambda: compare(controllers={"mine": LQR}, baseline="LQR"), "baseline"),
    "a comparison of nothing": (lambda: compare(controllers={}), "controllers"),
    "a comparison of a matrix": (lambda: compare(controllers={"LQR": LQR, "K": np.eye(2)}), "controller"),
    "a comparison on a tuple": (lambda: compare(scenario=(MODEL, [1, 0])), "scenario"),
    "a comparison in another X": (lambda: compare(X=INPUTS), "X"),
    "a comparison without an objective": (lambda: compare(objective=None), "objective"),
    "a comparison of few -1": (lambda: compare(few={"LQR": -1}), "few['LQR']"),
    "a comparison at another design": (
        lambda: compare(controllers={"LQR": LQR, "learned": POLICY}, design=[3, 0.5]),
        "design",
    ),
}


class SimpleNamespaceController(SimpleNamespace):
    """A controller that asks for whatever it is told to."""

    def __init__(self, needs):
        super().__init__(needs=needs)

    def __call__(self, x, **signals):
        return np.zeros((len(x), 1))


@pytest.mark.parametrize("name", CALLS)
def test_a_wrong_call_is_refused_in_one_line_that_names_the_argument(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call, argument = CALLS[name]
    with pytest.raises(OURS) as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) < 400
    assert ".cpp:" not in text  # of CasADi's own source
    assert "--" not in text  # the API knows nothing of the options of the command line
    if argument is not None:
        assert caught.value.argument == argument
        assert text.startswith(f"{argument}: got ")
        assert ", expected " in text


@pytest.mark.check
def test_the_calls_beside_them_are_right():
    """The calls above differ from right ones in one argument each: the right ones pass."""
    assert plant().nx == 2
    assert simulate().states.shape == (1, 6, 2)
    assert codesign().history.iteration[-1] == 1
    assert len(compare()) == 1
    assert update(config=None).scores is not None
    assert len(dataset().inputs) > 0
    assert LinearMPC(*MODEL.matrices(P0)[:2], Q=np.eye(2), R=[[0.1]], horizon=5)([1.0, 0.0]).shape == (1,)
