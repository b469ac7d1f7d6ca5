"""Sensors that repeat a value, or leap, more often than their noise allows."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import numpy as np
from scipy.stats import median_abs_deviation, norm

from ccdtools.arrays import Array, Mask


def warn_of_stuck(
    argument: str, signals: Array, inputs: Array, names: Sequence[str], deviations: Callable[[], Array], *,
    level: float = 1e-6,
) -> None:  # fmt: skip
    """Warn of signals that repeat a value more often than chance does in one of 1 / `level` logs.

    Gaussian noise of deviation σ, rounded to steps of q, repeats a value with probability 2 Φ(q / 2σ) − 1 at most,
    wherever the signal is. So L repeats begin at one of N samples with probability N (2 Φ(q / 2σ) − 1)^L at most; q is
    the least difference of two values of the signal, none of a signal of one value. The smaller of the changes into the
    repeats and out of them, less q, takes the place of a larger σ: a plant without noise comes to rest in small steps,
    and leaves its rest by one push. Steps in which nothing else changes either, as while an input is held, are not
    counted, and do not end a row of repeats.

    Parameters
    ----------
    signals : (n, T, m) array
        NaN where a sensor told nothing.
    inputs : (n, T, nu) array
    deviations : callable
        () → (m,) array of σ, of what a sample brings beyond all before it; asked only if a value is repeated.
    """
    still = np.diff(np.concatenate([signals, inputs], axis=2), axis=1) == 0
    paused = still.all(axis=2)
    repeats = still[:, :, : signals.shape[2]] & ~paused[:, :, None]
    if not repeats.any():
        return
    sigma = deviations()
    for j in map(int, np.flatnonzero(repeats.any(axis=(0, 1)) & (sigma > 0))):
        run, first, last, length = _longest(repeats[:, :, j], paused)
        step = _step(signals[run, :, j])
        around = np.abs(np.diff(signals[run, max(first - 1, 0) : last + 3, j])[[0, -1]])
        moves = np.min([sigma[j], *(around[around > 0] - step)])
        if not moves > 0:
            continue
        chance = repeats[:, :, j].size * (2 * norm.cdf(step / (2 * moves)) - 1) ** length
        if chance <= level / len(names):
            value, samples = signals[run, first, j], last + 2 - first
            said = f"{names[j]} repeats {value:g} over {samples} samples, from {first} of run {run}"
            expected = f"noise of their size leaves that to chance in less than one of {1 / level:.0e} logs"
            cure = (
                "A sensor is stuck, or coarser than its noise, or the plant stands there: put NaN if it says nothing."
            )
            warnings.warn(f"{argument}: {said}; {expected}. {cure}", UserWarning, stacklevel=4)


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
    return float(max(steps.min() if len(steps) else 0.0, rounding * np.abs(seen).max()))


def _longest(repeats: Mask, paused: Mask) -> tuple[int, int, int, int]:
    """Run, first and last step, and number of the longest row of repeats (n, T), which pauses (n, T) do not end."""
    begins = np.pad(~(repeats | paused), ((0, 0), (1, 0)), constant_values=True)  # so rows end with their run
    row = np.cumsum(begins) - 1
    counted = np.pad(repeats, ((0, 0), (1, 0))).ravel()
    number = np.bincount(row, weights=counted)
    places = np.flatnonzero(counted & (row == number.argmax()))
    run, first = divmod(int(places[0]), begins.shape[1])
    return run, first - 1, first - 1 + int(places[-1] - places[0]), len(places)
