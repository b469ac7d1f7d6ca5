"""Updates decided by turns on the real plant, and drift of a plant from its twin."""

import tracemalloc
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    DigitalTwin,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    discretise,
    simulate,
)
from ccdtools.twin import (
    Trial,
    TrialConfig,
    detect_drift,
    drift_of_log,
    identified_plant,
    outside_data,
    switchback,
    switchback_on,
)

A = np.array([[0.98, 0.1], [-0.1, 0.9]])
SERVED, BETTER, UNSTABLE = (LinearFeedback(np.array([gain])) for gain in ([0.0, 0.0], [0.3, 0.9], [0.0, -9.0]))
X0 = np.zeros(2)


def plant(share):
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    after = ca.DM(A) @ x + share * p * ca.vertcat(0, 0.3) * u + w
    return Plant(x, u, w, p, after, DesignSpace(["p"], [0.5], [1.5]), dt=0.1, continuous=False)


@pytest.fixture(scope="module")
def problem():
    wide = np.array([1e3, 1e3])
    return CoDesignProblem(
        discretise(plant(1.0)), X=(-wide, wide), U=(-1e3, 1e3), objective=QuadraticObjective(np.eye(2), [[0.1]]),
        scenarios=FixedStart(X0, Gaussian([0.1, 0.1])), steps=100,
    )  # fmt: skip


def tried(problem, candidate, steps=3000, seed=0, served=SERVED, margin=0.005, **options):
    rng = np.random.default_rng(seed)
    w = Gaussian([0.1, 0.1]).sample(1, steps, rng)[0]
    return switchback_on(
        problem, plant(1.1), served, candidate, [1.0], x0=X0, disturbance=w, rng=rng,
        config=TrialConfig(block=40, washout=10, margin=margin), **options,
    )  # fmt: skip


# ── the decision ──


def gains(kind, n, rng):
    """Differences of pairs about zero."""
    if kind == "heavy tails":
        return rng.standard_t(1.5, size=n)
    if kind == "from one block to the next":
        noise = rng.standard_normal(n + 1)
        return (noise[1:] + 0.5 * noise[:-1]) * rng.choice([-1, 1], n)
    return rng.standard_normal(n)


@pytest.mark.parametrize("kind", ["normal", "heavy tails", "from one block to the next"])
def test_a_candidate_that_is_not_better_is_rarely_adopted_however_often_one_looks(kind):
    rng = np.random.default_rng(1)
    trials = [switchback(np.zeros(60), gains(kind, 60, rng), margin=0.3) for _ in range(300)]
    assert sum(trial.status.value == "adopted" for trial in trials) <= 15 + 2 * 15**0.5


def test_one_better_by_the_margin_is_rarely_rejected():
    rng = np.random.default_rng(2)
    trials = [switchback(np.zeros(60), 0.5 + gains("normal", 60, rng), margin=0.5) for _ in range(200)]
    states = [trial.status.value for trial in trials]
    assert states.count("rejected") <= 10 + 2 * 10**0.5
    assert states.count("adopted") > 80


def test_the_bounds_hold_the_mean_gain_and_narrow():
    rng = np.random.default_rng(3)
    few, many = (switchback(np.zeros(n), 0.1 + rng.standard_normal(n), margin=0.05) for n in (40, 400))
    for trial in (few, many):
        assert trial.interval[0] < 0.1 < trial.interval[1]
    assert np.diff(many.interval) < np.diff(few.interval)


def test_units_of_the_return_do_not_matter():
    rng = np.random.default_rng(4)
    old, new = rng.standard_normal(30), rng.standard_normal(30) + 1
    one, other = switchback(old, new, margin=0.2), switchback(1e6 * old, 1e6 * new, margin=2e5)
    assert one.status is other.status
    np.testing.assert_allclose(np.array(other.interval), 1e6 * np.array(one.interval), rtol=1e-9)


def test_an_undecided_trial_says_how_many_pairs_it_needs():
    trial = switchback(np.zeros(20), np.random.default_rng(5).standard_normal(20), margin=0.1)
    assert trial.status.value == "undecided"
    assert 300 < trial.pairs_needed < 5000
    assert "20 pairs of blocks" in str(trial)


def pushed():
    """Plant whose second state is what its input was, so that gains are known exactly."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    return Plant(x, u, w, p, ca.vertcat(w[0], p * u), DesignSpace(["p"], [0.5], [1.5]), dt=0.1, continuous=False)


@pytest.fixture(scope="module")
def pushed_problem():
    return CoDesignProblem(
        discretise(pushed()), X=([-1e3] * 2, [1e3] * 2), U=(-1e3, 1e3),
        objective=QuadraticObjective(np.eye(2), [[1e-9]]),
        scenarios=FixedStart([0, 0], Gaussian([1.0, 1.0])), steps=100,
    )  # fmt: skip


def test_a_trial_goes_on_with_as_many_models_as_it_began_with(pushed_problem):
    begun = Trial(0.1 * np.ones(19), 100.0, told=np.ones((19, 2)))
    w = np.random.default_rng(0).normal(size=(24, 20, 2))
    with pytest.raises(InputError, match="model: got one, expected none, as the trial began with"):
        switchback_on(
            pushed_problem, pushed(), SERVED, BETTER, [1.0], x0=np.zeros((24, 2)), disturbance=w,
            rng=np.random.default_rng(4), before=begun, model=pushed(),
        )  # fmt: skip


@pytest.mark.parametrize(("old", "new", "said"), [
    (np.zeros(30), np.zeros(29), "29 blocks"),
    (np.zeros(5), np.zeros(5), "5 pairs of blocks"),
    (np.full(30, np.nan), np.zeros(30), "old"),
    (np.zeros((30, 2)), np.zeros(30), "old"),
])  # fmt: skip
def test_wrong_blocks_are_named(old, new, said):
    with pytest.raises(InputError, match=said):
        switchback(old, new, margin=1.0)


@pytest.mark.parametrize("options", [{"margin": 0.0}, {"margin": -1.0}, {"margin": 1.0, "level": 0.0}])
def test_wrong_margins_and_levels_are_named(options):
    with pytest.raises(InputError, match=r"margin|level"):
        switchback(np.zeros(30), np.ones(30), **options)


# ── on a plant ──


def test_a_better_law_is_adopted_and_drives_what_is_left(problem):
    found = tried(problem, BETTER)
    assert found.trial.status.value == "adopted"
    assert found.samples < 3000
    assert found.log.inputs.shape == (1, 3000, 1)
    late = found.log.inputs[0, found.samples :], found.log.states[0, found.samples : -1]
    np.testing.assert_allclose(late[0], BETTER(late[1]))


def test_a_worse_law_is_rejected(problem):
    found = tried(problem, SERVED, served=BETTER)
    assert found.trial.status.value == "rejected"
    assert found.trial.interval[1] < 0


def test_a_law_that_loses_the_run_is_rejected_at_once(problem):
    found = tried(problem, UNSTABLE)
    assert found.trial.status.value == "rejected"
    assert found.trial.lost
    assert found.trial.pairs <= 1


@pytest.mark.parametrize("seed", range(4))
def test_a_run_that_the_law_in_service_loses_is_not_laid_to_the_candidate(problem, seed):
    found = tried(problem, BETTER, served=UNSTABLE, seed=seed)
    assert found.trial.status.value == "undecided"  # of one run nothing goes on
    assert not found.trial.lost
    assert "1 lost by the law in service alone" in str(found.trial)
    assert found.samples <= 200


def test_a_candidate_that_keeps_runs_which_the_law_in_service_loses_is_adopted(problem):
    w = Gaussian([0.1, 0.1]).sample(60, 100, np.random.default_rng(0))
    laws = {"served": UNSTABLE, "better": BETTER, "lost, too": LinearFeedback(2 * UNSTABLE.K)}

    def after(current, candidate):
        rng = np.random.default_rng(1)
        return switchback_on(problem, plant(1.1), laws[current], laws[candidate], [1.0], x0=X0, disturbance=w, rng=rng)

    found = after("served", "better")
    assert found.trial.status.value == "adopted"
    assert found.trial.lost_before == 5  # 2^-5 is below 5 %
    assert not found.log.diverged[10:].any()
    both = after("served", "lost, too").trial
    assert (both.status.value, both.lost, both.lost_before) == ("undecided", False, 0)
    assert after("better", "served").trial.lost


def test_runs_lost_before_speak_for_a_candidate_at_the_level():
    rng = np.random.default_rng(0)
    adopted = 0
    for _ in range(1000):  # either law loses a run in one of three pairs, and nothing else tells them apart
        trial = Trial([], margin=1.0)
        for _ in range(30):
            trial = replace(trial, gains=np.append(trial.gains, rng.standard_normal()))
            by = rng.integers(6)
            trial = replace(trial, lost=by == 0, lost_before=trial.lost_before + (by == 1))
            if trial.status.value != "undecided":
                break
        adopted += trial.status.value == "adopted"
    assert adopted <= 60


def test_a_real_plant_of_another_rate_is_refused(problem):
    w = np.zeros((3000, 2))
    with pytest.raises(InputError, match=r"plant: got dt = 0\.2 s, expected dt = 0\.1 s of the model"):
        switchback_on(problem, replace(plant(1.0), dt=0.2), SERVED, BETTER, [1.0], x0=X0, disturbance=w,
                      rng=np.random.default_rng(0))  # fmt: skip


@pytest.mark.long
def test_a_model_that_is_right_takes_noise_out_of_the_trial(problem):
    near = {"candidate": LinearFeedback(0.9 * BETTER.K), "served": BETTER}
    spread = [tried(problem, **near, model=model).trial.gains.std() for model in (plant(1.0), plant(1.1))]
    assert spread[1] < 0.5 * spread[0]


def logged(problem, law=SERVED, lasting=0.0, steps=400, share=1.3):
    """Log of a law on a stronger plant, under noise and a disturbance that lasts."""
    w = Gaussian([0.1, 0.1]).sample(1, steps, np.random.default_rng(11)) + lasting
    return simulate(plant(share), law, x0=X0, steps=steps, disturbance=w, design=[1.0])


def test_a_plant_identified_from_a_log_predicts_the_real_one_whatever_disturbs_it(problem):
    model = identified_plant(problem, [logged(problem, BETTER, lasting=0.2), logged(problem, SERVED)])
    w = Gaussian([0.3, 0.3]).sample(20, 50, np.random.default_rng(12))
    runs = [simulate(one, law, x0=[1.0, -1.0], steps=50, disturbance=w, design=[1.0]).states
            for law in (BETTER, LinearFeedback(2 * BETTER.K)) for one in (model, plant(1.3), plant(1.0))]  # fmt: skip
    for own, real, nominal in (runs[:3], runs[3:]):
        assert np.abs(own - real).max() < 0.01 * np.abs(nominal - real).max()
    other = replace(problem, model=discretise(gusty(7.0)))
    again = identified_plant(other, logged(problem, BETTER))
    run = simulate(again, BETTER, x0=[1.0, -1.0], steps=50, disturbance=w, design=[1.0]).states
    assert np.abs(run - runs[1]).max() < 0.01 * np.abs(runs[2] - runs[1]).max()


@pytest.mark.long
def test_a_trial_that_predicts_with_a_log_or_its_own_is_decided_where_the_nominal_model_leaves_it_open(problem):
    near = LinearFeedback(0.9 * BETTER.K)
    w = Gaussian([0.1, 0.1]).sample(1, 3000, np.random.default_rng(13))[0]
    logs = identified_plant(problem, logged(problem, BETTER))
    nominal, own, with_log = (switchback_on(
        problem, plant(1.3), BETTER, near, [1.0], x0=X0, disturbance=w, rng=np.random.default_rng(14),
        config=TrialConfig(block=40, washout=10), model=model,
    ) for model in (plant(1.0), None, logs))  # fmt: skip
    assert nominal.trial.status.value == "undecided"
    for found in (own, with_log):
        assert found.trial.gains.std() < 0.5 * nominal.trial.gains.std()
        assert found.trial.status.value != "undecided"
    assert with_log.model is logs
    assert own.model is not None


@pytest.mark.long
def test_a_trial_goes_on_with_the_model_that_it_began_with(problem):
    fine = {"candidate": LinearFeedback(0.99 * BETTER.K), "served": BETTER, "margin": 1e-6, "steps": 2000}
    first = tried(problem, **fine)
    assert first.trial.status.value == "undecided"
    further = tried(problem, **fine, before=first.trial, model=first.model, seed=1)
    assert len(further.trial.gains) > 20
    np.testing.assert_array_equal(further.trial.told[: len(first.trial.told)], first.trial.told)
    assert len(further.trial.told) == len(further.trial.gains)
    with pytest.raises(InputError, match="model: got none, expected the model that the trial began with"):
        tried(problem, **fine, before=first.trial)


def gusty(size, share=1.1):
    """The plant with disturbances of another size."""
    own = plant(share)
    return replace(own, dynamics=ca.substitute(own.dynamics, own.w, size * own.w))


@pytest.mark.parametrize("size", [0.1, 10.0])
def test_the_margin_is_a_part_of_what_the_real_plant_returns(problem, size):
    """By a model with other gusts it was 100 times as much, and a law that is better by far stayed undecided."""
    wrong = replace(problem, model=discretise(gusty(size)))
    found = tried(wrong, BETTER).trial
    w = Gaussian([0.1, 0.1]).sample(20, 400, np.random.default_rng(15))
    runs = simulate(plant(1.1), SERVED, x0=X0, steps=400, disturbance=w, design=[1.0])
    block = -runs.returns(problem.objective).mean() / 10
    assert found.status.value == "adopted"
    assert 0.005 * block * 0.4 < found.margin < 0.005 * block * 1.2


@pytest.mark.long
@pytest.mark.parametrize("share", [-1.0, 40.0])
def test_a_model_that_foretells_nothing_does_not_harm_a_trial(problem, share):
    right, wrong = (tried(problem, BETTER, model=plant(one)).trial for one in (1.1, share))
    assert wrong.status.value == "adopted"
    assert (
        wrong.gains[:20].std() < 1.5 * tried(replace(problem, model=discretise(gusty(0.0))), BETTER).trial.gains.std()
    )
    assert right.pairs <= wrong.pairs


def test_a_nominal_model_that_gives_no_number_where_the_real_plant_goes_ends_no_trial(problem):
    own = plant(1.0)
    root = own.dynamics + 1e-3 * (ca.sqrt(0.15 - own.x[0]) - 0.15**0.5)
    small = {"X": ([-0.1] * 2, [0.1] * 2), "U": (-1, 1)}
    found = tried(replace(problem, model=discretise(replace(own, dynamics=root), **small)), BETTER)
    assert found.model is None
    assert len(found.trial.gains) >= 20
    assert np.isfinite(found.trial.gains).all()


def test_a_short_trial_that_goes_on_keeps_its_model_and_margin(problem):
    fine = {"candidate": LinearFeedback(0.99 * BETTER.K), "served": BETTER, "margin": 1e-6, "steps": 2000}
    first = tried(problem, **fine)
    cut = replace(first.trial, gains=first.trial.gains[:18])
    further = tried(problem, **fine, before=cut, model=first.model, seed=1).trial
    assert len(further.told) > len(cut.told)
    assert further.margin == cut.margin
    assert further.gains[18:].std() < 3 * cut.gains.std()


def test_logs_that_tell_no_plant_are_named(problem):
    log = logged(problem)
    with pytest.raises(InputError, match="3 disturbances"):
        identified_plant(problem, replace(log, disturbances=np.zeros((1, 400, 3))))
    with pytest.raises(InputError, match="at least one log"):
        identified_plant(problem, [])
    with pytest.raises(InputError, match="Trajectory"):
        identified_plant(problem, "a log")
    with pytest.raises(InputError, match="all diverged"):
        identified_plant(problem, replace(log, diverged_at=np.array([3])))


@pytest.mark.long
@pytest.mark.parametrize(("gust", "gain"), [(1.8, 0.6), (2.0, 0.35)])
def test_what_a_candidate_loses_in_one_gust_is_not_explained_away(gust, gain):
    """Its input works the other way far from rest: it is better in calm, and worse in a gust."""
    x, u, w, p = (ca.SX.sym(name) for name in "xuwp")

    def scalar(share):
        after = 0.9 * x + 0.3 * share * p * u + w
        return Plant(x, u, w, p, after, DesignSpace(["p"], [0.5], [1.5]), dt=0.1, continuous=False)

    real, far = scalar((1 - (x / 4) ** 2) / (1 + (x / 4) ** 2)), ([-1e3], [1e3])
    own = CoDesignProblem(
        discretise(scalar(0.95)), X=far, U=far, objective=QuadraticObjective([[1.0]], [[0.05]]),
        scenarios=FixedStart([1.0], Gaussian([0.02])), steps=60,
    )  # fmt: skip
    served, candidate, met = LinearFeedback([[0.25]]), LinearFeedback([[gain]]), []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        w = Gaussian([0.02]).sample(40, 60, rng)
        w[k := rng.integers(40), 10:14] += gust
        found = switchback_on(own, real, served, candidate, [1.0], x0=np.ones((40, 1)), disturbance=w, rng=rng)
        if np.allclose(found.log.inputs[k], candidate(found.log.states[k, :-1])):
            met.append(found.trial.status.value)
    assert len(met) >= 3
    assert "adopted" not in met


def test_an_undecided_trial_goes_on(problem):
    first = switchback(np.zeros(20), 10 * np.random.default_rng(8).standard_normal(20), margin=0.01)
    assert first.status.value == "undecided"
    further = tried(problem, BETTER, steps=500, before=first).trial
    assert len(further.gains) == 25
    np.testing.assert_array_equal(further.gains[:20], first.gains)


def test_too_short_a_deployment_is_refused(problem):
    with pytest.raises(InputError, match="room for 4 pairs of blocks"):
        tried(problem, BETTER, steps=400)


@pytest.mark.parametrize("options", [
    {"block": 0}, {"washout": -1}, {"margin": 0.0}, {"level": 2.0}, {"excitation": -0.1}, {"block": 1.5},
])  # fmt: skip
def test_wrong_settings_of_a_trial_are_named(options):
    with pytest.raises(InputError, match=next(iter(options))):
        TrialConfig(**options)


# ── drift ──


def correlated(share, n, rng):
    noise = rng.standard_normal((n + 100, 2))
    for k in range(1, len(noise)):
        noise[k] = share * noise[k - 1] + np.sqrt(1 - share**2) * noise[k]
    return noise[100:]


@pytest.mark.long
@pytest.mark.parametrize("share", [0.0, 0.6])
def test_a_change_is_seen_and_none_is_invented(share):
    rng = np.random.default_rng(6)
    alarms, seen = 0, []
    for _ in range(60):
        e = correlated(share, 2400, rng) * [1.0, 1e-3]
        alarms += detect_drift(e[:1200], e[1200:]).found is not None
        changed = e[1200:] + np.where(np.arange(1200) < 400, 0.0, 1.0)[:, None] * [1.5, 0]
        seen.append(detect_drift(e[:1200], changed))
    assert alarms <= 3 + 2 * 3**0.5
    found = [one for one in seen if one.found is not None]
    assert len(found) >= 54
    assert np.median([one.began for one in found]) == pytest.approx(400, abs=60)


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e6])
def test_residuals_where_there_were_none_are_a_change(size):
    assert detect_drift(np.zeros(900), np.full(900, size)).status.value == "drift"
    assert detect_drift(np.zeros(900), np.zeros(900)).status.value == "no drift"


def test_a_long_log_takes_memory_of_its_length():
    e = np.random.default_rng(0).standard_normal(10_300)
    tracemalloc.start()
    detect_drift(e[:300], e[300:])
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 1000 * e.nbytes


def test_a_twin_does_not_call_its_own_plant_drifted(illustrative):
    study, rng = illustrative, np.random.default_rng(7)
    law, w = LinearFeedback([[0.5, 0.8]]), study.real.disturbance

    def log(plant, runs=20):
        return simulate(plant, law, x0=np.tile(study.x0, (runs, 1)), steps=100, disturbance=w, design=[2.0], rng=rng)

    twin = DigitalTwin(study.model)
    with pytest.raises(InputError, match="after `update`"):
        drift_of_log(twin, log(study.real.plant))
    twin = twin.update(log(study.real.plant, 60), weight=study.weight, rng=rng, config=study_quantiles())
    assert drift_of_log(twin, log(study.real.plant)).status.value == "no drift"
    other = log(study.real.plant)
    few = drift_of_log(twin, other, block=30)
    assert few.status.value == "not known"
    assert "log longer" in str(few)
    assert outside_data(twin, other)[0] < 0.01
    share, excess = outside_data(twin, replace(other, states=3 * other.states))
    x = np.concatenate([twin.logs[0].x.reshape(-1, 2), 3 * other.states[:, :-1].reshape(-1, 2)])
    own, new = x[: 60 * 100], x[60 * 100 :]
    out = ((new < own.min(axis=0)) | (new > own.max(axis=0))).any(axis=1)
    assert share == pytest.approx(out.mean())
    beyond = np.maximum(new.max(axis=0) - own.max(axis=0), own.min(axis=0) - new.min(axis=0)) / np.ptp(own, axis=0)
    np.testing.assert_allclose(excess, [*np.maximum(beyond, 0), 0.0])
    with pytest.raises(InputError, match="one without a log"):
        outside_data(DigitalTwin(study.model), other)
    pushed = replace(other, states=other.states + np.linspace(0, 2, 101)[None, :, None] ** 2)
    assert drift_of_log(twin, pushed).status.value == "drift"


def test_another_law_on_the_same_plant_is_no_drift(problem):
    def log(gain, seed):
        w = Gaussian([0.1, 0.1]).sample(1, 3000, np.random.default_rng(seed))
        law = LinearFeedback(gain * np.array([[0.15, 0.45]]))
        return simulate(plant(1.1), law, x0=X0[None], steps=3000, disturbance=w, design=[1.0])

    twin = DigitalTwin(problem.model, scale=problem.state_scale)
    twin = twin.update(log(1.0, 1), weight=1e-2 * np.eye(2), rng=np.random.default_rng(0))
    for gain in (1.0, 2.0, 0.0):
        assert drift_of_log(twin, log(gain, 5)).status.value == "no drift"


def study_quantiles():
    from learning import QuantileConfig

    return QuantileConfig(hidden=(16,), steps=300, batch=256)


@pytest.mark.parametrize(("calibration", "residuals", "said"), [
    (np.zeros((100, 2)), np.zeros((50, 2)), "100 samples"),
    (np.zeros((400, 2)), np.zeros((50, 3)), "3 columns"),
    (np.full((400, 2), np.inf), np.zeros((50, 2)), "calibration"),
])  # fmt: skip
def test_wrong_residuals_are_named(calibration, residuals, said):
    with pytest.raises(InputError, match=said):
        detect_drift(calibration, residuals)


def test_a_trial_of_no_pairs_is_undecided():
    assert Trial([], margin=1.0).status.value == "undecided"
    assert np.isnan(Trial([], margin=1.0).mean)
