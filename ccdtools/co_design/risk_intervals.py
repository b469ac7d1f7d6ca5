"""Risks of runs, with intervals; lost runs are only counted.

References
----------
Efron and Stein, "The jackknife estimate of variance", Annals of Statistics 9(3), 1981. Shao and Wu, "A general theory
for jackknife variance estimation", Annals of Statistics 17(3), 1989 (functions that are not smooth, such as quantiles).
"""

from __future__ import annotations

import numpy as np

from ccdtools.arrays import Array, Indices, Mask
from ccdtools.co_design.risk import CVaR, Mean, MeanSpread, Risk, WorstCase, by_case, risk_of
from ccdtools.statistics import PairedDifference, Summary, interval_of_parts, summarise
from ccdtools.tolerances import FEWEST_RUNS

NONE = (float("nan"), float("nan"))


def parts_of_risk(risk: Risk, returns: Array, labels: Indices | None = None, runs: Indices | None = None) -> Array:
    """Part (g,) of each group in a risk of returns (n,); the risk is their mean.

    The part of a group is how far the risk moves when it is left out; of runs that are groups of their own, and a risk
    of this package, by its derivative. NaN of a single group, unless the risk is the mean.

    Parameters
    ----------
    labels : (n,) int array, optional
        The group of every run; by default each is one of its own. The parts are in the order of the labels.
    runs : (n,) int array, optional
        Numbers of the runs, which tell the case of each; by default 0, 1, 2, …
    """
    own = np.arange(len(returns)) if labels is None else labels
    numbers = np.arange(len(returns)) if runs is None else runs
    groups = np.unique(own)
    if len(groups) < 2:
        return np.full(len(groups), risk_of(risk, returns, numbers) if isinstance(risk, Mean) else np.nan)
    if len(groups) == len(returns) and isinstance(risk, Mean | MeanSpread | CVaR | WorstCase):
        alone = _parts_of_case(risk, returns, numbers) if isinstance(risk, WorstCase) else risk.values(returns)
        return np.asarray(alone[np.argsort(own)])
    kept = (own != group for group in groups)
    rest = np.array([risk_of(risk, returns[others], numbers[others]) for others in kept])
    return np.asarray(risk_of(risk, returns, numbers) + (len(groups) - 1) * (rest.mean() - rest))


def in_tail(risk: Risk, runs: Indices) -> int:
    """Number of runs (n,) that decide a risk.

    It is the risk's share of them, or the runs of the rarest case.
    """
    if isinstance(risk, CVaR):
        return int(risk.share * len(runs) + 1e-9)
    if isinstance(risk, WorstCase):
        return min(len(case) for case in by_case(risk, np.zeros(len(runs)), runs))
    return len(runs)


def too_few(risk: Risk, runs: Indices) -> str:
    """Reason why a risk has no interval, else empty."""
    count = in_tail(risk, runs)
    if isinstance(risk, Mean) or count >= FEWEST_RUNS:
        return ""
    return f"{count} runs decide it, fewer than {FEWEST_RUNS}: no interval"


def summarise_in_risk(risk: Risk, returns: Array, lost: Mask, labels: Indices | None = None) -> Summary:
    """Risk, with 95 % interval, of returns (n,) without `lost` (n,) runs.

    With `labels` (n,) the interval is over the groups that they name, such as logged runs drawn more than once. `std`
    is the standard deviation of the runs' parts in the risk, `median` that of their returns, and `warning` says that
    fewer than ten runs decide the risk, which then has no interval.
    """
    runs = np.flatnonzero(~lost)
    kept = returns[runs]
    plain = summarise(kept)
    if isinstance(risk, Mean) and labels is None:
        return plain
    value = risk_of(risk, kept, runs)
    own = None if labels is None else labels[runs]
    parts = parts_of_risk(risk, kept, own, runs)
    std = float(parts.std(ddof=1)) if len(parts) > 1 else float("nan")
    warning = too_few(risk, runs if labels is None else np.arange(len(parts)))
    ends = NONE if warning else _interval(risk, kept, parts, runs)
    if isinstance(risk, Mean):
        return Summary(value, plain.std, plain.median, plain.n, ends, summarise(parts).warning)
    return Summary(value, std, plain.median, plain.n, ends, warning)


def difference_of_parts(risk: Risk, parts: Array, runs: Indices) -> PairedDifference:
    """Mean difference of parts (n,) on common runs, with 95 % interval."""
    mean = float(parts.mean()) if len(parts) else float("nan")
    if isinstance(risk, Mean):
        return PairedDifference(mean, summarise(parts).ci95)
    return PairedDifference(mean, NONE if too_few(risk, runs) else interval_of_parts(parts))


def _interval(risk: Risk, returns: Array, parts: Array, runs: Indices) -> tuple[float, float]:
    """95 % interval of a risk; for a worst case, from all its cases.

    The least mean lies above the least of the lower ends, and below every upper end. The more cases are alike, the
    rarer it is that all lower ends miss it. Each of the m upper ends is taken to miss it in 5 / m %.
    """
    if not isinstance(risk, WorstCase):
        return interval_of_parts(parts)
    cases = by_case(risk, returns, runs)
    low = min(interval_of_parts(case)[0] for case in cases)
    return low, min(interval_of_parts(case, 1 - 0.1 / len(cases))[1] for case in cases)


def _parts_of_case(risk: WorstCase, returns: Array, runs: Indices) -> Array:
    """Parts of the runs in the least mean, from the worst case's deviations."""
    assert risk.cases is not None
    means = [case.mean() if len(case) else np.nan for case in by_case(risk, returns, runs)]
    worst = runs % risk.cases == np.argmin(means)
    return np.asarray(np.min(means) + worst * (len(returns) / max(worst.sum(), 1)) * (returns - np.min(means)))
