"""Whether what was deployed stays in service: it must not be worse than what it replaces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from scipy import stats

from ccdtools.arrays import Array
from ccdtools.co_design.risk import MEAN, Mean, Risk, measure
from ccdtools.statistics import SAME_RETURN, PairedDifference, Summary, summarise_returns
from ccdtools.studies.redesign import InService
from ccdtools.trajectory import Trajectory
from ccdtools.twin.common_runs import common_runs
from ccdtools.twin.paired_risk import paired_in_risk, parts_of_risk

FALSE_ALARM = 0.002  # chance that a judge who is right is called wrong in one generation: one per cent in five
STRETCH = 100  # steps of a single run that stand for a run
FEWEST_DEGREES = 2  # of freedom in the interval of a single run


class ServiceStatus(Enum):
    """What became of a deployed generation."""

    FIRST = "the first in service"
    BETTER = "better"
    NOT_WORSE = "not worse"
    NOT_BETTER = "not better"
    WORSE = "worse"
    DIVERGED = "more of its runs diverged"
    LIMITS = "further outside the limits than granted"

    @property
    def replaces(self) -> bool:
        """Whether it stays in service."""
        return self in (ServiceStatus.FIRST, ServiceStatus.BETTER, ServiceStatus.NOT_WORSE)

    @property
    def advice(self) -> str:
        """What the user may do about it."""
        if self.replaces:
            return ""
        return "What was in service before is in service again; the log of this generation still teaches the twin."


class JudgeStatus(Enum):
    """How a promise and what was delivered agree."""

    AGREED = "within chance"
    MORE = "more than promised"
    LESS = "less than promised: the judge was wrong"
    OPEN = "too few runs to tell"

    @property
    def kept(self) -> bool | None:
        """What it says of the judge: right, wrong, or nothing."""
        return {JudgeStatus.AGREED: True, JudgeStatus.LESS: False}.get(self)


@dataclass(frozen=True, eq=False)
class Served:
    """A generation in service: its number, what was deployed, and the log of its newest deployment."""

    generation: int
    designed: InService
    log: Trajectory


@dataclass(frozen=True)
class Delivery:
    """What a deployment delivered, beside what was promised and what the generation in service had delivered.

    Attributes
    ----------
    returns : Summary
        Of the deployment.
    promised : Summary
        Predicted for it.
    judge : JudgeStatus
        How the two agree.
    change : PairedDifference
        Deployed return, in the study's risk, minus that of what was in service; NaN for the first generation.
    paired : bool
        Whether both met the same disturbances.
    size : float
        The mean return that was in service, without the cost of its design.
    status : ServiceStatus
    measure : str
        What of the returns the change is of: "mean", or the study's risk in words.
    """

    returns: Summary
    promised: Summary
    judge: JudgeStatus
    change: PairedDifference
    paired: bool
    size: float
    status: ServiceStatus
    measure: str = "mean"

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for results.json."""
        return {
            "promised": asdict(self.promised), "judge": self.judge.value, "change": asdict(self.change),
            "paired": self.paired, "size": self.size, "status": self.status.value, "replaces": self.status.replaces,
            "measure": self.measure,
        }  # fmt: skip


def judge_deployment(
    log: Trajectory, former: Trajectory | None, objective: Any, promised: Summary, *, redesigned: bool,
    risk: Risk = MEAN, stretch: int = STRETCH,
) -> Delivery:  # fmt: skip
    """Whether a deployment replaces what was in service before it.

    It does if its return is better beyond chance; or if it is not worse and was asked for: by the judge, to whom it had
    promised a gain beyond its price, where no loss was delivered; or because nothing was redesigned. It does not if
    more runs diverged. Where there is no interval (a single run that is short for its correlation, or drifts) nothing
    can be said beyond that run, and a loss on it is enough for updates, too, to be taken back.

    Parameters
    ----------
    log : Trajectory
        Of the deployment.
    former : Trajectory or None
        Log of what was in service before. Runs that met the same disturbances are compared in pairs, a single run as
        a correlated series, others by Welch's interval.
    objective : QuadraticObjective or CustomObjective
    promised : Summary
        Predicted return.
    redesigned : bool
        Whether a redesign was deployed, which must bring something; what was in service before need not.
    risk : Risk
        What of the returns is compared with what was in service; promises are of their mean.
    stretch : int
        Steps of a stretch of a single run, which stands for a run where the risk is not the mean.
    """
    rewards = log.rewards(objective)
    returns = summarise_returns(rewards[~log.diverged], runs=len(rewards))
    judge = _agreement(promised, returns, SAME_RETURN * log.size_of(promised.mean, objective))
    if former is None:
        none = PairedDifference(np.nan, (np.nan, np.nan))
        size = log.size_of(returns.mean, objective)
        return Delivery(returns, promised, judge, none, False, size, ServiceStatus.FIRST, measure(risk))
    others = former.rewards(objective)
    size = former.size_of(float(others[~former.diverged].sum(axis=1).mean()), objective)
    change, paired = _change(log, former, rewards, others, risk, stretch)
    lost = _more_diverged(log, former, everywhere=redesigned or not paired)
    status = ServiceStatus.DIVERGED if lost else _status(change, SAME_RETURN * size, redesigned=redesigned)
    return Delivery(returns, promised, judge, change, paired, size, status, measure(risk))


def _agreement(promised: Summary, returns: Summary, rounding: float = 0.0) -> JudgeStatus:
    """How a promise and what was delivered agree: apart where chance would hardly ever part them so far."""
    if np.isfinite(promised.mean) and not np.isfinite(returns.mean):
        return JudgeStatus.LESS
    if not np.isfinite([*promised.ci95, *returns.ci95]).all():
        return JudgeStatus.OPEN
    if _apart(returns, promised, rounding):
        return JudgeStatus.LESS
    return JudgeStatus.MORE if _apart(promised, returns, rounding) else JudgeStatus.AGREED


def _apart(lower: Summary, upper: Summary, rounding: float) -> bool:
    """Whether one mean lies below another by more than chance brings in one of `FALSE_ALARM` comparisons.

    The halves of the 95 % intervals that face each other are those of independent errors; together they are widened
    from that level to the rarer one, with as many degrees of freedom as the shorter sample has.
    """
    degrees = min(s.n - 1 if s.n > 1 else FEWEST_DEGREES for s in (lower, upper))
    wider = stats.t.ppf(1 - FALSE_ALARM, degrees) / stats.t.ppf(0.975, degrees)
    half = np.hypot(lower.ci95[1] - lower.mean, upper.mean - upper.ci95[0])
    return bool(upper.mean - lower.mean > wider * half + rounding)


def _change(
    log: Trajectory, former: Trajectory, own: Array, others: Array, risk: Risk, stretch: int
) -> tuple[PairedDifference, bool]:  # fmt: skip
    """Difference of the deployed returns in a risk with its interval, and whether it is of pairs."""
    runs = len(own)
    common = common_runs(runs)
    same = log.disturbances.shape == former.disturbances.shape and np.array_equal(
        log.disturbances[common], former.disturbances[common]
    )
    if same and (runs == 1 or runs >= 4):
        kept = ~(log.diverged | former.diverged)[common]
        after, before = (rewards[common][kept] for rewards in (own, others))
        return paired_in_risk(risk, after, before, np.arange(len(after)), runs=runs, stretch=stretch), True
    each = (run[~one.diverged].sum(axis=1) for run, one in ((own, log), (others, former)))
    parts = each if isinstance(risk, Mean) else (parts_of_risk(risk, returns) for returns in each)
    a, b = parts
    return welch_difference(a, b), False


def welch_difference(a: Array, b: Array) -> PairedDifference:
    """Difference of the means of two independent samples with its 95 % interval by Welch."""
    if min(len(a), len(b)) < 2:
        mean = float(a.mean() - b.mean()) if min(len(a), len(b)) else float("nan")
        return PairedDifference(mean, (float("nan"), float("nan")))
    interval = stats.ttest_ind(a, b, equal_var=False).confidence_interval()
    return PairedDifference(float(a.mean() - b.mean()), (float(interval.low), float(interval.high)))


def _more_diverged(log: Trajectory, former: Trajectory, *, everywhere: bool) -> bool:
    """Whether more runs diverged than before: of all, or of those that met the same disturbances."""
    common = common_runs(len(log.diverged))
    if log.diverged[common].mean() > former.diverged[common].mean():
        return True
    return everywhere and bool(log.diverged.mean() > former.diverged.mean())


def _status(change: PairedDifference, floor: float, *, redesigned: bool) -> ServiceStatus:
    """What becomes of a deployment with that change; below `floor` it is rounding."""
    if change.ci95[1] < -floor:
        return ServiceStatus.WORSE
    if change.ci95[0] > floor:
        return ServiceStatus.BETTER
    asked = redesigned or not np.isfinite(change.ci95).all()
    return ServiceStatus.NOT_BETTER if asked and change.mean < -floor else ServiceStatus.NOT_WORSE


def after_deployment(
    status: ServiceStatus, deployed: Served, agent_at_end: Any, before: InService, former: Served | None,
    *, redesigned: bool, updated: bool,
) -> tuple[InService, Served]:  # fmt: skip
    """What is in service after a deployment, and the deployment that speaks for it.

    A generation that changed nothing serves under the number of the one that it repeats.

    Where a redesign fell short, that is what was in service before. Where nothing but updates of the policy came
    between two deployments and the later one is worse, it is the policy that the former deployment began with.
    """
    if status.replaces or former is None:
        idle = former is not None and not redesigned and not updated
        speaks = replace(deployed, generation=former.generation) if idle and former is not None else deployed
        return InService(agent_at_end, deployed.designed.design), speaks
    return (before if redesigned else former.designed), former


def promise_of(values: Mapping[str, Any]) -> Summary:
    """The predicted return that a stage has kept."""
    def real(value: float | None) -> float:
        """The value; NaN where JSON has none."""
        return float("nan") if value is None else value

    mean, std, median = (real(values[name]) for name in ("mean", "std", "median"))
    low, high = map(real, values["ci95"])
    return Summary(mean, std, median, values["n"], (low, high))
