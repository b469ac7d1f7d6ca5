"""Conformal calibration: by which factor a band grows or shrinks until it holds its level.

A score is the least factor by which a band holds what happened: the largest excess over outputs, or over the steps of a
run, makes it joint.

References
----------
Vovk, Gammerman and Shafer, "Algorithmic Learning in a Random World", 2005 (split conformal prediction);
Papadopoulos, Gammerman and Vovk, "Normalized nonconformity measures for regression conformal prediction", AIA 2008;
Hyndman and Fan, "Sample quantiles in statistical packages", The American Statistician 50(4), 1996 (Weibull's: type 6);
Gibbs and Candès, "Adaptive conformal inference under distribution shift", NeurIPS 2021;
Angelopoulos, Candès and Tibshirani, "Conformal PID control for time series prediction", NeurIPS 2023, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from ccdtools_ground.door import as_count, as_floats
from learning.checks import check_number
from learning.exceptions import InputError
from learning.tolerances import FALSE_ALARM

Array = NDArray[np.float64]


def samples_needed(level: float) -> int:
    """Fewest samples that calibrate a level."""
    return int(np.ceil(round(level / (1 - level), 9)))


@dataclass(frozen=True, eq=False)
class Conformal:
    """Factor that holds a level, and the power of a scale it grows with.

    Attributes
    ----------
    level : float
        Probability that a fresh score is at most its factor.
    factor : float
        At a scale of one.
    exponent : float
        From 0 to 1.
    """

    level: float
    factor: float
    exponent: float = 0.0

    @classmethod
    def fit(
        cls,
        scores: ArrayLike,
        level: float = 0.8,
        *,
        scale: ArrayLike | None = None,
        exponent: float | None = None,
        independent: int | None = None,
        at_least: bool = True,
    ) -> Conformal:
        """Factor from scores of samples that trained nothing.

        Their rank is that of finitely many samples, n. A fresh score, exchangeable with them, is within the factor with
        at least the level's probability. Interpolated between two ranks, that differs from the level by less than
        1 / (n + 1), on either side. Over regimes of the scale it holds as far as the power of the scale is right.

        Parameters
        ----------
        scores : (n,) array_like
        level : float
            In (0, 1).
        scale : (n,) array_like, optional
            What was known before each score of how large it may become, and positive.
        exponent : float, optional
            From `scale_exponent` of other samples. Fitted to these it costs exactness of the order of 1 / n.
        independent : int, optional
            How many of the scores do not overlap, if not all: windows of a series do, and are given in time order.
        at_least : bool
            Whether to round up to the next rank rather than interpolate.

        Raises
        ------
        InputError
            Where fewer than level / (1 − level) independent scores are given.
        """
        s = as_floats("scores", scores)
        level = check_number(level, "level", 0.0, 1.0)
        if s.ndim != 1 or np.isnan(s).any():
            raise InputError("scores", f"shape {s.shape}" if s.ndim != 1 else "NaN", "(n,) numbers")
        if not at_least and np.isinf(s).any():
            raise InputError("scores", "an infinite one", "finite numbers to interpolate between")
        count = len(s) if independent is None else min(as_count("independent", independent, least=0), len(s))
        if count < samples_needed(level):
            got = f"{count} independent samples to calibrate a level of {level:g}"
            raise InputError("scores", got, f"at least {samples_needed(level)}: more samples, or a lower level")
        known = np.ones(len(s)) if scale is None else _as_scale(scale, s)
        power = cls.scale_exponent(s, known, level) if exponent is None else exponent
        power = check_number(power, "exponent", 0.0, 1.0, closed=True)
        factor = (_at_least if at_least else _interpolated)(s / known**power, level, count)
        return cls(level, factor, power)

    @staticmethod
    def scale_exponent(scores: ArrayLike, scale: ArrayLike, level: float = 0.8) -> float:
        """Power of a scale that a quantile of scores grows with.

        From 0 to 1, by quantile regression of log score on log scale.

        Parameters
        ----------
        scores : (n,) array_like
        scale : (n,) array_like
            As in `fit`.
        level : float
            Of the quantile, in (0, 1).
        """
        s = as_floats("scores", scores)
        level = check_number(level, "level", 0.0, 1.0)
        x = np.log(_as_scale(scale, s))
        y = np.log(np.maximum(s, max(np.finfo(float).eps * s.max(), np.finfo(float).tiny)))

        def loss(exponent: float) -> float:
            off = y - exponent * x
            off -= np.quantile(off, level, method="inverted_cdf")  # the best intercept
            return float(np.maximum(level * off, (level - 1) * off).mean())

        return float(minimize_scalar(loss, bounds=(0, 1), method="bounded").x) if np.ptp(x) > 0 else 0.0

    def at(self, scale: ArrayLike) -> Array:
        """Factors (n,) at scales (n,)."""
        return np.asarray(self.factor * as_floats("scale", scale) ** self.exponent)


def _as_scale(scale: ArrayLike, scores: Array) -> Array:
    """Return positive numbers, one for each score."""
    known = as_floats("scale", scale)
    if known.shape != scores.shape or not (np.isfinite(known) & (known > 0)).all():
        got = f"shape {known.shape}" if known.shape != scores.shape else "one that is not positive"
        raise InputError("scale", got, f"{scores.shape} positive numbers, one for each score")
    return known


def _at_least(scores: Array, level: float, independent: int) -> float:
    """Return the score whose rank holds the level, of which so many are independent."""
    part = np.ceil(round((independent + 1) * level, 9)) / independent
    rank = max(1, int(np.ceil(round(part * len(scores), 9))))
    return float(np.sort(scores)[rank - 1])


def _interpolated(scores: Array, level: float, independent: int) -> float:
    """Return Weibull's quantile, averaged over sets of independent scores."""
    apart = len(scores) // independent
    return float(np.mean([np.quantile(scores[first::apart], level, method="weibull") for first in range(apart)]))


@dataclass(frozen=True)
class AdaptiveConformal:
    """Factor that follows the scores of a stream, with a flag.

    In its logarithm a miss makes the factor larger by the rate times the level, a hit smaller by the rate times the
    rest. Over any T scores the share of misses differs from 1 − level by at most the change of that
    logarithm over rate · T, whatever the scores are, as long as the factor stays above `least`.

    Attributes
    ----------
    level : float
    factor : float
        For the next score: that of a calibration at first.
    rate : float
        Step of the logarithm [-].
    calibrated : float, optional
        Fixed factor that is watched; the first `factor` by default.
    evidence : float
        Against the fixed factor: what a bet on more misses than promised has won since it began to win.
    least : float
        Part of the fixed factor below which the factor does not fall: so it comes back soon after a standstill, or a
        stuck sensor, whose scores are 0.
    """

    level: float = 0.8
    factor: float = 1.0
    rate: float = 0.05
    calibrated: float | None = None
    evidence: float = 1.0
    least: float = 0.1

    def __post_init__(self) -> None:
        check_number(self.level, "level", 0.0, 1.0)
        check_number(self.least, "least", 0.0, 1.0)
        for name in ("factor", "rate", "evidence"):
            check_number(getattr(self, name), name)
        if self.calibrated is None:
            object.__setattr__(self, "calibrated", self.factor)
        else:
            check_number(self.calibrated, "calibrated")

    @property
    def lost(self) -> bool:
        """Whether the fixed factor covers less than promised, beyond chance."""
        return self.evidence >= 1 / FALSE_ALARM

    def after(self, score: float) -> AdaptiveConformal:
        """Stream after one more score."""
        score = check_number(score, "score", closed=True)
        assert self.calibrated is not None
        promised = 1 - self.level
        won = max(self.evidence, 1.0) * (1 + float(score > self.calibrated) - promised)
        factor = self.factor * float(np.exp(self.rate * (float(score > self.factor) - promised)))
        factor = max(factor, self.least * self.calibrated)
        return replace(self, factor=factor, evidence=min(won, 1 / FALSE_ALARM**2))
