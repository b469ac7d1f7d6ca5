"""Conformal factors hold their level: with few samples, in every regime, jointly, and in a stream that changes."""

import numpy as np
import pytest
from scipy.stats import betabinom, norm

from learning import AdaptiveConformal, Conformal, InputError


@pytest.mark.parametrize("n", [4, 9, 30])
def test_few_samples_hold_the_level_exactly(n):
    rng = np.random.default_rng(n)
    factors = np.array([Conformal.fit(np.abs(rng.standard_normal(n)), 0.8).factor for _ in range(2000)])
    rank = int(np.ceil(0.8 * (n + 1)))
    covered = 2 * norm.cdf(factors) - 1
    assert covered.mean() == pytest.approx(betabinom(1, rank, n + 1 - rank).mean(), abs=0.01)
    assert covered.mean() > 0.79


@pytest.mark.long
@pytest.mark.parametrize("draw", [np.random.Generator.random, np.random.Generator.exponential])
@pytest.mark.parametrize("n", [5, 12, 20, 40])
def test_interpolated_the_level_is_held_on_average_and_not_more(draw, n):
    rng = np.random.default_rng(n)
    samples = draw(rng, size=(3000, n))
    factors = np.array([Conformal.fit(scores, 0.8, at_least=False).factor for scores in samples])
    covered = factors if draw is np.random.Generator.random else 1 - np.exp(-factors)
    below, rest = divmod(0.8 * (n + 1), 1)
    between = (below / (n + 1), (below + (rest > 1e-9)) / (n + 1))  # what the two ranks hold
    error = 3 * 0.4 / np.sqrt(3000 * (n + 2))
    assert between[0] - error < np.minimum(covered, 1).mean() < between[1] + error
    assert np.minimum(covered, 1).mean() == pytest.approx(0.8, abs=0.015)


@pytest.mark.long
@pytest.mark.parametrize("memory", [1, 5, 20])
def test_windows_that_overlap_hold_the_level_interpolated_however_alike_they_are(memory):
    # Twenty windows of twenty steps that do not overlap, and all between; scores last one step, or all of a window.
    rng = np.random.default_rng(memory)
    covered = []
    for _ in range(800):
        scores = np.abs(np.convolve(rng.standard_normal(400 + memory), np.ones(memory) / np.sqrt(memory), "same"))
        factor = Conformal.fit(scores[:400], 0.8, independent=20, at_least=False).factor
        covered.append(2 * norm.cdf(factor) - 1)
    assert np.mean(covered) == pytest.approx(0.8, abs=0.02)


@pytest.mark.parametrize(("level", "needed"), [(0.8, 4), (0.9, 9), (0.99, 99)])
def test_too_few_samples_are_refused_with_the_number_needed(level, needed):
    assert np.isfinite(Conformal.fit(np.ones(needed), level).factor)
    with pytest.raises(InputError, match=f"scores: got {needed - 1} independent samples .* expected at least {needed}"):
        Conformal.fit(np.ones(needed - 1), level)
    with pytest.raises(InputError, match=f"got {needed - 1} independent samples"):
        Conformal.fit(np.ones(1000), level, independent=needed - 1)


def test_a_level_near_zero_takes_the_least_score_and_no_number_is_named():
    assert Conformal.fit(np.arange(10.0), 1e-12).factor == 0.0
    with pytest.raises(InputError, match="scores: got NaN"):
        Conformal.fit([np.nan] * 10, 0.5)


def test_every_regime_holds_the_level():
    rng = np.random.default_rng(0)
    size = rng.choice([1.0, 5.0], 2000)
    known = Conformal.fit(size * np.abs(rng.standard_normal(2000)), 0.8, scale=size)
    fresh = rng.choice([1.0, 5.0], 20_000)
    held = fresh * np.abs(rng.standard_normal(20_000)) <= known.at(fresh)
    for regime in (1.0, 5.0):
        assert held[fresh == regime].mean() == pytest.approx(0.8, abs=0.03)


def test_a_power_of_the_scale_takes_no_number_of_samples_in_a_regime():
    # Thirty scores, as many in each regime as chance has it: the rough one holds its level as the calm one does.
    rng = np.random.default_rng(1)
    held = []
    for _ in range(400):
        size = rng.choice([1.0, 5.0], 30)
        known = Conformal.fit(size * np.abs(rng.standard_normal(30)), 0.8, scale=size, exponent=1.0, at_least=False)
        held.append(2 * norm.cdf(known.at([1.0, 5.0]) / [1.0, 5.0]) - 1)
    np.testing.assert_allclose(np.mean(held, axis=0), 0.8, atol=0.015)


def test_the_exponent_is_that_of_the_quantile_asked_for():
    # The median of these scores does not grow with the scale; their 80 % quantile does, as its square root.
    rng = np.random.default_rng(3)
    scale = np.exp(rng.standard_normal(4000))
    large = rng.random(4000) > 0.7
    scores = np.where(large, 10 * np.sqrt(scale), 0.1) * np.exp(0.01 * rng.standard_normal(4000))
    assert Conformal.scale_exponent(scores, scale, 0.8) == pytest.approx(0.5, abs=0.01)
    assert Conformal.scale_exponent(scores, scale, 0.5) == pytest.approx(0.0, abs=0.01)
    assert Conformal.scale_exponent(scores, np.ones(4000), 0.8) == 0.0
    assert Conformal.scale_exponent(1e6 * scores, 1e-3 * scale, 0.8) == pytest.approx(0.5, abs=0.01)


def test_overlapping_scores_count_as_those_that_do_not():
    scores = np.arange(1.0, 101.0)
    assert Conformal.fit(scores, 0.8).factor == 81  # of 101
    assert Conformal.fit(scores, 0.8, independent=10).factor == 90  # the ninth of ten, of 11


@pytest.mark.parametrize("change", [lambda e: 2 * e, lambda e: e + 1, lambda e: e / 2])
def test_a_stream_holds_its_level_five_hundred_samples_after_a_shift(change):
    rng = np.random.default_rng(1)
    stream = AdaptiveConformal(0.8, norm.ppf(0.9))
    inside = []
    for score in np.abs(np.concatenate([rng.standard_normal(500), change(rng.standard_normal(1000))])):
        inside.append(score <= stream.factor)
        stream = stream.after(score)
    assert np.mean(inside[:500]) == pytest.approx(0.8, abs=0.05)
    assert np.mean(inside[1000:]) == pytest.approx(0.8, abs=0.05)


@pytest.mark.parametrize("still", [100, 2000])
def test_a_stream_comes_back_after_a_standstill(still):
    rng = np.random.default_rng(0)
    stream = AdaptiveConformal(0.8, 1.0)
    for score in np.r_[np.abs(rng.standard_normal(300)), np.zeros(still), np.abs(rng.standard_normal(500))]:
        stream = stream.after(score)
    hits = []
    for score in np.abs(rng.standard_normal(1000)):
        hits.append(score <= stream.factor)
        stream = stream.after(score)
    assert np.mean(hits) == pytest.approx(0.8, abs=0.05)


def test_the_flag_is_raised_where_coverage_is_lost_and_falls_when_it_is_back():
    rng = np.random.default_rng(2)
    stream = AdaptiveConformal(0.8, norm.ppf(0.9))
    lost = []
    for part, size in ((1000, 1.0), (500, 2.0), (1000, 1.0)):
        for score in np.abs(size * rng.standard_normal(part)):
            stream = stream.after(score)
            lost.append(stream.lost)
    assert not any(lost[:1000])
    assert lost[1200:1500] == [True] * 300
    assert not lost[-1]


def test_the_flag_takes_evidence_of_one_in_ten_thousand():
    stream = AdaptiveConformal(0.8, 1.0)
    taken = 0
    while not stream.lost:
        stream = stream.after(2.0)  # a miss wins 1.8 times the stake
        taken += 1
    assert taken == int(np.ceil(np.log(1e4) / np.log(1.8)))


@pytest.mark.parametrize(
    ("make", "argument"),
    [
        (lambda: Conformal.fit(np.ones((5, 2))), "scores"),
        (lambda: Conformal.fit([np.nan] * 9), "scores"),
        (lambda: Conformal.fit(np.ones(9), 1.0), "level"),
        (lambda: Conformal.fit(np.ones(9), scale=np.ones(8)), "scale"),
        (lambda: Conformal.fit(np.ones(9), scale=np.zeros(9)), "scale"),
        (lambda: Conformal.fit(np.ones(9), exponent=2.0), "exponent"),
        (lambda: Conformal.fit([*range(9), np.inf], at_least=False), "scores"),
        (lambda: Conformal.scale_exponent(np.ones(9), np.ones(9), 1.0), "level"),
        (lambda: AdaptiveConformal(level=0.0), "level"),
        (lambda: AdaptiveConformal(factor=0.0), "factor"),
        (lambda: AdaptiveConformal(calibrated=-1.0), "calibrated"),
        (lambda: AdaptiveConformal(least=1.0), "least"),
        (lambda: AdaptiveConformal().after(-1.0), "score"),
    ],
)
def test_wrong_calls_name_their_argument(make, argument):
    with pytest.raises(InputError, match=f"^{argument}: got"):
        make()
