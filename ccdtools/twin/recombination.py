"""New runs out of logged ones: where errors do not depend on each other in time, every step may be of another run."""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.fft import next_fast_len
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
FALSE_ALARM = 0.1  # of logs without any dependence that are said to have one, over all that is looked at together,
SUMS = 0.6  # of it by sums of the errors themselves, which add up what is small at every lag,
LOOKS = 0.2  # and each by all other sums, and by single lags
SLIGHT = 0.03  # correlation at one lag that counts, beyond chance
PLAIN = 0.1  # correlation at one lag that is never recombined, beyond chance,
PLAIN_SUMS = 0.5  # and relative change of the variance of sums,
PLAIN_ALARM = 1e-3  # which is said of so many logs without any dependence
ROUNDING = 1e-9  # of the largest |x|: errors that differ by less among the runs tell nothing
NUMBERS_AT_ONCE = 4_000_000  # of spectra that are in memory


class Dependence(Enum):
    """What the errors of a log show of a dependence in time."""

    NONE = "none"
    SLIGHT = "slight"
    PLAIN = "plain"


def dependence(errors: Array, states: Array) -> Dependence:
    """How far errors (n, T, nx) depend on each other in time, along runs with `states` (n, T, nx).

    Looked at are the correlations between all states, and between their sizes |e|, at up to 30 lags, and the
    covariances of sums over 2, 4, 8 … steps and over whole runs. Of every step the errors are replaced by the normal
    scores of their ranks among the runs: neither a loud start nor one spike of any size can hide what all the others
    show, and no unit matters. Errors that are the same in all runs, or up to rounding, are left out step by step.
    """
    runs, steps, nx = errors.shape
    if steps < 3 or runs < 3:
        return Dependence.NONE
    sizes = np.abs(errors - np.median(errors, axis=0))
    both = np.concatenate([errors, sizes], axis=2)
    seen = np.ptp(both, axis=0) > ROUNDING * np.tile(np.abs(states).max(axis=(0, 1)), 2)
    scores = seen * _scores(both)
    if not seen.any():
        return Dependence.NONE
    found, chance = _correlations(scores, seen)
    sums, sums_chance = _sums(found, chance)
    own = np.arange(2 * nx) < nx
    itself = np.outer(own, own)
    looks = (
        (np.abs(found[1 : LAGS + 1]), chance[1 : LAGS + 1], LOOKS, SLIGHT, PLAIN),
        (sums[:, itself], sums_chance[:, itself], SUMS, 0.0, PLAIN_SUMS),
        (sums[:, ~itself], sums_chance[:, ~itself], LOOKS, 0.0, PLAIN_SUMS),
    )
    if any(_beyond(value, error, plain, share * PLAIN_ALARM) for value, error, share, _, plain in looks):
        return Dependence.PLAIN
    if any(_beyond(value, error, slight, share * FALSE_ALARM) for value, error, share, slight, _ in looks):
        return Dependence.SLIGHT
    return Dependence.NONE


def _scores(errors: Array) -> Array:
    """Normal scores (n, T, ·) of the ranks of errors among the runs, of mean zero and variance one at every step."""
    scores: Array = ndtri((stats.rankdata(errors, axis=0) - 0.5) / len(errors))
    size = scores.std(axis=0)
    return (scores - scores.mean(axis=0)) / np.where(size > 0, size, 1.0)


def _correlations(scores: Array, seen: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Correlations (T, ·, ·) of scores k steps later with scores, over what is seen, and their errors by chance.

    Under independence products of scores have variance one and no correlation, whatever that of the states at one step.
    The error is infinite where nothing is seen k steps apart.
    """
    pairs = np.round(_lagged(seen[None].astype(float)))
    count = np.where(pairs > 0, pairs, np.inf)
    return _lagged(scores) / (len(scores) * count), np.where(pairs > 0, 1 / np.sqrt((len(scores) - 1) * count), np.inf)


def _lagged(values: Array) -> Array:
    """Sums (T, ·, ·) over runs (n, T, ·) and steps of the values k steps later times the values."""
    runs, steps, several = values.shape
    length = next_fast_len(2 * steps, real=True)
    spectrum = np.zeros((length // 2 + 1, several, several), dtype=complex)
    at_once = max(NUMBERS_AT_ONCE // (length * several), 1)
    for begun in range(0, runs, at_once):
        waves = np.fft.rfft(values[begun : begun + at_once], length, axis=1).transpose(1, 2, 0)
        spectrum += waves @ waves.conj().transpose(0, 2, 1)
    lagged: Array = np.fft.irfft(spectrum, length, axis=0)[:steps]
    return lagged


def _sums(found: Array, chance: Array) -> tuple[Array, Array]:
    """Changes (lengths, ·, ·) of the covariances of sums over some lengths against no dependence, without their sign.

    A sum over L steps holds the correlations at lag k with the weight 1 − k/L, those of either state with the other
    later. With them come their errors by chance: that of both together depends on the correlation at one step.
    """
    steps = len(found)
    lengths = np.unique([*(2 ** np.arange(1, int(np.log2(steps)) + 1)), steps])
    weights = np.maximum(1 - np.arange(steps) / lengths[:, None], 0)
    weights[:, 0] = 0
    both = found + found.transpose(0, 2, 1)
    known = np.isfinite(chance)
    variance = np.where(known, chance, 0.0) ** 2
    spread = (variance + variance.transpose(0, 2, 1)) * (1 + found[0] ** 2)
    change, error = (np.tensordot(w, v, 1) for w, v in ((weights, both), (weights**2, spread)))
    return np.abs(change), np.where(error > 0, np.sqrt(error), np.inf)


def _beyond(found: Array, chance: Array, least: float, alarm: float) -> bool:
    """Whether any of what was found is more than `least` and more than chance, by so many false alarms of them all."""
    sure = -ndtri(alarm / (2 * max(np.isfinite(chance).sum(), 1)))
    return bool((found > np.maximum(least, sure * chance)).any())


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
