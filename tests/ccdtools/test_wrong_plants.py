"""Wrong plants, designs, models and disturbances."""

import casadi as ca
import control
import numpy as np
import pytest
import torch
from refusals import assert_refused
from right_calls import LTI, MODEL, P0, SPACE, TF, P, U, X, plant, rng

import ccdtools as cc

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
}


@pytest.mark.parametrize("name", CALLS)
def test_a_wrong_call_is_refused_in_one_line_that_names_the_argument(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_refused(*CALLS[name])
