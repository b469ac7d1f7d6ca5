"""Runs that meet the same disturbance in every deployment: together they are one piece of evidence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ccdtools.arrays import Array
from ccdtools.statistics import PairedDifference, paired_returns
from ccdtools.twin.residuals import Residuals

EVERY = 2  # of several runs, from the first on, meets the same disturbance in every deployment


def common_runs(runs: int) -> slice:
    """The runs of a deployment that meet the same disturbances in every generation."""
    return slice(None, None, EVERY if runs > 1 else 1)


def is_common(numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether runs of these numbers in their deployment meet the same disturbance in every one."""
    return numbers % EVERY == 0


def groups(logs: Sequence[Residuals]) -> NDArray[np.int64]:
    """The group of every run of logs: its number where it met the same disturbance in all of them, else its own."""
    several = 1 + max(int(log.numbers.max()) for log in logs)
    own = [(k + 1) * several + log.numbers for k, log in enumerate(logs)]
    return np.concatenate([np.where(is_common(log.numbers), log.numbers, alone) for log, alone in zip(logs, own)])


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
