"""Means over seeds and runs, with their intervals."""

from __future__ import annotations

import numpy as np
from scipy.stats import beta, t as student
from scipy.stats.mstats import trimmed_mean, trimmed_mean_ci

from ccdtools.arrays import Array
from ccdtools.statistics import (
    PairedDifference,
    interval_of_crossed,
    kept_means,
    summarise_returns,
    variance_of_crossed,
)

QUARTERS = (0.25, 0.25)


def mean_over_seeds(values: Array, *, fresh: bool, series: Array | None = None) -> PairedDifference:
    """Mean of values (seeds, runs) with its 95 % interval.

    Where each seed draws runs of its own, the means of seeds are what is independent. Where all seeds meet the same
    runs, both are sources of chance: see `interval_of_crossed`. Beside one single run, squares of half-widths by seeds
    and by the parts of the run are added.

    Parameters
    ----------
    values : (S, N) array
        NaN marks what does not count, such as a lost run.
    fresh : bool
        Whether each seed draws runs of its own.
    series : (T,) array, optional
        Of the same single run in all seeds: its parts in time, averaged over the seeds. Without it such a run is taken
        as the only one that there is.
    """
    of_seeds = kept_means(values, axis=1)
    if not len(of_seeds):
        return PairedDifference(np.nan, (np.nan, np.nan))
    mean = float(of_seeds.mean())
    nested = fresh and len(values) > 1
    if nested or values.shape[1] > 1:
        return PairedDifference(mean, interval_of_crossed(of_seeds[:, None] if nested else values))
    away = [] if fresh else [(0.0, 0.0)]
    if len(values) > 1:
        away.append(_away(mean, interval_of_crossed(values)))
    if series is not None:
        found = summarise_returns(series[None])
        away.append(_away(found.mean, found.ci95))
    low, high = np.sqrt((np.array(away) ** 2).sum(axis=0)) if away else (np.nan, np.nan)
    return PairedDifference(mean, (mean - float(low), mean + float(high)))


def share_over_seeds(values: Array, *, fresh: bool) -> PairedDifference:
    """Mean of shares in [0, 1] (seeds, runs) with its 95 % interval, which is no point where all agree.

    Clopper and Pearson's, of as many runs as a share of this variance would have if they were independent: no more than
    there are, and no less than what surely is independent, seeds that draw runs of their own, or else the fewer of
    seeds and runs. Runs of a single seed are as many as they are.

    Parameters
    ----------
    values : (S, N) array
        NaN marks what does not count.
    fresh : bool
        Whether each seed draws runs of its own.

    References
    ----------
    Clopper and Pearson, Biometrika 26, 1934; Korn and Graubard, Survey Methodology 24, 1998 (the number of runs).
    """
    of_seeds = kept_means(values, axis=1)
    if not len(of_seeds):
        return PairedDifference(np.nan, (np.nan, np.nan))
    mean, runs = float(of_seeds.mean()), int((~np.isnan(values)).sum())
    table = of_seeds[:, None] if fresh and len(values) > 1 else values
    least = min((size for size in (len(of_seeds), len(kept_means(table, axis=0))) if size > 1), default=1)
    few = np.square(student.isf(0.025, runs - 1) / student.isf(0.025, least - 1))
    variance = variance_of_crossed(table) * (least - 1) / least
    alike = few * mean * (1 - mean) / variance if variance > 0 else least  # without variance nothing is known of it
    counted = np.clip(alike, least, runs)
    won = mean * counted
    low, high = beta.ppf(0.025, won, counted - won + 1), beta.ppf(0.975, won + 1, counted - won)
    return PairedDifference(mean, (float(np.nan_to_num(low)), float(np.nan_to_num(high, nan=1.0))))


def interquartile_mean(values: Array) -> PairedDifference:
    """Interquartile mean over seeds, or over one seed's runs.

    Values are (S, N), minus infinity for a lost run. The interval is that of a trimmed mean, by the winsorised
    variance; NaN where nothing is trimmed. It covers more often than a bootstrap of few seeds.

    References
    ----------
    Tukey and McLaughlin, Sankhyā A 25, 1963; Agarwal et al., Deep reinforcement learning at the edge of the statistical
    precipice, 2021 (why the middle half).
    """
    parts = kept_means(values, axis=1) if len(values) > 1 else kept_means(values, axis=0)
    if not len(parts):
        return PairedDifference(np.nan, (np.nan, np.nan))
    middle = float(trimmed_mean(parts, QUARTERS))
    if int(QUARTERS[0] * len(parts)) == 0 or not np.isfinite(middle):  # nothing is trimmed
        return PairedDifference(middle, (np.nan, np.nan))
    low, high = trimmed_mean_ci(parts, QUARTERS)
    return PairedDifference(middle, (float(low), float(high)))


def _away(mean: float, ends: tuple[float, float]) -> tuple[float, float]:
    """Half-widths below and above."""
    return mean - ends[0], ends[1] - mean
