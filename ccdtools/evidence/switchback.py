"""Switchback trial: two laws take turns on the real plant."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.special import logsumexp

from ccdtools.arrays import Array, ArrayField, Immutable, frozen
from ccdtools.evidence.betting import dependence, log_wealth
from ccdtools.evidence.percent import number, with_minus
from ccdtools.exceptions import InputError
from ccdtools.tolerances import FEWEST_PAIRS
from ccdtools_ground.door import as_array, as_number, as_positive, as_share
from ccdtools_ground.outcome import Outcome

BETS = 10.0 ** np.arange(-2, 1.5, 0.5)  # sizes of the bets, beside the margin
STAYS = "The law in service stays"


class TrialStatus(Outcome):
    """Status of a switchback trial."""

    ADOPTED = "adopted", "The candidate is deployed."
    REJECTED = "rejected", f"{STAYS}: the candidate is worse, not better by the margin, or loses more runs."
    UNDECIDED = "undecided", f"{STAYS}; deploy as many pairs of blocks as are needed, or state a larger margin."


@dataclass(frozen=True, eq=False)
class Trial(Immutable):
    """Switchback trial, which may be ended after every pair.

    Attributes
    ----------
    gains : (n,) array
        Return of the candidate's block less that of the law in service, pair by pair.
    margin : float
        A candidate that is not better by this much is rejected [return of a block].
    level : float
        Probability with which one that is not better is ever adopted, at most; and one that is better by the margin
        ever rejected.
    lost : bool
        Whether the candidate lost a run, which rejects it.
    lost_before : int
        Pairs in which the law in service alone lost a run: each is a bet of all that the candidate is better.
    told : (n, 1 + models) array
        Change of the return within pairs, whoever drove first, and what models foretold: they tell what is taken out of
        further gains.
    """

    gains: ArrayField
    margin: float
    level: float = 0.05
    lost: bool = False
    told: ArrayField = ()
    lost_before: int = 0

    def __post_init__(self) -> None:
        gains = np.asarray(self.gains, dtype=float)
        self._set(gains=frozen(gains if not gains.size else as_array("gains", gains, ("pairs",))))
        self._set(margin=as_positive("margin", self.margin, unit="of the return of a block"))
        as_share("level", self.level)
        told = np.asarray(self.told, dtype=float)
        self._set(told=frozen(told if not told.size else as_array("told", told, ("pairs", "1 + models"))))

    @cached_property
    def _dependence(self) -> Array:
        """Dependence (n, 1) of the gains up to each pair."""
        return np.array([[dependence(self.gains[: k + 1])] for k in range(len(self.gains))]).reshape(-1, 1)

    def _above(self, gains: Array) -> Array:
        """Log wealth (n,) of bets on gains above zero."""
        bets = gains[:, None] * (BETS / self.margin)
        stakes = np.where(np.arange(len(gains)), -np.inf, -np.log(len(BETS)))
        wealth = log_wealth(np.log(2) - np.logaddexp(0.0, -2 * bets), stakes, self._dependence)
        return np.asarray(logsumexp(wealth, axis=1) + np.log(self.level))

    @cached_property
    def _ended(self) -> tuple[int, TrialStatus]:
        """Pairs until the decision, and what it is."""
        above = self._above(self.gains) if len(self.gains) else np.log([self.level])
        above[-1] += self.lost_before * np.log(2)  # earlier pairs were looked at before
        if self.lost_before and above[-1] >= 0:
            return len(self.gains), TrialStatus.REJECTED if self.lost else TrialStatus.ADOPTED
        if len(self.gains) >= FEWEST_PAIRS:
            better, worse = above >= 0, self._above(self.margin - self.gains) >= 0
            worse &= not self.lost_before
            found = np.flatnonzero((better | worse)[FEWEST_PAIRS - 1 :])
            if len(found):
                last = int(found[0]) + FEWEST_PAIRS - 1
                return last + 1, TrialStatus.REJECTED if worse[last] else TrialStatus.ADOPTED
        return len(self.gains), TrialStatus.REJECTED if self.lost else TrialStatus.UNDECIDED

    @property
    def pairs(self) -> int:
        """Pairs of blocks until the decision, or so far."""
        return self._ended[0]

    @property
    def status(self) -> TrialStatus:
        """What became of the candidate."""
        return self._ended[1]

    @property
    def mean(self) -> float:
        """Mean gain of a block; NaN without any."""
        return float(self.gains[: self.pairs].mean()) if self.pairs else float("nan")

    @cached_property
    def interval(self) -> tuple[float, float]:
        """Bounds of the mean gain, each at the level."""
        return self._bound(1.0), self._bound(-1.0)

    def _bound(self, side: float) -> float:
        """Lower (1) or upper (−1) bound; infinite if none yet."""
        tried = Trial(side * self.gains[: self.pairs], self.margin, self.level)
        if not self.pairs:
            return -side * np.inf

        def short(bound: float) -> float:
            return float(tried._above(tried.gains - bound * self.margin)[-1])

        low, high = tried.gains.min() / self.margin - 10 / BETS[0], tried.gains.max() / self.margin
        if short(low) < 0:
            return -side * np.inf
        return side * self.margin * float(brentq(short, low, high))

    @property
    def pairs_needed(self) -> float:
        """Pairs that would tell the margin from zero; or NaN."""
        if self.pairs < 2:
            return float("nan")
        spread = float(self.gains[: self.pairs].var(ddof=1)) * float(self._dependence[self.pairs - 1, 0])
        return float(max(FEWEST_PAIRS, np.ceil(2 * np.log(len(BETS) / self.level) * spread / self.margin**2)))

    def __str__(self) -> str:
        low, high = (number(bound) for bound in self.interval)
        why = ", having lost a run" if self.lost else ""
        why += f", {self.lost_before} lost by the law in service alone" if self.lost_before else ""
        told = f"gain of a block {number(self.mean)} [{low}, {high}] at any time, margin {number(self.margin)}"
        return with_minus(f"{self.status.value} after {self.pairs} pairs of blocks{why}: {told}")

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for results.json."""
        return {"status": self.status.value, "advice": self.status.advice, "pairs": self.pairs, "mean": self.mean,
                "interval": self.interval, "margin": self.margin, "level": self.level, "lost": self.lost,
                "lost_before": self.lost_before,
                "pairs_needed": self.pairs_needed, "gains": self.gains, "text": str(self)}  # fmt: skip


def switchback(old: ArrayLike, new: ArrayLike, *, margin: float, level: float = 0.05) -> Trial:
    """Decision on a candidate from returns of blocks, in turn.

    The order within each pair has to be drawn by a coin, as `switchback_on` does. Then the difference of a pair is
    symmetric about the candidate's effect in it, however blocks follow from one another and however heavy their tails
    are: 1 + tanh(λ(gain − m)) is a fair bet that it is above m, and a mixture over λ wins against every m below the
    effect. The level holds exactly where the effect is the same in all pairs or at most zero in all. An effect that
    comes and goes is a correlated series: wealth is tempered by the correlation of neighbouring gains.

    Parameters
    ----------
    old, new : (pairs,) array_like
        Returns of the law in service and of the candidate, without the samples of the washout.
    margin : float
        Gain that is worth an update [return of a block].
    level : float
        Probability of ever adopting a candidate that is not better.

    Raises
    ------
    InputError
        If the blocks are not as many of each, fewer than 20 pairs, or not finite.

    References
    ----------
    de la Peña, A general class of exponential inequalities for martingales and ratios, Annals of Probability 27, 1999
    (sums of symmetric variables); Howard, Ramdas, McAuliffe and Sekhon, Time-uniform, nonparametric, nonasymptotic
    confidence sequences, Annals of Statistics 49, 2021 (mixtures); Bojinov, Simchi-Levi and Zhao, Design and analysis
    of switchback experiments, Management Science 69, 2023.
    """
    returns = [as_array(name, value, ("pairs",)) for name, value in (("old", old), ("new", new))]
    if len(returns[0]) != len(returns[1]):
        raise InputError("new", f"{len(returns[1])} blocks", f"{len(returns[0])}, as many as the law in service drove")
    if len(returns[0]) < FEWEST_PAIRS:
        got = f"{len(returns[0])} pairs of blocks"
        raise InputError("old", got, f"at least {FEWEST_PAIRS}", "Log more blocks, or shorter ones.")
    return Trial(returns[1] - returns[0], as_number("margin", margin), level)
