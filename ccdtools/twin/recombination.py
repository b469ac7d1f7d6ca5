"""New runs out of logged ones: where errors do not depend on each other in time, every step may be of another run."""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import ndtri

from ccdtools.arrays import Array

Indices = NDArray[np.int64]

FEWEST_BLOCKS = 6  # of runs: with fewer the interval of their mean is wide, with more there are few runs to recombine
SOME_BLOCKS = 10  # of six runs or more,
SOME_RUNS = 6
MOST_BLOCKS = 20  # of twelve runs or more
MANY_RUNS = 12
FEWEST_RUNS = 2  # of a block
LAGS = 30  # steps between two errors at which a correlation is looked for
SLIGHT = 0.03  # correlation at one lag that counts, beyond `SURE` standard errors,
SLIGHT_SURE = 2.5  # and standard errors of the variance of sums: it adds up what is small at every lag
PLAIN = 0.1  # correlation at one lag that is never recombined, beyond `SURE` standard errors,
PLAIN_SUMS = 0.5  # and relative change of the variance of sums
SURE = 4.0
ROUNDING = 1e-9  # of the largest |x|: an error below it is none


class Dependence(Enum):
    """What the errors of a log show of a dependence in time."""

    NONE = "none"
    SLIGHT = "slight"
    PLAIN = "plain"


def dependence(errors: Array, states: Array) -> Dependence:
    """How far errors (n, T, nx) depend on each other in time, along runs with `states` (n, T, nx).

    Looked at are the correlations at up to 30 lags, and the variance of sums over 2, 4, 8 … steps and over whole runs.
    Of every step the errors are replaced by the normal scores of their ranks among the runs: neither a loud start nor
    one spike of any size can hide what all the others show, and no unit matters. Errors that are rounding are none.
    """
    scores = _scores(errors[:, :, _seen(errors, states)])
    if scores.shape[2] == 0 or scores.shape[1] < 3 or scores.shape[0] < 3:
        return Dependence.NONE
    lags, chance = _lags(scores)
    sums, sums_chance = _sums(scores)
    if (lags > np.maximum(PLAIN, SURE * chance)).any() or (sums > np.maximum(PLAIN_SUMS, SURE * sums_chance)).any():
        return Dependence.PLAIN
    if (lags > np.maximum(SLIGHT, SURE * chance)).any() or (sums > SLIGHT_SURE * sums_chance).any():
        return Dependence.SLIGHT
    return Dependence.NONE


def _seen(errors: Array, states: Array) -> NDArray[np.bool_]:
    """The states (nx,) whose errors are more than rounding."""
    return np.abs(errors).max(axis=(0, 1)) > ROUNDING * np.abs(states).max(axis=(0, 1))


def _scores(errors: Array) -> Array:
    """Normal scores (n, T, ·) of the ranks of errors among the runs, of mean zero and variance one at every step."""
    scores: Array = ndtri((stats.rankdata(errors, axis=0) - 0.5) / len(errors))
    size = scores.std(axis=0)
    return (scores - scores.mean(axis=0)) / np.where(size > 0, size, 1.0)


def _lags(scores: Array) -> tuple[Array, Array]:
    """The largest correlation of any state at every lag, without its sign, and its standard error by chance."""
    runs, steps, _ = scores.shape
    lags = np.arange(1, min(LAGS, steps - 1) + 1)
    found = np.array([np.abs((scores[:, k:] * scores[:, :-k]).mean(axis=(0, 1))).max() for k in lags])
    return found, 1 / np.sqrt(runs * (steps - lags))


def _sums(scores: Array) -> tuple[Array, Array]:
    """The largest relative change, of any state, of the variance of sums over some lengths, and its standard error.

    A sum over L steps holds the correlation at lag k with the weight 2 (1 − k/L); near L = T there are few sums.
    """
    runs, steps, _ = scores.shape
    lengths = np.unique([*(2 ** np.arange(1, int(np.log2(steps)) + 1)), steps])
    total = np.cumsum(np.pad(scores, ((0, 0), (1, 0), (0, 0))), axis=1)
    found = [np.abs(np.square(total[:, k:] - total[:, :-k]).mean(axis=(0, 1)) / k - 1).max() for k in lengths]
    weights = (lengths - 1) * (2 * lengths - 1) / (1.5 * lengths)
    return np.array(found), np.sqrt(weights / (runs * steps) * (1 + lengths / (2 * steps)))


def dealt(numbers: Indices) -> Indices | None:
    """The block of every run by its number in the deployment; None where the runs are too few.

    Runs of one number, in several deployments, are of one block. Neighbours are dealt in pairs: every second run meets
    the same disturbance in every deployment, and blocks should be alike.
    """
    several = len(np.unique(numbers))
    if several < FEWEST_BLOCKS * FEWEST_RUNS:
        return None
    pairs = np.unique(numbers // 2, return_inverse=True)[1]
    some = np.clip(several // SOME_RUNS, FEWEST_BLOCKS, SOME_BLOCKS)
    return pairs % int(max(some, min(several // MANY_RUNS, MOST_BLOCKS)))


def shuffled(blocks: Indices, steps: int, rng: np.random.Generator) -> Indices:
    """The logged run (n, T) that gives every step of n recombined runs: each error of a block goes to one of its runs.

    The first step stays with its initial state. As every error is met once, what is additive in them is as logged.
    """
    source = np.tile(np.arange(len(blocks))[:, None], (1, steps))
    for block in np.unique(blocks):
        members = np.flatnonzero(blocks == block)
        source[members, 1:] = members[np.argsort(rng.random((len(members), steps - 1)), axis=0)]
    return source


def drawn(first: Indices, runs: int, steps: int, rng: np.random.Generator) -> Indices:
    """The logged run (n, T), out of so many, that gives every step of n recombined runs; at the first step `first`."""
    source = rng.integers(0, runs, (len(first), steps))
    source[:, 0] = first
    return source
