"""Deployment: logs without gaps, replays that are exact, updates only where they help."""

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ccdtools import InputError, LearnedPolicy, deploy, simulate
from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.controllers.controllers import Passive
from ccdtools.statistics import PairedDifference, paired_returns
from ccdtools.twin.deployment import deploy_and_update
from ccdtools.twin.discrepancy import TwinPlant
from ccdtools.twin.online import OnlineConfig
from ccdtools.twin.recombined_returns import NOT_ASKED, LoggedGain, recombined_gain
from ccdtools.twin.replay import Replay, replay_problem
from ccdtools.twin.residuals import residuals
from ccdtools.twin.twin import DigitalTwin
from ccdtools.twin.update_judge import UpdateJudge
from learning.ppo import PPOConfig
from learning.quantile import QuantileConfig

DESIGN = np.array([2.0])
TINY = CoDesignConfig(
    iterations=1, runs=4, pathwise_runs=8, design_rate=0.0, evaluation_runs=10, ppo=PPOConfig(passes=1, critic_only=1)
)
ONLINE = OnlineConfig(updates=2, window=20, judged=30, training=TINY)


def start(n=1):
    return np.tile([-2.0, -2.0], (n, 1))


def disturbances(study, runs, steps, seed=0):
    return study.real.disturbance.sample(runs, steps, np.random.default_rng(seed))


def deployed(study, agent, *, runs, steps, seed=0, config=ONLINE, x0=None):
    return deploy_and_update(
        study.problem(), study.real.plant, agent, DESIGN, x0=start(runs) if x0 is None else x0,
        disturbance=disturbances(study, runs, steps), rng=np.random.default_rng(seed), config=config,
    )  # fmt: skip


@pytest.fixture(scope="module")
def log(illustrative, clone):
    """Return a log of the clone on the real plant: four runs."""
    policy = LearnedPolicy(clone(illustrative), DESIGN)
    return deploy(illustrative.real.plant, policy, DESIGN, disturbances(illustrative, 4, 50), x0=start(4))


# ── deploy ──


def test_a_deployment_is_a_simulation_as_long_as_its_disturbance(illustrative):
    w = disturbances(illustrative, 1, 30)
    log = deploy(illustrative.real.plant, Passive(), DESIGN, w[0], x0=[0.0, 0.0])
    run = simulate(illustrative.real.plant, Passive(), x0=[0, 0], steps=30, disturbance=w, design=DESIGN)
    np.testing.assert_array_equal(log.states, run.states)


def test_a_single_channel_may_be_a_plain_sequence(suspension):
    log = deploy(suspension.real.plant, Passive(), suspension.p0, np.ones(7), x0=np.zeros(4))
    assert log.inputs.shape == (1, 7, 1)


# ── replays ──


def test_windows_reproduce_the_logged_trajectory_exactly_under_the_logged_inputs(illustrative, log):
    errors_of_the_log = residuals(illustrative.model, log)
    problem = replay_problem(illustrative.problem(), [errors_of_the_log], 15)
    x0, w = problem.scenarios.sample(40, 15, np.random.default_rng(0))
    for start_state, errors in zip(x0, w):
        same_start = (log.states[:, :-1] == start_state).all(axis=-1)
        same_error = np.isclose(errors_of_the_log.e_next, errors[0, :2] + errors[0, 2:]).all(axis=-1)
        ((run, k),) = np.argwhere(same_start & same_error)
        inputs = iter(log.inputs[run, k : k + 15])
        again = simulate(
            problem.model, lambda x, inputs=inputs: next(inputs)[None], x0=start_state, steps=15, disturbance=errors,
            design=DESIGN,
        )  # fmt: skip
        np.testing.assert_allclose(again.states[0], log.states[run, k : k + 16], atol=1e-12)


def test_every_window_of_every_stretch_can_be_drawn(illustrative, log):
    r = residuals(illustrative.model, log)
    one, three, short = (slice(0, 1), slice(0, 12)), (slice(1, 4), slice(20, 33)), (slice(0, 1), slice(0, 5))
    stretches = tuple(r.part(*stretch) for stretch in (one, three, short))
    x0, w = Replay(stretches).sample(3000, 10, np.random.default_rng(0))
    assert w.shape == (3000, 10, 2)
    expected = np.vstack([r.x[0, :3], *(r.x[i, 20:24] for i in (1, 2, 3))])
    drawn, counts = np.unique(x0, axis=0, return_counts=True)
    np.testing.assert_array_equal(drawn, np.unique(expected, axis=0))
    assert counts.min() > 3000 / 15 * 0.6


def test_whole_runs_begin_where_the_log_began_and_meet_all_of_its_errors(illustrative, log):
    r = residuals(illustrative.model, log)
    one, three = r.part(slice(0, 1), slice(None)), r.part(slice(1, 4), slice(None))
    x0, w = Replay((three, one)).whole()
    np.testing.assert_array_equal(x0, log.states[[1, 2, 3, 0], 0])
    np.testing.assert_array_equal(w, r.e_next[[1, 2, 3, 0]])
    with pytest.raises(InputError, match="logs: got runs of 20 to 50 steps, expected logs of one length"):
        Replay((r, r.part(slice(0, 1), slice(0, 20)))).whole()


def test_runs_keep_their_numbers_where_others_were_lost(illustrative, log):
    lost = replace(log, diverged_at=np.array([-1, 3, -1, -1]))
    np.testing.assert_array_equal(residuals(illustrative.model, lost).numbers, [0, 2, 3])
    np.testing.assert_array_equal(residuals(illustrative.model, lost).part(slice(1, 3), slice(None)).numbers, [2, 3])
    with pytest.raises(InputError, match="numbers: got shape"):
        replace(residuals(illustrative.model, log), numbers=np.arange(3))


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


def test_a_replay_longer_than_the_log_is_refused(illustrative, log):
    with pytest.raises(InputError, match="steps: got 51, expected at most 50"):
        Replay((residuals(illustrative.model, log),)).sample(3, 51, np.random.default_rng(0))


def test_the_replay_problem_lets_errors_enter_through_E_and_their_rest_as_it_is(illustrative, log):
    problem = replay_problem(illustrative.problem(), [residuals(illustrative.model, log)], 15)
    A, B, E = problem.model.matrices(DESIGN)
    np.testing.assert_array_equal(E, np.hstack([illustrative.model.matrices(DESIGN)[2], np.eye(2)]))
    np.testing.assert_array_equal(A, illustrative.model.matrices(DESIGN)[0])
    np.testing.assert_array_equal(B, illustrative.model.matrices(DESIGN)[1])
    assert problem.steps == 15
    assert problem.discrepancy is None


# ── updates on the way ──


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


def test_an_update_follows_every_stretch_but_the_last(illustrative, clone):
    done = deployed(illustrative, clone(illustrative), runs=1, steps=300)
    assert [update.after for update in done.updates] == [100, 200]
    done = deployed(illustrative, clone(illustrative), runs=6, steps=40)
    assert [update.after for update in done.updates] == [80, 160]


def test_an_update_is_accepted_exactly_when_its_interval_lies_above_zero(illustrative, clone):
    for seed in range(3):
        done = deployed(illustrative, clone(illustrative), runs=6, steps=40, seed=seed)
        assert [u.accepted for u in done.updates] == [u.gain.ci95[0] > 0 for u in done.updates]


def weakened(agent, factor=0.5):
    """The same agent with half its gain, or so many times it."""
    weak = copy.deepcopy(agent)
    with torch.no_grad():
        for parameter in (weak.mean_network.head.weight, weak.mean_network.head.bias, weak.mean_network.skip.weight):
            parameter.mul_(factor)
    return weak


def training_gives(monkeypatch, candidate):
    """Let every training end with one candidate."""
    trained = []

    def codesign(problem, *, agent, design, rng, config):
        trained.append((problem, agent))
        return SimpleNamespace(agent=candidate)

    monkeypatch.setattr("ccdtools.twin.deployment.codesign", codesign)
    return trained


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


def test_the_agent_passed_in_is_not_changed(illustrative, clone):
    agent = clone(illustrative)
    before = copy.deepcopy(agent.state_dict())
    deployed(illustrative, agent, runs=6, steps=40)
    torch.testing.assert_close(agent.state_dict(), before, rtol=0, atol=0)


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


def test_a_candidate_is_trained_at_the_design_in_service_whatever_the_rate_of_the_design(illustrative, clone):
    moving = replace(ONLINE, training=replace(TINY, design_rate=0.5))
    frozen, asked = (
        deployed(illustrative, clone(illustrative), runs=1, steps=400, config=config) for config in (ONLINE, moving)
    )
    assert len(asked.updates) == 2
    assert [one.gain.mean for one in asked.updates] == [one.gain.mean for one in frozen.updates]


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
        ({"recombine": 1}, "recombine: got 1, expected True or False"),
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


# ── updates on recombined runs ──


def told_independent(monkeypatch, answer=True):
    """Let every log be found so, and keep the runs that were looked at, and what was judged."""
    looked, judged = [], []

    def told(replay, *_):
        looked.append(np.concatenate([log.numbers for log in replay.logs]))
        return replace(NOT_ASKED, independent=answer, possible=answer)

    def spy(replay, drive, objective, count, rng, *risk):
        judged.append(np.concatenate([log.numbers for log in replay.logs]))
        return recombined_gain(replay, drive, objective, count, rng, *risk)

    monkeypatch.setattr("ccdtools.twin.update_judge.independence", told)
    monkeypatch.setattr("ccdtools.twin.update_judge.recombined_gain", spy)
    return looked, judged


def test_updates_are_told_by_all_runs_so_far_and_judged_on_recombined_held_out_ones(illustrative, clone, monkeypatch):
    good, weak = clone(illustrative), weakened(clone(illustrative))
    trained = training_gives(monkeypatch, good)
    looked, judged = told_independent(monkeypatch)
    config = replace(ONLINE, judged=100)
    done = deployed(illustrative, weak, runs=120, steps=40, config=config)
    np.testing.assert_array_equal(looked[0], np.arange(40))
    np.testing.assert_array_equal(looked[1], np.arange(80))
    so_far = [np.arange(28, 40), np.arange(40), [*range(28, 40), *range(68, 80)], np.arange(80)]
    for runs, expected in zip(judged, so_far):
        np.testing.assert_array_equal(runs, expected)
    assert all(log.independent for problem, _ in trained for log in problem.scenarios.logs)
    assert done.updates[0].accepted
    again = deployed(illustrative, weak, runs=120, steps=40, config=config)
    assert [update.gain for update in again.updates] == [update.gain for update in done.updates]


def test_updates_are_judged_on_runs_as_logged_where_recombination_is_off_or_refused(illustrative, clone, monkeypatch):
    trained = training_gives(monkeypatch, clone(illustrative))
    looked, judged = told_independent(monkeypatch, answer=False)
    refused = deployed(illustrative, weakened(clone(illustrative)), runs=60, steps=40)
    assert len(looked) == 2
    plain = replace(ONLINE, recombine=False)
    off = deployed(illustrative, weakened(clone(illustrative)), runs=60, steps=40, config=plain)
    assert len(looked) == 2
    assert not judged
    assert not any(log.independent for problem, _ in trained for log in problem.scenarios.logs)
    assert [update.gain for update in off.updates] == [update.gain for update in refused.updates]


def test_an_update_that_all_runs_so_far_deny_is_not_taken(illustrative, clone, monkeypatch):
    """A dozen runs are few, and held-out ones that are fewer than the trained ones know less of rare events."""
    training_gives(monkeypatch, clone(illustrative))
    says = {12: PairedDifference(2.0, (1.0, 3.0)), 40: PairedDifference(-0.5, (-1.0, 0.5))}
    monkeypatch.setattr(
        "ccdtools.twin.update_judge.recombined_gain",
        lambda replay, *_: LoggedGain(says[sum(log.runs for log in replay.logs)], 10.0, False),
    )
    for possible, low in ((True, -1.0), (False, 1.0)):
        told = replace(NOT_ASKED, independent=True, possible=possible)
        monkeypatch.setattr("ccdtools.twin.update_judge.independence", lambda *_, told=told: told)
        config = replace(ONLINE, updates=1, judged=100)
        (update,) = deployed(illustrative, clone(illustrative), runs=80, steps=40, config=config).updates
        assert update.gain.ci95 == (low, 3.0)
        assert update.accepted is not possible


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


@pytest.fixture(scope="module")
def former(illustrative, clone):
    """Return the errors of a former deployment of 60 runs."""
    w = disturbances(illustrative, 60, 40, seed=5)
    log = deploy(illustrative.real.plant, LearnedPolicy(clone(illustrative), DESIGN), DESIGN, w, x0=start(60))
    return residuals(illustrative.model, log)


def judge(study, **options):
    """Return what compares policies on logged errors of 60 runs."""
    rng = np.random.default_rng(0)
    return UpdateJudge(study.problem(), DESIGN, replace(ONLINE, **options), 60, rng.spawn(1)[0], rng, None)


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
