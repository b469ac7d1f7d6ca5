"""Conformal calibration: by which factor a band grows or shrinks until it holds its level.

A score is the least factor by which a band holds what happened: the largest excess over outputs, or over the steps of a
run, makes it joint.

References
----------
Vovk, Gammerman and Shafer, "Algorithmic Learning in a Random World", 2005 (split and Mondrian conformal prediction);
Gibbs and Candès, "Adaptive conformal inference under distribution shift", NeurIPS 2021;
Angelopoulos, Candès and Tibshirani, "Conformal PID control for time series prediction", NeurIPS 2023, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ccdtools_ground.door import as_count, as_floats
from learning.checks import check_number
from learning.exceptions import InputError
from learning.tolerances import FALSE_ALARM, PER_REGIME

Array = NDArray[np.float64]


def samples_needed(level: float) -> int:
    """Fewest samples that calibrate a level."""
    return int(np.ceil(round(level / (1 - level), 9)))


@dataclass(frozen=True, eq=False)
class Conformal:
    """Factors that hold a level, one for each regime.

    Attributes
    ----------
    level : float
        Probability that a fresh score is at most its factor.
    edges : (G − 1,) array
        Scales that part the regimes, increasing.
    factors : (G,) array
    """

    level: float
    edges: Array
    factors: Array

    @classmethod
    def fit(
        cls, scores: ArrayLike, level: float = 0.8, *, scale: ArrayLike | None = None, independent: int | None = None
    ) -> Conformal:
        """Factors from scores of samples that trained nothing.

        Their rank is that of finitely many samples: a fresh score, exchangeable with them, is within the factor of its
        regime with at least the level's probability.

        Parameters
        ----------
        scores : (n,) array_like
        level : float
            In (0, 1).
        scale : (n,) array_like, optional
            What was known before each score of how large it may become. Regimes are parted by it, as many as have a
            hundred independent scores each; one by default.
        independent : int, optional
            How many of the scores do not overlap, if not all: windows of a series do.

        Raises
        ------
        InputError
            Where fewer than level / (1 − level) independent scores are given.
        """
        s = as_floats("scores", scores)
        level = check_number(level, "level", 0.0, 1.0)
        if s.ndim != 1 or np.isnan(s).any():
            raise InputError("scores", f"shape {s.shape}" if s.ndim != 1 else "NaN", "(n,) numbers")
        count = len(s) if independent is None else min(as_count("independent", independent, least=0), len(s))
        if count < samples_needed(level):
            got = f"{count} independent samples to calibrate a level of {level:g}"
            raise InputError("scores", got, f"at least {samples_needed(level)}: more samples, or a lower level")
        known = np.zeros(len(s)) if scale is None else as_floats("scale", scale)
        if known.shape != s.shape or not np.isfinite(known).all():
            raise InputError("scale", f"shape {known.shape}", f"{s.shape} finite numbers, one for each score")
        regimes = 1 if scale is None else max(1, min(count // PER_REGIME, count // samples_needed(level)))
        edges = np.unique(np.quantile(known, np.arange(1, regimes) / regimes))
        group = np.searchsorted(edges, known, side="right")
        share = count / len(s)
        factors = [_factor(s[group == g], level, share) for g in range(len(edges) + 1)]
        return cls(level, edges, np.array(factors))

    def at(self, scale: ArrayLike) -> Array:
        """Factors (n,) at scales (n,)."""
        return np.asarray(self.factors[np.searchsorted(self.edges, as_floats("scale", scale), side="right")])


def _factor(scores: Array, level: float, share: float) -> float:
    """Return the score whose rank holds the level, of which a share are independent."""
    if len(scores) == 0:
        return np.inf
    independent = share * len(scores)
    part = np.ceil(round((independent + 1) * level, 9)) / independent
    rank = max(1, int(np.ceil(round(part * len(scores), 9))))
    return float(np.sort(scores)[rank - 1]) if rank <= len(scores) else np.inf


@dataclass(frozen=True)
class AdaptiveConformal:
    """Factor that follows the scores of a stream, with a flag.

    In its logarithm a miss makes the factor larger by the rate times the level, a hit smaller by the rate times the
    rest. Over any T scores the share of misses differs from 1 − level by at most the change of that
    logarithm over rate · T, whatever the scores are.

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
    """

    level: float = 0.8
    factor: float = 1.0
    rate: float = 0.05
    calibrated: float | None = None
    evidence: float = 1.0

    def __post_init__(self) -> None:
        check_number(self.level, "level", 0.0, 1.0)
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
        return replace(self, factor=factor, evidence=min(won, 1 / FALSE_ALARM**2))
