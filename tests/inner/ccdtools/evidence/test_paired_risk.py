"""The gain in a risk is the difference of the risk itself, and its interval covers as often as it says."""

import numpy as np
import pytest

from ccdtools import CVaR, MeanSpread
from ccdtools.co_design.risk import MEAN, measure
from ccdtools.co_design.risk_intervals import parts_of_risk
from ccdtools.evidence.evidence import paired_in_risk, paired_over_groups, stretches

RISKS = {
    "spread": (MeanSpread(2.0), lambda r: r.mean() - 2 * r.std()),
    "tenth": (CVaR(0.1), lambda r: np.sort(r)[: int(np.ceil(0.1 * len(r) - 1e-9))].mean()),
}


def gain(risk, after, before, labels=None, *, runs=None, stretch=10):
    labels = np.arange(len(after)) if labels is None else labels
    return paired_in_risk(risk, after, before, labels, runs=len(after) if runs is None else runs, stretch=stretch)


@pytest.mark.parametrize("name", RISKS)
@pytest.mark.parametrize("unit", [1.0, 1e6])
def test_the_gain_is_that_of_the_measure_in_any_unit(name, unit):
    risk, value = RISKS[name]
    rng = np.random.default_rng(0)
    after, before = (unit * rng.standard_normal((101, 5)) for _ in range(2))
    found = gain(risk, after, before)
    assert found.mean == pytest.approx(value(after.sum(axis=1)) - value(before.sum(axis=1)))
    assert found.ci95[0] < found.mean < found.ci95[1]


def test_the_parts_of_the_mean_are_the_returns():
    returns = np.random.default_rng(0).standard_normal(30)
    np.testing.assert_allclose(parts_of_risk(MEAN, returns), returns)


def test_of_the_mean_nothing_is_changed():
    after, before = np.random.default_rng(0).standard_normal((2, 40, 5))
    labels = np.arange(40) % 25
    assert gain(MEAN, after, before, labels) == paired_over_groups(after, before, labels, runs=40)
    whole = paired_over_groups(after.reshape(1, -1), before.reshape(1, -1), np.zeros(1, dtype=int), runs=1)
    assert gain(MEAN, after, before, runs=1) == whole


def test_fewer_than_ten_runs_in_the_tail_have_no_interval():
    after, before = np.random.default_rng(0).standard_normal((2, 99, 5))
    few = gain(CVaR(0.1), after, before)
    assert np.isfinite(few.mean)
    assert np.isnan(few.ci95).all()


@pytest.mark.parametrize("name", RISKS)
def test_the_interval_covers_the_true_gain(name):
    risk, value = RISKS[name]
    rng = np.random.default_rng(1)
    big = rng.standard_normal(400_000)
    truth = value(1.2 * big) - value(big)
    covered = 0
    for _ in range(300):
        before = rng.standard_normal((100, 1))
        after = 1.2 * (0.8 * before + 0.6 * rng.standard_normal((100, 1)))
        low, high = gain(risk, after, before).ci95
        covered += low < truth < high
    assert 0.92 <= covered / 300 <= 0.99


def test_runs_that_met_one_disturbance_are_one_piece_of_evidence():
    rng = np.random.default_rng(0)
    after, before = rng.standard_normal((2, 40, 3))
    once = gain(CVaR(0.25), after, before)
    twice = gain(CVaR(0.25), *(np.tile(r, (3, 1)) for r in (after, before)), np.tile(np.arange(40), 3))
    assert twice.mean == pytest.approx(once.mean)
    assert np.diff(twice.ci95) == pytest.approx(np.diff(once.ci95), rel=0.2)


def test_of_one_run_its_stretches_stand_for_runs_and_the_gain_is_of_the_whole_run():
    rng = np.random.default_rng(0)
    before = rng.standard_normal((1, 4000))
    after = before + 0.1
    found = gain(MeanSpread(1.0), after, before, runs=1, stretch=20)
    assert found.mean == pytest.approx(400.0)  # the spread is the same
    worse = gain(MeanSpread(3.0), 2.0 * before + 0.1, before, runs=1, stretch=20)
    spread = before.reshape(-1, 20).sum(axis=1)
    expected = (2.0 * spread.mean() + 2.0 - 6 * spread.std()) - (spread.mean() - 3 * spread.std())
    assert worse.mean == pytest.approx(200 * expected, rel=1e-2)
    assert worse.ci95[1] < 0


def test_too_short_a_run_has_no_interval():
    r = np.random.default_rng(0).standard_normal((1, 30))
    assert np.isnan(gain(CVaR(0.5), r, 2 * r, runs=1, stretch=25).ci95).all()
    assert np.isnan(gain(CVaR(0.5), r, 2 * r, runs=10).ci95).all()


def test_stretches_stay_within_their_parts():
    np.testing.assert_allclose(stretches(np.arange(14.0).reshape(2, 7), 3), [3, 12, 24, 33])


def test_a_risk_is_named_in_words():
    class Own:
        def values(self, returns):
            return returns

    named = [measure(risk) for risk in (MEAN, MeanSpread(1), MeanSpread(0.5), CVaR(0.1), Own())]
    assert named == ["mean", "mean minus spread", "mean minus 0.5 times the spread", "mean of the worst 10 %", "Own"]
