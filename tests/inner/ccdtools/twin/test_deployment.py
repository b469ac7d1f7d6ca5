"""Deployment: logs without gaps, of as many parts as it has room for."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from deployments import DESIGN, ONLINE, deployed, disturbances, start, training_gives

from ccdtools import InputError, LearnedPolicy, OnlineConfig, deploy, deploy_and_update, simulate
from ccdtools.controllers import Passive
from ccdtools.exceptions import SimulatorError


def test_a_deployment_is_a_simulation_as_long_as_its_disturbance(illustrative):
    w = disturbances(illustrative, 1, 30)
    log = deploy(illustrative.real.plant, Passive(), DESIGN, w[0], x0=[0.0, 0.0])
    run = simulate(illustrative.real.plant, Passive(), x0=[0, 0], steps=30, disturbance=w, design=DESIGN)
    np.testing.assert_array_equal(log.states, run.states)


def test_a_single_channel_may_be_a_plain_sequence(suspension):
    log = deploy(suspension.real.plant, Passive(), suspension.p0, np.ones(7), x0=np.zeros(4))
    assert log.inputs.shape == (1, 7, 1)


@pytest.mark.long
@pytest.mark.parametrize("runs", [1, 6])
def test_stretches_join_without_a_gap(illustrative, clone, runs):
    steps = 240 if runs == 1 else 40
    log = deployed(illustrative, clone(illustrative), runs=runs, steps=steps).log
    assert log.states.shape == (runs, steps + 1, 2)
    np.testing.assert_array_equal(log.disturbances, disturbances(illustrative, runs, steps))
    np.testing.assert_array_equal(log.states[:, 0], start(runs))
    step = illustrative.real.plant.stepper(DESIGN, batch=runs)
    for k in range(steps):
        following = step(log.states[:, k], log.inputs[:, k], log.disturbances[:, k])
        np.testing.assert_allclose(log.states[:, k + 1], following, rtol=1e-12, atol=1e-12)
    assert not log.diverged.any()


def test_without_updates_the_deployment_is_one_piece_under_the_first_policy(illustrative, clone):
    agent = clone(illustrative)
    done = deployed(illustrative, agent, runs=1, steps=50, config=replace(ONLINE, updates=0))
    assert done.agent is agent
    assert done.updates == ()
    whole = deploy(
        illustrative.real.plant, LearnedPolicy(agent, DESIGN), DESIGN, disturbances(illustrative, 1, 50), x0=start()
    )
    np.testing.assert_array_equal(done.log.states, whole.states)


@pytest.mark.long
def test_the_agent_passed_in_is_not_changed(illustrative, clone):
    agent = clone(illustrative)
    before = copy.deepcopy(agent.state_dict())
    deployed(illustrative, agent, runs=6, steps=40)
    torch.testing.assert_close(agent.state_dict(), before, rtol=0, atol=0)


class Dying:
    """The real plant, whose process ends in its 170th sample."""

    def __init__(self, plant):
        self.plant, self.left = plant, 170

    def __getattr__(self, name):
        return getattr(self.plant, name)

    def stepper(self, p, *, batch):
        step = self.plant.stepper(p, batch=batch)

        def dying(x, u, w):
            self.left -= 1
            if self.left < 0:
                raise SimulatorError("advance", "a simulator that dies", "x⁺")
            return step(x, u, w)

        return dying


@pytest.mark.long
def test_the_parts_that_ended_before_a_simulator_died_are_kept(illustrative, clone):
    agent, w = clone(illustrative), disturbances(illustrative, 1, 240)
    given = {"x0": start(), "disturbance": w, "config": ONLINE}
    plant = illustrative.real.plant
    whole = deploy_and_update(illustrative.problem(), plant, agent, DESIGN, **given, rng=np.random.default_rng(0))
    with pytest.raises(SimulatorError, match="at step 10") as caught:
        deploy_and_update(illustrative.problem(), Dying(plant), agent, DESIGN, **given, rng=np.random.default_rng(0))
    kept = caught.value.kept
    np.testing.assert_array_equal(kept.log.states, whole.log.states[:, :161])
    assert len(kept.updates) == len(whole.updates) == 2


def test_a_run_lost_in_one_stretch_stays_lost(illustrative, clone):
    done = deployed(illustrative, clone(illustrative), runs=1, steps=90, x0=np.array([[-5e3, -2.5e3]]))
    log = done.log
    (at,) = log.diverged_at
    assert 0 <= at < 30
    np.testing.assert_array_equal(log.states[0, at + 1 :], np.tile(log.states[0, at + 1], (90 - at, 1)))
    assert not log.inputs[0, at + 1 :].any()
    assert done.updates == ()
    whole = deploy(
        illustrative.real.plant, LearnedPolicy(done.agent, DESIGN), DESIGN, disturbances(illustrative, 1, 90),
        x0=[-5e3, -2.5e3], limit=illustrative.problem().limit,
    )  # fmt: skip
    np.testing.assert_array_equal(log.states, whole.states)
    np.testing.assert_array_equal(log.diverged_at, whole.diverged_at)


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("runs", "steps", "updates"), [(1, 90, 0), (1, 700, 1), (1, 1000, 2), (3, 150, 0), (4, 150, 1)]
)
def test_a_deployment_too_short_to_judge_every_update_gets_fewer(illustrative, clone, runs, steps, updates):
    config = replace(ONLINE, window=100, updates=4)
    done = deployed(illustrative, clone(illustrative), runs=runs, steps=steps, config=config)
    assert len(done.updates) == updates
    assert done.log.inputs.shape[:2] == (runs, steps)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"updates": -1}, "updates: got -1, expected a whole number, at least 0"),
        ({"window": 0}, "window: got 0, expected a whole number, at least 1"),
        ({"judged": 1}, "judged: got 1, expected a whole number, at least 2"),
        ({"held_out": 0.0}, r"held_out: got 0.0, expected a fraction between 0 and 1"),
        ({"least": -0.1}, r"least: got -0.1, expected a fraction from 0 to 1"),
        ({"accept_loss": 2.0}, r"accept_loss: got 2.0, expected a fraction from 0 to 1"),
        ({"quantile": 3}, r"quantile: got 3, expected a QuantileConfig"),
        ({"held_out": 1.0}, r"held_out: got 1.0, expected a fraction between 0 and 1"),
    ],
)
def test_online_updates_that_make_no_sense_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        OnlineConfig(**options)


def test_a_design_outside_its_bounds_is_refused(illustrative, clone):
    with pytest.raises(InputError, match="design: got p = 9"):
        deploy_and_update(
            illustrative.problem(), illustrative.real.plant, clone(illustrative), [9.0], x0=start(),
            disturbance=disturbances(illustrative, 1, 30), rng=np.random.default_rng(0),
        )  # fmt: skip


def test_a_piece_of_which_one_run_survived_teaches_nothing(illustrative, clone, monkeypatch):
    """Its only run would be cut in time, and be shorter than those of the other pieces."""
    trained = training_gives(monkeypatch, clone(illustrative))
    x0 = start(12)
    x0[:3] = [-5e3, -2.5e3]  # of the first four
    done = deployed(illustrative, clone(illustrative), runs=12, steps=80, x0=x0, config=replace(ONLINE, window=20))
    np.testing.assert_array_equal(done.log.diverged, np.arange(12) < 3)
    assert len(done.updates) == 1
    ((problem, _),) = trained
    np.testing.assert_array_equal(problem.scenarios.logs[0].numbers, [4, 5, 6])
