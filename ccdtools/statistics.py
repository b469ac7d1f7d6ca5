"""Means, intervals and paired differences of returns."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats
from scipy.fft import dct

from ccdtools.arrays import Array
from ccdtools.budgets import BATCHES
from ccdtools.exceptions import InputError
from ccdtools.tolerances import COSINES, FEWEST_RUNS, INDEPENDENCE_LEVEL, SAME_RETURN, TRANSIENT
from ccdtools_ground.door import as_array, as_finite, as_floats

FEW_DECIDE = "a few runs make most of its spread: others may move it beyond the interval"
TOO_SHORT = "the run is too short for its own correlation: no interval"


@dataclass(frozen=True)
class Summary:
    """Mean, standard deviation, median, number and 95 % interval; NaN with too few values.

    `warning` says why there is no interval although there are values, or that it stands on a few of them; empty where
    nothing is to be said.
    """

    mean: float
    std: float
    median: float
    n: int
    ci95: tuple[float, float]
    warning: str = ""


@dataclass(frozen=True)
class PairedDifference:
    """Mean difference on common random numbers with its 95 % interval."""

    mean: float
    ci95: tuple[float, float]


def summarise(values: ArrayLike) -> Summary:
    """Statistics of independent values (n,), with the interval of `interval_of_parts`."""
    v = as_floats("values", values)
    if v.ndim != 1:
        raise InputError("values", f"shape {v.shape}", "(n,)")
    if len(v) == 0:
        return Summary(np.nan, np.nan, np.nan, 0, (np.nan, np.nan))
    std = float(v.std(ddof=1)) if len(v) > 1 else float("nan")
    warning = FEW_DECIDE if len(v) >= 3 * FEWEST_RUNS and _skewness_and_degrees(v)[1] < FEWEST_RUNS else ""
    return Summary(float(v.mean()), std, float(np.median(v)), len(v), interval_of_parts(v), warning)


def paired_difference(a: ArrayLike, b: ArrayLike) -> PairedDifference:
    """Mean of a − b over pairs (n,), with its interval."""
    first = as_floats("a", a)
    second = as_floats("b", b)
    if first.shape != second.shape:
        raise InputError("a, b", f"shapes {first.shape} and {second.shape}", "as many of each")
    summary = summarise(first - second)
    return PairedDifference(summary.mean, summary.ci95)


@dataclass(frozen=True)
class MeanInterval:
    """Mean of a correlated series, with a 95 % interval.

    Attributes
    ----------
    mean : float
    ci95 : (float, float)
        NaN where the series is too short for its correlation: see `reliable`.
    std_error : float
        Standard deviation of the mean.
    correlation : float
        Autocorrelation at lag one of the twentieths of the series: what decides whether there is an interval.
    """

    mean: float
    ci95: tuple[float, float]
    std_error: float
    correlation: float

    @property
    def reliable(self) -> bool:
        """Whether the series is long enough for an interval."""
        return bool(np.isfinite(self.ci95).all())


def mean_interval(series: ArrayLike) -> MeanInterval:
    """Mean of a stationary, correlated series, with a 95 % interval.

    The variance of the mean is the spectrum at frequency zero, here the mean square of the first four cosine
    transforms, with Student's t of four degrees of freedom. The interval is skewed as the mean is. The first 5 % of
    the series are left out of the variance (a start is not noise), not out of the mean.

    A series shows only what it repeats: variation slower than its length (another driver, a level that never changed)
    is in no interval of a single run.

    Parameters
    ----------
    series : (n,) array_like
        In the order of time: rewards of one run, the difference of two on the same disturbance, or the returns of
        consecutive windows.

    Returns
    -------
    MeanInterval
        Without an interval where n < 20, or where von Neumann's test at the level of 1 % finds that neighbouring
        twentieths of the series move together.

    Raises
    ------
    InputError
        If the series is not a vector of finite numbers.

    References
    ----------
    Lazarus, Lewis, Stock and Watson, HAR inference: recommendations for practice, Journal of Business & Economic
    Statistics 36(4), 2018 (equal-weighted cosines, Student's t); von Neumann, Annals of Mathematical Statistics 12,
    1941 (the test); Hall, On the removal of skewness by transformation, Journal of the Royal Statistical Society B 54,
    1992.
    """
    values = as_finite("series", as_array("series", series, ("n",)))
    mean = float(values.mean()) if len(values) else float("nan")
    settled = values[int(TRANSIENT * len(values)) :]
    if len(values) < BATCHES:
        return MeanInterval(mean, (np.nan, np.nan), np.nan, np.nan)
    if np.ptp(settled) == 0:
        return MeanInterval(mean, (mean, mean), 0.0, 0.0)
    edges = np.linspace(0, len(settled), BATCHES + 1).round().astype(int)
    means = np.array([settled[i:j].mean() for i, j in pairwise(edges)])
    away = means - means.mean()
    correlation = float(away[1:] @ away[:-1] / (away @ away)) if away.any() else 0.0
    cosines = dct(settled, norm="ortho")[1 : COSINES + 1]
    error = float(np.sqrt((cosines**2).mean() / len(values)))
    if correlation > float(stats.norm.ppf(INDEPENDENCE_LEVEL)) / np.sqrt(BATCHES) - 1 / BATCHES:
        return MeanInterval(mean, (np.nan, np.nan), error, correlation)
    return MeanInterval(mean, _skewed(mean, error, _skewness_and_degrees(means)[0], COSINES), error, correlation)


def interval_of_parts(parts: ArrayLike, level: float = 0.95) -> tuple[float, float]:
    """Interval of a mean of parts (n,) of independent runs.

    Returns and their parts in a risk can be far from normal (of the worst tenth nine parts in ten are alike), so the
    interval is skewed as they are, and Student's t has as many degrees of freedom as their fourth moment leaves, ten at
    least. What happens in one run of a thousand is in no interval of a hundred runs that have not met it. NaN of fewer
    than two parts.

    References
    ----------
    Hall, Journal of the Royal Statistical Society B 54, 1992; Satterthwaite, Biometrics Bulletin 2, 1946.
    """
    return interval_of_crossed(as_floats("parts", parts)[:, None], level)


def interval_of_crossed(values: ArrayLike, level: float = 0.95) -> tuple[float, float]:
    """Interval of a mean over rows and columns that are both drawn.

    Every row, such as a seed, meets every column, such as a run. The variances of both means are added; what rows and
    columns do together is in both, and is taken off once. Third moments add up, and the degrees of freedom are
    Satterthwaite's of the three mean squares. A single row, or a single column, is no source of chance.

    Parameters
    ----------
    values : (S, N) array_like
        NaN marks what does not count.
    level : float

    Returns
    -------
    (float, float)
        NaN of a single value, or where a single row or column of several is left.

    References
    ----------
    Dorfman, Berbaum and Metz, Investigative Radiology 27, 1992, and Hillis, Statistics in Medicine 26, 2007 (readers
    and cases, crossed); Satterthwaite, Biometrics Bulletin 2, 1946; Hall, Journal of the Royal Statistical Society B
    54, 1992.
    """
    table = as_floats("values", values)
    factors = [kept_means(table, axis) for axis in (1, 0) if table.shape[1 - axis] > 1]
    if not factors or min(map(len, factors)) < 2:
        return (float("nan"), float("nan"))
    mean = float(kept_means(table, 1).mean())
    shapes = [_skewness_and_degrees(parts) for parts in factors]
    squares = [float(parts.var(ddof=1)) / len(parts) for parts in factors]
    together, free = _together(table)
    variance = variance_of_crossed(table)
    if variance == 0:
        return (mean, mean)
    degrees = [min(len(parts) - 1.0, max(own, FEWEST_RUNS)) for parts, (_, own) in zip(factors, shapes)]
    doubt = together**2 / free + sum(square**2 / own for square, own in zip(squares, degrees))
    skewness = sum(own * square**1.5 for square, (own, _) in zip(squares, shapes)) / variance**1.5
    return _skewed(mean, float(np.sqrt(variance)), skewness, variance**2 / doubt, level)


def variance_of_crossed(values: Array) -> float:
    """Variance of a mean over rows and columns (S, N) that are both drawn; see `interval_of_crossed`."""
    factors = [parts for parts in (kept_means(values, axis) for axis in (1, 0)) if len(parts) > 1]
    squares = [float(parts.var(ddof=1)) / len(parts) for parts in factors]
    return max(sum(squares) - _together(values)[0], *squares, 0.0)


def kept_means(values: Array, axis: int) -> Array:
    """Means (n,) along an axis of what is not NaN, where anything is."""
    kept = ~np.isnan(values)
    number = kept.sum(axis=axis)
    total = np.where(kept, values, 0.0).sum(axis=axis)
    return np.asarray(total[number > 0] / number[number > 0])


def summarise_returns(rewards: ArrayLike, *, runs: int | None = None) -> Summary:
    """Statistics of the returns of runs with rewards (n, T).

    Of a single run `mean` and `median` are its return, `n` is 1 and `std` is the standard deviation of the return
    from run to run, as far as one run shows it; the interval is that of `mean_interval`.

    Parameters
    ----------
    rewards : (n, T) array_like
    runs : int, optional
        Runs that were begun, where some have been left out; one that remains of many has no interval.
    """
    r = _rewards("rewards", rewards)
    if len(r) != 1 or (runs is not None and runs > 1):
        return summarise(r.sum(axis=1))
    total = float(r.sum())
    of_mean = mean_interval(r[0])
    low, high = (r.shape[1] * end for end in of_mean.ci95)
    warning = "" if of_mean.reliable else TOO_SHORT
    return Summary(total, r.shape[1] * of_mean.std_error, total, 1, (low, high), warning)


def paired_returns(a: ArrayLike, b: ArrayLike, *, runs: int | None = None) -> PairedDifference:
    """Mean difference of returns with rewards (n, T) on common disturbances."""
    first, second = _alike(a=a, b=b)
    summary = summarise_returns(first - second, runs=runs)
    most = float(np.abs(first - second).sum())
    if len(first) == 1 and 0 < most <= SAME_RETURN * float(np.abs(second).sum()):
        return PairedDifference(summary.mean, (-most, most))  # no process, but rounding, which has this bound
    return PairedDifference(summary.mean, summary.ci95)


def change_of_level(change: ArrayLike, base: ArrayLike, *, runs: int | None = None) -> PairedDifference:
    """Mean return of a change, with its interval at the level of `base`.

    How rough a road is moves all returns alike and their ratio hardly. The interval is given in units of return, at the
    level that `base` has on these runs: divided by its return it is that of the ratio (to first order in the rest,
    change − ratio · base). It does not cover the change on rougher or calmer runs. Where rewards of `base` have both
    signs there is no level, and the interval is that of the change alone.
    """
    changed, level = _alike(change=change, base=base)
    whole = float(level.sum())
    one_sign = not ((level > 0).any() and (level < 0).any())
    ratio = float(changed.sum()) / whole if one_sign and whole != 0 else 0.0
    rest = summarise_returns(changed - ratio * level, runs=runs)
    mean = float(changed.sum(axis=1).mean()) if len(changed) else float("nan")
    low, high = (mean + end - rest.mean for end in rest.ci95)
    return PairedDifference(mean, (low, high))


def _rewards(argument: str, value: ArrayLike) -> Array:
    """Rewards (n, T); n may be 0."""
    rewards = as_finite(argument, as_floats(argument, value))
    if rewards.ndim != 2:
        raise InputError(argument, f"shape {rewards.shape}", "(n, T)")
    return rewards


def _alike(**given: ArrayLike) -> list[Array]:
    """Rewards of the same shape (n, T)."""
    pair = [_rewards(name, value) for name, value in given.items()]
    if pair[0].shape != pair[1].shape:
        raise InputError(", ".join(given), f"shapes {pair[0].shape} and {pair[1].shape}", "as many of each")
    return pair


def _together(table: Array) -> tuple[float, float]:
    """Variance of the mean by what rows and columns of (S, N) do together, and its degrees of freedom."""
    kept = ~np.isnan(table)
    full = table[np.ix_(kept.any(axis=1), kept.any(axis=0))]
    rows, columns = kept_means(full, 1), kept_means(full, 0)
    rest = (full - rows[:, None] - columns + rows.mean())[~np.isnan(full)]
    free = max(rest.size - len(rows) - len(columns) + 1.0, 1.0)
    return float(rest @ rest) / free / rest.size, free


def _skewness_and_degrees(values: Array) -> tuple[float, float]:
    """Skewness of the mean of values (n,), and degrees of freedom of their variance, by their kurtosis."""
    away = values - values.mean()
    spread = away.std()
    if not spread > 0:
        return 0.0, float("inf")
    excess = float(((away / spread) ** 4).mean()) - 1
    skewness = float(((away / spread) ** 3).mean() / np.sqrt(len(values)))
    return skewness, 2 * len(values) / excess if excess > 0 else float("inf")


def _skewed(mean: float, error: float, skewness: float, degrees: float, level: float = 0.95) -> tuple[float, float]:
    """Student's t interval of a skewed mean (Hall's cubic, inverted)."""
    quantile = float(stats.t.ppf((1 + level) / 2, degrees))
    if abs(skewness) < 1e-6:
        return (mean - error * quantile, mean + error * quantile)
    low, high = (3 / skewness * (np.cbrt(1 + skewness * (t - skewness / 6)) - 1) for t in (quantile, -quantile))
    return (mean - error * float(low), mean - error * float(high))
