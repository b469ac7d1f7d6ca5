"""Gain in risk, with a jackknife interval over groups of runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ccdtools.arrays import Array
from ccdtools.co_design.risk import Mean, Risk
from ccdtools.co_design.risk_intervals import difference_of_parts, parts_of_risk, too_few
from ccdtools.statistics import PairedDifference, mean_interval, paired_returns

Labels = NDArray[np.int64]


def paired_in_risk(
    risk: Risk, after: Array, before: Array, labels: Labels, *, runs: int, stretch: int
) -> PairedDifference:
    """Paired difference in risk with its 95 % interval over groups.

    Of a deployment of one run the returns of its stretches take the place of those of runs, scaled to its whole length.
    There is no interval where fewer than ten groups decide a risk that is not the mean.

    Parameters
    ----------
    risk : Risk
    after, before : (n, T) arrays
        Rewards of both; of one run, (k, T) of consecutive parts.
    labels : (n,) int array
        The group of every run: only groups are independent evidence.
    runs : int
        That were begun.
    stretch : int
        Length of a stretch of a single run: that of an episode.
    """
    if isinstance(risk, Mean):
        if runs == 1:
            after, before, labels = after.reshape(1, -1), before.reshape(1, -1), np.zeros(1, dtype=np.int64)
        return paired_over_groups(after, before, labels, runs=runs)
    if runs == 1:
        one, other = (stretches(rewards, stretch) for rewards in (after, before))
        if len(one) < 2:
            return PairedDifference(np.nan, (np.nan, np.nan))
        number = after.size / min(stretch, after.shape[1])
        found = mean_interval(number * (parts_of_risk(risk, one) - parts_of_risk(risk, other)))
        few = too_few(risk, np.arange(len(one)))
        return PairedDifference(found.mean, (np.nan, np.nan) if few else found.ci95)
    parts = [parts_of_risk(risk, rewards.sum(axis=1), labels) for rewards in (after, before)]
    return difference_of_parts(risk, parts[0] - parts[1], np.arange(len(parts[0])))


def stretches(rewards: Array, stretch: int) -> Array:
    """Returns (m,) of whole stretches in consecutive rewards (k, T)."""
    length = min(stretch, rewards.shape[1])
    count = rewards.shape[1] // length
    return rewards[:, : count * length].reshape(-1, length).sum(axis=1)


def paired_over_groups(after: Array, before: Array, labels: Labels, *, runs: int) -> PairedDifference:
    """Mean difference of returns over groups, from rewards (n, T), labels (n,).

    Only groups are independent evidence. Of one group the interval is that of its series, if no more runs were begun.
    """
    return paired_returns(*(_grouped(rewards, labels) for rewards in (after, before)), runs=runs)


def _grouped(rewards: Array, labels: Labels) -> Array:
    """Mean rewards (groups, T) of runs (n, T) with equal labels."""
    _, group, sizes = np.unique(labels, return_inverse=True, return_counts=True)
    means = np.zeros((len(sizes), rewards.shape[1]))
    np.add.at(means, group, rewards / sizes[group, None])
    return means
