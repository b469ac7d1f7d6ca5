"""Outputs that a log lost, and inputs that answered them."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import norm

from ccdtools.arrays import Array, Mask
from mpc.tolerances import NEGLIGIBLE


class Samples(NamedTuple):
    """Samples of a log, after the first of each run."""

    before: Array  # (N, m): a constant, states foretold, outputs told last, the input before
    innovations: Array  # (N, ny), 0 where an output is lost
    inputs: Array  # (N, nu)
    lost: Mask  # (N, ny)
    ahead: Mask  # (N,): whether an output is told from here on

    @classmethod
    def of(cls, outputs: Array, inputs: Array, foretold: Array, innovations: Array) -> Samples:
        """Samples of outputs, inputs, states foretold and innovations (n, T, ·)."""
        lost, steps = np.isnan(outputs), np.arange(outputs.shape[1])[:, None]
        some = np.asarray(np.isfinite(outputs).any(axis=2))
        ahead = np.maximum.accumulate(some[:, ::-1], axis=1)[:, ::-1]
        last = np.maximum.accumulate(np.where(lost, -1, steps), axis=1)
        held = np.where(last < 0, 0.0, np.take_along_axis(outputs, last.clip(0), axis=1))
        ones = np.ones((*ahead[:, 1:].shape, 1))
        before = np.concatenate([ones, foretold[:, 1:], held[:, :-1], inputs[:, :-1]], axis=2)
        columns: tuple[Any, ...] = (before, innovations[:, 1:], inputs[:, 1:], lost[:, 1:], ahead[:, 1:])
        return cls(*(one.reshape(ones.size, *one.shape[2:]) for one in columns))


def inputs_answered(
    logs: Sequence[Samples], laws: Sequence[Hashable], *, level: float = 1e-3, size: float = 0.01
) -> bool:
    """Whether inputs answered outputs that logs lost.

    They then are as far from a feedback of what is told, where an output is lost, as elsewhere without its innovation,
    and by more than a part `size` of their variance further than with it. The feedback is fitted to each, log by log;
    those that are too short for it count as one of their law. Where nearly every output follows a lost one, as of a
    sensor that is told at every fourth sample, inputs elsewhere know as much that the log does not, and nothing shows.
    """
    finite = [np.isfinite(one.before).all() and np.isfinite(one.innovations).all() for one in logs]
    if not all(finite):  # a filter diverged
        return False
    ny, nu = logs[0].innovations.shape[1], logs[0].inputs.shape[1]
    z = norm.isf(level / ny / nu)
    for j in range(ny):
        short = [(law, one) for law, one in zip(laws, logs) if not _enough(one, j)]
        rest = [
            Samples(*map(np.concatenate, zip(*(one for its, one in short if its == law))))
            for law in {law for law, _ in short}
        ]
        parts = [one for one in (*logs, *rest) if _enough(one, j)]
        if not parts:
            continue
        more, explained, least, variance = np.sum([_beside(one, j, size) for one in parts], axis=0)
        if (more > np.maximum.reduce([z * np.sqrt(variance), explained / 2, least])).any():
            return True
    return False


def _enough(samples: Samples, j: int) -> bool:
    """Whether there are samples enough for both feedbacks."""
    gaps, seen = samples.lost[:, j] & samples.ahead, ~samples.lost[:, j]
    width = samples.before.shape[1] + samples.innovations.shape[1]
    return bool(min(np.count_nonzero(gaps), np.count_nonzero(seen)) > 2 * width)


def _beside(samples: Samples, j: int, size: float) -> tuple[Array, Array, Array, Array]:
    """Sums over the gaps of samples.

    What inputs are further from a feedback there than elsewhere with the innovation; what that explains elsewhere; what
    counts; and the variance of the first.
    """
    before, innovations, inputs, lost, ahead = samples
    others = np.hstack([before, np.delete(innovations, j, axis=1)])
    told = np.hstack([others, innovations[:, j : j + 1]])
    gaps, seen = lost[:, j] & ahead, ~lost[:, j]
    of_gaps, of_others, of_all = (
        _unexplained(one[at], inputs[at]) for one, at in ((others, gaps), (others, seen), (told, seen))
    )
    count = len(of_gaps)
    more, explained = (count * (one.mean(axis=0) - of_all.mean(axis=0)) for one in (of_gaps, of_others))
    least = count * size * np.maximum(inputs.var(axis=0), NEGLIGIBLE * (inputs**2).mean(axis=0))
    variance = count**2 * (of_gaps.var(axis=0) / count + of_all.var(axis=0) / len(of_all))
    return more, explained, least, variance


def _unexplained(features: Array, inputs: Array) -> Array:
    """Squares (N, nu) of what a feedback of features leaves of inputs, for its degrees of freedom."""
    fitted, _, rank, _ = np.linalg.lstsq(features, inputs, rcond=None)
    return np.asarray((inputs - features @ fitted) ** 2 * (len(inputs) / (len(inputs) - rank)))
