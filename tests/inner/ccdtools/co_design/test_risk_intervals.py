"""A risk is of the runs that were kept, and its interval covers as often as it says."""

import numpy as np
import pytest

from ccdtools import CVaR, MeanSpread, WorstCase
from ccdtools.co_design.closed_loop import ClosedLoopReturns
from ccdtools.co_design.risk import Mean

RISKS = {
    "spread": (MeanSpread(1.0), lambda r: r.mean(axis=-1) - r.std(axis=-1)),
    "tenth": (CVaR(0.1), lambda r: np.sort(r, axis=-1)[..., : r.shape[-1] // 10].mean(axis=-1)),
    "worst case": (WorstCase(cases=4), lambda r: r.reshape(*r.shape[:-1], -1, 4).mean(axis=-2).min(axis=-1)),
    "own": (type("Own", (), {"values": lambda _, r: 2 * r})(), lambda r: 2 * r.mean(axis=-1)),
}


def loop(returns, risk, lost=()):
    mask = np.zeros(len(returns), dtype=bool)
    mask[list(lost)] = True
    return ClosedLoopReturns(np.where(mask, -1e8, returns), mask, risk=risk)


@pytest.mark.parametrize("name", [*RISKS, "mean"])
def test_one_lost_run_of_a_thousand_hardly_moves_the_risk_of_the_rest_and_is_said(name):
    risk = Mean() if name == "mean" else RISKS[name][0]
    returns = np.random.default_rng(0).standard_normal(1000) - 10
    whole, kept = loop(returns, risk), loop(returns, risk, [500])
    assert kept.summary.mean == pytest.approx(whole.summary.mean, abs=0.02)
    assert kept.summary.ci95 == pytest.approx(whole.summary.ci95, abs=0.02)
    assert kept.summary.n == 999
    assert "999 runs; 0.10% of the runs lost, not counted" in repr(kept)


def test_the_cases_of_the_runs_that_are_kept_stay_theirs():
    returns = np.tile([-1.0, -2.0, -3.0], 40) + 1e-3 * np.random.default_rng(0).standard_normal(120)
    assert loop(returns, WorstCase(cases=3), [0, 4]).summary.mean == pytest.approx(-3.0, abs=1e-3)


@pytest.mark.quick(6)
@pytest.mark.parametrize("name", RISKS)
@pytest.mark.parametrize("n", [100, 1000])
def test_the_interval_of_a_risk_covers_that_of_skewed_returns(name, n):
    risk, exact = RISKS[name]
    rng = np.random.default_rng(n)
    truth = exact(-rng.exponential(1.0, 400_000))
    draws = -rng.exponential(1.0, (200, n))
    ends = np.array([loop(one, risk).summary.ci95 for one in draws[: 200 if n == 100 else 40]])
    assert np.mean((ends[:, 0] < truth) & (truth < ends[:, 1])) >= 0.9


@pytest.mark.parametrize("risk", [CVaR(0.02), WorstCase(cases=11)])
def test_fewer_than_ten_runs_in_the_tail_are_named_and_have_no_interval(risk):
    found = loop(np.random.default_rng(0).standard_normal(100), risk)
    assert np.isfinite(found.summary.mean)
    assert np.isnan(found.summary.ci95).all()
    assert "fewer than 10" in found.summary.warning
    assert found.summary.warning in str(found)
