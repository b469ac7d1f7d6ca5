"""Rows of a reproduction, filled from its folder, each with its verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.comparison.seeds import mean_over_seeds
from ccdtools.evidence.evidence import Asked, Evidence
from ccdtools.evidence.percent import number, with_minus
from ccdtools.evidence.verdict import Status, Verdict, decide
from ccdtools.plants.design_space import DesignSpace
from ccdtools.statistics import PairedDifference
from ccdtools.studies.reproduce.budget import CASES, EPOCHS, Budget
from ccdtools.studies.reproduce.lines import Line, lines_of
from ccdtools.studies.stage_storage import Stage

if TYPE_CHECKING:
    from ccdtools.studies.reproduce.tasks import Task

COMMON_TO_ALL = -1  # in place of a seed
WORDS = {Status.BETTER: "better", Status.WORSE: "worse", Status.MORE_LOST: "loses more runs"}
PRESET = ("nominal-after-paper",)  # what --paper-budgets carries out whole
ELSEWHERE = " (on a generated road: the recorded one is not at hand)"


@dataclass(frozen=True)
class Cell:
    """Mean with its 95 % interval, spread and design; NaN without one."""

    mean: float = float("nan")
    low: float = float("nan")
    high: float = float("nan")
    std: float = float("nan")
    at: str = ""

    def __str__(self) -> str:
        if not np.isfinite(self.mean):
            return "—"
        ends = f" [{number(self.low, 4)}, {number(self.high, 4)}]" if self.high > self.low else ""
        std = f", std {number(self.std, 3)}" if self.std > 0 else ""
        return with_minus(number(self.mean, 4) + ends + std) + (f"; {self.at}" if self.at else "")


@dataclass(frozen=True)
class Found:
    """Findings of one case study by key, of each seed and once.

    `seeds` and `once` hold arrays, `designs` texts of designs or lists of their values.
    """

    seeds: tuple[dict[str, Array], ...]
    once: dict[str, Array]
    designs: tuple[dict[str, Any], ...]
    space: DesignSpace
    decisions: tuple[bool, ...] = ()
    updates: tuple[int, ...] = ()  # accepted in each deployment

    def values(self, key: str) -> Array | None:
        """Values (seeds, runs) of a key, (1, runs) if common, or None."""
        own = [found[key] for found in self.seeds if key in found]
        if not own:
            return self.once[key][None] if key in self.once else None
        return np.array(own)

    def cell(self, key: str, *, fresh: bool) -> Cell:
        """Cell of a key; empty if nothing was measured under it."""
        table = self.values(key)
        if table is None:
            return Cell()
        found = mean_over_seeds(table, fresh=fresh)
        lost = np.isnan(table)
        kept = table[~lost.all(axis=1)]
        spread = float(np.nanstd(kept, axis=1).mean()) if len(kept) and table.shape[1] > 1 else float("nan")
        told = (self._where(key), f"{lost.mean():.2%} of the runs lost" if lost.any() else "")
        return Cell(found.mean, *found.ci95, spread, "; ".join(filter(None, told)))

    def beside(self, key: str, other: str, *, fresh: bool, lower: bool) -> Verdict | None:
        """Verdict on one key beside another, or None."""
        one, two = self.values(key), self.values(other)
        if one is None or two is None:
            return None
        runs = min(one.shape[1], two.shape[1])
        one, two = np.broadcast_arrays(one[:, :runs], two[:, :runs])
        gain = mean_over_seeds((one - two) * (-1 if lower else 1), fresh=fresh)
        lost = (int(np.isnan(one).sum()), int(np.isnan(two).sum()))
        kept = ~np.isnan(one - two)
        values = (float(one[kept].mean()), float(two[kept].mean())) if kept.any() else (0.0, 0.0)
        return judged(gain, *values, lost=lost)

    def _where(self, key: str) -> str:
        """Design or designs that a key belongs to, in words."""
        known = [found[key] for found in self.designs if key in found]
        if not known or isinstance(known[0], str):
            return known[0] if known else ""
        low, high = np.min(known, axis=0), np.max(known, axis=0)
        return ", ".join(
            f"{name} = {a:.5g}" + (f" to {b:.5g}" if f"{a:.5g}" != f"{b:.5g}" else "")
            for name, a, b in zip(self.space.names, low, high)
        )


def filled_rows(tasks: Sequence[Task], budget: Budget) -> list[dict[str, Any]]:
    """Rows of both case studies, as texts and numbers by column."""
    rows = []
    for case in CASES:
        found = found_in([task for task in tasks if task.case == case])
        for line in lines_of(case):
            partly = f" ({EPOCHS} of its 10 000 epochs)" if line.key in PRESET and not budget.paper else ""
            rows.append(_row(line, found, partly + ("" if budget.road or not line.on_road else ELSEWHERE)))
    return rows


def found_in(tasks: Sequence[Task]) -> Found:
    """What the finished tasks of one case study have found."""
    seeds: dict[int, dict[str, Array]] = {}
    designs: dict[int, dict[str, Any]] = {COMMON_TO_ALL: {}}
    once: dict[str, Array] = {}
    decisions, updates = [], []
    for task in tasks:
        stages = task.finished()
        texts = designs.setdefault(task.seed if task.of_seed else COMMON_TO_ALL, {})
        for part, stage in stages.items():
            texts |= stage.values.get("designs", {})
            decisions += [stage.values["replaces"]] if "replaces" in stage.values else []
            updates += [stage.values["accepted"]] if "accepted" in stage.values else []
            if not task.of_seed and part not in task.programs:
                once |= stage.arrays
        if task.of_seed and "measured" in stages:
            seeds.setdefault(task.seed, {}).update(_of_seed(task, stages))
    for task in tasks:
        if task.kind == "optimum":
            stages = task.finished()
            best = max((stages[name].arrays for name in task.programs), key=lambda one: float(one["return"][0]))
            once["nominal.optimum"] = best["return"]
            place = task.problem.design.describe(best["p"])
            designs[COMMON_TO_ALL]["nominal.optimum"] = f"dynamic program at {place}"
    return Found(tuple(seeds.values()), once, tuple(designs.values()), tasks[0].problem.design, tuple(decisions),
                 tuple(updates))  # fmt: skip


def _of_seed(task: Task, stages: Mapping[str, Stage]) -> dict[str, Array]:
    """What one seed has measured, with the scores of its clone and of its twin."""
    own = {f"r2{'-paper' if task.kind == 'paper' else ''}.ours": stages["start"].arrays["r2"]}
    if "twin" in stages:
        own |= {f"{name}.ours": value for name, value in stages["twin"].arrays.items()}
    return own | stages["measured"].arrays


def _row(line: Line, found: Found, note: str) -> dict[str, Any]:
    ours, policy, lqr, optimum = (
        found.cell(key, fresh=line.fresh)
        for key in (f"{line.key}.ours", f"{line.key}.policy", f"{line.base}.lqr", f"{line.place}.optimum")
    )
    said = _of_sets(line, found) if line.key.startswith("set") else verdict(line, found, ours, optimum)
    former = found.beside(f"{line.key}.ours", f"{line.former}.ours", fresh=line.fresh, lower=line.lower)
    if former is not None:
        deployed = f"{sum(found.decisions)} of {len(found.decisions)} redesigns deployed"
        said += f"; {said_of(former, 'equal within chance')} beside generation 1; {deployed}"
    before = found.beside(f"{line.key}.ours", "nominal-before.ours", fresh=False, lower=False)
    if line.key in PRESET and before is not None:
        said += f"; {said_of(before, 'equal within chance')} beside the return before it"
    if line.key.endswith("-updated") and found.updates:
        said += f"; {sum(found.updates)} updates accepted in {len(found.updates)} deployments"
    return {
        "case": line.case, "row": line.says, "paper": str(line.printed), "place": line.printed.place, "LQR": str(lqr),
        "our policy there": str(policy), "ours": str(ours), "optimum": str(optimum), "verdict": said + note,
        "figure": line.figure, "mean": ours.mean, "low": ours.low, "high": ours.high,
    }  # fmt: skip


def verdict(line: Line, found: Found, ours: Cell, optimum: Cell) -> str:
    """Verdict on a row, beside the paper.

    Where the paper prints no figure, ours is compared with LQR at the paper's design, on the same runs.
    """
    printed = line.printed
    if not np.isfinite(ours.mean):
        return "not measured"
    if not np.isfinite(printed.mean):
        beside = found.beside(f"{line.key}.ours", f"{line.base}.lqr", fresh=line.fresh, lower=line.lower)
        if beside is None:
            return "no figure to compare"
        return f"no figure; {said_of(beside, 'equal within chance')} beside LQR at the paper's design"
    paper = Cell(printed.mean, printed.mean - printed.half_width, printed.mean + printed.half_width)
    word = said_of(apart(ours, paper, lower=line.lower), "not told apart")
    if not np.isfinite(optimum.mean) or apart(paper, optimum, lower=line.lower).status is not Status.BETTER:
        return word
    return _out_of_reach(line, optimum, word)


def _out_of_reach(line: Line, optimum: Cell, word: str) -> str:
    """Why a figure beyond the optimum cannot be, as far as measured."""
    best = with_minus(number(optimum.mean))
    if line.key != "rmse":
        if optimum.at.startswith("dynamic"):
            return f"cannot be here, because no policy at a design of the grid comes there: {best} at best"
        return f"{word}; no LQR of the grid comes there: {best} at best"
    if line.case == "illustrative":
        return f"cannot be, because the noise of its real plant alone leaves {best}"
    return f"{word}; linear prediction of the road leaves {best} at the paper's design"


def apart(one: Cell, other: Cell, *, lower: bool) -> Verdict:
    """Verdict on one mean beside another of other runs."""
    sign = -1 if lower else 1
    away = np.nan_to_num([one.mean - one.low, one.high - one.mean, other.high - other.mean])
    below, above = np.hypot(away[:2], away[2])[::sign]
    gain = sign * (one.mean - other.mean)
    return judged(PairedDifference(gain, (gain - below, gain + above)), one.mean, other.mean)


def judged(gain: PairedDifference, one: float, other: float, *, lost: tuple[int, int] = (0, 0)) -> Verdict:
    """Verdict by the decision rule for deployments."""
    evidence = Evidence("ours", "other", "these runs", Asked.GAIN, gain, (one, other), abs(other), 1, "seeds", lost)
    return decide([evidence])


def said_of(verdict: Verdict, otherwise: str) -> str:
    """Word on a verdict, or another where nothing is shown, and the gain."""
    return f"{WORDS.get(verdict.status, otherwise)}: {verdict.percent}"


def _of_sets(line: Line, found: Found) -> str:
    areas = [float(value[0]) for key, value in found.once.items() if key.startswith("set") and key.endswith("ours")]
    away = found.once[f"{line.key}.ours"][0] / found.once[f"{line.key}.optimum"][0] - 1
    grows = "reproduced: it grows with p" if (np.diff(areas) > 0).all() else "not reproduced: it does not grow with p"
    return f"{grows}; {with_minus(f'{100 * away:+.1f}')} % beside a grid of states"
