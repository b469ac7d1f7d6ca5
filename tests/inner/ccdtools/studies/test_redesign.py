"""A redesign replaces what is deployed only for a gain beyond chance that is worth it, and loses nowhere."""

from dataclasses import replace

import numpy as np
import pytest

from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.evidence.verdict import Status
from ccdtools.scenario import Scenario
from ccdtools.studies import RedesignCost, configuration
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.redesign import RedesignJudge, described, predicted
from ccdtools.twin.deployable import Deployable
from ccdtools.twin.deployment import deploy
from ccdtools.twin.distributions import BOX, NOMINAL, REPLAY, START, UPDATED, logged
from ccdtools.twin.residuals import residuals
from ccdtools.twin.twin import DigitalTwin
from learning.quantile import QuantileConfig

STEPS = 100


@pytest.fixture(scope="module")
def evaluation(illustrative):
    """The illustrative study with few runs and a small network."""
    config = replace(configuration(illustrative), model_runs=300, quantile=QuantileConfig(hidden=(8,), steps=300))
    return Evaluation(illustrative, config, 0)


@pytest.fixture(scope="module")
def agent(clone, illustrative):
    """A policy that imitates LQR."""
    return clone(illustrative)


def log(evaluation, agent, *, disturbance, x0):
    """The twin with the errors of the nominal model along a deployment on the nominal plant."""
    study = evaluation.study
    policy = LearnedPolicy(agent, [2.0])
    run = deploy(study.plant, policy, [2.0], disturbance, x0=x0, limit=evaluation.problem.limit)
    return DigitalTwin(study.model, logs=(residuals(study.model, run),), scale=evaluation.problem.state_scale)


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
    return Deployable(agent, np.array([p]))


def judged(evaluation, candidate, current, twin):
    """The decision as plain values, and the verdict."""
    judge = RedesignJudge(evaluation, current, twin)
    verdict = judge.verdict(candidate)
    return judge.as_dict(candidate, verdict), verdict


@pytest.mark.long
def test_a_better_design_is_taken_and_looked_at_on_all_that_it_will_serve(evaluation, agent, noisy):
    decision, verdict = judged(evaluation, at(agent, 2.2), at(agent, 1.2), noisy)
    assert decision["accepted"]
    assert decision["moved"]
    assert decision["gain"]["mean"] > decision["needed"] > 0
    assert decision["nominal_after"] > decision["nominal_before"]
    assert [one.distribution for one in verdict.evidence] == [REPLAY, UPDATED, START, BOX, NOMINAL]
    assert described("redesign", decision).startswith("redesign deployed: +")


def test_a_worse_design_is_refused_before_anything_else_is_looked_at(evaluation, agent, noisy):
    decision, verdict = judged(evaluation, at(agent, 1.2), at(agent, 2.2), noisy)
    assert not decision["accepted"]
    assert verdict.status is Status.WORSE
    assert [one.distribution for one in verdict.evidence] == [REPLAY, NOMINAL]
    assert "not deployed, worse: −" in described("redesign", decision)


def test_the_same_policy_and_design_change_nothing(evaluation, agent, noisy):
    decision, verdict = judged(evaluation, at(agent, 2.0), at(agent, 2.0), noisy)
    assert decision["gain"]["mean"] == 0
    assert verdict.status is Status.NO_GAIN
    assert not decision["moved"]


def test_a_log_that_says_nothing_moves_no_design(evaluation, agent, silent):
    """Some design must look better in such a log, and beyond chance: one of a pair, either way round."""
    (forth, _), (back, _) = (judged(evaluation, at(agent, one), at(agent, other), silent) for one, other in
                             ((1.5, 2.2), (2.2, 1.5)))  # fmt: skip
    assert max(forth["gain"]["ci95"][0], back["gain"]["ci95"][0]) > 0
    assert not forth["accepted"]
    assert not back["accepted"]


@pytest.mark.long
def test_a_design_costs_half_a_per_cent_and_a_policy_a_tenth_by_default(evaluation, agent, noisy):
    moved, _ = judged(evaluation, at(agent, 2.1), at(agent, 2.0), noisy)
    stays, _ = judged(evaluation, at(agent, 2.0), at(agent, 2.0), noisy)
    assert moved["needed"] / stays["needed"] == pytest.approx(0.005 / 0.001)
    assert stays["needed"] >= 0.001 * abs(stays["nominal_before"])
    assert (moved["price"], stays["price"]) == ("0.5 %", "0.1 %")


@pytest.mark.long
def test_a_gain_beyond_chance_below_its_price_is_not_taken_and_says_so(evaluation, agent, noisy):
    free, _ = judged(evaluation, at(agent, 2.2), at(agent, 1.2), noisy)
    study = replace(evaluation.study, redesign_price=f"{1.01 * free['gain']['mean']} return")
    dear, verdict = judged(replace(evaluation, study=study), at(agent, 2.2), at(agent, 1.2), noisy)
    assert verdict.status is Status.BELOW_PRICE
    assert "less than its price" in described("redesign", dear)
    cheap = replace(study, redesign_price=f"{0.99 * free['gain']['mean']} return")
    assert judged(replace(evaluation, study=cheap), at(agent, 2.2), at(agent, 1.2), noisy)[0]["accepted"]


@pytest.mark.long
def test_a_gain_on_the_log_that_costs_elsewhere_needs_the_users_word(evaluation, agent, noisy):
    """A log from near the origin asks for a small p, the study's start for a large one."""
    study = evaluation.study
    near = log(evaluation, agent, disturbance=study.disturbance.sample(60, STEPS, np.random.default_rng(0)),
               x0=np.zeros((60, 2)))  # fmt: skip
    decision, verdict = judged(evaluation, at(agent, 0.9), at(agent, 2.0), near)
    assert decision["gain"]["ci95"][0] > 0
    assert verdict.status in (Status.LOSS, Status.MORE_LOST)
    assert START in verdict.reason or BOX in verdict.reason


def test_the_same_disturbances_logged_twice_are_no_more_evidence(evaluation, agent, noisy):
    """Half of the runs of a deployment meet the disturbances of every other deployment; here all of them do."""
    once, twice = (
        logged(evaluation.split, noisy.logs * times, series=False, most=300, rng=np.random.default_rng(0))
        for times in (1, 2)
    )
    assert len(np.unique(once.groups)) == len(once.scenario.x0) == 60
    assert len(twice.scenario.x0) == 120
    assert len(np.unique(twice.groups)) == 90


def test_the_prediction_is_the_deployment_itself_where_the_plant_is_the_model(evaluation, agent, noisy):
    study = evaluation.study
    w = study.disturbance.sample(60, STEPS, np.random.default_rng(0))
    run = deploy(study.plant, LearnedPolicy(agent, [2.0]), [2.0], w, x0=np.tile(study.x0, (60, 1)))
    own = predicted(evaluation, at(agent, 2.0), noisy.logs)
    assert own.mean == pytest.approx(run.returns(study.objective).mean())
    first = predicted(evaluation, at(agent, 2.0), noisy.logs, 40)
    assert first.mean == pytest.approx(run.rewards(study.objective)[:, :40].sum(axis=1).mean())
    before_any_log = predicted(evaluation, at(agent, 2.0), ())
    assert before_any_log.ci95[0] < before_any_log.mean < 0


def test_a_redesign_has_no_gain_where_what_is_deployed_loses_every_run(evaluation, agent, noisy, monkeypatch):
    """There is no return to compare with, and it is not the redesign that loses runs."""

    def lost(self, controller, **options):
        """Return runs of a plant that all are lost."""
        run = driven(self, controller, **options)
        return replace(run, diverged_at=np.full(len(run.states), 5))

    driven = Scenario.run
    monkeypatch.setattr(Scenario, "run", lost)
    decision, verdict = judged(evaluation, at(agent, 2.2), at(agent, 2.0), noisy)
    assert verdict.status is Status.NO_GAIN
    assert decision["size"] == 0


@pytest.mark.long
def test_a_redesign_of_one_long_run_is_worth_as_much_by_two_logs_as_by_one(evaluation, agent):
    """Two equal logs gain twice what one does, in twice the time."""
    study = evaluation.study
    real = replace(study.real, runs=1, steps=600)
    terms = RedesignCost(cost=20.0, serves=500, unit="EUR", worth=1.0)
    single = Evaluation(replace(study, real=real, redesign_cost=terms), evaluation.config, 0)
    w = study.disturbance.sample(1, 600, np.random.default_rng(0))
    twin = log(single, agent, disturbance=w, x0=[study.x0])
    found = []
    for logs in (twin.logs, twin.logs * 2):
        judge = RedesignJudge(single, at(agent, 1.2), replace(twin, logs=logs))
        found.append((verdict := judge.verdict(at(agent, 2.2))).gain.mean)
        middle = np.mean(judge.worth(verdict, 0).redesign)
        assert middle == pytest.approx(500 * found[0] * study.steps / 600 - 20, rel=1e-9)
    assert found[1] == pytest.approx(2 * found[0], rel=1e-9)
