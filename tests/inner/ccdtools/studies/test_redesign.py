"""A redesign replaces what is in service only for a gain beyond chance that is worth it."""

from dataclasses import replace

import numpy as np
import pytest

from ccdtools import InputError, LearnedPolicy, Scenario, deploy
from ccdtools.statistics import PairedDifference
from ccdtools.studies import StudyConfig, configuration
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.redesign import WORTH_A_POLICY, InService, RedesignStatus, judge_redesign, promised
from ccdtools.studies.stage_storage import Stage
from ccdtools.studies.stages import LoopStages
from ccdtools.studies.trust_region import Trust
from ccdtools.twin.recombined_returns import independence, recombined_gain
from ccdtools.twin.residuals import residuals

STEPS = 100


@pytest.fixture(scope="module")
def evaluation(illustrative):
    """The illustrative study with few runs."""
    return Evaluation(illustrative, replace(configuration(illustrative), model_runs=300), 0)


@pytest.fixture(scope="module")
def agent(clone, illustrative):
    """A policy that imitates LQR."""
    return clone(illustrative)


def log(evaluation, agent, *, disturbance, x0):
    """The errors of the nominal model along a deployment on the nominal plant."""
    study = evaluation.study
    policy = LearnedPolicy(agent, [2.0])
    run = deploy(study.plant, policy, [2.0], disturbance, x0=x0, limit=evaluation.problem.limit)
    return [residuals(study.model, run)]


@pytest.fixture(scope="module")
def noisy(evaluation, agent):
    """A log with the disturbance that the model assumes, from the start of the study."""
    w = evaluation.study.disturbance.sample(60, STEPS, np.random.default_rng(0))
    return log(evaluation, agent, disturbance=w, x0=np.tile(evaluation.study.x0, (60, 1)))


@pytest.fixture(scope="module")
def silent(evaluation, agent):
    """A log without any disturbance, near the origin: it says nothing about the design."""
    x0 = 1e-3 * np.random.default_rng(0).standard_normal((60, 2))
    return log(evaluation, agent, disturbance=np.zeros((60, STEPS, 2)), x0=x0)


def at(agent, p):
    """The policy at a design."""
    return InService(agent, np.array([p]))


def test_a_better_design_is_taken(evaluation, agent, noisy):
    decision = judge_redesign(evaluation, at(agent, 2.2), at(agent, 1.2), noisy)
    assert decision.accepted
    assert decision.moved
    assert decision.gain.mean > decision.needed > 0
    assert decision.nominal_after > decision.nominal_before


def test_a_worse_design_is_not_taken(evaluation, agent, noisy):
    decision = judge_redesign(evaluation, at(agent, 1.2), at(agent, 2.2), noisy)
    assert not decision.accepted
    assert decision.status is RedesignStatus.NO_GAIN
    assert "not taken, no gain beyond chance" in decision.describe("redesign")


def test_the_same_policy_and_design_change_nothing(evaluation, agent, noisy):
    decision = judge_redesign(evaluation, at(agent, 2.0), at(agent, 2.0), noisy)
    assert decision.gain.mean == 0
    assert not decision.accepted
    assert not decision.moved


def test_a_log_that_says_nothing_moves_no_design(evaluation, agent, silent):
    """Some design must look better in such a log, and beyond chance: one of a pair, either way round."""
    forth = judge_redesign(evaluation, at(agent, 1.5), at(agent, 2.2), silent)
    back = judge_redesign(evaluation, at(agent, 2.2), at(agent, 1.5), silent)
    assert max(forth.gain.ci95[0], back.gain.ci95[0]) > 0
    assert not forth.accepted
    assert not back.accepted


def test_a_design_costs_half_a_per_cent_and_a_policy_a_tenth_by_default(evaluation, agent, noisy):
    moved = judge_redesign(evaluation, at(agent, 2.1), at(agent, 2.0), noisy)
    stays = judge_redesign(evaluation, at(agent, 2.0), at(agent, 2.0), noisy)
    assert moved.needed / stays.needed == pytest.approx(0.005 / WORTH_A_POLICY)
    assert stays.needed >= WORTH_A_POLICY * abs(stays.nominal_before)


def test_a_gain_beyond_chance_below_its_price_is_not_taken_and_says_so(evaluation, agent, noisy):
    free = judge_redesign(evaluation, at(agent, 2.2), at(agent, 1.2), noisy)
    study = replace(evaluation.study, redesign_price=f"{1.01 * free.gain.mean} return")
    dear = judge_redesign(replace(evaluation, study=study), at(agent, 2.2), at(agent, 1.2), noisy)
    assert dear.status is RedesignStatus.BELOW_PRICE
    assert "less than its price of" in dear.describe("redesign")
    cheap = replace(study, redesign_price=f"{0.99 * free.gain.mean} return")
    assert judge_redesign(replace(evaluation, study=cheap), at(agent, 2.2), at(agent, 1.2), noisy).accepted


def test_a_gain_that_the_updated_model_denies_is_not_taken(evaluation, agent, noisy, monkeypatch):
    denied = PairedDifference(-1.0, (-2.0, -0.1))
    monkeypatch.setattr("ccdtools.studies.redesign._updated_gain", lambda *_: denied)
    decision = judge_redesign(evaluation, at(agent, 2.2), at(agent, 1.2), noisy)
    assert decision.status is RedesignStatus.CONTRADICTED
    assert "the updated model says the contrary, −" in decision.describe("redesign")
    assert decision.status.advice


def test_the_same_disturbances_logged_twice_are_no_more_evidence(evaluation, agent, noisy):
    """Half of the runs of a deployment meet the disturbances of every other deployment; here all of them do."""
    once, groups = evaluation.on_logs(noisy)
    study = replace(evaluation.study, real=replace(evaluation.study.real, runs=60))
    twice, both = replace(evaluation, study=study).on_logs([*noisy, *noisy])
    assert len(np.unique(groups)) == len(once.x0) == 60
    assert len(twice.x0) == 120
    assert len(np.unique(both)) == 90


def test_the_promise_is_the_deployment_itself_where_the_plant_is_the_model(evaluation, agent, noisy):
    study = evaluation.study
    w = study.disturbance.sample(60, STEPS, np.random.default_rng(0))
    run = deploy(study.plant, LearnedPolicy(agent, [2.0]), [2.0], w, x0=np.tile(study.x0, (60, 1)))
    assert promised(evaluation, at(agent, 2.0), noisy).mean == pytest.approx(run.returns(study.objective).mean())
    before_any_log = promised(evaluation, at(agent, 2.0), ())
    assert before_any_log.ci95[0] < before_any_log.mean < 0


# ── recombined runs ──


def told(evaluation, agent, logs):
    """The logs with what is told of them where the policy is in service at the design of the logs."""
    policy = LearnedPolicy(agent, [2.0])
    drive = lambda x0, w: (Scenario(evaluation.split.replayed_model, x0, w).run(policy, design=[2.0]),)  # noqa: E731
    found = independence(evaluation.replay(logs), drive, evaluation.study.objective, np.random.default_rng(0))
    return [replace(one, independent=found.independent) for one in logs]


def test_independent_errors_are_recombined_and_say_the_same(evaluation, agent, noisy):
    (recombined,) = told(evaluation, agent, noisy)
    assert recombined.independent
    for one, other in ((2.2, 1.2), (1.9, 2.0)):
        whole, made = (judge_redesign(evaluation, at(agent, one), at(agent, other), [log]) for log in
                       (noisy[0], recombined))  # fmt: skip
        again = judge_redesign(evaluation, at(agent, one), at(agent, other), [recombined])
        assert again == made
        assert made.gain.ci95[0] < whole.gain.mean < made.gain.ci95[1]
        assert whole.gain.ci95[0] < made.gain.mean < whole.gain.ci95[1]
        assert made.gain.mean != whole.gain.mean
        assert np.diff(made.gain.ci95) < 1.5 * np.diff(whole.gain.ci95)  # of few blocks, where nothing is gained
    assert judge_redesign(evaluation, at(agent, 2.2), at(agent, 1.2), [recombined]).accepted


def test_the_number_of_recombined_runs_is_that_of_the_configuration(evaluation, agent, noisy, monkeypatch):
    counts = []

    def spy(replay, drive, objective, count, rng, *risk):
        counts.append(count)
        return recombined_gain(replay, drive, objective, count, rng, *risk)

    monkeypatch.setattr("ccdtools.studies.redesign.recombined_gain", spy)
    log = replace(noisy[0], independent=True)
    few = replace(evaluation, config=replace(evaluation.config, model_runs=119))
    for one in (evaluation, few):
        judge_redesign(one, at(agent, 2.2), at(agent, 2.0), [log])
    assert counts == [300, 119]


@pytest.mark.parametrize("independent", [True, False])
def test_a_redesign_has_no_gain_where_the_service_loses_every_run(evaluation, agent, noisy, monkeypatch, independent):
    """There is no return to compare with, and it is not the redesign that loses runs."""

    def lost(self, controller, **options):
        """Return runs of a plant that all are lost."""
        run = driven(self, controller, **options)
        return replace(run, diverged_at=np.full(len(run.states), 5))

    driven = Scenario.run
    monkeypatch.setattr(Scenario, "run", lost)
    decision = judge_redesign(evaluation, at(agent, 2.2), at(agent, 2.0), [replace(noisy[0], independent=independent)])
    assert decision.status is RedesignStatus.NO_GAIN
    assert decision.size == 0


def test_what_was_not_told_of_every_log_is_judged_on_whole_runs(evaluation, agent, noisy):
    mixed = [replace(noisy[0], independent=True), noisy[0]]
    whole = [noisy[0], noisy[0]]
    one, other = (judge_redesign(evaluation, at(agent, 2.2), at(agent, 2.0), logs) for logs in (mixed, whole))
    assert one == other


@pytest.mark.parametrize(("everywhere", "online"), [(True, True), (True, False), (False, True), (False, False)])
def test_updates_are_recombined_where_both_options_say_so(evaluation, agent, monkeypatch, everywhere, online):
    class Begun(Exception):
        """Ends a stage that has begun a deployment."""

    def begin(*_, config, **options):
        assert config.recombine is (everywhere and online)
        raise Begun

    monkeypatch.setattr("ccdtools.studies.stages.deploy_and_update", begin)
    config = evaluation.config
    config = replace(config, recombine=everywhere, online=replace(config.online, recombine=online))
    stages = LoopStages(replace(evaluation, config=config), progress=False)
    found = Stage({}, {"design": np.array([2.0])}, {"agent": agent})
    with pytest.raises(Begun):
        stages.deploy(np.random.default_rng(0), 1, found, None, Trust())


def test_an_option_that_is_neither_on_nor_off_is_refused():
    with pytest.raises(InputError, match="recombine: got 'no', expected True or False"):
        StudyConfig(recombine="no")
