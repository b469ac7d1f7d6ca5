"""Outputs that a log lost, and inputs that answered them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.stats import t

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
    parts: Sequence[Innovations], outputs: Sequence[Array], values: Array, *, level: float = 0.01, size: float = 0.1
) -> bool:  # fmt: skip
    """Whether inputs answered outputs that logs lost.

    What they are beside a feedback of what is told then tells of the disturbance. So, summed over a gap, it tells the
    innovation after it, beyond chance and by more than a part `size`: a score test (Rao 1948) beside the parameters
    that were fitted. Inputs that nothing lost drives pass it whatever their law, but for a part `level` of the logs.
    Or they are a feedback but for a part `size` where outputs are told, and further from it in gaps.
    """
    if not any(np.isnan(one).any() for one in outputs):
        return False
    every = [Filtered.of(part, values, given) for part, given in zip(parts, outputs)]
    logs = [log for log in every if all(np.isfinite(one).all() for one in log[1:])]  # others diverged
    if not logs:
        return False
    beside = _unexplained(logs)
    slopes, errors = (np.concatenate([np.split(log[at], 2) for log in logs], axis=1) for at in (5, 4))
    known, _ = np.linalg.qr(_scaled(slopes.reshape(errors.size, -1)))
    ny, nu = logs[0].outputs.shape[2], logs[0].inputs.shape[2]
    for i, j in product(range(ny), range(nu)):
        if _follow_less(logs, [one[:, :, j] for one in beside], i, size):
            return True
        sums = [_over_gaps(one[:, :, j], log.lost[:, :, i]) for log, one in zip(logs, beside)]
        for k in range(ny):
            rows = [_as_rows(one, log.lost, k) for log, one in zip(logs, sums)]
            moves = np.concatenate([*rows, np.zeros(errors.shape[1])])
            least = size * np.linalg.norm(moves) * np.sqrt(np.count_nonzero(moves))
            moves = moves - known @ (known.T @ moves)
            rises = (moves * errors.ravel()).reshape(2, -1).sum(axis=0)
            alike = np.sum(moves**2) ** 2 / max(np.sum(moves**4), np.finfo(float).tiny)  # samples of equal weight
            chance = t.isf(level / ny**2 / nu / 2, max(alike, 1.0)) * np.linalg.norm(rises)
            if abs(rises.sum()) > max(chance, least):
                return True
    return False


def _follow_less(logs: Sequence[Filtered], beside: Sequence[Array], i: int, size: float) -> bool:
    """Whether inputs follow what is told, but less where output i is lost.

    Most are there by more than a twentieth of their size away from it, and farther than elsewhere.
    """
    squares = np.concatenate([one[log.between] ** 2 for log, one in zip(logs, beside)])
    lost = np.concatenate([log.lost[log.between, i] for log in logs])
    if lost.all() or not lost.any():
        return False
    gaps, rest = np.median(squares[lost]), np.median(squares[~lost])
    return bool(squares[~lost].mean() < size and gaps > max(size / 5, 3 * rest))


def _unexplained(logs: Sequence[Filtered], samples: int = 20) -> list[Array]:
    """Inputs (n, T, nu) less a feedback of what is told.

    They are in units of their deviations, and the feedback is of each log; those that are short for it share one.
    """
    rows, inputs = [log.told[log.between] for log in logs], [log.inputs[log.between] for log in logs]
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
