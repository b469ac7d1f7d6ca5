"""Updates are judged on what former deployments have taught, too."""

from dataclasses import replace

import numpy as np
import pytest
from deployments import DESIGN, ONLINE, disturbances, judge, start, told_independent, training_gives, weakened

from ccdtools import DigitalTwin, InputError, LearnedPolicy, deploy, deploy_and_update, simulate
from ccdtools.statistics import PairedDifference
from ccdtools.twin.discrepancy import TwinPlant
from ccdtools.twin.recombined_returns import NOT_ASKED
from ccdtools.twin.replay import Replay
from ccdtools.twin.residuals import residuals
from ccdtools.twin.update_judge import UpdateJudge
from learning import QuantileConfig


@pytest.fixture(scope="module")
def former(illustrative, clone):
    """Return the errors of a former deployment of 60 runs."""
    w = disturbances(illustrative, 60, 40, seed=5)
    log = deploy(illustrative.real.plant, LearnedPolicy(clone(illustrative), DESIGN), DESIGN, w, x0=start(60))
    return residuals(illustrative.model, log)


def test_updates_are_judged_on_former_deployments_too(illustrative, clone, monkeypatch):
    """No candidate was trained on them, and they are more than the held-out runs.

    Those of a disturbance that it was trained on are left out: first those of the runs 0 and 2, then also that of 6.
    """
    weak = weakened(clone(illustrative))
    trained = training_gives(monkeypatch, clone(illustrative))
    judged = []

    def spy(self, candidate, agent, replay):
        judged.append([log.numbers.tolist() for log in replay.logs])
        return gain(self, candidate, agent, replay)

    gain = UpdateJudge._logged_gain
    monkeypatch.setattr(UpdateJudge, "_logged_gain", spy)
    w = disturbances(illustrative, 30, 40, seed=5)
    log = deploy(illustrative.real.plant, LearnedPolicy(weak, DESIGN), DESIGN, w, x0=start(30))
    long, short, single = (residuals(illustrative.model, log).part(*cut) for cut in (
        (slice(None), slice(None)), (slice(None), slice(0, 30)), (slice(0, 1), slice(None))
    ))  # fmt: skip

    def done(runs, steps, former):
        """Return the gains of a deployment."""
        updates = deploy_and_update(
            illustrative.problem(), illustrative.real.plant, weak, DESIGN, x0=start(runs), former=former,
            disturbance=disturbances(illustrative, runs, steps), rng=np.random.default_rng(0), config=ONLINE,
        ).updates  # fmt: skip
        return [update.gain for update in updates]

    done(15, 40, [long, short, single])
    first, second = ([k for k in range(30) if k not in trained] for trained in ((0, 2), (0, 2, 6)))
    assert judged == [[first, [3, 4]], [second, [3, 4], [8, 9]]]
    assert all(log.runs < 5 for problem, _ in trained for log in problem.scenarios.logs)
    assert done(1, 600, [long]) == done(1, 600, [])
    with pytest.raises(InputError, match="former: got"):
        done(15, 40, [log])


def test_runs_that_met_the_same_disturbance_in_several_deployments_are_one_piece_of_evidence(
    illustrative, clone, former
):
    """Five deployments that met nothing new say what one says: the same gain with the same interval."""
    good, weak = clone(illustrative), weakened(clone(illustrative))
    common = former.part(former.numbers % 2 == 0, slice(None))
    judged = judge(illustrative, judged=400)
    one, five = (judged.gain(good, weak, [common] * times, [common], NOT_ASKED)[0] for times in (1, 5))
    assert five.mean == pytest.approx(one.mean)
    np.testing.assert_allclose(five.ci95, one.ci95)
    others = former.part(former.numbers % 2 == 1, slice(None))
    fresh = judged.gain(good, weak, [others] * 5, [others], NOT_ASKED)[0]
    assert np.diff(fresh.ci95) < 0.6 * np.diff(one.ci95)


def test_updates_are_recombined_at_the_defaults_however_many_former_runs_there_are(
    illustrative, clone, former, monkeypatch
):
    """Of 60 former runs and some held-out ones there are more than half of the 400 that a judgement asks for."""
    training_gives(monkeypatch, clone(illustrative))
    _, judged = told_independent(monkeypatch)
    long = replace(former, independent=True)
    for known in ([long] * 4, [long, former]):
        judged.clear()
        deploy_and_update(
            illustrative.problem(), illustrative.real.plant, weakened(clone(illustrative)), DESIGN, x0=start(60),
            former=known, disturbance=disturbances(illustrative, 60, 40), rng=np.random.default_rng(0),
            config=replace(ONLINE, updates=1, judged=400),
        )  # fmt: skip
        if known[-1].independent:
            held_out, everything = judged
            assert len(held_out) == 4 * (60 - 11) + 9  # the disturbances of 11 common runs were trained on
            np.testing.assert_array_equal(everything, np.arange(30))
        else:  # what a former log was told is respected
            (everything,) = judged
            np.testing.assert_array_equal(everything, np.arange(30))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda log: replace(log, x=log.x[..., :1]), r"former\[1\]: got 1 states with 2 errors"),
        (lambda log: replace(log, e_next=log.e_next[..., :1]), r"former\[1\]: got 2 states with 1 errors"),
        (lambda log: replace(log, u=np.repeat(log.u, 2, axis=2)), r"former\[1\]: got 2 states .* 2 inputs"),
        (lambda log: replace(log, p=[2.0, 2.0]), r"former\[1\].p: got"),
        (lambda log: replace(log, p=[9.0]), r"former\[1\].p: got p = 9"),
        (lambda log: replace(log, x=np.nan * log.x), r"former\[1\].x: got a value that is not finite"),
    ],
)  # fmt: skip
def test_former_errors_of_another_plant_are_refused(illustrative, clone, former, change, message):
    with pytest.raises(InputError, match=message):
        deploy_and_update(
            illustrative.problem(), illustrative.real.plant, clone(illustrative), DESIGN, x0=start(12),
            former=[former, change(former)], disturbance=disturbances(illustrative, 12, 40),
            rng=np.random.default_rng(0), config=ONLINE,
        )  # fmt: skip


@pytest.fixture(scope="module")
def taught(illustrative, clone):
    """Return a twin that learned from a former deployment of 200 runs."""
    w = disturbances(illustrative, 200, 40, seed=5)
    log = deploy(illustrative.real.plant, LearnedPolicy(clone(illustrative), DESIGN), DESIGN, w, x0=start(200))
    config = QuantileConfig(hidden=(16,), steps=300, batch=256)
    return DigitalTwin(illustrative.model).update(
        log, weight=illustrative.weight, rng=np.random.default_rng(0), config=config
    )


def test_an_update_must_bring_a_gain_on_the_updated_model_too(illustrative, clone, taught, monkeypatch):
    """There errors follow what a candidate does; what was logged stays as the former policy met it."""
    good, weak = clone(illustrative), weakened(clone(illustrative))
    training_gives(monkeypatch, good)
    config = replace(ONLINE, updates=1, judged=400)

    def done(twin, runs=80, steps=40):
        """Return the update of a deployment."""
        (update,) = deploy_and_update(
            illustrative.problem(), illustrative.real.plant, weak, DESIGN, x0=start(runs), twin=twin,
            disturbance=disturbances(illustrative, runs, steps), rng=np.random.default_rng(0), config=config,
        ).updates  # fmt: skip
        return update

    alone = done(None)
    assert alone.accepted
    assert alone.updated_gain is None
    update = done(taught)
    assert update.accepted
    assert update.gain == alone.gain
    assert update.updated_gain.mean > 0
    plant = TwinPlant(illustrative.model, replace(taught.discrepancy, noise="replayed"))
    x0, w = Replay(taught.innovations()).whole()
    runs = [
        simulate(plant, LearnedPolicy(agent, DESIGN), x0=x0, steps=40, disturbance=w, design=DESIGN)
        for agent in (good, weak)
    ]
    after, before = (run.returns(illustrative.objective) for run in runs)
    assert update.updated_gain.mean == pytest.approx((after - before).mean())
    assert done(taught, steps=30).updated_gain is None  # of another length
    assert done(DigitalTwin(illustrative.model)).updated_gain is None  # has learned nothing
    assert done(taught, runs=1, steps=600).updated_gain is None
    for denied in (PairedDifference(1e-3, (-1e-3, 3e-3)), PairedDifference(np.nan, (np.nan, np.nan))):
        monkeypatch.setattr(UpdateJudge, "updated_gain", lambda self, *_, denied=denied: denied)
        assert not done(taught).accepted
    with pytest.raises(InputError, match="twin: got"):
        done(taught.logs)
