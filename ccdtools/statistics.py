"""Means, intervals and paired differences of returns: of many independent runs, and of one long run."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats
from scipy.fft import dct
from scipy.optimize import brentq

from ccdtools.arrays import Array
from ccdtools.checks import as_array, as_floats, finite
from ccdtools.exceptions import InputError

BATCHES = 20  # parts of a series between which correlation is looked for
SHORTEST = 20  # samples of a series that an interval is built from
START = 0.05  # part of a series that counts in the mean but not in its variance: a transient is no noise
FEWEST, MOST = 2, 6  # frequencies that the variance at frequency zero is estimated from
PER_FREQUENCY = 2.5  # correlation times for each of them: there the spectrum is still that at zero
DOUBT = 0.1  # added to the autocorrelation before they are counted, half of its standard error: too few cost little
SAME_RETURN = 1e-6  # part of a return: smaller differences are rounding and the tolerances of solvers
ENOUGH = 4.0  # correlation times, below which a series says too little about its own mean


@dataclass(frozen=True)
class Summary:
    """Mean, standard deviation, median, number and 95 % interval of the mean; NaN where there are too few values."""

    mean: float
    std: float
    median: float
    n: int
    ci95: tuple[float, float]


@dataclass(frozen=True)
class PairedDifference:
    """Mean difference on common random numbers with its 95 % interval."""

    mean: float
    ci95: tuple[float, float]


def summarise(values: ArrayLike) -> Summary:
    """Statistics of independent values (n,), by Student's t."""
    v = as_floats("values", values)
    if v.ndim != 1:
        raise InputError("values", f"shape {v.shape}", "(n,)")
    if len(v) == 0:
        return Summary(np.nan, np.nan, np.nan, 0, (np.nan, np.nan))
    std = float(v.std(ddof=1)) if len(v) > 1 else float("nan")
    mean = float(v.mean())
    return Summary(mean, std, float(np.median(v)), len(v), _interval(mean, std, len(v)))


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
    """Mean of a correlated series and the 95 % interval of its expectation.

    Attributes
    ----------
    mean : float
    ci95 : (float, float)
        NaN where the series is too short for its correlation: see `reliable`.
    std_error : float
        Standard deviation of the mean.
    correlation_times : float
        Length of the series in correlation times (the sum of its autocorrelation over all lags, both signs), as far
        as the series shows them; infinite where its twentieths look independent.
    """

    mean: float
    ci95: tuple[float, float]
    std_error: float
    correlation_times: float

    @property
    def reliable(self) -> bool:
        """Whether the series is long enough for an interval."""
        return bool(np.isfinite(self.ci95).all())


def mean_interval(series: ArrayLike) -> MeanInterval:
    """The mean of a stationary, correlated series with the 95 % interval of its expectation.

    The variance of the mean is the spectrum at frequency zero, here the mean square of the first 2 to 6 cosine
    transforms: as many as the correlation between the twentieths of the series allows, with Student's t for so few.
    The interval is skewed as the mean is. The first 5 % of the series are left out of the variance (a start is not
    noise), not out of the mean.

    A series shows only what it repeats: variation slower than a few times its length (another driver, another road)
    is in no interval of a single run.

    Parameters
    ----------
    series : (n,) array_like
        In the order of time: rewards of one run, the difference of two on the same disturbance, or the returns of
        consecutive windows.

    Returns
    -------
    MeanInterval
        Without an interval where n < 20, or where the series seems to hold fewer than 4 correlation times (it takes
        about 10 for the interval to cover as often as it says).

    Raises
    ------
    InputError
        If the series is not a vector of finite numbers.

    References
    ----------
    Lazarus, Lewis, Stock and Watson, HAR inference: recommendations for practice, Journal of Business & Economic
    Statistics 36(4), 2018 (cosines, Student's t); Marriott and Pope, Biometrika 41, 1954 (bias of autocorrelations);
    Hall, On the removal of skewness by transformation, Journal of the Royal Statistical Society B 54, 1992.
    """
    values = finite("series", as_array("series", series, ("n",)))
    mean = float(values.mean()) if len(values) else float("nan")
    settled = values[int(START * len(values)) :]
    if len(values) < SHORTEST:
        return MeanInterval(mean, (np.nan, np.nan), np.nan, np.nan)
    if np.ptp(settled) == 0:
        return MeanInterval(mean, (mean, mean), 0.0, np.inf)
    means = _batch_means(settled)
    lag_one = _lag_one(means)
    times = _correlation_times(lag_one)
    degrees = int(np.clip(_correlation_times(lag_one + DOUBT) / PER_FREQUENCY, FEWEST, MOST))
    cosines = dct(settled, norm="ortho")[1 : degrees + 1]
    error = float(np.sqrt((cosines**2).mean() / len(values)))
    if times < ENOUGH:
        return MeanInterval(mean, (np.nan, np.nan), error, times)
    quantile = float(stats.t.ppf(0.975, degrees))
    skewness = float(np.clip(stats.skew(means, bias=False) / np.sqrt(BATCHES), -1, 1))
    low, high = (mean - error * _unskewed(end, skewness) for end in (quantile, -quantile))
    return MeanInterval(mean, (low, high), error, times)


def summarise_returns(rewards: ArrayLike, *, runs: int | None = None) -> Summary:
    """Statistics of the returns of runs with rewards (n, T); one run has the interval of `mean_interval`.

    Of a single run `mean` and `median` are its return, `n` is 1 and `std` is the standard deviation of the return
    from run to run, as far as one run shows it.

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
    return Summary(total, r.shape[1] * of_mean.std_error, total, 1, (low, high))


def paired_returns(a: ArrayLike, b: ArrayLike, *, runs: int | None = None) -> PairedDifference:
    """Mean difference of the returns of runs with rewards (n, T) on common disturbances; see `summarise_returns`."""
    first = _rewards("a", a)
    second = _rewards("b", b)
    if first.shape != second.shape:
        raise InputError("a, b", f"shapes {first.shape} and {second.shape}", "as many of each")
    summary = summarise_returns(first - second, runs=runs)
    most = float(np.abs(first - second).sum())
    if len(first) == 1 and 0 < most <= SAME_RETURN * float(np.abs(second).sum()):
        return PairedDifference(summary.mean, (-most, most))  # no process, but rounding, which has this bound
    return PairedDifference(summary.mean, summary.ci95)


def change_of_level(change: ArrayLike, base: ArrayLike, *, runs: int | None = None) -> PairedDifference:
    """Mean return of a change, with the interval of its ratio to the return of `base`, both with rewards (n, T).

    How rough a road is moves all returns alike and their ratio hardly. The interval is given in units of return, at the
    level that `base` has on these runs: divided by its return it is that of the ratio (to first order in the rest,
    change − ratio · base). It does not cover the change on rougher or calmer runs. Where rewards of `base` have both
    signs there is no level, and the interval is that of the change alone.
    """
    changed = _rewards("change", change)
    level = _rewards("base", base)
    if changed.shape != level.shape:
        raise InputError("change, base", f"shapes {changed.shape} and {level.shape}", "as many of each")
    whole = float(level.sum())
    one_sign = not ((level > 0).any() and (level < 0).any())
    ratio = float(changed.sum()) / whole if one_sign and whole != 0 else 0.0
    rest = summarise_returns(changed - ratio * level, runs=runs)
    mean = float(changed.sum(axis=1).mean()) if len(changed) else float("nan")
    low, high = (mean + end - rest.mean for end in rest.ci95)
    return PairedDifference(mean, (low, high))


def _rewards(argument: str, value: ArrayLike) -> Array:
    """Rewards (n, T), n of them possibly none."""
    rewards = finite(argument, as_floats(argument, value))
    if rewards.ndim != 2:
        raise InputError(argument, f"shape {rewards.shape}", "(n, T)")
    return rewards


def _batch_means(values: Array) -> Array:
    """Means (20,) of consecutive parts of a series."""
    edges = np.linspace(0, len(values), BATCHES + 1).round().astype(int)
    return np.array([values[i:j].mean() for i, j in pairwise(edges)])


def _lag_one(means: Array) -> float:
    """Autocorrelation of batch means at lag one, its bias to first order taken off."""
    away = means - means.mean()
    lag_one = float(away[1:] @ away[:-1] / (away @ away)) if away.any() else 0.0
    return lag_one + (1 + 3 * lag_one) / BATCHES


def _correlation_times(lag_one: float) -> float:
    """Correlation times in a series whose batch means have this autocorrelation, taken as exponential in time."""
    if lag_one <= 0.01:
        return float("inf")
    highest = min(lag_one, 0.99)
    return BATCHES / 2 * float(brentq(lambda length: _neighbours(length) - highest, 1e-3, 1e3))


def _neighbours(length: float) -> float:
    """Autocorrelation at lag one of batch means of a process with autocorrelation exp(-t), of batches of a length."""
    return float(np.expm1(-length) ** 2 / (2 * (length + np.expm1(-length))))


def _unskewed(quantile: float, skewness: float) -> float:
    """The quantile of a mean with a small skewness, from that of a symmetric one (Hall's cubic, inverted)."""
    if abs(skewness) < 1e-6:
        return quantile
    return 3 / skewness * float(np.cbrt(1 + skewness * (quantile - skewness / 6)) - 1)


def _interval(mean: float, std: float, n: int) -> tuple[float, float]:
    """The 95 % interval of a mean of n values by Student's t; NaN below two."""
    if n < 2:
        return (float("nan"), float("nan"))
    half = float(stats.t.ppf(0.975, n - 1)) * std / float(np.sqrt(n))
    return (mean - half, mean + half)
