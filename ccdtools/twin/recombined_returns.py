"""Returns on recombined runs: whether they are those of the logged runs, and which of two services has the larger."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from ccdtools.arrays import Array
from ccdtools.co_design.objective import Objective
from ccdtools.co_design.risk import MEAN, Mean, Risk
from ccdtools.statistics import PairedDifference, summarise
from ccdtools.trajectory import Trajectory
from ccdtools.twin.paired_risk import parts_of_risk
from ccdtools.twin.recombination import Dependence, Indices, dependence
from ccdtools.twin.replay import Replay

FEWEST_DECIDED = 36  # logged runs from which on it can be told whether errors depend on each other,
FEWEST_STEPS = 3  # and steps: of two the first stays with its state
RECOMBINED = 0.5  # share of recombined runs in a gain; the rest is of the logged ones
ROUNDS = 4  # that every logged error is met in at least, to tell it

Drive = Callable[[Array, Array], tuple[Trajectory, ...]]
Part = tuple[Array, Array, Indices]


@dataclass(frozen=True)
class Independence:
    """Whether the runs of a log are recombined.

    Attributes
    ----------
    dependence : str
        What the errors themselves show: none, slight, plain, or not looked at.
    change : PairedDifference
        Mean return of what is in service on recombined runs, less that on the logged ones; NaN where it was not looked
        at.
    independent : bool
    possible : bool
        Whether the log does not speak against it, if not for it either: the errors show a slight dependence, and the
        mean return is the same within its 95 % interval, if not within a standard error.
    reason : str
        Why it is not independent.
    """

    dependence: str
    change: PairedDifference
    independent: bool
    possible: bool
    reason: str = ""

    def describe(self) -> str:
        """What becomes of the log in one line."""
        if self.independent:
            return "errors of different steps are taken as independent: runs are recombined step by step"
        return f"runs are replayed as logged: {self.reason}"


TOO_FEW = "the runs are too few or too short to tell whether errors of different steps depend on each other"
PLAINLY = "errors of different steps depend on each other"
MOVED = "recombined they move the return of what is in service"
SLIGHTLY = "errors of different steps may depend on each other, and the return on recombined runs does not deny it"
NOT_ASKED = Independence(
    "not looked at", PairedDifference(np.nan, (np.nan, np.nan)), False, False, "recombination is switched off"
)


@dataclass(frozen=True)
class LoggedGain:
    """What a candidate brings on logged errors.

    Attributes
    ----------
    gain : PairedDifference
        Its return, or what a risk makes of it, less that of what is in service, over the runs that neither loses.
    size : float
        How large the mean return of what is in service is, without the cost of its design; zero where no run is kept.
    more_lost : bool
        Whether more of its runs diverge.
    """

    gain: PairedDifference
    size: float
    more_lost: bool


@dataclass(frozen=True, eq=False)
class _Tally:
    """Sums over the runs of every block (B,): runs, those that no controller lost, their returns, those lost (k, B).

    Of the n runs that no controller lost, `labels` (n,) are the blocks and `each` (k, n) the returns; `last` is a run
    of the last controller.
    """

    runs: Array
    kept: Array
    returns: Array
    lost: Array
    labels: Indices
    each: Array
    last: Trajectory

    def means(self) -> Array:
        """Mean returns (k, B); zero of a block without a run."""
        return self.returns / np.maximum(self.kept, 1)

    def lost_shares(self) -> Array:
        """Share of the runs that diverged (k, B)."""
        return self.lost / np.maximum(self.runs, 1)


def independence(log_of: Replay, drive: Drive, objective: Objective, rng: np.random.Generator) -> Independence:
    """Whether recombined runs of a log tell the same of what is in service as the log does.

    The errors must show no plain dependence in time, and the mean return of what is in service must be the same on
    recombined runs as on the logged ones: within its 95 % interval where the errors show no dependence at all, within
    one standard error where they show a slight one, as it may be harmless.

    Parameters
    ----------
    log_of : Replay
        Of one deployment, as far as it went.
    drive : callable
        (x0, errors) → the run of what is in service, as the only one of a tuple.
    """
    runs = sum(log.runs for log in log_of.logs)
    blocks = log_of.blocks()
    shortest = min(log.steps for log in log_of.logs)
    if runs < FEWEST_DECIDED or blocks is None or shortest < FEWEST_STEPS:
        return replace(NOT_ASKED, reason=TOO_FEW)
    errors, states = (np.concatenate([getattr(log, name) for log in log_of.logs]) for name in ("e_next", "x"))
    found = dependence(errors, states)
    if found is Dependence.PLAIN:
        return replace(NOT_ASKED, dependence=found.value, reason=PLAINLY)
    logged = _tally([(*log_of.whole(), blocks)], drive, objective, blocks)
    recombined = _tally(log_of.recombined(ROUNDS, rng), drive, objective, blocks)
    both = np.where((logged.kept > 0) & (recombined.kept > 0), logged.kept, 0)
    change = over_blocks(recombined.means()[0] - logged.means()[0], both)
    lost = over_blocks(recombined.lost_shares()[0] - logged.lost_shares()[0], logged.runs)
    half = change.ci95[1] - change.mean
    error = half / float(stats.t.ppf(0.975, max((both > 0).sum() - 1, 1)))
    possible = bool(abs(change.mean) <= half and lost.ci95[0] <= 0 <= lost.ci95[1])
    harmless = found is Dependence.NONE or abs(change.mean) <= error
    reason = MOVED if not possible else "" if harmless else SLIGHTLY
    return Independence(found.value, change, bool(possible and harmless), possible, reason)


def recombined_gain(
    replay: Replay, drive: Drive, objective: Objective, count: int, rng: np.random.Generator, risk: Risk = MEAN
) -> LoggedGain:  # fmt: skip
    """What a candidate brings on about `count` recombined runs; both meet the same ones.

    The gain of a block is half that of the runs recombined in it and half that of its logged runs: what a dependence in
    time that is too weak to be seen does to the recombined ones counts half. The interval is of the means of the
    blocks, however many runs were recombined. More of the logged runs must not be lost. Of many recombined runs one or
    two more are lost by chance: they count if the share differs beyond chance between the blocks, or by more than one
    of the logged number of runs.

    Parameters
    ----------
    replay : Replay
        Of runs that are dealt to blocks.
    drive : callable
        (x0, errors) → the runs of the candidate and of what is in service.
    risk : Risk
        What of the returns the gain is of, by default their mean.
    """
    blocks = replay.blocks()
    assert blocks is not None
    found = _tally(replay.recombined(replay.rounds(count), rng), drive, objective, blocks)
    logged = _tally([(*replay.whole(), blocks)], drive, objective, blocks)
    made, met = (np.subtract(*one.means()) for one in (found, logged))
    gain = over_blocks(np.where(logged.kept > 0, RECOMBINED * made + (1 - RECOMBINED) * met, made), found.kept)
    gain = gain if isinstance(risk, Mean) else _gain_in_risk(risk, found, logged)
    lost = over_blocks(np.subtract(*found.lost_shares()), found.runs)
    own = found.returns[1].sum() / found.kept.sum() if found.kept.any() else 0.0
    more_lost = logged.lost[0].sum() > logged.lost[1].sum() or lost.ci95[0] > 0 or lost.mean > 1 / len(blocks)
    return LoggedGain(gain, found.last.size_of(float(own), objective) if found.kept.any() else 0.0, bool(more_lost))


def _gain_in_risk(risk: Risk, found: _Tally, logged: _Tally) -> PairedDifference:
    """Half of the gain on recombined runs and half of that on logged ones, with the interval over blocks."""
    made, met = (np.subtract(*(parts_of_risk(risk, each, one.labels) for each in one.each)) for one in (found, logged))
    same = np.array_equal(np.unique(found.labels), np.unique(logged.labels))
    summary = summarise(RECOMBINED * made + (1 - RECOMBINED) * met if same else made)
    return PairedDifference(summary.mean, summary.ci95)


def over_blocks(values: Array, weights: Array) -> PairedDifference:
    """Weighted mean of the means of blocks (B,) with its 95 % interval: blocks are independent, their runs are not."""
    n = int((weights > 0).sum())
    shares = weights / max(weights.sum(), 1)
    mean = float(shares @ values) if n else float("nan")
    if n < 2:
        return PairedDifference(mean, (np.nan, np.nan))
    error = np.sqrt(n / (n - 1) * float(shares**2 @ (values - mean) ** 2))
    half = float(stats.t.ppf(0.975, n - 1) * error)
    return PairedDifference(mean, (mean - half, mean + half))


def _tally(parts: Iterable[Part], drive: Drive, objective: Objective, blocks: Indices) -> _Tally:
    """The sums over runs that come in parts, so that they need not fit into memory together."""
    size = int(blocks.max()) + 1

    def summed(labels: Indices, values: Array) -> Array:
        """Sum of the values (n,) of every block."""
        return np.bincount(labels, weights=values, minlength=size).astype(float)

    sums = []
    singles = []
    for x0, w, labels in parts:
        driven = drive(x0, w)
        kept = ~np.any([run.diverged for run in driven], axis=0)
        returns = [summed(labels, np.where(kept, run.returns(objective), 0.0)) for run in driven]
        lost = [summed(labels, run.diverged.astype(float)) for run in driven]
        sums.append((summed(labels, np.ones(len(labels))), summed(labels, kept.astype(float)), returns, lost))
        singles.append((labels[kept], np.array([run.returns(objective)[kept] for run in driven])))
    runs, kept, returns, lost = (np.sum([one[k] for one in sums], axis=0) for k in range(4))
    own = np.concatenate([labels for labels, _ in singles])
    return _Tally(runs, kept, returns, lost, own, np.concatenate([each for _, each in singles], axis=1), driven[-1])
