"""Drift: residuals that are no longer what they were."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from ccdtools.arrays import Array
from ccdtools.evidence.betting import dependence, log_wealth
from ccdtools.exceptions import InputError
from ccdtools.tolerances import CALIBRATION_BLOCKS, NO_RESIDUAL, SLOWER_DEPENDENCE
from ccdtools_ground.door import as_array, as_count, as_share
from ccdtools_ground.outcome import Outcome

POWERS = np.array([0.1, 0.3, 0.6])  # ε of the bets ε p^(ε − 1), from a few large changes to many small ones


class DriftStatus(Outcome):
    """Status of a stretch of residuals."""

    NONE = "no drift", (
        "No change was seen, and small ones may be missed: of a spring, 480, 900 and 1800 samples to calibrate always "
        "showed errors 2.5, 2 and 1.5 times as large, of one state nearly always; not always smaller changes or errors."
    )  # fmt: skip
    UNKNOWN = "not known", "Too few samples to tell: log longer, or state a shorter block."
    DRIFT = "drift", "The twin no longer describes the plant: log again, then redesign."


@dataclass(frozen=True)
class Drift:
    """Whether and since when residuals have changed.

    Attributes
    ----------
    found, began : int or None
        Sample after which it was known, and the first one of the change, as estimated; None without.
    samples, block : int
        Residuals that were looked at, none where too few calibrate; and how many make a block [samples].
    level : float
        Probability of any alarm in all of them without a drift, at most.
    calibrated : int
        Residuals that they were compared with.
    left_out : (int, int)
        Runs of the log that diverged, which are not among them, of so many.
    """

    found: int | None
    began: int | None
    samples: int
    block: int
    level: float
    calibrated: int = 0
    left_out: tuple[int, int] = (0, 0)

    @property
    def status(self) -> DriftStatus:
        """Whether there is a drift."""
        if not self.samples:
            return DriftStatus.UNKNOWN
        return DriftStatus.NONE if self.found is None else DriftStatus.DRIFT

    def __str__(self) -> str:
        alarms = f"(false alarms: {self.level:.0%} where errors are correlated over no more than {self.block} samples)"
        lost = ". {} of {} runs diverged and are left out".format(*self.left_out) if self.left_out[0] else ""
        if not self.samples:
            return f"not known whether there is a drift{lost}. {self.status.advice}"
        if self.found is None:
            return f"no drift in {self.samples} samples, calibrated by {self.calibrated} {alarms}{lost}"
        since = f"drift since about sample {self.began}, known after {self.found} of {self.samples}"
        return f"{since} {alarms}{lost}. {self.status.advice}"

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for results.json."""
        return vars(self) | {"status": self.status.value, "advice": self.status.advice, "text": str(self)}


def detect_drift(
    calibration: ArrayLike, residuals: ArrayLike, *, level: float = 0.05, block: int | None = None
) -> Drift:
    """Whether residuals come from what the calibrating ones came from.

    Blocks are told by the mean and by the logarithm of the size of the residuals in their principal directions, both
    decorrelated on the first fifth of the calibration. Each is a conformal p-value, its rank among all blocks before
    it, and a bet that small or large p are too many, begun at any block. So the level holds for blocks that are
    exchangeable. Residuals that are correlated beyond a block are not: wealth is tempered by twice what the correlation
    of neighbouring blocks says, which is measured, not proven.

    Parameters
    ----------
    calibration, residuals : (T, nx) or (T,) array_like
        In the order of time, for instance one-step errors less the median of the twin.
    level : float
        Probability of any alarm in all of `residuals`.
    block : int, optional
        Samples of a block: a three hundredth of the calibration by default.

    Raises
    ------
    InputError
        If sizes differ, a number is not finite, or the calibration has fewer than 300 blocks.

    References
    ----------
    Vovk, Testing randomness online, Statistical Science 36(4), 2021; Shin, Ramdas and Rinaldo, E-detectors, New England
    Journal of Statistics in Data Science 2(2), 2024 (bets begun at any time).
    """
    known, new = (np.atleast_2d(as_array(name, value, ("T",), ("T", "nx")).T).T
                  for name, value in (("calibration", calibration), ("residuals", residuals)))  # fmt: skip
    level = as_share("level", level)
    if known.shape[1] != new.shape[1]:
        raise InputError("residuals", f"{new.shape[1]} columns", f"{known.shape[1]}, as many as the calibration has")
    length = max(1, len(known) // CALIBRATION_BLOCKS) if block is None else as_count("block", block)
    if len(known) < CALIBRATION_BLOCKS * length:
        raise InputError("calibration", f"{len(known)} samples", f"at least {CALIBRATION_BLOCKS * length}")
    if len(new) < length:
        raise InputError("residuals", f"{len(new)} samples", f"at least {length}, a block")
    seen, now = _features(known, new, length)
    enough = np.log(seen.shape[1] / level)
    found = [_alarm(before, after, enough) for before, after in zip(seen.T, now.T)]
    first = min((one for one in found if one is not None), default=None)
    alarm, began = (None, None) if first is None else (length * (first[0] + 1), length * first[1])
    return Drift(alarm, began, len(new), length, level, len(known))


def _features(known: Array, new: Array, length: int) -> tuple[Array, Array]:
    """Decorrelated features (n, 2 nx) of known and new blocks."""
    fitted = len(known) // length // 5
    first = known[: fitted * length]
    centre = first.mean(axis=0)
    sizes, axes = np.linalg.eigh(np.cov((first - centre).T).reshape(known.shape[1], -1))
    scale = np.sqrt(np.maximum(sizes, NO_RESIDUAL**2 * sizes[-1] or 1.0))

    def told(residuals: Array) -> Array:
        whole = residuals[: len(residuals) // length * length]
        blocks = ((whole - centre) @ (axes / scale)).reshape(-1, length, len(scale))
        return np.hstack([blocks.mean(axis=1), np.log((blocks**2).mean(axis=1) + NO_RESIDUAL**2)])

    seen = told(known)
    spread = seen[:fitted].std(axis=0)
    kept = spread > 0
    unit = seen[:fitted].mean(axis=0), np.where(kept, spread, 1.0)
    turned = np.linalg.eigh(np.cov(((seen[:fitted] - unit[0]) / unit[1]).T))[1]
    seen, now = ((blocks - unit[0]) / unit[1] @ turned for blocks in (seen, told(new)))
    return seen[fitted:], now


def _alarm(known: Array, new: Array, enough: float) -> tuple[int, int] | None:
    """Block of the alarm, and of the change; None without."""
    count = len(known) + np.arange(len(new))
    series, below = np.sort(known).tolist(), np.zeros((2, len(new)))
    for k, value in enumerate(new.tolist()):
        below[:, k] = bisect_left(series, value), bisect_right(series, value)
        insort(series, value)
    p = (count - below.mean(axis=0) + 0.5) / (count + 1)  # the mean over a rank's random part: bets are convex in it
    logs = np.log(POWERS) + (POWERS - 1) * np.log(np.stack([p, 1 - p])[..., None])
    stakes = np.full(len(new), -np.log(2 * len(POWERS) * len(new)))
    logs = np.hstack([*logs])
    wealth = log_wealth(logs, stakes, SLOWER_DEPENDENCE * dependence(known))
    won = np.flatnonzero(logsumexp(wealth, axis=1) >= enough)
    if not len(won):
        return None
    richest = logs[: won[0] + 1, wealth[won[0]].argmax()]
    return int(won[0]), int((np.cumsum(richest) - richest).argmin())
