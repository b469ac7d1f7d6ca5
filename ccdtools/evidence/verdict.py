"""Verdict on a candidate, from the evidence on every distribution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ccdtools.evidence.evidence import NOTHING, Asked, Evidence
from ccdtools.evidence.percent import signed_percent
from ccdtools.exceptions import InputError
from ccdtools.statistics import PairedDifference
from ccdtools.tolerances import NOT_WORSE, SAME_RETURN
from ccdtools_ground.door import as_number, shown
from ccdtools_ground.outcome import Outcome

LOG_MORE = "Log more runs or a longer one"
STAYS = "What was deployed before stays deployed; the log still teaches the twin."


class Status(Outcome):
    """Status of a candidate: what becomes of it."""

    FIRST = "the first deployed", ""
    BETTER = "better", ""
    NOT_WORSE = "not worse", ""
    NO_LOSS_SHOWN = "no loss shown", "It stays deployed; log more runs or a longer one to know whether it loses."
    NOT_COMPARED = (
        "not compared", "It stays deployed as it was decided before; log runs that both keep to compare them."
    )  # fmt: skip
    NO_GAIN = "no gain beyond chance", f"{LOG_MORE}; or what is deployed is as good as the log can tell."
    BELOW_PRICE = (
        "less than its price", "State another price (redesign_price) if so small a gain is worth a redesign."
    )  # fmt: skip
    LOSS = (
        "a loss beyond the tolerance",
        "If the gain is worth that loss, say so: accept_loss, or --accept-loss on the command line.",
    )
    UNDECIDED = (
        "a loss beyond the tolerance cannot be ruled out",
        f"{LOG_MORE}; or, if the gain is worth such a loss, accept it: accept_loss.",
    )
    WORSE = "worse", STAYS
    NOT_BETTER = "not better", STAYS
    MORE_LOST = "more of its runs are lost", "Limit the box of designs to those that keep the plant stable."
    LIMITS = "further outside the limits than the tolerance", "Raise limit_tolerance, or deploy with the filter."
    NO_FILTER = (
        "the filter finds no set at its design",
        "Widen X or U, or leave the filter out: no state can be kept within X for ever.",
    )

    @property
    def replaces(self) -> bool:
        """Whether the candidate takes the place of the current one."""
        return self in (Status.FIRST, Status.BETTER, Status.NOT_WORSE, Status.NO_LOSS_SHOWN, Status.NOT_COMPARED)


@dataclass(frozen=True)
class Verdict:
    """Verdict on whether a candidate replaces the current one.

    Attributes
    ----------
    status : Status
    evidence : tuple of Evidence
        That on what the candidate was made for comes first.
    reason : str
        The number and the distribution that decide.
    tolerance : float
        The loss that is accepted, as a part of the size of a return.
    """

    status: Status
    evidence: tuple[Evidence, ...] = ()
    reason: str = ""
    tolerance: float = NOT_WORSE

    @property
    def replaces(self) -> bool:
        """Whether the candidate replaces the current one."""
        return self.status.replaces

    @property
    def gain(self) -> PairedDifference:
        """Gain on what the candidate was made for; NaN without evidence."""
        return self.evidence[0].gain if self.evidence else NOTHING

    @property
    def percent(self) -> str:
        """Gain on what the candidate was made for, in per cent; "n/a" without evidence."""
        return self.evidence[0].percent if self.evidence else "n/a"

    def on(self, distribution: str) -> Evidence | None:
        """Evidence on one distribution, if there is any."""
        return next((one for one in self.evidence if one.distribution == distribution), None)

    def __str__(self) -> str:
        return str(self.status.value) + (f": {self.reason}" if self.reason else "")

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for results.json."""
        return {
            "status": self.status.value, "replaces": self.replaces, "reason": self.reason, "tolerance": self.tolerance,
            "advice": self.status.advice, "evidence": [one.as_dict() for one in self.evidence],
        }  # fmt: skip


def decide(evidence: Sequence[Evidence], *, tolerance: float = NOT_WORSE) -> Verdict:
    """Verdict on whether the candidate may replace the current one.

    It must show on every distribution what is asked of it there. Before any return count lost runs, of which it may
    lose no more, and limits. Where the current one loses every run of a distribution there is nothing to compare. It is
    called better where it gains on what it was made for, and not worse where no interval reaches below the tolerance.

    Parameters
    ----------
    evidence : sequence of Evidence
        What the candidate was made for first.
    tolerance : float
        Loss, as a part of the size of a return, that the user accepts.

    Raises
    ------
    InputError
        If there is no evidence, the tolerance is no fraction, a size or price is no number, or a gain is infinite; one
        that nobody knows is NaN.
    """
    records = tuple(evidence)
    deciding = [one for one in records if isinstance(one, Evidence) and one.asked is not Asked.SHOWN]
    if not deciding or not all(isinstance(one, Evidence) for one in records):
        raise InputError("evidence", shown(evidence), "at least one Evidence, and one that is not only shown")
    for one in deciding:
        if not np.isfinite([one.size, one.needed]).all() or np.isinf([one.gain.mean, *one.gain.ci95]).any():
            gain = ", ".join(f"{value:g}" for value in (one.gain.mean, *one.gain.ci95))
            numbers = f"a gain of {gain}, a price of {one.needed:g} and a size of {one.size:g}"
            raise InputError("evidence", f"{numbers} on {one.distribution}", "finite numbers")
    tolerance = as_number("tolerance", tolerance, expected="a fraction from 0 to 1", low=0.0, high=1.0)
    tests: tuple[Callable[[Evidence], Status | None], ...] = (
        lambda one: Status.MORE_LOST if one.lost[0] > one.lost[1] else None,
        lambda one: None if one.violation is None else Status.LIMITS,
        lambda one: _short(one, tolerance),
    )
    for test in tests:
        for one in deciding:
            found = test(one)
            if found is not None:
                return Verdict(found, records, _reason(found, one, tolerance), tolerance)
    first = deciding[0]
    status, shown_by = Status.BETTER, first
    if not first.gain.ci95[0] > SAME_RETURN * first.size:
        status, shown_by = _without_gain(deciding, tolerance)
    return Verdict(status, records, f"{shown_by.percent} on {shown_by.distribution}", tolerance)


def _without_gain(deciding: Sequence[Evidence], tolerance: float) -> tuple[Status, Evidence]:
    """Status of a candidate replacing without a gain, and the deciding evidence."""
    for one in deciding:
        if np.isnan(one.gain.mean):
            return Status.NOT_COMPARED, one
    for one in deciding:
        if not one.gain.ci95[0] >= -max(tolerance, SAME_RETURN) * one.size:
            return Status.NO_LOSS_SHOWN, one
    return Status.NOT_WORSE, deciding[0]


def _short(one: Evidence, tolerance: float) -> Status | None:
    """Shortfall of the candidate against what is asked, None without one."""
    low, high = one.gain.ci95
    floor = SAME_RETURN * one.size
    if one.asked is Asked.GAIN:
        if low > 0 or 0 < one.gain.mean < one.needed:
            return Status.BELOW_PRICE if one.gain.mean <= one.needed else None
        return Status.WORSE if high < -floor else Status.NO_GAIN
    if one.asked is Asked.TOLERANCE:
        allowed = max(tolerance * one.size, floor)
        if one.lost[1] == one.runs or low >= -allowed:
            return None
        return Status.LOSS if high < -allowed else Status.UNDECIDED
    if high < -floor:
        return Status.WORSE
    in_the_mean = one.asked is Asked.NO_LOSS or not np.isfinite([low, high]).all()
    return Status.NOT_BETTER if in_the_mean and one.gain.mean < -floor else None


def _reason(status: Status, one: Evidence, tolerance: float) -> str:
    """Reason for a status, in numbers of the deciding evidence."""
    if status is Status.MORE_LOST:
        return f"{one.lost[0]} of {one.runs} runs on {one.distribution}, where {one.current} loses {one.lost[1]}"
    if status is Status.LIMITS:
        return f"{one.violation} on {one.distribution}"
    if status is Status.BELOW_PRICE:
        needed = signed_percent(100 * one.needed / one.size) if one.size else f"{one.needed:.4g}"
        return f"{one.percent} on {one.distribution}, price {needed.removeprefix('+')}"
    if status in (Status.LOSS, Status.UNDECIDED):
        return f"{one.percent} on {one.distribution}, tolerance {100 * tolerance:g} %"
    return f"{one.percent} on {one.distribution}"
