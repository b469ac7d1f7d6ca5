"""Whether a redesign replaces what is in service, before anything is built."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccdtools.arrays import Array
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.plants.design_space import DesignSpace
from ccdtools.scenario import Scenario
from ccdtools.statistics import PairedDifference, Summary, mean_interval, summarise, summarise_returns
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.price import RedesignPrice
from ccdtools.studies.report.formatting import percent_interval
from ccdtools.trajectory import Trajectory
from ccdtools.twin.residuals import Residuals
from ccdtools.twin.twin import DigitalTwin
from learning.networks import ActorCritic

WORTH_A_POLICY = 0.001  # a policy costs nothing to build: it is replaced for a gain of this fraction of the return
SAME_DESIGN = 1e-3  # of the range of each parameter


class RedesignStatus(Enum):
    """What became of a redesign, and why."""

    TAKEN = "taken"
    BELOW_PRICE = "less than its price"
    NO_GAIN = "no gain beyond chance"
    DIVERGES = "more of its runs diverge"
    CONTRADICTED = "the updated model says the contrary"

    @property
    def advice(self) -> str:
        """What the user may do about it."""
        return {
            RedesignStatus.TAKEN: "",
            RedesignStatus.BELOW_PRICE: "State another price (redesign_price) if so small a gain is worth a redesign.",
            RedesignStatus.NO_GAIN: "Log more runs or a longer one; or the design is as good as the log can tell.",
            RedesignStatus.DIVERGES: "Limit the box of designs to those that keep the plant stable.",
            RedesignStatus.CONTRADICTED: "Deploy longer: the errors and what was learned of them tell two stories.",
        }[self]


@dataclass(frozen=True, eq=False)
class InService:
    """A policy together with the design that it controls."""

    agent: ActorCritic
    design: Array


@dataclass(frozen=True)
class RedesignDecision:
    """What a redesign would bring, and whether it is taken.

    Attributes
    ----------
    gain : PairedDifference
        Return of the redesign minus that of what is in service, on windows of the logged errors that share no sample,
        each met through E(p) of its own design.
    updated_gain : PairedDifference
        The same on the updated model with the unexplained rest replayed; NaN where there is none.
    needed : float
        Smallest gain for which it is taken: the price.
    size : float
        The return in service, of which relative prices and gains are parts.
    nominal_before, nominal_after : float
        Return on the nominal model of what is in service, and of the redesign.
    moved : bool
        Whether the redesign has another design.
    status : RedesignStatus
    price : str
    """

    gain: PairedDifference
    updated_gain: PairedDifference
    needed: float
    size: float
    nominal_before: float
    nominal_after: float
    moved: bool
    status: RedesignStatus
    price: str

    @property
    def accepted(self) -> bool:
        """Whether the gain is beyond chance and worth its price, no more runs diverge, and nothing contradicts it."""
        return self.status is RedesignStatus.TAKEN

    def describe(self, proposed: str) -> str:
        """The decision in one sentence; `proposed` says what was judged."""
        verdict = "taken" if self.accepted else f"not taken, {self.reason()}"
        return f"{proposed} {verdict}: it promised {self.promise()} on the logged errors at a price of {self.price}; " \
               f"nominal model {self.nominal_before:.4g} → {self.nominal_after:.4g}"  # fmt: skip

    def promise(self) -> str:
        """The gain and its interval in per cent of the return in service."""
        return percent_interval(self.gain.mean, self.gain.ci95, self.size)

    def reason(self) -> str:
        """Why it is not taken."""
        if self.status is RedesignStatus.BELOW_PRICE:
            return f"less than its price of {self.price}"
        if self.status is RedesignStatus.CONTRADICTED:
            contrary = percent_interval(self.updated_gain.mean, self.updated_gain.ci95, self.size)
            return f"the updated model says the contrary, {contrary}"
        return self.status.value

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for results.json."""
        return {
            "gain": _plain(self.gain), "updated_gain": _plain(self.updated_gain), "needed": self.needed,
            "size": self.size, "nominal_before": self.nominal_before, "nominal_after": self.nominal_after,
            "moved": self.moved, "accepted": self.accepted, "status": self.status.value, "price": self.price,
            "promise": self.promise(), "reason": "" if self.accepted else self.reason(),
        }  # fmt: skip


def judge_redesign(
    evaluation: Evaluation, candidate: InService, current: InService, logs: Sequence[Residuals],
    twin: DigitalTwin | None = None,
) -> RedesignDecision:  # fmt: skip
    """The decision between a redesign and what is in service, both on the same windows of the logged errors.

    It is taken only for a gain whose 95 % interval excludes zero and that exceeds the study's price of a redesign (a
    tenth of a per cent if the policy alone changes), and if the updated model of `twin` does not deny it beyond chance.
    Relative prices are of the larger of the returns on the logged errors and on the nominal model: a log with hardly
    any disturbance says little, and the return on it is small; a part of that would move a design for nothing.
    """
    logged, labels = evaluation.on_logs(logs)
    nominal = evaluation.on_model(())
    before, after = (_run(evaluation, choice, logged) for choice in (current, candidate))
    gain = _clustered(evaluation, after, before, labels)
    nominal_before, nominal_after = (_mean_return(evaluation, choice, nominal) for choice in (current, candidate))
    kept = ~(before.diverged | after.diverged)
    own = before.returns(evaluation.study.objective)[kept]
    part = logged.steps / nominal.steps
    sizes = [abs(nominal_before) * part, abs(float(own.mean())) if len(own) else 0.0]
    size = max(s for s in sizes if np.isfinite(s))
    moved = not same_design(evaluation.problem.design, candidate.design, current.design)
    price = evaluation.study.price if moved else _price_of_a_policy(evaluation.study.price, size, part)
    needed = price.of(size, part)
    updated = _updated_gain(evaluation, candidate, current, twin)
    status = _status(gain, updated, needed, safe=after.diverged.mean() <= before.diverged.mean())
    return RedesignDecision(gain, updated, needed, size, nominal_before, nominal_after, moved, status, str(price))


def promised(evaluation: Evaluation, choice: InService, logs: Sequence[Residuals]) -> Summary:
    """Predicted return of a deployment: on the newest log's errors from end to end, or before any on the model."""
    scenario = evaluation.whole_log(logs[-1]) if logs else evaluation.nominal_deployment()
    run = _run(evaluation, choice, scenario)
    rewards = run.rewards(evaluation.study.objective)[~run.diverged]
    return summarise_returns(rewards, runs=len(run.states))


def same_design(space: DesignSpace, one: Array, other: Array) -> bool:
    """Whether two designs differ by less than a thousandth of the range of every parameter."""
    return bool(np.abs(space.to_unit(one) - space.to_unit(other)).max() <= SAME_DESIGN)


def _price_of_a_policy(price: RedesignPrice, size: float, part: float) -> RedesignPrice:
    """What a policy alone must bring: a tenth of a per cent, or the price of a redesign if that is less."""
    own = RedesignPrice(100 * WORTH_A_POLICY, relative=True)
    return own if own.of(size, part) <= price.of(size, part) else price


def _status(gain: PairedDifference, updated: PairedDifference, needed: float, *, safe: bool) -> RedesignStatus:
    """What becomes of a redesign with that gain."""
    if not safe:
        return RedesignStatus.DIVERGES
    if not (gain.ci95[0] > 0 or 0 < gain.mean < needed):
        return RedesignStatus.NO_GAIN
    if not (gain.mean > needed):
        return RedesignStatus.BELOW_PRICE
    return RedesignStatus.CONTRADICTED if updated.ci95[1] < 0 else RedesignStatus.TAKEN


def _updated_gain(
    evaluation: Evaluation, candidate: InService, current: InService, twin: DigitalTwin | None
) -> PairedDifference:
    """Candidate minus current on the updated model with its innovations replayed; NaN without a twin."""
    if twin is None or twin.discrepancy is None:
        return PairedDifference(np.nan, (np.nan, np.nan))
    scenario, labels = evaluation.on_updated_logs(twin)
    after, before = (_run(evaluation, choice, scenario) for choice in (candidate, current))
    return _clustered(evaluation, after, before, labels)


def _clustered(
    evaluation: Evaluation, after: Trajectory, before: Trajectory, labels: NDArray[np.int64]
) -> PairedDifference:
    """Mean difference of the returns, over groups of windows that met the same disturbance or stood in one run.

    Windows of a single long run follow each other in time; their rewards make one correlated series.
    """
    kept = ~(after.diverged | before.diverged)
    objective = evaluation.study.objective
    difference = (after.rewards(objective) - before.rewards(objective))[kept]
    _, group, sizes = np.unique(labels[kept], return_inverse=True, return_counts=True)
    means = np.zeros((len(sizes), difference.shape[1]))
    np.add.at(means, group, difference / sizes[group, None])
    if evaluation.study.real.runs > 1 or not len(means):
        summary = summarise(means.sum(axis=1))
        return PairedDifference(summary.mean, summary.ci95)
    series = mean_interval(means.ravel())
    length = means.shape[1]
    return PairedDifference(length * series.mean, (length * series.ci95[0], length * series.ci95[1]))


def _run(evaluation: Evaluation, choice: InService, scenario: Scenario) -> Trajectory:
    """Closed-loop runs of a policy and its design."""
    policy = LearnedPolicy(choice.agent, choice.design)
    return scenario.run(policy, design=choice.design, limit=evaluation.problem.limit)


def _mean_return(evaluation: Evaluation, choice: InService, scenario: Scenario) -> float:
    """Mean return over the runs that do not diverge; NaN if all do."""
    run = _run(evaluation, choice, scenario)
    kept = run.returns(evaluation.study.objective)[~run.diverged]
    return float(kept.mean()) if len(kept) else float("nan")


def _plain(difference: PairedDifference) -> dict[str, Any]:
    """Mean and interval as plain values."""
    return {"mean": difference.mean, "ci95": difference.ci95}
