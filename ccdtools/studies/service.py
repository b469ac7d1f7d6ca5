"""Decision whether a deployment stays, compared with the one before."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from scipy import stats

from ccdtools.evidence.evidence import Asked, Evidence, Pairing, Violation
from ccdtools.evidence.verdict import Status, Verdict, decide
from ccdtools.statistics import Summary, summarise_returns
from ccdtools.studies.tolerances import FALSE_ALARM
from ccdtools.tolerances import SAME_RETURN
from ccdtools.trajectory import Trajectory
from ccdtools.twin.deployable import Deployable
from ccdtools.twin.residuals import is_common

DEPLOYMENT = "the deployment"
UPDATED_SINCE = "the deployment since its last update"

Limits = Callable[[Trajectory, Trajectory], Violation | None]


class Agreement(Enum):
    """Agreement of a predicted and a measured return."""

    AGREED = "within chance"
    MORE = "more than predicted"
    LESS = "less than predicted"
    APART = "95 % intervals apart, chance not ruled out"
    OPEN = "no interval"

    @property
    def kept(self) -> bool | None:
        """True if the prediction was right, False if wrong, None if undecided."""
        return {Agreement.AGREED: True, Agreement.LESS: False}.get(self)


@dataclass(frozen=True, eq=False)
class Deployed:
    """Deployment, and the stretch of its log that each policy drove.

    Attributes
    ----------
    generation : int
    designed, after : Deployable
        What it began with, and what it ended with.
    log : Trajectory
    changes : tuple of int
        Samples logged before every update that was accepted: of one run its steps, of several their runs times steps.
    """

    generation: int
    designed: Deployable
    after: Deployable
    log: Trajectory
    changes: tuple[int, ...] = ()

    @property
    def samples(self) -> int:
        """Number of samples of all runs."""
        return int(self.log.inputs.shape[0] * self.log.inputs.shape[1])

    def stretch(self, one: Deployable) -> tuple[int, int]:
        """First sample that a policy drove alone, and the one after its last."""
        if one.same_as(self.designed):
            return (0, self.changes[0] if self.changes else self.samples)
        if one.same_as(self.after):
            return (self.changes[-1] if self.changes else 0, self.samples)
        return (0, 0)

    def part(self, first: int, last: int, *, common: bool = False) -> Trajectory:
        """Log between two samples, in whole runs if several; `common` ones on request."""
        log = self.log
        runs, steps = log.inputs.shape[:2]
        chosen: Any = slice(None)
        span = slice(first, last)
        if runs > 1:
            own = np.arange(-(-first // steps), last // steps)
            chosen = own[is_common(own)] if common else own
            span = slice(0, steps)
        lost = log.diverged_at[chosen]
        return replace(
            log, states=log.states[chosen, span.start : span.stop + 1], inputs=log.inputs[chosen, span],
            disturbances=log.disturbances[chosen, span],
            diverged_at=np.where((lost >= 0) & (lost < span.stop), np.maximum(lost - span.start, 0), -1),
        )  # fmt: skip


@dataclass(frozen=True)
class Delivery:
    """Outcome of a deployment beside its prediction and the one before.

    Attributes
    ----------
    predicted, returns : Summary
        Of the policy as designed, on the stretch that it drove.
    agreement : Agreement
        How the two agree.
    verdict : Verdict
        On the stretches that either policy drove under the same disturbance; it says who is compared with whom.
    size : float
        The mean return of what was deployed before there, without the cost of its design.
    carried : bool
        Whether nothing was redesigned and the updates of the deployment before are what is compared.
    former : int or None
        The generation that was deployed before.
    """

    predicted: Summary
    returns: Summary
    agreement: Agreement
    verdict: Verdict
    size: float
    carried: bool = False
    former: int | None = None

    @property
    def replaces(self) -> bool:
        """Whether it stays."""
        return self.verdict.replaces

    @property
    def breach(self) -> str:
        """Limits that were left too far, in words; empty if none."""
        return next((str(one.violation) for one in self.verdict.evidence if one.violation is not None), "")

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for results.json."""
        return self.verdict.as_dict() | {
            "predicted": asdict(self.predicted), "returns": asdict(self.returns), "agreement": self.agreement.value,
            "change": asdict(self.verdict.gain), "size": self.size, "carried": self.carried, "former": self.former,
            "paired": self.former is not None, "breach": self.breach,
            "measure": self.verdict.evidence[0].measure if self.verdict.evidence else "mean",
        }  # fmt: skip


def measured(
    pairing: Pairing, candidates: Sequence[Deployable], deployed: Deployed, current: Deployable, former: Deployed,
    asked: Asked, limits: Limits | None = None,
) -> Evidence | None:  # fmt: skip
    """Comparison of policies with one on samples with equal disturbances; None without any.

    Of several runs these are common runs, of a single one the same stretch of time. Of several candidates it is all
    that was driven from the first to the last.
    """
    other = former.stretch(current)
    met = [one for one in candidates if _overlap(deployed.stretch(one), other)]
    if not met:
        return None
    spans = [deployed.stretch(one) for one in met]
    first, last = _overlap((min(spans)[0], max(spans)[1]), other)
    runs, steps = deployed.log.inputs.shape[:2]
    if deployed.log.inputs.shape != former.log.inputs.shape:
        return None
    after, before = (one.part(first, last, common=True) for one in (deployed, former))
    if not len(after.states) or not np.array_equal(after.disturbances, before.disturbances):
        return None
    where = f"steps {first} to {last}" if runs == 1 else f"runs {-(-first // steps) + 1} to {last // steps}"
    names = tuple(f"{' and '.join(policy.name for policy in some)} in deployment {of.generation}, {where}"
                  for some, of in ((met, deployed), ([current], former)))  # fmt: skip
    found = pairing.evidence(after, before, names=names, distribution=DEPLOYMENT, asked=asked, series=runs == 1)  # type: ignore[arg-type]
    return found if limits is None else replace(found, violation=limits(after, before))


def judge_deployment(
    deployed: Deployed, former: Deployed | None, current: Deployable | None, pairing: Pairing,
    predicted: Callable[[int | None], Summary], *, redesigned: bool, limits: Limits | None = None,
    other_plant: bool = False,
) -> Delivery:  # fmt: skip
    """Whether a deployment stays, compared with the one before.

    It stays if the return of all that was new in it is not worse beyond chance; where a redesign was deployed, which
    must bring something, or where there is no interval, if it is no loss in the mean either. It must lose no more runs,
    and leave the limits no further than the tolerance. Where updates followed a redesign, what they led to may be no
    worse beyond chance by itself.

    Parameters
    ----------
    former, current : Deployed and Deployable, or None
        The deployment before, and the policy that was deployed at its end.
    pairing : Pairing
    predicted : callable
        Steps of a single run, or None for all → predicted return of what was designed.
    redesigned : bool
    limits : callable, optional
        (runs of the candidate, runs of the current one) → limits that are broken.
    other_plant : bool
        Whether the plant has changed, so that nothing compares the two.
    """
    first, last = deployed.stretch(deployed.designed)
    own = deployed.part(first, last)
    runs = len(deployed.log.inputs)
    rewards = own.rewards(pairing.objective)
    returns = summarise_returns(rewards[~own.diverged], runs=runs)
    expected = predicted(last if runs == 1 and deployed.changes else None)
    agreement = _agreement(expected, returns, SAME_RETURN * own.size_of(expected.mean, pairing.objective))
    size = own.size_of(returns.mean, pairing.objective)
    if former is None or current is None:
        return Delivery(expected, returns, agreement, Verdict(Status.FIRST), size)
    carried = deployed.designed.same_as(current) and deployed.after.same_as(current)
    reference = former.designed if carried else current
    changed = [deployed.designed] + [deployed.after] * (not deployed.after.same_as(deployed.designed))
    candidates = [one for one in changed if not one.same_as(reference)]
    asked = Asked.NO_LOSS if redesigned else Asked.NO_SURE_LOSS
    evidence: list[Evidence] = []
    for some in [] if other_plant else [candidates, candidates[1:]]:
        found = measured(pairing, some, deployed, reference, former, asked, limits)
        if found is not None and not evidence:
            evidence.append(found)
        elif found is not None and found.candidate != evidence[0].candidate:
            sure = Asked.NO_SURE_LOSS if np.isfinite(found.gain.ci95).all() else Asked.SHOWN
            evidence.append(replace(found, asked=sure, distribution=UPDATED_SINCE))
    why = "the plant has changed" if other_plant else "no samples in common"
    alone = (Status.NOT_COMPARED, why) if candidates else (Status.NOT_WORSE, "the same policy")
    verdict = decide(evidence) if evidence else Verdict(alone[0], reason=alone[1])
    size = evidence[0].size if evidence else size
    return Delivery(expected, returns, agreement, verdict, size, carried and bool(evidence), former.generation)


def _overlap(one: tuple[int, int], other: tuple[int, int]) -> tuple[int, ...]:
    """Samples from the first to before the last that two stretches share; empty if none."""
    first, last = max(one[0], other[0]), min(one[1], other[1])
    return (first, last) if first < last else ()


def _agreement(predicted: Summary, returns: Summary, rounding: float = 0.0) -> Agreement:
    if np.isfinite(predicted.mean) and not np.isfinite(returns.mean):
        return Agreement.LESS
    if not np.isfinite([*predicted.ci95, *returns.ci95]).all():
        return Agreement.OPEN
    if _apart(returns, predicted, rounding):
        return Agreement.LESS
    if _apart(predicted, returns, rounding):
        return Agreement.MORE
    disjoint = max(predicted.ci95[0], returns.ci95[0]) > min(predicted.ci95[1], returns.ci95[1]) + rounding
    return Agreement.APART if disjoint else Agreement.AGREED


def _apart(lower: Summary, upper: Summary, rounding: float) -> bool:
    """Whether one mean lies below another beyond chance: facing halves of their intervals, widened to `FALSE_ALARM`."""
    degrees = min(s.n - 1 if s.n > 1 else 2 for s in (lower, upper))  # a single run has at least two
    wider = stats.t.ppf(1 - FALSE_ALARM, degrees) / stats.t.ppf(0.975, degrees)
    half = np.hypot(lower.ci95[1] - lower.mean, upper.mean - upper.ci95[0])
    return bool(upper.mean - lower.mean > wider * half + rounding)


def after_deployment(
    deployed: Deployed, current: Deployable, former: Deployed | None, *, replaces: bool, carried: bool
) -> tuple[Deployable, Deployed]:  # fmt: skip
    """Deployable that is deployed next, and its reference deployment.

    Where a deployment fell short, that is what was deployed before: of updates that a whole deployment has shown to be
    worse, the policy before them. A generation that changed nothing keeps the number of the one that it repeats.
    """
    if former is None:
        return deployed.after, deployed
    if not replaces:
        return (former.designed if carried else current), former
    idle = deployed.designed.same_as(current) and deployed.after.same_as(current)
    return deployed.after, replace(deployed, generation=former.generation) if idle else deployed
