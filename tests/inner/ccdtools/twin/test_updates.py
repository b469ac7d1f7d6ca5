"""Updates while deployed: only where they help, on what they were not trained on, and lose nowhere."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from deployments import DESIGN, ONLINE, TINY, deployed, training_gives, weakened

from ccdtools import LearnedPolicy, simulate
from ccdtools.evidence.verdict import Status
from ccdtools.statistics import PairedDifference
from ccdtools.twin.deployment import deploy_and_update
from ccdtools.twin.distributions import BOX, NOMINAL, REPLAY, START, UPDATED
from ccdtools.twin.judge import Judge
from ccdtools.twin.trial import TrialConfig
from learning.quantile import QuantileConfig


@pytest.mark.check
def test_a_candidate_is_judged_on_held_out_samples_as_one_series_or_on_held_out_runs(illustrative, clone, monkeypatch):
    """Blocks of one run would count what is correlated as independent."""
    training_gives(monkeypatch, weakened(clone(illustrative)))
    judged = []
    compared = Judge._compared

    def spy(self, candidate, current, on):
        if on.name == REPLAY:
            judged.append((on.scenario.disturbance.shape[:2], on.counted, on.series))
        return compared(self, candidate, current, on)

    monkeypatch.setattr(Judge, "_compared", spy)
    deployed(illustrative, clone(illustrative), runs=1, steps=601)  # 60 of every 200 samples are held out
    assert judged == [((1, 200), 60, True), ((2, 200), 60, True)]
    judged.clear()
    deployed(illustrative, clone(illustrative), runs=15, steps=40, config=replace(ONLINE, judged=3))
    assert judged == [((2, 40), None, False), ((3, 40), None, False)]


def test_a_candidate_that_loses_a_run_is_refused(illustrative, clone, monkeypatch):
    """Rewards end where a run is lost, so that a sum over the last part would flatter it."""
    wild = weakened(clone(illustrative), -20.0)
    training_gives(monkeypatch, wild)
    wild.action_scale.mul_(1e6)
    done = deployed(illustrative, clone(illustrative), runs=1, steps=600)
    assert done.updates
    assert all(update.verdict.status is Status.MORE_LOST for update in done.updates)


@pytest.mark.long
def test_an_update_follows_every_stretch_but_the_last(illustrative, clone):
    done = deployed(illustrative, clone(illustrative), runs=1, steps=300)
    assert [update.after for update in done.updates] == [100, 200]
    done = deployed(illustrative, clone(illustrative), runs=6, steps=40)
    assert [update.after for update in done.updates] == [80, 160]


def test_a_better_candidate_is_deployed_and_every_distribution_has_its_say(illustrative, clone, monkeypatch):
    good, weak = clone(illustrative), weakened(clone(illustrative))
    training_gives(monkeypatch, good)
    done = deployed(illustrative, weak, runs=60, steps=40, config=replace(ONLINE, judged=100))
    (first, *_) = done.updates
    assert first.verdict.status is Status.BETTER
    assert done.agent is good
    assert done.changes == (20 * 40,)
    assert [one.distribution for one in first.verdict.evidence] == [REPLAY, UPDATED, START, BOX, NOMINAL]
    assert {one.candidate for one in first.verdict.evidence} == {"update 1, simulated"}
    assert first.as_dict()["updated_gain"]["mean"] == first.verdict.on(UPDATED).gain.mean
    for agent, runs in ((weak, slice(0, 20)), (good, slice(20, 60))):
        u = LearnedPolicy(agent, DESIGN)(done.log.states[runs, :-1].reshape(-1, 2))
        np.testing.assert_allclose(done.log.inputs[runs].reshape(-1, 1), u)


def test_a_worse_or_equal_candidate_is_not_deployed(illustrative, clone, monkeypatch):
    good = clone(illustrative)
    for candidate in (weakened(good), copy.deepcopy(good)):
        training_gives(monkeypatch, candidate)
        done = deployed(illustrative, good, runs=1, steps=600)
        assert done.agent is good
        assert done.changes == ()
        assert all(update.gain.ci95[0] <= 0 for update in done.updates)


class Elsewhere:
    """A policy that is the better one near the origin, where the log is, and a weak one where the study starts."""

    def __init__(self, near, far, radius):
        self.agents = (near, far)
        self.radius = radius
        self.design = DESIGN

    def __call__(self, x):
        near, far = (LearnedPolicy(agent, DESIGN)(x) for agent in self.agents)
        return np.where(np.linalg.norm(x, axis=1, keepdims=True) < self.radius, near, far)


def test_a_trial_is_told_little_by_a_log_that_runs_away_under_the_candidate(illustrative, clone, monkeypatch):
    training_gives(monkeypatch, clone(illustrative))
    config = replace(ONLINE, updates=1, judged=100, trial=TrialConfig())
    done = deployed(illustrative, weakened(clone(illustrative)), runs=80, steps=40, config=config)
    (update,) = done.updates
    assert np.abs(update.trial.gains).max() < 100


@pytest.mark.check
def test_a_policy_that_gains_on_the_drive_and_loses_from_the_start_is_refused_by_name(illustrative, clone, monkeypatch):
    """The drive stays near the origin; the study starts at (−2, −2)."""
    good, weak, far = clone(illustrative), weakened(clone(illustrative)), weakened(clone(illustrative), 0.4)
    candidate = copy.deepcopy(good)
    controller = Judge.run

    def run(self, one, on):
        if one.agent is not candidate:
            return controller(self, one, on)
        return on.scenario.run(Elsewhere(good, far, 1.0), design=DESIGN, limit=self.problem.limit)

    monkeypatch.setattr(Judge, "run", run)
    training_gives(monkeypatch, candidate)
    study = illustrative.started(x0=[-2.0, -2.0])
    w = 0.5 * study.disturbance.sample(40, 40, np.random.default_rng(0))

    def update(accept_loss):
        """Return the first update on a linear plant driven from rest."""
        return deploy_and_update(
            study.problem(), study.plant, weak, DESIGN, x0=np.zeros((40, 2)), disturbance=w,
            rng=np.random.default_rng(0), config=replace(
                ONLINE, updates=1, judged=100, accept_loss=accept_loss, quantile=QuantileConfig(steps=300)
            ),
        ).updates[0]  # fmt: skip

    refused = update(0.005)
    assert refused.gain.ci95[0] > 0
    assert refused.verdict.status is Status.LOSS
    assert f"on {START}, tolerance 0.5 %" in refused.verdict.reason or f"on {BOX}" in refused.verdict.reason
    lost = refused.verdict.on(START)
    assert lost.gain.ci95[1] < -0.005 * lost.size
    assert update(1.0).accepted


def test_a_candidate_is_judged_on_what_it_was_not_trained_on(illustrative, clone, monkeypatch):
    trained = training_gives(monkeypatch, clone(illustrative))
    log = deployed(illustrative, clone(illustrative), runs=1, steps=300).log
    first, second = (problem.scenarios.logs for problem, _ in trained)
    np.testing.assert_array_equal(first[0].x[0], log.states[0, :70])
    assert len(second) == 2
    np.testing.assert_array_equal(second[1].x[0], log.states[0, 100:170])


def test_a_candidate_is_trained_from_the_log_and_from_the_starts_that_it_will_serve(illustrative, clone, monkeypatch):
    trained = training_gives(monkeypatch, clone(illustrative))
    study = illustrative.started(x0=[-2.0, -2.0])
    deployed(study, clone(illustrative), runs=1, steps=300, x0=np.zeros((1, 2)))
    x0, _ = trained[0][0].scenarios.sample(2000, 20, np.random.default_rng(0))
    logged = (x0[:, None] == trained[0][0].scenarios.logs[0].x[0]).all(axis=2).any(axis=1)
    started = (x0 == [-2.0, -2.0]).all(axis=1)
    assert logged.mean() == pytest.approx(0.5, abs=0.05)
    assert started.mean() == pytest.approx(0.25, abs=0.05)
    assert (study.X.contains(x0)).all()
    assert np.ptp(x0[~logged & ~started], axis=0).min() > 1


@pytest.mark.check
def test_a_candidate_is_trained_at_the_deployed_design_whatever_the_rate_of_the_design(illustrative, clone):
    moving = replace(ONLINE, training=replace(TINY, design_rate=0.5))
    frozen, asked = (
        deployed(illustrative, clone(illustrative), runs=1, steps=400, config=config) for config in (ONLINE, moving)
    )
    assert len(asked.updates) == 2
    assert [one.gain.mean for one in asked.updates] == [one.gain.mean for one in frozen.updates]


@pytest.mark.parametrize(("least", "status"), [(1.0, Status.BELOW_PRICE), (0.0, Status.BETTER)])
def test_an_update_must_bring_the_part_of_the_return_that_is_asked_for(illustrative, clone, monkeypatch, least, status):
    """A sure gain that is too small to matter is not worth another policy."""
    training_gives(monkeypatch, clone(illustrative))
    config = replace(ONLINE, updates=1, judged=100, least=least)
    (update,) = deployed(illustrative, weakened(clone(illustrative)), runs=60, steps=40, config=config).updates
    assert update.verdict.status is status


@pytest.mark.parametrize("runs", [1, 12])
def test_a_gain_is_a_part_of_the_nominal_return_where_the_logged_one_is_small(illustrative, clone, monkeypatch, runs):
    """Without any disturbance and from the origin the deployed return is next to nothing, and so is a part of it."""
    good, weak = clone(illustrative), weakened(clone(illustrative))
    training_gives(monkeypatch, good)
    steps = 400 if runs == 1 else 40
    problem = illustrative.problem()
    updates = deploy_and_update(
        problem, illustrative.plant, weak, DESIGN, x0=1e-6 * np.ones((runs, 2)), disturbance=np.zeros((runs, steps, 2)),
        rng=np.random.default_rng(0), config=ONLINE,
    ).updates  # fmt: skip
    x0, w = problem.scenarios.sample(300, problem.steps, np.random.default_rng(1))
    run = simulate(illustrative.plant, LearnedPolicy(weak, DESIGN), x0=x0, steps=problem.steps, disturbance=w,
                   design=DESIGN)  # fmt: skip
    counted = {1: 0.3 * 400 / 3, 12: 40}[runs]
    nominal = -run.returns(problem.objective).mean() * counted / problem.steps
    sizes = [update.verdict.evidence[0].size for update in updates]
    assert sizes == pytest.approx([nominal, 2 * nominal] if runs == 1 else [nominal, nominal], rel=0.3)
    assert not any(update.accepted for update in updates)


def test_a_gain_is_in_units_of_the_return(illustrative, clone, monkeypatch):
    """Whatever the cost of a design that both pay."""
    training_gives(monkeypatch, clone(illustrative))
    (update,) = deployed(illustrative, weakened(clone(illustrative)), runs=12, steps=40,
                         config=replace(ONLINE, updates=1)).updates  # fmt: skip
    assert isinstance(update.gain, PairedDifference)
    made = update.verdict.evidence[0]
    assert made.gain.mean == pytest.approx(made.values[0] - made.values[1])
