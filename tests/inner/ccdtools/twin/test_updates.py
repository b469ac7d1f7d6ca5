"""Updates while deployed: only where they help, on what they were not trained on."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from deployments import DESIGN, ONLINE, TINY, deployed, training_gives, weakened

from ccdtools import LearnedPolicy, deploy_and_update, simulate
from ccdtools.statistics import PairedDifference, paired_returns
from ccdtools.twin.update_judge import UpdateJudge


@pytest.mark.check
def test_a_candidate_is_judged_on_held_out_samples_as_one_series_or_on_held_out_runs(illustrative, clone, monkeypatch):
    """Blocks of one run would count what is correlated as independent."""
    training_gives(monkeypatch, clone(illustrative))
    judged = []

    def spy(a, b, *, runs):
        judged.append((a.shape, runs))
        return paired_returns(a, b, runs=runs)

    monkeypatch.setattr("ccdtools.twin.common_runs.paired_returns", spy)
    deployed(illustrative, clone(illustrative), runs=1, steps=601)  # 60 of every 200 samples are held out
    assert judged == [((1, 60), 1), ((1, 120), 1)]
    judged.clear()
    deployed(illustrative, clone(illustrative), runs=15, steps=40, config=replace(ONLINE, judged=3))
    assert judged == [((2, 40), 15), ((3, 40), 15)]


def test_a_candidate_that_loses_a_run_has_no_gain(illustrative, clone, monkeypatch):
    """Rewards end where a run is lost, so that a sum over the last part would flatter it."""
    wild = weakened(clone(illustrative), -20.0)
    training_gives(monkeypatch, wild)
    wild.action_scale.mul_(1e6)
    done = deployed(illustrative, clone(illustrative), runs=1, steps=600)
    assert done.updates
    assert all(np.isnan(update.gain.mean) and not update.accepted for update in done.updates)


def test_an_update_follows_every_stretch_but_the_last(illustrative, clone):
    done = deployed(illustrative, clone(illustrative), runs=1, steps=300)
    assert [update.after for update in done.updates] == [100, 200]
    done = deployed(illustrative, clone(illustrative), runs=6, steps=40)
    assert [update.after for update in done.updates] == [80, 160]


def test_an_update_is_accepted_exactly_when_its_interval_lies_above_zero(illustrative, clone):
    for seed in range(3):
        done = deployed(illustrative, clone(illustrative), runs=6, steps=40, seed=seed)
        assert [u.accepted for u in done.updates] == [u.gain.ci95[0] > 0 for u in done.updates]


def test_a_better_candidate_goes_into_service(illustrative, clone, monkeypatch):
    good, weak = clone(illustrative), weakened(clone(illustrative))
    training_gives(monkeypatch, good)
    done = deployed(illustrative, weak, runs=1, steps=6000)
    assert done.updates[0].accepted
    assert done.updates[0].gain.mean > 0
    assert done.agent is good
    u = LearnedPolicy(weak, DESIGN)(done.log.states[0, :2000])
    np.testing.assert_allclose(done.log.inputs[0, :2000], u)
    u = LearnedPolicy(good, DESIGN)(done.log.states[0, 2000:4000])
    np.testing.assert_allclose(done.log.inputs[0, 2000:4000], u)


def test_a_worse_or_equal_candidate_does_not_go_into_service(illustrative, clone, monkeypatch):
    good = clone(illustrative)
    for candidate in (weakened(good), copy.deepcopy(good)):
        training_gives(monkeypatch, candidate)
        done = deployed(illustrative, good, runs=1, steps=600)
        assert done.agent is good
        assert not any(update.accepted for update in done.updates)
        assert all(update.gain.ci95[0] <= 0 for update in done.updates)


def test_a_candidate_is_judged_on_what_it_was_not_trained_on(illustrative, clone, monkeypatch):
    trained = training_gives(monkeypatch, clone(illustrative))
    log = deployed(illustrative, clone(illustrative), runs=1, steps=300).log
    first, second = (problem.scenarios.logs for problem, _ in trained)
    np.testing.assert_array_equal(first[0].x[0], log.states[0, :70])
    assert len(second) == 2
    np.testing.assert_array_equal(second[1].x[0], log.states[0, 100:170])


def test_a_candidate_is_trained_at_the_design_in_service_whatever_the_rate_of_the_design(illustrative, clone):
    moving = replace(ONLINE, training=replace(TINY, design_rate=0.5))
    frozen, asked = (
        deployed(illustrative, clone(illustrative), runs=1, steps=400, config=config) for config in (ONLINE, moving)
    )
    assert len(asked.updates) == 2
    assert [one.gain.mean for one in asked.updates] == [one.gain.mean for one in frozen.updates]


@pytest.mark.parametrize(("mean", "taken"), [(0.09, False), (0.11, True)])
def test_an_update_must_bring_a_tenth_of_a_per_cent(illustrative, clone, monkeypatch, mean, taken):
    """A sure gain that is too small to matter is not worth another policy."""
    gain = (PairedDifference(mean, (0.05, 0.2)), 100.0)
    monkeypatch.setattr("ccdtools.twin.update_judge.UpdateJudge.gain", lambda *_: gain)
    updates = deployed(illustrative, clone(illustrative), runs=12, steps=40).updates
    assert updates
    assert all(update.accepted is taken for update in updates)


def test_any_gain_beyond_chance_is_an_update_where_none_is_asked_for(illustrative, clone, monkeypatch):
    gain = (PairedDifference(1e-9, (1e-10, 2e-9)), 100.0)
    monkeypatch.setattr("ccdtools.twin.update_judge.UpdateJudge.gain", lambda *_: gain)
    config = replace(ONLINE, least=0.0)
    updates = deployed(illustrative, clone(illustrative), runs=12, steps=40, config=config).updates
    assert updates
    assert all(update.accepted for update in updates)


@pytest.mark.parametrize("runs", [1, 12])
def test_a_gain_is_a_part_of_the_nominal_return_where_the_logged_one_is_small(illustrative, clone, monkeypatch, runs):
    """Without any disturbance and from the origin the return in service is next to nothing, and so is a part of it."""
    good, weak = clone(illustrative), weakened(clone(illustrative))
    training_gives(monkeypatch, good)
    sizes = []

    def spy(self, *arguments):
        sizes.append(gain(self, *arguments)[1])
        return PairedDifference(0.0, (0.0, 0.0)), sizes[-1]

    gain = UpdateJudge.gain
    monkeypatch.setattr(UpdateJudge, "gain", spy)
    steps = 400 if runs == 1 else 40
    problem = illustrative.problem()
    deploy_and_update(
        problem, illustrative.plant, weak, DESIGN, x0=1e-6 * np.ones((runs, 2)), disturbance=np.zeros((runs, steps, 2)),
        rng=np.random.default_rng(0), config=ONLINE,
    )  # fmt: skip
    x0, w = problem.scenarios.sample(300, problem.steps, np.random.default_rng(1))
    run = simulate(illustrative.plant, LearnedPolicy(weak, DESIGN), x0=x0, steps=problem.steps, disturbance=w,
                   design=DESIGN)  # fmt: skip
    counted = {1: 0.3 * 400 / 3, 12: 40}[runs]
    nominal = -run.returns(problem.objective).mean() * counted / problem.steps
    assert sizes == pytest.approx([nominal, 2 * nominal] if runs == 1 else [nominal, nominal], rel=0.3)
