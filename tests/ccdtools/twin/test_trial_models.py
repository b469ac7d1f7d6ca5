"""Models that take the noise out of a trial."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from trial_plants import BETTER, SERVED, X0, plant, tried, wide_problem

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    InputError,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    discretise,
    simulate,
)
from ccdtools.twin import TrialConfig, identified_plant, switchback_on


@pytest.fixture(scope="module")
def problem():
    return wide_problem()


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
