"""Means over seeds and runs, with their intervals."""

from __future__ import annotations

import numpy as np
from scipy.stats.mstats import trimmed_mean, trimmed_mean_ci

from ccdtools.arrays import Array
from ccdtools.comparison.budgets import FEWEST_TRIMMED
from ccdtools.statistics import PairedDifference, interval_of_parts, summarise_returns

QUARTERS = (0.25, 0.25)


def mean_over_seeds(values: Array, *, fresh: bool, series: Array | None = None) -> PairedDifference:
    """Mean of values (seeds, runs) with its 95 % interval.

    Where each seed draws runs of its own, the means of seeds are what is independent. Where all seeds meet the same
    runs, chance enters twice, by what was trained and by the runs: squares of the half-widths are added.

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
    of_seeds = means(values, axis=1)
    if not len(of_seeds):
        return PairedDifference(np.nan, (np.nan, np.nan))
    away = [_away(of_seeds)] if len(values) > 1 else []
    if not fresh or len(values) == 1:
        away.append(_away_of_runs(values, series, fresh))
    low, high = np.sqrt((np.array(away) ** 2).sum(axis=0))
    mean = float(of_seeds.mean())
    return PairedDifference(mean, (mean - float(low), mean + float(high)))


def interquartile_mean(values: Array) -> PairedDifference:
    """Interquartile mean over seeds, or over one seed's runs.

    Values are (S, N), minus infinity for a lost run. The interval is that of a trimmed mean, by the winsorised
    variance; NaN where nothing is trimmed. It covers more often than a bootstrap of few seeds.

    References
    ----------
    Tukey and McLaughlin, Sankhyā A 25, 1963; Agarwal et al., Deep reinforcement learning at the edge of the statistical
    precipice, 2021 (why the middle half).
    """
    parts = means(values, axis=1) if len(values) > 1 else means(values, axis=0)
    if not len(parts):
        return PairedDifference(np.nan, (np.nan, np.nan))
    middle = float(trimmed_mean(parts, QUARTERS))
    if len(parts) < FEWEST_TRIMMED or not np.isfinite(middle):
        return PairedDifference(middle, (np.nan, np.nan))
    low, high = trimmed_mean_ci(parts, QUARTERS)
    return PairedDifference(middle, (float(low), float(high)))


def means(values: Array, axis: int) -> Array:
    """Means of what counts along an axis, where anything does."""
    kept = ~np.isnan(values)
    number = kept.sum(axis=axis)
    total = np.where(kept, values, 0.0).sum(axis=axis)
    return np.asarray(total[number > 0] / number[number > 0])


def _away_of_runs(values: Array, series: Array | None, fresh: bool) -> tuple[float, float]:
    """Half-widths below and above by the runs that all seeds meet; unknown of one that was drawn."""
    if values.shape[1] > 1:
        return _away(means(values, axis=0))
    if series is None:
        return (np.nan, np.nan) if fresh else (0.0, 0.0)
    found = summarise_returns(series[None])
    return found.mean - found.ci95[0], found.ci95[1] - found.mean


def _away(parts: Array) -> tuple[float, float]:
    """Half-widths below and above of the mean of independent parts."""
    low, high = interval_of_parts(parts)
    return float(parts.mean()) - low, high - float(parts.mean())
