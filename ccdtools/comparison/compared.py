"""One controller on one scenario and plant, over all seeds, beside the baseline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccdtools.arrays import Array, Indices, Mask
from ccdtools.comparison.experiment_record import Cell, Record
from ccdtools.comparison.seeds import interquartile_mean, mean_over_seeds, share_over_seeds
from ccdtools.evidence.evidence import NOTHING, Asked, Evidence, Violation
from ccdtools.evidence.percent import nothing_done, word_of_gain
from ccdtools.limits import Excursions, deepest_row, further_outside
from ccdtools.statistics import PairedDifference

STOPPED = "stopped"
NONE = "none"
LOSES_MORE = "loses more runs"
OPEN = "open"
RETURN_ONLY = " in return only"
WORDS = (
    STOPPED, NONE, LOSES_MORE, "worse", OPEN, *(f"{word}{RETURN_ONLY}" for word in ("not worse", "equal", "better")),
    "not worse", "equal", "better",
)  # fmt: skip
Names = tuple[str, str, str, str]  # of controller, design, scenario and plant


@dataclass(frozen=True, eq=False)
class Compared:
    """One controller beside the baseline, over all seeds.

    Attributes
    ----------
    names : (str, str, str, str)
        Of controller, design, scenario and plant.
    seeds, runs : int
        Seeds that it was made with, and runs of each.
    stopped : int
        Seeds for which no controller could be made, or a run stopped, but not with the baseline; the remark says why.
    value : PairedDifference
        Mean return of the runs that did not diverge, with its 95 % interval.
    middle : PairedDifference
        Interquartile mean over seeds, or over the runs of one; a lost run is worse than any other.
    evidence : Evidence
        The gain over the baseline on the same runs, and the runs that each lost. One that stopped is lost, and a seed
        for which no controller could be made has lost all. There is no gain where a return is no number.
    better : PairedDifference
        Share of the runs in which its return is higher than the baseline's; those equal to five digits count half, and
        those in which the baseline stopped do not.
    fraction, peak : float
        Of the states outside the limits, and mean largest depth in half-widths.
    times : (k,) array
        Of single calls [s].
    seconds, steps : float
        What making the controller took, in the median of the seeds: time, and samples of the environment.
    metrics : dict of str to float
        Means over the seeds.
    c_step_time : (float, float)
        Median and 99th percentile of exported C [s], in the median of the seeds; NaN where there is none.
    remark : str
        Why seeds are missing, or what the controller says of itself.
    apart : bool
        Whether it says so with every seed: then it is none to compare with.
    """

    names: Names
    seeds: int
    runs: int
    stopped: int
    value: PairedDifference
    middle: PairedDifference
    evidence: Evidence
    better: PairedDifference
    fraction: float
    peak: float
    times: Array
    seconds: float
    steps: float
    metrics: dict[str, float]
    c_step_time: tuple[float, float]
    remark: str
    apart: bool

    @property
    def step_time(self) -> tuple[float, float]:
        """Median and 99th percentile of a call's time [s]."""
        if not len(self.times):
            return float("nan"), float("nan")
        median, most = np.quantile(self.times, [0.5, 0.99])
        return float(median), float(most)

    @property
    def word(self) -> str:
        """One of `WORDS`; "in return only" beyond the baseline's limits.

        One that stopped is so whatever it gains elsewhere; one that is none to compare with is "none".
        """
        found = self.evidence
        if self.stopped or self.apart:
            return STOPPED if self.stopped else NONE
        if found.lost[0] > found.lost[1]:
            return LOSES_MORE
        ends = (found.gain.mean, *found.gain.ci95)
        if not np.isfinite(ends).all() or not found.size > 0:
            return OPEN
        word = word_of_gain(*(value / found.size for value in ends))
        return word if found.violation is None or word in (OPEN, "worse") else f"{word}{RETURN_ONLY}"


def weakest(cells: Sequence[Compared]) -> str:
    """Weakest word of several cells, its gain and place."""
    worst = min(cells, key=lambda cell: (WORDS.index(cell.word), cell.evidence.gain.mean / (cell.evidence.size or 1.0)))
    better = sum(cell.word == "better" for cell in cells)
    also = f", better on {better} of {len(cells)}" if worst.word != "better" and better else ""
    return f"{worst.word}: {worst.evidence.percent} on {worst.evidence.distribution}{also}"


def compared(
    names: Names, records: Sequence[Record], base: Sequence[Record], *, baseline: str, fresh: bool
) -> Compared:
    """Controller beside the baseline on one scenario and plant.

    Parameters
    ----------
    names : (str, str, str, str)
        Of controller, design, scenario and plant.
    records, base : sequence of Record
        Of the controller and of the baseline, one per seed.
    baseline : str
        Its name.
    fresh : bool
        Whether each seed draws runs of its own.
    """
    own, other = ({one.seed: cell for one in some for cell in one.cells if (cell.scenario, cell.plant) == names[2:]}
                  for some in (records, base))  # fmt: skip
    cells = list(own.values())
    made = [one for one in records if one.made]
    stopped, base_stopped = ({seed for seed, cell in some.items() if cell.stopped} for some in (own, other))
    no_number = [_no_number(names, seed, cell) for seed, cell in own.items() if len(cell.undefined)]
    judged = cells if not no_number else []
    pairs = [] if any(len(cell.undefined) for cell in (*cells, *other.values())) else list(zip(cells, other.values()))
    told = [*no_number, *(f"seed {seed}: {own[seed].stopped}" for seed in sorted(stopped))]
    own_words = [one.remark for one in records if one.remark]
    idle = [nothing_done(_place(names))] * (names[0] == baseline and all(cell.idle for cell in cells))
    kept = [np.where(cell.lost, np.nan, cell.returns) for cell in judged]
    worst = [np.where(cell.lost, -np.inf, cell.returns) for cell in judged]
    left = [_left(cell) for cell in cells]
    runs = max(len(cell.returns) for cell in cells)
    lost, base_lost = (sum(int(cell.lost.sum()) for cell in some.values()) for some in (own, other))
    begun = sum(len(cell.returns) for cell in cells)
    grouped = f"{len(records)} seeds of {runs} runs"
    median, most = np.median([(one.c_step_time, one.c_step_time_99) for one in made or records], axis=0)
    return Compared(
        names, len(made), runs, len(stopped - base_stopped),
        value=_mean(kept, fresh, [cell.series for cell in judged if not cell.lost.any()]),
        middle=interquartile_mean(_table(worst)) if judged else NOTHING,
        evidence=_evidence(names, baseline, pairs, fresh, (lost, base_lost), (begun, grouped)),
        better=share_over_seeds(_table([_won(*pair) for pair in pairs]), fresh=fresh) if pairs else NOTHING,
        fraction=_average([one[0] for one in left]),
        peak=_average([one[1] for one in left]),
        times=np.concatenate([np.zeros(0), *(cell.times for cell in cells)]),
        seconds=float(np.median([one.seconds for one in made])) if made else float("nan"),
        steps=float(np.median([one.steps for one in made])) if made else float("nan"),
        c_step_time=(float(median), float(most)),
        metrics=_metrics([cell.metrics for cell in cells if not cell.lost.all()]),
        remark=next(iter([*told, *own_words, *idle]), ""), apart=len(own_words) == len(records),
    )  # fmt: skip


def _evidence(
    names: Names, baseline: str, pairs: list[tuple[Cell, Cell]], fresh: bool, lost: tuple[int, int],
    begun: tuple[int, str],
) -> Evidence:  # fmt: skip
    """Evidence of the pairs of cells with common seeds, and of the runs that each lost."""
    candidate = ", ".join(name for name in names[:2] if name)
    kept = [~(own.lost | base.lost) for own, base in pairs]
    both = [[np.where(keep, cell.returns, np.nan) for keep, cell in zip(kept, cells)] for cells in zip(*pairs)]
    gain, values, size = NOTHING, (float("nan"), float("nan")), 0.0
    if any(keep.any() for keep in kept):
        series = [own.series - base.series for (own, base), keep in zip(pairs, kept) if keep.all()]
        gain = _mean([own - base for own, base in zip(*both)], fresh, series)
        values = (_mean(both[0], fresh, []).mean, _mean(both[1], fresh, []).mean)
        size = abs(values[1] + pairs[0][1].design_cost)
    return Evidence(
        candidate, baseline, _place(names), Asked.TOLERANCE, gain, values, size, *begun, lost,
        violation=_violation(pairs),
    )  # fmt: skip


def _place(names: Names) -> str:
    """Names of scenario and plant."""
    return ", ".join(name for name in names[2:] if name) or "the scenario"


def _no_number(names: Names, seed: int, cell: Cell) -> str:
    """Which return is no number."""
    run = cell.undefined[0]
    return f"seed {seed}: {_place(names)}: run {run} has the return {cell.returns[run]}, so that there is no verdict"


def _violation(pairs: list[tuple[Cell, Cell]]) -> Violation | None:
    """Limits that are left further, or more often, than by the baseline: of one kind, if it is one."""
    kept = [[replace(cell, lost=own.lost | base.lost) for cell in (own, base)] for own, base in pairs]
    for kind in reversed(range(len(pairs[0][0].peaks) if pairs else 0)):
        own, base = (_excursions(cells, kind) for cells in zip(*kept))
        if further_outside(own, base):
            met = ~np.asarray(own.lost)
            achieved, before = ((float(one.fraction[met].mean()), float(one.peak[met].mean())) for one in (own, base))
            peaks, rows, lost = (np.concatenate(found) for found in zip(*(_rows(cell, kind) for cell, _ in kept)))
            row = deepest_row(peaks, rows, lost, kept[0][0].texts[kind])
            return Violation(achieved, before, before, row, False)
    return None


def _excursions(cells: Sequence[Cell], kind: int) -> Excursions:
    """Violations of a kind of limits by seed, or by the runs of the only one."""
    if len(cells) == 1:
        (cell,) = cells
        fraction = cell.fractions[kind]
        peak, rows, lost = _rows(cell, kind)
        return Excursions(fraction, fraction, peak, rows, cell.texts[kind], lost=lost, single=cell.single)
    fraction, peak = np.array([_left(cell, kind) for cell in cells]).T
    return Excursions(np.nan_to_num(fraction), np.nan_to_num(fraction), np.nan_to_num(peak), lost=np.isnan(peak))


def _rows(cell: Cell, kind: int) -> tuple[Array, Indices, Mask]:
    """Peaks, rows that are exceeded most, and losses of the runs."""
    peak = cell.peaks[kind]
    return peak, cell.rows[kind], np.broadcast_to(cell.lost, peak.shape)


def _left(cell: Cell, kind: int = 0) -> tuple[float, float]:
    """Fraction of states outside and mean peak, without lost runs."""
    if cell.lost.all():
        return float("nan"), float("nan")
    fraction, peak = cell.fractions[kind], cell.peaks[kind]
    if cell.single:
        return float(fraction.mean()), float(peak.max())
    return float(fraction[~cell.lost].mean()), float(peak[~cell.lost].mean())


def _won(own: Cell, base: Cell) -> Array:
    """Runs (N,) better than the baseline's; equal ones, to five digits, count half, and NaN where that stopped."""
    first, second = (np.where(cell.lost, -np.inf, cell.returns) for cell in (own, base))
    return np.where(np.isnan(base.returns), np.nan, np.where(np.isclose(first, second, atol=0.0), 0.5, first > second))


def _mean(values: Sequence[Array], fresh: bool, series: Sequence[Array]) -> PairedDifference:
    """Mean over seeds of values (runs,); nothing without a seed."""
    if not len(values):
        return NOTHING
    same = len({len(parts) for parts in series}) == 1
    parts = np.mean(series, axis=0) if same and len(series[0]) else None
    return mean_over_seeds(_table(values), fresh=fresh, series=parts)


def _table(values: Sequence[Array]) -> Array:
    """Values (seeds, runs), NaN where a seed has fewer runs than another."""
    table = np.full((len(values), max(map(len, values))), np.nan)
    for row, found in zip(table, values):
        row[: len(found)] = found
    return table


def _metrics(found: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean metrics over the seeds; NaN where one of them has none."""
    names = dict.fromkeys(name for one in found for name in one)
    return {name: float(np.mean([one.get(name, np.nan) for one in found])) for name in names}


def _average(values: Sequence[float]) -> float:
    """Mean of the finite values; NaN without any."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")
