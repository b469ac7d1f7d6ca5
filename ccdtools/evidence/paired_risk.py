"""What a change brings in the risk that was asked for, with an interval: each group of runs left out once.

A mean over runs has an interval because every run has its part in it. So has every other risk: the part of a group of
runs is how far the risk moves when they are left out.

References
----------
Efron and Stein, "The jackknife estimate of variance", Annals of Statistics 9(3), 1981. Shao and Wu, "A general theory
for jackknife variance estimation", Annals of Statistics 17(3), 1989 (functions that are not smooth, such as quantiles).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ccdtools.arrays import Array
from ccdtools.co_design.risk import Mean, Risk
from ccdtools.evidence.groups import paired_over_groups
from ccdtools.statistics import PairedDifference, mean_interval, summarise

Labels = NDArray[np.int64]


def parts_of_risk(risk: Risk, returns: Array, labels: Labels | None = None) -> Array:
    """The part that every group of runs has in a risk of their returns (n,), (g,): their mean is the risk.

    Of the mean, and of runs that are groups of their own, these are the returns. NaN of a single group.

    Parameters
    ----------
    labels : (n,) int array, optional
        The group of every run; by default each is one of its own. The parts are in the order of the labels.
    """
    groups = np.arange(len(returns)) if labels is None else np.unique(labels)
    own = groups if labels is None else labels
    if len(groups) < 2:
        return np.full(len(groups), np.nan)
    rest = np.array([float(risk.values(returns[own != group]).mean()) for group in groups])
    return float(risk.values(returns).mean()) + (len(groups) - 1) * (rest.mean() - rest)


def paired_in_risk(
    risk: Risk, after: Array, before: Array, labels: Labels, *, runs: int, stretch: int
) -> PairedDifference:
    """Difference of the risk of two controllers on the same runs, with the 95 % interval over groups of runs.

    Of a deployment of one run the returns of its stretches take the place of those of runs, scaled to its whole length.

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
        return PairedDifference(found.mean, found.ci95)
    parts = [parts_of_risk(risk, rewards.sum(axis=1), labels) for rewards in (after, before)]
    summary = summarise(parts[0] - parts[1])
    return PairedDifference(summary.mean, summary.ci95)


def stretches(rewards: Array, stretch: int) -> Array:
    """Returns (m,) of whole stretches within consecutive parts of a run, with rewards (k, T)."""
    length = min(stretch, rewards.shape[1])
    count = rewards.shape[1] // length
    return rewards[:, : count * length].reshape(-1, length).sum(axis=1)
