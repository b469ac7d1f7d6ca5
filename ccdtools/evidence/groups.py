"""Runs in groups: only groups are independent evidence."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ccdtools.arrays import Array
from ccdtools.statistics import PairedDifference, paired_returns


def paired_over_groups(after: Array, before: Array, labels: NDArray[np.int64], *, runs: int) -> PairedDifference:
    """Mean difference of the returns of runs with rewards (n, T), over the groups that their labels (n,) tell.

    Only groups are independent evidence. Of one group the interval is that of its series, if no more runs were begun.
    """
    return paired_returns(*(_grouped(rewards, labels) for rewards in (after, before)), runs=runs)


def _grouped(rewards: Array, labels: NDArray[np.int64]) -> Array:
    """Mean rewards (groups, T) of the runs (n, T) with the same label."""
    _, group, sizes = np.unique(labels, return_inverse=True, return_counts=True)
    means = np.zeros((len(sizes), rewards.shape[1]))
    np.add.at(means, group, rewards / sizes[group, None])
    return means
