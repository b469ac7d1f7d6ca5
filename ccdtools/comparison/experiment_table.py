"""Experiment: the records of all tasks as rows, and compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ccdtools.comparison.compared import Compared, compared, weakest
from ccdtools.comparison.experiment_record import Record
from ccdtools.evidence.percent import number, share
from ccdtools.exceptions import InputError
from ccdtools.pages import paragraphs
from ccdtools.table import Table, csv_text, data_frame
from ccdtools.tolerances import FEWEST_RUNS

AXES = ("controller", "design", "scenario", "plant")


@dataclass(frozen=True, eq=False, repr=False)
class Experiment:
    """Controllers, designs, scenarios, plants and seeds, compared in pairs.

    Iterated, it gives a `Compared` per controller, design, scenario and plant; indexed by as many of these names as
    tell it apart, the one.

    Attributes
    ----------
    records : tuple of Record
        One per controller, design and seed.
    baseline : str
        The controller that the others are paired to, at the same design.
    fresh : frozenset of str
        Scenarios that draw runs of their own for each seed.
    limits : str
        What violations are of.
    conditions : tuple of (what, which, in words)
        Plants, scenarios, designs, objective, limits and seeds: the head of a page, with the controllers.
    """

    records: tuple[Record, ...]
    baseline: str
    fresh: frozenset[str]
    limits: str = "X"
    conditions: tuple[tuple[str, ...], ...] = ()

    @property
    def header(self) -> Table:
        """Table of what was compared: conditions, and each controller as made for the first seed."""
        made = {one.controller: one.about for one in reversed(self.records) if one.about}
        controllers = (("controller", name, about) for name, about in reversed(made.items()))
        return Table(("", "", "what was compared"), [*self.conditions, *controllers])

    @cached_property
    def cells(self) -> tuple[Compared, ...]:
        """Every controller and design on every scenario and plant."""
        found: dict[tuple[str, str], list[Record]] = {}
        for one in self.records:
            found.setdefault((one.controller, one.design), []).append(one)
        places = dict.fromkeys((cell.scenario, cell.plant) for one in self.records for cell in one.cells)
        return tuple(
            compared(
                (*kind, *place), records, found[self.baseline, kind[1]], baseline=self.baseline,
                fresh=place[0] in self.fresh,
            )
            for place in places for kind, records in found.items()
        )  # fmt: skip

    @property
    def verdicts(self) -> dict[tuple[str, str], str]:
        """Weakest word on each controller and design, by names.

        It stands with its gain and place: a controller is better if it is so on every scenario and plant.
        """
        kinds = dict.fromkeys(cell.names[:2] for cell in self.cells if cell.names[0] != self.baseline)
        return {kind: weakest([cell for cell in self.cells if cell.names[:2] == kind]) for kind in kinds}

    def __iter__(self) -> Iterator[Compared]:
        return iter(self.cells)

    def __len__(self) -> int:
        return len(self.cells)

    def __getitem__(self, names: str | tuple[str, ...]) -> Compared:
        asked = (names,) if isinstance(names, str) else tuple(names)
        in_order = [cell for cell in self.cells if cell.names[: len(asked)] == asked]
        found = in_order if len(in_order) == 1 else [cell for cell in self.cells if set(asked) <= set(cell.names)]
        if len(found) != 1:
            raise KeyError(f"{', '.join(map(str, asked))}: {len(found)} cells have these names among {', '.join(AXES)}")
        return found[0]

    def rows(self) -> list[dict[str, Any]]:
        """One dictionary of plain values per run.

        A lost run has the return up to where it was stopped.
        """
        return [
            {
                **dict(zip(AXES, (one.controller, one.design, cell.scenario, cell.plant))), "seed": one.seed,
                "run": run, "return": float(cell.returns[run]), "lost": bool(cell.lost[run]),
                "outside": float(cell.fractions[0].mean() if cell.single else cell.fractions[0, run]),
                "depth": float(cell.peaks[0].max() if cell.single else cell.peaks[0, run]),
            }
            for one in self.records for cell in one.cells for run in range(len(cell.returns))
        ]  # fmt: skip

    def to_frame(self) -> Any:
        """`pandas.DataFrame` of the rows.

        Raises
        ------
        ImportError
            If pandas is not installed.
        """
        return data_frame(self.rows(), "Experiment.to_frame", "take rows(), or save a .csv file")

    def save(self, path: str | Path) -> None:
        """Write rows as .csv or .parquet, or a page as .html.

        Raises
        ------
        InputError
            If the path ends otherwise, or cannot be written.
        ImportError
            If a .parquet file is asked for without pandas and pyarrow.
        """
        from ccdtools.comparison.experiment_figure import page

        file = Path(path)
        kinds = (".csv", ".parquet", ".html")
        if file.suffix not in kinds:
            raise InputError("path", str(path), f"a file that ends in {', '.join(kinds)}")
        try:
            if file.suffix == ".parquet":
                self.to_frame().to_parquet(file)
            else:
                text = csv_text(self.rows()) if file.suffix == ".csv" else page(self)
                file.write_text(text, encoding="utf-8")
        except OSError as error:
            raise InputError("path", f"{path} ({error.strerror or error})", "a file that can be written") from None

    def plot(self, figure: Any = None) -> Any:
        """Plot gains, profiles of returns and times as a matplotlib Figure."""
        from ccdtools.comparison.experiment_figure import plot_experiment

        return plot_experiment(self, figure)

    @property
    def table(self) -> Table:
        """Printed table, a line per cell."""
        told = [i for i in range(len(AXES)) if i == 0 or len({cell.names[i] for cell in self}) > 1]
        metrics = list(dict.fromkeys(name for cell in self for name in cell.metrics))
        head = (
            *(AXES[i] for i in told), "return", "95 % interval", "middle half", f"against {self.baseline}", "better in",
            "lost", f"outside {self.limits}", "µs a step", *self._in_c, "training", *metrics, "verdict",
        )  # fmt: skip
        lines = [(*(cell.names[i] for i in told), *self._cells(cell, metrics)) for cell in self]
        return Table(head, lines, right=frozenset(range(len(told), len(head) - 1)))

    @property
    def notes(self) -> list[str]:
        """What each cell stands on, and remarks."""
        seeds = len({one.seed for one in self.records})
        runs = " or ".join(str(n) for n in sorted({cell.runs for cell in self}))
        lines = [
            f"{seeds} seed{'s'[: seeds - 1]}, {runs} runs of each. µs a step: median, 99th percentile. "
            f"{'In C: those of the exported code. ' * len(self._in_c)}Training: median of the seeds.",
            f"Per cents are of what control costs {self.baseline}, the price of the design left out.",
        ]
        if seeds == 1:
            lines.append("Of one seed intervals are of the runs alone, and say nothing of another training.")
        elif seeds < FEWEST_RUNS:
            lines.append(f"{seeds} seeds are too few for 95 % where returns are skewed: take {FEWEST_RUNS} or more.")
        if any(cell.evidence.lost != (0, 0) for cell in self):
            lines.append("Lost runs diverged or stopped, and have no return; a seed without a controller has lost all.")
        return lines + list(dict.fromkeys(f"{cell.names[0]}: {cell.remark}" for cell in self if cell.remark))

    def __repr__(self) -> str:
        return "\n".join([str(self.table), *self.notes])

    def _repr_html_(self) -> str:
        return self.table.html + paragraphs(self.notes)

    @property
    def _in_c(self) -> tuple[str, ...]:
        """Head of the column of exported C, where there is one."""
        return ("in C",) * any(np.isfinite(cell.c_step_time[0]) for cell in self)

    def _cells(self, cell: Compared, metrics: list[str]) -> tuple[str, ...]:
        """Texts of a line, but for its names; the baseline is not compared."""
        low, high = (number(end) for end in cell.value.ci95)
        own, in_c = (", ".join(number(1e6 * one, 3) for one in pair) for pair in (cell.step_time, cell.c_step_time))
        training = f"{number(cell.seconds, 2)} s" + (f", {cell.steps:.3g} samples" if cell.steps > 0 else "")
        base = cell.names[0] == self.baseline
        ends = ", ".join(number(100 * end, 2) for end in cell.better.ci95)
        better = f"{share(cell.better.mean)} [{ends}]"
        against = ("", "") if base else (cell.evidence.percent, better)
        lost = share(cell.evidence.lost[0] / max(cell.evidence.runs, 1))
        return (
            number(cell.value.mean, 5), f"[{low}, {high}]", number(cell.middle.mean, 5), *against, lost,
            share(cell.fraction), own, *[in_c] * len(self._in_c), training,
            *(number(cell.metrics.get(name)) for name in metrics), "" if base else cell.word,
        )  # fmt: skip
