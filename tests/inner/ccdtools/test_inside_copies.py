"""What test_copies.py claims, seen from inside."""

import copy
import pickle
from dataclasses import fields, is_dataclass

import numpy as np
import pytest

import ccdtools as cc
from ccdtools.co_design import LearnedCoDesign
from ccdtools.co_design.expert import ExpertData
from ccdtools.co_design.learned_result import GradientCheck
from ccdtools.co_design.result import History
from ccdtools.twin.discrepancy import Discrepancy, TwinPlant
from ccdtools.twin.replay import Replay
from ccdtools.twin.residuals import residuals
from learning.quantile import QuantileNetwork

P = np.array([2.0])


def twice(thing):
    """The object deep-copied, and the object pickled and read back."""
    return copy.deepcopy(thing), pickle.loads(pickle.dumps(thing))


@pytest.fixture(scope="module")
def log(illustrative):
    return cc.simulate(
        illustrative.model, cc.saturated_lqr(illustrative.problem(), P), x0=np.zeros((3, 2)), steps=30, design=P,
        disturbance=illustrative.disturbance, rng=np.random.default_rng(0),
    )  # fmt: skip


@pytest.fixture(scope="module")
def things(illustrative, clone, log):
    """Return one object of every public kind."""
    policy = cc.LearnedPolicy(clone(illustrative), P)
    policy(np.zeros(2))
    errors = residuals(illustrative.model, log)
    network = QuantileNetwork(5, 2, (0.1, 0.5, 0.9), (4,))
    discrepancy = Discrepancy(network, np.eye(2))
    noise = cc.Gaussian([0.1, 0.2])
    scenario = cc.Scenario(illustrative.model, np.zeros((3, 2)), np.zeros((3, 9, 2)))
    history = History(*(np.arange(3.0) for _ in range(6)))
    return [
        illustrative.plant, illustrative.real.plant, illustrative.model, illustrative.plant.design,
        illustrative.problem(), illustrative, illustrative.real, cc.feasible_sets(illustrative.problem()),
        illustrative.objective, policy, policy.sampled(np.random.default_rng(1)),
        cc.DigitalTwin(illustrative.model, (errors,), discrepancy), discrepancy,
        TwinPlant(illustrative.model, discrepancy), errors, Replay((errors,)), log, scenario, noise,
        cc.Uniform([0], [1]), cc.Sum((noise, noise)), cc.Recorded(np.zeros(50)), cc.GeneratedRoad(),
        cc.ISORoad("D", 15.0, track=1.5), cc.SuspensionMetrics(*np.ones((7, 3))),
        cc.FixedStart([0, 0], noise), cc.Reference([0, 0]), cc.LinearFeedback([[1.0]], [-1], [1]), cc.Passive(2),
        cc.PID([[1.0]], [1], [0], [0], dt=1.0, lower=[-1], upper=[1]), cc.CoDesignConfig(), cc.OnlineConfig(),
        ExpertData(np.zeros((200, 3)), np.zeros((200, 1)), np.zeros(200), 1.0, 0.0), history,
        LearnedCoDesign(
            design=P, agent=clone(illustrative), history=history, gradients=GradientCheck(("p",), P, P, P),
        ),
        cc.compare({"LQR": cc.LinearFeedback([[0.1, 0.1]])}, scenario, design=P, objective=illustrative.objective,
                   X=illustrative.X),
    ]  # fmt: skip


def arrays_of(thing, depth=0):
    """Every array inside a dataclass of this package."""
    for field in fields(thing):
        value = None if field.name.startswith("_") else getattr(thing, field.name)
        if isinstance(value, np.ndarray):
            yield field.name, value
        elif is_dataclass(value) and type(value).__module__.startswith("ccdtools") and depth < 3:
            yield from arrays_of(value, depth + 1)


def test_every_public_object_is_copied_and_pickled(things):
    for thing in things:
        for other in twice(thing):
            assert type(other) is type(thing)
            if is_dataclass(thing) and not isinstance(thing, cc.CoDesignConfig | cc.OnlineConfig):
                assert [f.name for f in fields(thing) if not hasattr(other, f.name)] == []


def test_copies_are_as_read_only_as_their_originals(things):
    for thing in things:
        for one in (thing, *twice(thing)):
            for name, array in arrays_of(one):
                assert not array.flags.writeable, (type(one).__name__, name)


def test_every_public_object_prints_in_a_few_lines(things):
    for thing in things:
        text = repr(thing)
        assert len(text) < 700, type(thing).__name__
        assert text.count("\n") < 8
        assert " at 0x" not in text
