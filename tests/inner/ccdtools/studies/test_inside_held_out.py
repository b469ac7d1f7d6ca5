"""What test_held_out.py claims, seen from inside."""

from dataclasses import replace

import numpy as np
import pytest
from small_runs import SPRING, tiny

from ccdtools import InputError, Recorded
from ccdtools.studies import configuration
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.held_out import (
    GenerationRecord,
    formerly_deployed,
    gains_by_source,
    gains_in,
    places_of,
    steps_of,
)
from ccdtools.twin.deployable import Deployable
from learning import ActorCritic
from mpc import NotStabilisableError


@pytest.fixture(scope="module")
def study():
    """A mass on a spring whose real plant makes one long run."""
    scope: dict = {}
    exec(SPRING, scope)
    spring = scope["study"]
    return replace(spring, real=replace(spring.real, runs=1, steps=600))


@pytest.fixture(scope="module")
def evaluation(study):
    """Its evaluation, with few runs."""
    return Evaluation(study, tiny(configuration(study, quick=True)), 3)


@pytest.fixture(scope="module")
def agents(study):
    """Three different policies."""
    problem = study.problem()
    return [ActorCritic(*problem.observation_bounds, *problem.input_bounds, seed=seed) for seed in range(3)]


def with_real(study, **changes):
    """The real plant of a study, changed."""
    return replace(study.real, **changes)


def test_a_recording_too_short_to_hold_out_is_refused_before_anything_runs(study):
    real = with_real(study, held_out={"short": Recorded(np.zeros(10))})
    with pytest.raises(InputError, match="at most 10, the samples of the recording"):
        Evaluation(replace(study, real=real), configuration(study), 0).held_out  # noqa: B018


def test_held_out_runs_are_repeated_exactly_and_are_not_those_of_the_deployment(study, evaluation):
    again = Evaluation(study, evaluation.config, 3)
    w = evaluation.held_out["fresh draws"].disturbance
    np.testing.assert_array_equal(w, again.held_out["fresh draws"].disturbance)
    deployed = evaluation.on_real().disturbance[0]
    assert len(w) == evaluation.config.held_out_runs
    assert not any(np.allclose(run, deployed[: w.shape[1]]) for run in w)


@pytest.mark.check
def test_baselines_are_tuned_once_and_as_new_every_time(study, evaluation):
    one, other = (evaluation.baselines(study.p0) for _ in range(2))
    x = np.array([[0.3, -0.2]])
    assert all(one[name] is not other[name] for name in one)
    np.testing.assert_array_equal(one["LQR"](x), other["LQR"](x))


def test_gains_by_source_add_up_and_name_their_source():
    rewards = np.random.default_rng(0).standard_normal((4, 6, 50))
    gains = gains_by_source(["start", "design", "policy", "design"], rewards)
    returns = rewards.sum(axis=2).mean(axis=1)
    assert gains["start"] == pytest.approx(returns[0])
    assert gains["design"]["mean"] == pytest.approx(returns[1] - returns[0] + returns[3] - returns[2])
    assert gains["policy"]["mean"] == pytest.approx(returns[2] - returns[1])
    assert (gains["updates"]["mean"], gains["redesign"]["ci95"]) == (0.0, (0.0, 0.0))
    parts = (gains[name]["mean"] for name in ("design", "policy", "updates", "redesign"))
    assert sum(parts) == pytest.approx(gains["total"]["mean"])


def test_gains_of_unknown_sources_are_refused():
    rewards = np.zeros((2, 1, 50))
    with pytest.raises(InputError, match=r"sources: got .*, expected 'start', then any of design, policy"):
        gains_by_source(["start", "luck"], rewards)
    with pytest.raises(InputError, match="rewards: got 2, expected 3, one per source"):
        gains_by_source(["start", "design", "policy"], rewards)


def test_a_generation_that_was_taken_back_brings_nothing(study, evaluation, agents):
    start = Deployable(agents[0], np.array([2.0]))
    first = Deployable(agents[1], np.array([3.0]))
    tried = Deployable(agents[2], np.array([1.0]))
    history = [GenerationRecord(start, start), GenerationRecord(first, first), GenerationRecord(tried, first)]
    assert [source for source, *_ in steps_of(evaluation, history)] == ["start", "design", "policy"]
    gains = gains_in(evaluation, evaluation.on_real(), steps_of(evaluation, history))
    assert gains["redesign"] == gains["updates"] == {"mean": 0.0, "ci95": (0.0, 0.0)}


@pytest.mark.check
def test_a_deployed_redesign_and_its_updates_are_told_apart(study, evaluation, agents):
    first = Deployable(agents[0], np.array([2.0]))
    redesigned = Deployable(agents[1], np.array([3.0]))
    updated = Deployable(agents[2], np.array([3.0]))
    history = [GenerationRecord(first, first), GenerationRecord(first, first), GenerationRecord(redesigned, updated)]
    steps = steps_of(evaluation, history)
    scenario = evaluation.held_out["fresh draws"]
    gains = gains_in(evaluation, scenario, steps)
    objective = study.objective
    returns = [scenario.run(law, design=design).returns(objective).mean() for _, law, design in steps]
    assert gains["design"]["mean"] == 0.0  # the first generation left the design where it was
    assert gains["policy"]["mean"] == pytest.approx(returns[2] - returns[0])
    assert gains["redesign"]["mean"] == pytest.approx(returns[-2] - returns[2])
    assert gains["updates"]["mean"] == pytest.approx(returns[-1] - returns[-2])


def test_gains_are_measured_where_it_was_deployed_and_on_what_was_held_out(evaluation):
    places = places_of(evaluation)
    assert list(places) == ["deployed drive", "fresh draws", "the study's start"]
    np.testing.assert_array_equal(places["deployed drive"].disturbance, evaluation.on_real().disturbance)


def test_the_start_and_what_was_deployed_before_is_proposed_once_and_failures_are_not(illustrative, clone):
    agent = clone(illustrative)
    at = [Deployable(agent, np.array([p])) for p in (1.0, 1.5, 2.0, 2.5)]
    start, first, failed, third = at
    history = [GenerationRecord(start, start), GenerationRecord(first, first),
               GenerationRecord(failed, first, stayed=False), GenerationRecord(third, third)]  # fmt: skip
    assert formerly_deployed(history, third) == {"the start": start, "generation 1": first}
    assert formerly_deployed(history[:1], start) == {}
    returned = [*history, GenerationRecord(start, third, stayed=False)]  # the start has been tried, and has failed
    assert formerly_deployed(returned, third) == {"generation 1": first}


@pytest.mark.long
def test_a_baseline_that_no_log_can_give_says_so_and_stands_for_no_other(evaluation, monkeypatch):
    def unstable(*_):
        raise NotStabilisableError("nothing pushes it")

    monkeypatch.setattr("ccdtools.studies.evaluation.identified_lqr", unstable)
    found = evaluation.baselines(evaluation.study.p0, [object()])["LQR, identified"]
    assert "no input stabilises" in found.remark
    assert (found(np.ones((3, evaluation.study.plant.nx))) == 0).all()
