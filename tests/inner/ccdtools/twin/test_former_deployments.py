"""Updates are judged on what former deployments have taught, too."""

from dataclasses import replace

import numpy as np
import pytest
from deployments import DESIGN, ONLINE, disturbances, start, training_gives, weakened

from ccdtools import InputError, LearnedPolicy, deploy, simulate
from ccdtools.evidence.evidence import Asked
from ccdtools.twin.deployable import Deployable
from ccdtools.twin.deployment import deploy_and_update
from ccdtools.twin.distributions import REPLAY, ServedDistributions, logged
from ccdtools.twin.judge import Judge
from ccdtools.twin.residuals import residuals
from ccdtools.twin.transport import ErrorSplit
from ccdtools.twin.updated_plant import UpdatedPlant
from learning.quantile import QuantileConfig


@pytest.fixture(scope="module")
def former(illustrative, clone):
    """Return the errors of a former deployment of 60 runs."""
    w = disturbances(illustrative, 60, 40, seed=5)
    log = deploy(illustrative.real.plant, LearnedPolicy(clone(illustrative), DESIGN), DESIGN, w, x0=start(60))
    return residuals(illustrative.model, log)


@pytest.fixture(scope="module")
def split(illustrative):
    """Return the split of errors of the nominal model."""
    return ErrorSplit(illustrative.model, illustrative.problem().state_scale)


@pytest.fixture(scope="module")
def judge(illustrative):
    """Return what compares policies."""
    return Judge(illustrative.problem(), illustrative.plant, lambda _: None, 40)


def test_updates_are_judged_on_former_deployments_too(illustrative, clone, monkeypatch):
    """No candidate was trained on them, and they are more than the held-out runs.

    Those of a disturbance that it was trained on are left out: first those of the runs 0 and 2, then also that of 6.
    """
    weak = weakened(clone(illustrative))
    trained = training_gives(monkeypatch, weakened(clone(illustrative), 0.3))
    judged = []
    compared = Judge._compared

    def spy(self, candidate, current, on):
        if on.name == REPLAY:
            judged.append(len(on.scenario.x0))
        return compared(self, candidate, current, on)

    monkeypatch.setattr(Judge, "_compared", spy)
    w = disturbances(illustrative, 30, 40, seed=5)
    log = deploy(illustrative.real.plant, LearnedPolicy(weak, DESIGN), DESIGN, w, x0=start(30))
    long, short, single = (residuals(illustrative.model, log).part(*cut) for cut in (
        (slice(None), slice(None)), (slice(None), slice(0, 30)), (slice(0, 1), slice(None))
    ))  # fmt: skip

    def done(runs, steps, former):
        """Return the gains of a deployment."""
        updates = deploy_and_update(
            illustrative.problem(), illustrative.real.plant, weak, DESIGN, x0=start(runs), former=former,
            disturbance=disturbances(illustrative, runs, steps), rng=np.random.default_rng(0),
            config=replace(ONLINE, judged=100),
        ).updates  # fmt: skip
        return [update.gain for update in updates]

    done(15, 40, [long, short, single])
    assert judged == [28 + 2, 27 + 4]
    assert all(log.runs < 5 for problem, _ in trained for log in problem.scenarios.logs)
    np.testing.assert_equal([g.mean for g in done(1, 600, [long])], [g.mean for g in done(1, 600, [])])
    with pytest.raises(InputError, match=r"former\[0\]: got"):
        done(15, 40, [3])


def test_runs_that_met_the_same_disturbance_in_several_deployments_are_one_piece_of_evidence(
    illustrative, clone, former, split, judge
):
    """Five deployments that met nothing new say what one says: the same gain with the same interval."""
    good, weak = (Deployable(agent, DESIGN) for agent in (clone(illustrative), weakened(clone(illustrative))))

    def gain(logs):
        """Return the gain on whole runs."""
        on = logged(split, logs, series=False, most=400, rng=np.random.default_rng(0))
        return judge.evidence(good, weak, on).gain

    common = former.part(former.numbers % 2 == 0, slice(None))
    one, five = (gain([common] * times) for times in (1, 5))
    assert five.mean == pytest.approx(one.mean)
    np.testing.assert_allclose(five.ci95, one.ci95)
    others = former.part(former.numbers % 2 == 1, slice(None))
    assert np.diff(gain([others] * 5).ci95) < 0.6 * np.diff(one.ci95)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda log: replace(log, x=log.x[..., :1]), r"former\[1\]: got 1 states with 2 errors"),
        (lambda log: replace(log, e_next=log.e_next[..., :1]), r"former\[1\]: got 2 states with 1 errors"),
        (lambda log: replace(log, u=np.repeat(log.u, 2, axis=2)), r"former\[1\]: got 2 states .* 2 inputs"),
        (lambda log: replace(log, p=[2.0, 2.0]), r"former\[1\].p: got"),
        (lambda log: replace(log, p=[9.0]), r"former\[1\].p: got p = 9"),
        (lambda log: replace(log, x=np.nan * log.x), r"x: got (nan|-?inf) at index"),
    ],
)  # fmt: skip
def test_former_errors_of_another_plant_are_refused(illustrative, clone, former, change, message):
    with pytest.raises(InputError, match=message):
        deploy_and_update(
            illustrative.problem(), illustrative.real.plant, clone(illustrative), DESIGN, x0=start(12),
            former=[former, change(former)], disturbance=disturbances(illustrative, 12, 40),
            rng=np.random.default_rng(0), config=ONLINE,
        )  # fmt: skip


# ── the updated model ──


def quick():
    """Return a small network."""
    return QuantileConfig(hidden=(16,), steps=300, batch=256)


def test_on_the_updated_model_runs_of_what_was_deployed_are_those_of_the_log(illustrative, clone, former, split, judge):
    """Under the policy of the log what follows the state and what is replayed add up to the errors as they were."""
    plant = UpdatedPlant.from_logs(split, [former], rng=np.random.default_rng(0), config=quick())
    again = logged(plant, [former], series=False, most=400, rng=np.random.default_rng(0))
    assert again.asked is Asked.GAIN
    run = judge.run(Deployable(clone(illustrative), DESIGN), again)
    np.testing.assert_allclose(run.states[:, :-1], former.x, atol=1e-4)


@pytest.mark.long
def test_where_the_input_is_weaker_in_truth_the_updated_model_says_what_a_candidate_brings(illustrative, clone):
    """The real plant has 60 % of the input; a policy of a higher gain is better there, and worse on the model."""
    plant = illustrative.plant
    weaker = replace(plant, dynamics=plant.dynamics - 0.4 * (plant.dynamics - _without_input(plant)))
    study = illustrative.started(x0=[-2.0, -2.0])
    usual, higher = (Deployable(weakened(clone(illustrative), gain), DESIGN) for gain in (1.0, 1.5))
    w = disturbances(study, 100, 40)
    log = deploy(weaker, usual.controller(), DESIGN, w, x0=start(100))
    split = ErrorSplit(study.model, study.problem().state_scale)
    logs = [residuals(study.model, log)]
    updated = UpdatedPlant.from_logs(split, logs, rng=np.random.default_rng(0), config=QuantileConfig(steps=600))
    judge = Judge(study.problem(), plant, lambda _: None, 40)
    found = judge.evidence(higher, usual, logged(updated, logs, series=False, most=100,
                                                 rng=np.random.default_rng(0)))  # fmt: skip
    runs = [simulate(weaker, one.controller(), x0=start(100), steps=40, disturbance=w, design=DESIGN)
            for one in (higher, usual)]  # fmt: skip
    truth = (runs[0].returns(study.objective) - runs[1].returns(study.objective)).mean()
    assert found.gain.mean == pytest.approx(truth, abs=0.5 * abs(truth))


def _without_input(plant):
    """The dynamics with the input at zero."""
    import casadi as ca

    return ca.substitute(plant.dynamics, plant.u, ca.DM.zeros(plant.nu))


@pytest.mark.check
def test_of_a_single_drive_only_what_does_not_enter_through_E_follows_the_state(suspension, clone):
    """A slow road looks like a consequence of the state; learned as one it would be met twice."""
    agent = clone(suspension)
    w = suspension.real.disturbance.sample(1, 1500, np.random.default_rng(0))
    log = deploy(suspension.plant, LearnedPolicy(agent, suspension.p0), suspension.p0, w, x0=np.zeros(4))
    split = ErrorSplit(suspension.model, suspension.problem().state_scale)
    logs = [residuals(suspension.model, log)]
    plant = UpdatedPlant.from_logs(split, logs, rng=np.random.default_rng(0), config=quick())
    learned = plant.learned(logs[0].x, logs[0].u)
    assert np.abs(learned).max() < 1e-3 * np.abs(logs[0].e_next).max()
    np.testing.assert_allclose(plant.drawn(logs, w)[..., :1], w + w.mean(), atol=1e-3 * np.abs(w).max())


def test_the_box_of_starts_is_what_lqr_keeps_within_X_or_what_the_study_declares(illustrative):
    problem = illustrative.problem()
    rng = np.random.default_rng(0)
    box = ServedDistributions(problem, np.zeros(2), runs=200).box(DESIGN, rng)
    assert illustrative.X.contains(box).all()
    assert 20 < len(box) <= 200
    declared = replace(illustrative, starts=np.array([[1.0, 0.0], [0.0, 1.0]])).problem()
    states = ServedDistributions(declared, np.zeros(2), runs=50).box(DESIGN, rng)
    assert set(map(tuple, states)) == {(1.0, 0.0), (0.0, 1.0)}
