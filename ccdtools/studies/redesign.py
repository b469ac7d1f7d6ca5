"""Whether a redesign replaces what is in service, before anything is built."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccdtools.arrays import Array
from ccdtools.co_design.risk import measure
from ccdtools.plants.design_space import SAME_DESIGN, DesignSpace
from ccdtools.scenario import Scenario
from ccdtools.statistics import PairedDifference, Summary, summarise_returns
from ccdtools.studies.evaluation import Evaluation
from ccdtools.studies.price import RedesignPrice
from ccdtools.studies.report.formatting import in_measure, percent_interval
from ccdtools.trajectory import Trajectory
from ccdtools.twin.limits_kept import Breach, breach
from ccdtools.twin.paired_risk import paired_in_risk
from ccdtools.twin.recombined_returns import LoggedGain, recombined_gain
from ccdtools.twin.residuals import Residuals
from ccdtools.twin.twin import DigitalTwin
from learning.networks import ActorCritic

WORTH_A_POLICY = 0.001  # a policy costs nothing to build: it is replaced for a gain of this fraction of the return


class RedesignStatus(Enum):
    """What became of a redesign, and why."""

    TAKEN = "taken"
    BELOW_PRICE = "less than its price"
    NO_GAIN = "no gain beyond chance"
    DIVERGES = "more of its runs diverge"
    CONTRADICTED = "the updated model says the contrary"
    UNFILTERED = "the filter finds no set at its design"
    LIMITS = "it leaves the limits further than granted"

    @property
    def advice(self) -> str:
        """What the user may do about it."""
        return {
            RedesignStatus.TAKEN: "",
            RedesignStatus.BELOW_PRICE: "State another price (redesign_price) if so small a gain is worth a redesign.",
            RedesignStatus.NO_GAIN: "Log more runs or a longer one; or the design is as good as the log can tell.",
            RedesignStatus.DIVERGES: "Limit the box of designs to those that keep the plant stable.",
            RedesignStatus.CONTRADICTED: "Deploy longer: the errors and what was learned of them tell two stories.",
            RedesignStatus.LIMITS: "Grant more with limit_tolerance, or put the filter in service.",
            RedesignStatus.UNFILTERED: "Widen X or U, or leave the filter out: no state can be kept within X for ever.",
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
        Return of a deployment of the redesign minus that of what is in service, in the study's risk, each through E(p)
        of its own design: on whole runs of logged errors (the interval is of the mean over the runs), or on runs
        recombined of them where all logs are `independent` (the interval is of the means of blocks of logged runs).
    updated_gain : PairedDifference
        The same on the updated model with the unexplained rest replayed; NaN where there is none, and where the
        redesign is not taken anyway.
    needed : float
        Smallest gain for which it is taken: the price.
    size : float
        The return in service without the cost of the design, of which relative prices and gains are parts.
    nominal_before, nominal_after : float
        Return on the nominal model of what is in service, and of the redesign.
    moved : bool
        Whether the redesign has another design.
    status : RedesignStatus
    price : str
    measure : str
        What of the returns it is judged by: "mean", or the study's risk in words.
    breach : str
        How it breaks the limits, where it is refused for that.
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
    measure: str = "mean"
    breach: str = ""

    @property
    def accepted(self) -> bool:
        """Whether the gain is beyond chance and worth its price, no more runs diverge, the limits are kept as far as
        was granted, and nothing contradicts it.
        """
        return self.status is RedesignStatus.TAKEN

    def describe(self, proposed: str) -> str:
        """The decision in one sentence; `proposed` says what was judged."""
        verdict = "taken" if self.accepted else f"not taken, {self.reason()}"
        if self.status is RedesignStatus.UNFILTERED:
            return f"{proposed} {verdict}"
        return f"{proposed} {verdict}: it promised {self.promise()} on the logged errors at a price of {self.price}; " \
               f"nominal model {self.nominal_before:.4g} → {self.nominal_after:.4g}"  # fmt: skip

    def promise(self) -> str:
        """The gain and its interval in per cent of the return in service, and of what of the returns it is."""
        return percent_interval(self.gain.mean, self.gain.ci95, self.size) + in_measure(self.measure)

    def reason(self) -> str:
        """Why it is not taken."""
        if self.status is RedesignStatus.BELOW_PRICE:
            return f"less than its price of {self.price}"
        if self.status is RedesignStatus.LIMITS:
            return self.breach
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
            "promise": self.promise(), "measure": self.measure, "breach": self.breach,
            "reason": "" if self.accepted else self.reason(),
        }  # fmt: skip


def judge_redesign(
    evaluation: Evaluation, candidate: InService, current: InService, logs: Sequence[Residuals],
    twin: DigitalTwin | None = None,
) -> RedesignDecision:  # fmt: skip
    """The decision between a redesign and what is in service, both on the same runs of logged errors.

    These are the logged runs. Where the errors of all logs do not depend on each other in time, `model_runs` runs are
    recombined of them step by step; the interval is then of the means of blocks of logged runs, not of those many runs.

    Each goes from the start of a run to its end, through states of its own: in a window that begins within a run the
    cost of a start that neither has earned can outweigh everything else. Both stand behind the study's filter. It is
    taken only for a gain whose 95 % interval excludes zero and that exceeds the study's price of a redesign (a tenth
    of a per cent if the policy alone changes), if it keeps the limits as far as was granted where what is in service
    does, and if the updated model of `twin` does not deny it beyond chance. Gains are in the study's risk: of the mean
    return, or of the mean less its spread, or of the worst runs.
    Relative prices are of the larger of the returns on the logged errors and on the nominal model: a log with hardly
    any disturbance says little, and the return on it is small; a part of that would move a design for nothing. They are
    of what control makes, without the cost of the design.
    """
    if not evaluation.can_serve(candidate.design):
        return _unfiltered(evaluation, candidate, current)
    found = _gain_on_logs(evaluation, candidate, current, logs)
    gain = found.gain
    nominal = evaluation.on_model(())
    nominal_before, nominal_after = (_mean_return(evaluation, choice, nominal) for choice in (current, candidate))
    part = logs[-1].steps / nominal.steps
    of_control = evaluation.study.objective.made_by_control(nominal_before, current.design, nominal.steps)
    size = float(np.nan_to_num(np.fmax(of_control * part, found.size)))
    moved = _moved(evaluation, candidate, current)
    price = evaluation.study.price if moved else _price_of_a_policy(evaluation.study.price, size, part)
    needed = price.of(size, part)
    status = _status(gain, needed, safe=not found.more_lost)
    updated = _no_gain()
    broken = _breach(evaluation, candidate, current, logs) if status is RedesignStatus.TAKEN else None
    status = status if broken is None else RedesignStatus.LIMITS
    if status is RedesignStatus.TAKEN:
        updated = _updated_gain(evaluation, candidate, current, twin)
        status = RedesignStatus.CONTRADICTED if updated.ci95[1] < 0 else status
    return RedesignDecision(
        gain, updated, needed, size, nominal_before, nominal_after, moved, status, str(price),
        measure(evaluation.study.judged_in), "" if broken is None else str(broken),
    )  # fmt: skip


def _breach(
    evaluation: Evaluation, candidate: InService, current: InService, logs: Sequence[Residuals]
) -> Breach | None:
    """How a redesign breaks limits on whole logged runs that what is in service keeps."""
    scenario, _ = evaluation.on_logs(logs)
    after, before = (_run(evaluation, choice, scenario) for choice in (candidate, current))
    return breach(evaluation.problem, scenario, after, before, evaluation.study.plant)


def _gain_on_logs(
    evaluation: Evaluation, candidate: InService, current: InService, logs: Sequence[Residuals]
) -> LoggedGain:  # fmt: skip
    """What a redesign brings on the logged errors, recombined where that may be."""
    replay = evaluation.replay(logs)
    objective = evaluation.study.objective
    count = evaluation.config.model_runs
    if replay.recombines:
        model = evaluation.split.replayed_model

        def drive(x0: Array, w: Array) -> tuple[Trajectory, Trajectory]:
            """The runs of both services."""
            scenario = Scenario(model, x0, w)
            return _run(evaluation, candidate, scenario), _run(evaluation, current, scenario)

        rng = evaluation.rng("recombined runs")
        return recombined_gain(replay, drive, objective, count, rng, evaluation.study.judged_in)
    scenario, labels = evaluation.on_logs(logs)
    before, after = (_run(evaluation, choice, scenario) for choice in (current, candidate))
    own = before.returns(objective)[~(before.diverged | after.diverged)]
    gain = _clustered(evaluation, after, before, labels)
    size = before.size_of(float(own.mean()), objective) if len(own) else 0.0
    return LoggedGain(gain, size, bool(after.diverged.mean() > before.diverged.mean()))


def promised(evaluation: Evaluation, choice: InService, logs: Sequence[Residuals]) -> Summary:
    """Predicted return of a deployment: on the newest log's errors from end to end, or before any on the model."""
    scenario = evaluation.on_model(logs) if logs else evaluation.nominal_deployment()
    run = _run(evaluation, choice, scenario)
    rewards = run.rewards(evaluation.study.objective)[~run.diverged]
    return summarise_returns(rewards, runs=len(run.states))


def same_service(one: InService, other: InService) -> bool:
    """Whether two services are the same policy at the same design."""
    weights = zip(one.agent.state_dict().values(), other.agent.state_dict().values())
    return np.array_equal(one.design, other.design) and all(bool((a == b).all()) for a, b in weights)


def same_design(space: DesignSpace, one: Array, other: Array) -> bool:
    """Whether two designs differ by less than a thousandth of the range of every parameter."""
    return bool(np.abs(space.to_unit(one) - space.to_unit(other)).max() <= SAME_DESIGN)


def _moved(evaluation: Evaluation, candidate: InService, current: InService) -> bool:
    """Whether a candidate has another design than what is in service."""
    return not same_design(evaluation.problem.design, candidate.design, current.design)


def _unfiltered(evaluation: Evaluation, candidate: InService, current: InService) -> RedesignDecision:
    """The decision on a design at which the study's filter has no set to keep the state in."""
    nan = float("nan")
    return RedesignDecision(
        _no_gain(), _no_gain(), nan, nan, nan, nan, _moved(evaluation, candidate, current), RedesignStatus.UNFILTERED,
        str(evaluation.study.price),
    )  # fmt: skip


def _price_of_a_policy(price: RedesignPrice, size: float, part: float) -> RedesignPrice:
    """What a policy alone must bring: a tenth of a per cent, or the price of a redesign if that is less."""
    own = RedesignPrice(100 * WORTH_A_POLICY, relative=True)
    return own if own.of(size, part) <= price.of(size, part) else price


def _status(gain: PairedDifference, needed: float, *, safe: bool) -> RedesignStatus:
    """What becomes of a redesign with that gain on the logged errors."""
    if not safe:
        return RedesignStatus.DIVERGES
    if not (gain.ci95[0] > 0 or 0 < gain.mean < needed):
        return RedesignStatus.NO_GAIN
    return RedesignStatus.TAKEN if gain.mean > needed else RedesignStatus.BELOW_PRICE


def _no_gain() -> PairedDifference:
    """A gain that was not looked at."""
    return PairedDifference(np.nan, (np.nan, np.nan))


def _updated_gain(
    evaluation: Evaluation, candidate: InService, current: InService, twin: DigitalTwin | None
) -> PairedDifference:
    """Candidate minus current on the updated model with its innovations replayed; NaN without a twin."""
    if twin is None or twin.discrepancy is None:
        return _no_gain()
    scenario, labels = evaluation.on_updated_logs(twin)
    after, before = (_run(evaluation, choice, scenario) for choice in (candidate, current))
    return _clustered(evaluation, after, before, labels)


def _clustered(
    evaluation: Evaluation, after: Trajectory, before: Trajectory, labels: NDArray[np.int64]
) -> PairedDifference:
    """Difference of the returns in the study's risk: over groups of runs that met the same disturbance."""
    kept = ~(after.diverged | before.diverged)
    objective = evaluation.study.objective
    made, met = (run.rewards(objective)[kept] for run in (after, before))
    study = evaluation.study
    return paired_in_risk(study.judged_in, made, met, labels[kept], runs=study.real.runs, stretch=evaluation.window)


def _run(evaluation: Evaluation, choice: InService, scenario: Scenario) -> Trajectory:
    """Closed-loop runs of a policy and its design, as they would be in service."""
    controller = evaluation.in_service(choice.agent, choice.design)
    return scenario.run(controller, design=choice.design, limit=evaluation.problem.limit)


def _mean_return(evaluation: Evaluation, choice: InService, scenario: Scenario) -> float:
    """Mean return over the runs that do not diverge; NaN if all do."""
    run = _run(evaluation, choice, scenario)
    kept = run.returns(evaluation.study.objective)[~run.diverged]
    return float(kept.mean()) if len(kept) else float("nan")


def _plain(difference: PairedDifference) -> dict[str, Any]:
    """Mean and interval as plain values."""
    return {"mean": difference.mean, "ci95": difference.ci95}
