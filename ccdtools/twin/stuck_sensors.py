"""Sensors that repeat a value, or leap, more often than their noise allows."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import median_abs_deviation, norm

from ccdtools.arrays import Array, Indices


class _Rows(NamedTuple):
    """Rows of one value that a sensor told again and again, (k,) each."""

    run: Indices
    first: Indices  # sample
    told: Indices  # number of samples
    number: Array  # of repeats
    leap: Array  # the smaller of the changes into the row and out of it


def warn_of_stuck(
    argument: str, signals: Array, inputs: Array, names: Sequence[str], deviations: Callable[[], Array], *,
    level: float = 1e-6,
) -> None:  # fmt: skip
    """Warn of signals that repeat a value more often than chance does in one of 1 / `level` logs.

    Gaussian noise of deviation σ, rounded to steps of q, repeats a value with probability 2 Φ(q / 2σ) − 1 at most,
    wherever the signal is. So L repeats begin at one of N samples with probability N (2 Φ(q / 2σ) − 1)^L at most; q is
    the least difference of two values of the run, or of all runs where none comes back. The smaller of the changes into
    the repeats and out of them, less q, takes the place of a larger σ: a plant without noise comes to rest in small
    steps, and leaves its rest by one push. A step in which nothing else changes either, as while an input is held, is
    no repeat.

    Parameters
    ----------
    signals : (n, T, m) array
        NaN where a sensor told nothing: its last value stands beside its next.
    inputs : (n, T, nu) array
    deviations : callable
        () → (m,) array of σ, of what a sample brings beyond all before it; asked only if a value is repeated.
    """
    rows = _rows(signals, inputs)
    if not any(one.number.any() for one in rows):
        return
    sigma = deviations()
    for j, one in enumerate(rows):
        if not one.number.any():
            continue
        step, told = _resolution(signals[:, :, j])[one.run], one.told.sum()
        moves = np.minimum(sigma[j], one.leap - step)
        seldom = 2 * norm.cdf(step / (2 * np.where(moves > 0, moves, np.nan))) - 1
        chance = np.where(moves > 0, told * seldom**one.number, np.inf)
        if chance.min(initial=np.inf) <= level / len(names):
            k = int(chance.argmin())
            run, first, samples = (int(each[k]) for each in one[:3])
            said = f"{names[j]} repeats {signals[run, first, j] + 0.0:g} over {samples} samples, from {first}"
            expected = f"noise of their size leaves that to chance in less than one of {1 / level:.0e} logs"
            cure = (
                "A sensor is stuck, or coarser than its noise, or the plant stands there: put NaN if it says nothing."
            )
            warnings.warn(f"{argument}: {said} of run {run}; {expected}. {cure}", UserWarning, stacklevel=4)


def _rows(signals: Array, inputs: Array) -> list[_Rows]:
    """Rows of every sensor."""
    told = np.isfinite(signals)
    last = np.maximum.accumulate(np.where(told, np.arange(signals.shape[1])[:, None], 0), axis=1)
    channels = np.concatenate([np.take_along_axis(signals, last, axis=1), inputs], axis=2)
    before, after = channels[:, :-1], channels[:, 1:]
    changed = np.pad((before != after) & ~np.isnan(before), ((0, 0), (1, 0), (0, 0)))
    changes, found = changed.sum(axis=2), []
    for j in range(signals.shape[2]):
        others = np.cumsum(changes > changed[:, :, j], axis=1)
        run, sample = np.nonzero(told[:, :, j])
        value, moves = signals[run, sample, j], others[run, sample]
        begins = np.flatnonzero(np.append(True, (np.diff(run) != 0) | (np.diff(value) != 0))[: len(run)])
        ends = np.append(begins[1:], len(run))[: len(begins)] - 1
        repeats = np.append(0, np.cumsum(np.diff(moves) > 0))
        leap = np.where(np.diff(run[begins]) == 0, np.abs(np.diff(value[begins])), np.inf)
        leap = np.minimum(np.append(np.inf, leap), np.append(leap, np.inf))[: len(begins)]
        found.append(_Rows(run[begins], sample[begins], ends - begins + 1, repeats[ends] - repeats[begins], leap))
    return found


def warn_of_spikes(argument: str, innovations: Sequence[Array], names: Sequence[str], *, level: float = 1e-3) -> None:
    """Warn of innovations (n, T, m), in their deviations, that are thrice as large as normal ones are by chance.

    The largest of a log's is larger than that chance with probability `level`.
    """
    for i, one in enumerate(innovations):
        far = np.argwhere(np.abs(one) > 3 * norm.isf(level / 2 / max(one.size, 1)))
        for run, k, j in far[:1]:
            said = f"{names[j]} is {abs(one[run, k, j]):.0f} deviations from what a fit foretells"
            said += f" in sample {k} of run {run} of those kept"
            more = f", and {len(far) - 1} other values are as odd" if len(far) > 1 else ""
            cure = "Put NaN where a sensor leaps: a fit takes it for noise of all samples."
            warnings.warn(f"{argument}[{i}]: {said}{more}. {cure}", UserWarning, stacklevel=3)


def warn_of_leaps(
    argument: str, states: Array, errors: Array, past: Callable[[], Array], names: Sequence[str], *, level: float = 1e-3
) -> None:
    """Warn of states that are off alone: an error leads into them and one out of them, but none past them.

    A disturbance leads past them, too, unless the next one takes it back. Errors are odd where they are thrice as large
    as the largest of normal ones is but with probability `level`. Where neighbours, or others as large, are odd too,
    that is how the noise is.

    Parameters
    ----------
    states, errors : (n, T, nx) array
        x, and x⁺ less what x foretells.
    past : callable
        () → (n, T − 1, nx) array of x⁺⁺ less what x foretells; asked only where two errors in a row are odd.
    """
    chance = norm.isf(level / 2 / errors.size)
    step = np.array([_step(column) for column in np.moveaxis(states, 2, 0)])
    each = _in_deviations(errors, step)
    size = each.max(axis=2)
    odd, usual = size > 3 * chance, size < chance
    off = usual[:, :-3] & odd[:, 1:-2] & odd[:, 2:-1] & usual[:, 3:]
    if not off.any():
        return
    off &= _in_deviations(past(), step).max(axis=2)[:, 1:-1] < chance
    least = np.where(off, np.minimum(size[:, 1:-2], size[:, 2:-1]), 0.0)
    sizes = np.sort(least[off])
    as_odd = size.size - np.searchsorted(np.sort(size, axis=None), sizes)
    mostly = np.flatnonzero(3 * np.arange(len(sizes), 0, -1) > as_odd)  # each is two errors
    if len(mostly):
        run, k = np.argwhere(least == sizes[-1])[0] + (0, 1)
        j = int(each[run, k].argmax())
        value = states[run, k + 1, j]
        said = f"{names[j]} is {value:g} in sample {k + 1} of run {run} of those kept"
        said += f", where its neighbours foretell {value - errors[run, k, j]:g}"
        more = f", and {len(sizes) - mostly[0] - 1} others are as odd" if len(sizes) > mostly[0] + 1 else ""
        cure = "Where a sensor leaps, put what is foretold, or cut the log: it is taken for noise of all samples."
        warnings.warn(f"{argument}: {said}{more}. {cure}", UserWarning, stacklevel=4)


def _in_deviations(errors: Array, least: Array) -> Array:
    """Sizes of errors (n, T, nx) in their robust deviations, or the least ones (nx,)."""
    deviations = np.maximum(median_abs_deviation(errors, axis=(0, 1), scale="normal"), least)
    return np.abs(errors) / np.where(deviations > 0, deviations, np.inf)


def _step(signal: Array, rounding: float = 1.2e-7) -> float:
    """Least difference of two values, at least that of rounding: recorders have single precision."""
    seen = np.unique(signal[np.isfinite(signal)])
    steps = np.diff(seen)
    return float(max(steps.min() if len(steps) else 0.0, rounding * np.abs(seen).max(initial=0.0)))


def _resolution(signals: Array) -> Array:
    """Least difference of two values of each run (n, T), or of all where none of a run's comes back."""
    steps = np.array([_step(one) for one in signals])
    told = [one[np.isfinite(one)] for one in signals]
    entered = [one[np.diff(one, prepend=np.nan) != 0] for one in told]
    distinct, rows = np.array([(len(np.unique(one)), len(one)) for one in entered]).T
    least = steps[distinct > 1].min() if (distinct > 1).any() else steps
    return np.where(distinct < rows, steps, least)
