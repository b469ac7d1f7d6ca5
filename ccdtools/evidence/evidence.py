"""Evidence on two candidates: paired returns, lost runs and limits."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from typing import Any

import numpy as np

from ccdtools.arrays import Array, Indices
from ccdtools.co_design.objective import Objective
from ccdtools.co_design.risk import MEAN, Mean, Risk, measure
from ccdtools.co_design.risk_intervals import difference_of_parts, parts_of_risk, too_few
from ccdtools.evidence.percent import in_measure, percent_interval
from ccdtools.statistics import PairedDifference, Summary, mean_interval, paired_returns, summarise_returns
from ccdtools.trajectory import Trajectory
from ccdtools_ground.door import as_finite

NOTHING = PairedDifference(float("nan"), (float("nan"), float("nan")))


class Asked(Enum):
    """What a candidate must show on a distribution."""

    GAIN = "a gain beyond chance, above its price"
    TOLERANCE = "no loss beyond the tolerance"
    NO_LOSS = "no loss in the mean"
    NO_SURE_LOSS = "no loss beyond chance"
    SHOWN = "shown only"


@dataclass(frozen=True)
class Violation:
    """Violation of limits beyond the tolerance and beyond the compared candidate's.

    Attributes
    ----------
    achieved, before, tolerance : (float, float)
        Fraction of the samples outside and mean peak in half-widths: of the candidate, of what it is compared with on
        the same runs, and what the user's tolerance allows at the candidate's design.
    exceeded : str
        The limit that is exceeded most.
    by_mpc : bool
        Whether the tolerance is what MPC of the same design does.
    """

    achieved: tuple[float, float]
    before: tuple[float, float]
    tolerance: tuple[float, float]
    exceeded: str
    by_mpc: bool

    def __str__(self) -> str:
        source = " by what MPC does" if self.by_mpc else ""
        achieved, before, tolerance = (
            f"{fraction:.2%} of the samples, {depth:.3g} half-widths at the peak"
            for fraction, depth in (self.achieved, self.before, self.tolerance)
        )
        return (
            f"it leaves the limits further than the tolerance ({self.exceeded}: {achieved}; tolerance{source} "
            f"{tolerance}; before {before})"
        )


@dataclass(frozen=True)
class Evidence:
    """Two candidates compared on one distribution of starts and disturbances.

    Attributes
    ----------
    candidate, current : str
        Each by its policy and design, and by the stretch of a log that it stands for, if it does.
    distribution : str
    asked : Asked
        What the candidate must show here.
    gain : PairedDifference
        Candidate less current, in `measure`, with its 95 % interval; NaN where no pair is left.
    values : (float, float)
        Mean returns of the candidate and of the current one, over the pairs.
    size : float
        How large the current return is without the cost of the design: what per cents are of.
    runs : int
    grouped : str
        What is independent: runs, groups of runs that met one disturbance, or parts of one series.
    lost : (int, int)
        Runs that the candidate and the current one lose.
    needed : float
        Price: the gain that is asked for.
    violation : Violation or None
        Limits that the candidate leaves too far.
    measure : str
        What of the returns is compared: "mean", or the study's risk in words.
    """

    candidate: str
    current: str
    distribution: str
    asked: Asked
    gain: PairedDifference
    values: tuple[float, float]
    size: float
    runs: int
    grouped: str
    lost: tuple[int, int] = (0, 0)
    needed: float = 0.0
    violation: Violation | None = None
    measure: str = "mean"

    @property
    def percent(self) -> str:
        """Gain and its interval in per cent: "+0.1 % [−0.2, +0.4]"."""
        return percent_interval(self.gain.mean, self.gain.ci95, self.size) + in_measure(self.measure)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for results.json."""
        violation = "" if self.violation is None else str(self.violation)
        return asdict(self) | {"asked": self.asked.value, "percent": self.percent, "violation": violation}


@dataclass(frozen=True, eq=False)
class Pairing:
    """Rule by which returns are compared in pairs.

    Attributes
    ----------
    objective : QuadraticObjective or CustomObjective
    risk : Risk
        What of the returns is compared.
    stretch : int
        Steps of a stretch of a single run, which stands for a run where the risk is not the mean.
    """

    objective: Objective
    risk: Risk = field(default_factory=lambda: MEAN)
    stretch: int = 100

    def evidence(
        self, after: Trajectory, before: Trajectory, *, names: tuple[str, str], distribution: str, asked: Asked,
        groups: Indices | None = None, series: bool = False, counted: int | None = None,
    ) -> Evidence:  # fmt: skip
        """Evidence of two candidates on the same starts and disturbances.

        Parameters
        ----------
        after, before : Trajectory
            Of the candidate and of the current one.
        names : (str, str)
            Theirs.
        groups : (n,) int array, optional
            Runs of one group met one disturbance: together they are one piece of evidence. Each is its own by default.
        series : bool
            Whether the runs are consecutive parts of a single one.
        counted : int, optional
            Last steps of every run that count; all by default.

        Raises
        ------
        InputError
            If a reward of a run that neither loses is not finite.
        """
        kept = ~(after.diverged | before.diverged)
        labels = np.arange(len(kept)) if groups is None else np.asarray(groups, dtype=np.int64)
        lost = (int(after.diverged.sum()), int(before.diverged.sum()))
        none = Evidence(
            *names, distribution, asked, NOTHING, (np.nan, np.nan), 0.0, len(kept), _grouped(labels, series), lost,
            measure=measure(self.risk),
        )  # fmt: skip
        if not kept.any():
            return none
        made, met = (
            as_finite(f"rewards of {name}", run.rewards(self.objective)[kept][:, -(counted or 0) :])
            for name, run in zip(names, (after, before))
        )
        gain = paired_in_risk(
            self.risk, made, met, labels[kept], runs=1 if series else max(2, len(kept)), stretch=self.stretch
        )
        parts = 1 if series else kept.sum()
        values = (float(made.sum() / parts), float(met.sum() / parts))
        steps = met.size // parts
        size = float(self.objective.made_by_control(values[1], before.design, steps))
        return replace(none, gain=gain, values=values, size=size)


def summary_of(run: Trajectory, objective: Objective) -> Summary:
    """Statistics of the returns of the runs that did not diverge."""
    return summarise_returns(run.rewards(objective)[~run.diverged], runs=len(run.states))


def _grouped(labels: Indices, series: bool) -> str:
    if series:
        return "one run, as a series"
    groups = len(np.unique(labels))
    return f"{len(labels)} runs" if groups == len(labels) else f"{len(labels)} runs in {groups} groups"


def paired_in_risk(
    risk: Risk, after: Array, before: Array, labels: Indices, *, runs: int, stretch: int
) -> PairedDifference:
    """Paired difference in risk with its 95 % interval over groups.

    Of a deployment of one run the returns of its stretches take the place of those of runs, scaled to its whole length.
    There is no interval where fewer than ten groups decide a risk that is not the mean.

    Parameters
    ----------
    risk : Risk
    after, before : (n, T) arrays
        Rewards of both; of one run, (k, T) of consecutive parts.
    labels : (n,) int array
        The group of every run: only groups are independent evidence.
    runs : int
        That were begun.
    stretch : int
        Length of a stretch of a single run: that of an episode.
    """
    if isinstance(risk, Mean):
        if runs == 1:
            after, before, labels = after.reshape(1, -1), before.reshape(1, -1), np.zeros(1, dtype=np.int64)
        return paired_over_groups(after, before, labels, runs=runs)
    if runs == 1:
        one, other = (stretches(rewards, stretch) for rewards in (after, before))
        if len(one) < 2:
            return NOTHING
        number = after.size / min(stretch, after.shape[1])
        found = mean_interval(number * (parts_of_risk(risk, one) - parts_of_risk(risk, other)))
        few = too_few(risk, np.arange(len(one)))
        return PairedDifference(found.mean, (np.nan, np.nan) if few else found.ci95)
    parts = [parts_of_risk(risk, rewards.sum(axis=1), labels) for rewards in (after, before)]
    return difference_of_parts(risk, parts[0] - parts[1], np.arange(len(parts[0])))


def stretches(rewards: Array, stretch: int) -> Array:
    """Returns (m,) of whole stretches in consecutive rewards (k, T)."""
    length = min(stretch, rewards.shape[1])
    count = rewards.shape[1] // length
    return np.asarray(rewards[:, : count * length].reshape(-1, length).sum(axis=1))


def paired_over_groups(after: Array, before: Array, labels: Indices, *, runs: int) -> PairedDifference:
    """Mean difference of returns over groups, from rewards (n, T), labels (n,).

    Only groups are independent evidence. Of one group the interval is that of its series, if no more runs were begun.
    """
    return paired_returns(*(_means_of_groups(rewards, labels) for rewards in (after, before)), runs=runs)


def _means_of_groups(rewards: Array, labels: Indices) -> Array:
    """Mean rewards (groups, T) of runs (n, T) with equal labels."""
    _, group, sizes = np.unique(labels, return_inverse=True, return_counts=True)
    means = np.zeros((len(sizes), rewards.shape[1]))
    np.add.at(means, group, rewards / sizes[group, None])
    return means
