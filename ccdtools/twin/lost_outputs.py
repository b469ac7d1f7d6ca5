"""Outputs that a log lost, and inputs that answered them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.stats import binom, t

from ccdtools.arrays import Array, Mask
from ccdtools.estimation.innovations import Innovations
from ccdtools.twin.likelihood import information_rows
from mpc.tolerances import NEGLIGIBLE, ROUNDED_SUM


class Filtered(NamedTuple):
    """A log beside its filter."""

    outputs: Array  # (n, T, ny), NaN where one is lost
    inputs: Array  # (n, T, nu)
    innovations: Array  # (n, T, ny), 0 where an output is lost
    foretold: Array  # (n, T, nx)
    errors: Array  # (2 N,), innovations and squares less one, in units of their deviations
    slopes: Array  # (2 N, m)

    @classmethod
    def of(cls, part: Innovations, values: Array, outputs: Array) -> Filtered:
        """Log at values of the parameters."""
        with np.errstate(all="ignore"):  # a filter may diverge
            r, s, dr, ds = part.at(values)
            errors = np.concatenate([r / np.sqrt(s), (r**2 / s - 1) / np.sqrt(2)])
            return cls(outputs, part.inputs, *part.normalised(values), errors, information_rows(r, s, dr, ds))

    @property
    def lost(self) -> Mask:
        """(n, T, ny)."""
        return np.isnan(self.outputs)

    @property
    def between(self) -> Mask:
        """Samples (n, T) from the first to the last output."""
        some = np.asarray(np.isfinite(self.outputs).any(axis=2))
        return np.asarray(np.maximum.accumulate(some, axis=1) & np.maximum.accumulate(some[:, ::-1], axis=1)[:, ::-1])

    @property
    def told(self) -> Array:
        """What a linear law may feed back (n, T, ·)."""
        last = np.maximum.accumulate(np.where(self.lost, -1, np.arange(self.lost.shape[1])[:, None]), axis=1)
        held = np.where(last < 0, 0.0, np.take_along_axis(self.outputs, last.clip(0), axis=1))
        now = [self.foretold, self.innovations, held]
        return np.concatenate([*now, *map(_before, (held, self.innovations, self.inputs))], axis=2)


def inputs_answered(
    parts: Sequence[Innovations], outputs: Sequence[Array], values: Array, *, level: float = 0.02, size: float = 0.1
) -> bool:  # fmt: skip
    """Whether inputs answered outputs that logs lost.

    What they are beside a feedback of what is told then tells of the disturbance. So, summed over a gap, it tells the
    innovation after it, by a correlation of `size` and beyond chance: a score test (Rao 1948) beside the parameters
    that were fitted. Inputs that nothing lost drives pass it whatever their law, but for a part `level` of the logs;
    five times that where inputs follow what is told up to a gap and no longer at its end, as answers do.
    """
    if not any(np.isnan(one).any() for one in outputs):
        return False
    every = [Filtered.of(part, values, given) for part, given in zip(parts, outputs)]
    logs = [log for log in every if log.between.any() and all(np.isfinite(one).all() for one in log[1:])]
    if not logs:  # filters diverged
        return False
    errors = np.concatenate([np.split(log.errors, 2) for log in logs], axis=1)
    slopes = np.concatenate([np.split(log.slopes, 2) for log in logs], axis=1)
    known, _ = np.linalg.qr(_scaled(slopes.reshape(errors.size, -1)))
    ny, nu = logs[0].outputs.shape[2], logs[0].inputs.shape[2]
    beside = [_unexplained(logs, i) for i in range(ny)]
    for i, j in product(range(ny), range(nu)):
        gaps = [(log.lost[:, :, i], one[:, :, j]) for log, one in zip(logs, beside[i])]
        chance = (5 if _cease_to_follow(gaps) else 1) * level / ny**2 / nu
        sums = [_over_gaps(one, lost) for lost, one in gaps]
        for k in range(ny):
            rows = [_as_rows(one, log.lost, k) for log, one in zip(logs, sums)]
            moves = np.concatenate([*rows, np.zeros(errors.shape[1])])
            least = size * np.linalg.norm(moves) * np.sqrt(np.count_nonzero(moves))
            moves = moves - known @ (known.T @ moves)
            rises = (moves * errors.ravel()).reshape(2, -1).sum(axis=0)
            alike = np.sum(moves**2) ** 2 / max(np.sum(moves**4), np.finfo(float).tiny)  # samples of equal weight
            beyond = t.isf(chance / 2, max(alike, 1.0)) * np.linalg.norm(rises)
            if abs(rises.sum()) > max(beyond, least):
                return True
    return False


def _cease_to_follow(
    gaps: Sequence[tuple[Mask, Array]], *, level: float = 1e-3, most: float = 0.1, least: float = 0.02
) -> bool:  # fmt: skip
    """Whether inputs follow what is told, but at the end of gaps no longer.

    At more gaps than one in three they are there thrice as far from it, squared, as at both samples told last before,
    beyond chance. Were one of the three as good as another, that would be so at fewer.
    """
    squares = np.concatenate([beside[~lost] ** 2 for lost, beside in gaps])
    if squares.sum() > most * len(squares):
        return False
    ends, before = [np.zeros(0)], [np.zeros(0)]
    for lost, beside in gaps:
        last = np.maximum.accumulate(np.where(lost, -1, np.arange(lost.shape[1])), axis=1)
        run, end = np.nonzero(lost[:, :-1] & ~lost[:, 1:])
        first = last[run, end]
        second = np.where(first > 0, last[run, first - 1], -1)
        both = second >= 0
        at = [beside[run[both], one[both]] ** 2 for one in (end, first, second)]
        ends.append(at[0])
        before.append(np.maximum(at[1], at[2]))
    end, rest = np.concatenate(ends), np.concatenate(before)
    count = np.count_nonzero(end > 3 * rest)
    return bool(len(end) and np.median(end) > least and binom.sf(count - 1, len(end), 1 / 3) < level)


def _unexplained(logs: Sequence[Filtered], output: int, samples: int = 20) -> list[Array]:
    """Inputs (n, T, nu) less a feedback of what is told, another one where an output is lost.

    They are in units of their deviations, and the feedback is of each log; those that are short for it share one.
    """
    rows, inputs = [], [log.inputs[log.between] for log in logs]
    for log in logs:
        told = log.told[log.between]
        lost = log.lost[log.between, output][:, None]
        rows.append(np.hstack([told, lost, told * lost]))
    short = [i for i, one in enumerate(rows) if len(one) < samples * one.shape[1]]
    found = [np.zeros_like(log.inputs) for log in logs]
    for group in [[i] for i in range(len(logs)) if i not in short] + [short] * bool(short):
        X, U = (_scaled(np.concatenate([each[i] for i in group]), centred=True) for each in (rows, inputs))
        rest = np.sqrt(len(U)) * (U - X @ np.linalg.lstsq(X, U, rcond=NEGLIGIBLE)[0])
        for i, part in zip(group, np.split(rest, np.cumsum([len(rows[i]) for i in group])[:-1])):
            found[i][logs[i].between] = part
    return found


def _scaled(rows: Array, *, centred: bool = False) -> Array:
    """Columns of length one; zeros where only rounding varies."""
    large = np.abs(rows).max(axis=0, initial=0.0)
    moved = rows - rows.mean(axis=0) if centred else rows
    length = np.linalg.norm(moved, axis=0)
    varied = length > ROUNDED_SUM * large * np.sqrt(len(rows))
    return np.where(varied, moved / np.where(varied, length, 1.0), 0.0)


def _before(rows: Array) -> Array:
    """Rows (n, T, ·) a sample later."""
    return np.concatenate([np.zeros_like(rows[:, :1]), rows[:, :-1]], axis=1)


def _over_gaps(rows: Array, lost: Mask) -> Array:
    """Sums (n, T) over each gap, before each sample."""
    sums = np.zeros_like(rows)
    for k in range(1, rows.shape[1]):
        sums[:, k] = np.where(lost[:, k - 1], sums[:, k - 1] + rows[:, k - 1], 0.0)
    return sums


def _as_rows(sums: Array, lost: Mask, k: int) -> Array:
    """Sums (n, T) at the innovations (N,) of output k."""
    at = np.zeros(lost.shape)
    at[:, :, k] = np.where(lost[:, :, k], 0.0, sums)
    return at.transpose(2, 1, 0).ravel()
