"""Wrong simulations, controllers and comparisons; right calls pass."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from refusals import assert_refused
from right_calls import (
    AGENT,
    INPUTS,
    LOG,
    LQR,
    LTI,
    MODEL,
    P0,
    POLICY,
    PROBLEM,
    SPACE,
    TF,
    codesign,
    compare,
    dataset,
    plant,
    problem,
    rng,
    simulate,
    update,
)

import ccdtools as cc
from mpc import LinearMPC


class SimpleNamespaceController(SimpleNamespace):
    """A controller that asks for whatever it is told to."""

    def __init__(self, needs):
        super().__init__(needs=needs)

    def __call__(self, x, **signals):
        return np.zeros((len(x), 1))


CALLS = {
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


@pytest.mark.parametrize("name", CALLS)
def test_a_wrong_call_is_refused_in_one_line_that_names_the_argument(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_refused(*CALLS[name])


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
