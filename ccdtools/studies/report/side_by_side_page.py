"""Tables, picture and page of a run of one design per use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ccdtools import figure_style as style
from ccdtools.evidence.percent import number, percent_interval
from ccdtools.studies.report.method_page import page_of
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.side_by_side import START, SideBySide, Trial
from ccdtools.studies.stage_storage import Stage
from ccdtools.table import Table, csv_text


def designs_table(study: SideBySide, found: Mapping[str, Stage]) -> Table:
    """Designs of LQG and of the learned policy, a line each."""
    space = study.plant.design
    rows = {START: study.p0}
    for use, stage in found.items():
        rows |= {f"{use}, LQG": stage.arrays["LQG"], f"{use}, learned": stage.arrays["design"]}
    head = ("design", *(f"{name} [{unit}]" for name, unit in zip(space.names, space.units)))
    lines = [(name, *(number(value) for value in p)) for name, p in rows.items()]
    return Table(head, lines, right=frozenset(range(1, len(head))))


def changes_table(trials: Mapping[str, Trial]) -> Table:
    """Changes of every metric with 95 % intervals, a line per use and question."""
    names = next(iter(trials.values())).names
    lines = [
        (use, question, *(percent_interval(one.change.mean, one.change.ci95, one.before) for one in changes))
        for use, trial in trials.items() for question, changes in trial.changes.items()
    ]  # fmt: skip
    return Table(("use", "what changes", *names), lines, right=frozenset(range(2, 2 + len(names))))


def values_table(trials: Mapping[str, Trial]) -> Table:
    """Metrics of every design and controller, a line each."""
    names = next(iter(trials.values())).names
    lines = [
        (use, *place, *(number(value) for value in values.values()))
        for use, trial in trials.items() for place, values in trial.values.items()
    ]  # fmt: skip
    return Table(("use", "design", "controller", *names), lines, right=frozenset(range(3, 3 + len(names))))


def plot_side_by_side(
    study: SideBySide, found: Mapping[str, Stage], trials: Mapping[str, Trial], *, quick: bool = False
) -> Any:
    """Plot the designs in their box, and what changes in every use, as a matplotlib Figure."""
    with style.styled():
        figure = style.blank(4.0 + 4.5 * len(trials), 4.6, quick=quick)
        first, *others = figure.subplots(1, 1 + len(trials), width_ratios=(0.7, *(1 for _ in trials)))
        space = study.plant.design
        for use, stage in {START: study.p0, **{use: stage.arrays["design"] for use, stage in found.items()}}.items():
            first.plot(space.names, space.to_unit(stage), "o-", lw=0.8, label=use)
        first.set(ylim=(-0.05, 1.05), ylabel="place in the box of designs", title="designs")
        first.legend()
        for ax, (use, trial) in zip(others, trials.items()):
            _plot_changes(ax, trial)
            ax.set_title(use)
            ax.label_outer()
        others[0].legend(loc="lower left")
    return figure


def _plot_changes(ax: Any, trial: Trial) -> None:
    """Changes of the metrics with their intervals, a colour per question."""
    rows = np.arange(len(trial.names))
    for i, (question, changes) in enumerate(trial.changes.items()):
        at = rows + 0.8 * (i / max(len(trial.changes) - 1, 1) - 0.5)
        size = np.array([abs(one.before) or np.nan for one in changes])
        mean, low, high = 100 * np.array([(one.change.mean, *one.change.ci95) for one in changes]).T / size
        ax.errorbar(mean, at, xerr=[mean - low, high - mean], fmt="o", ms=3.5, lw=1.2, label=question)
    ax.axvline(0.0, color="#444444", lw=0.9)
    ax.set_yticks(rows, [style.label(name) for name in trial.names])
    ax.invert_yaxis()
    ax.set_xlabel("change [%], 95 % interval")


def write_side_by_side(
    study: SideBySide, found: Mapping[str, Stage], trials: Mapping[str, Trial], folder: RunFolder, *, quick: bool
) -> tuple[str, Path]:
    """Write results.json, side_by_side.csv, its picture and report.html; return what is printed, and the page."""
    tables = {
        "Designs": designs_table(study, found), "What changes": changes_table(trials), "Values": values_table(trials),
    }  # fmt: skip
    image = style.png(plot_side_by_side(study, found, trials, quick=quick))
    folder.write_bytes("side_by_side.png", image)
    values = tables["Values"]
    folder.write_text("side_by_side.csv", csv_text([dict(zip(values.head, line)) for line in values.lines]))
    changed = {use: {name: list(map(asdict, ones)) for name, ones in t.changes.items()} for use, t in trials.items()}
    folder.write_json("results.json", {"study": study.name, "quick": quick, "changes": changed})
    body = "".join(f"<h2>{name}</h2><div>{table.html}</div>" for name, table in tables.items())
    page = folder.write_text("report.html", page_of(study.title, body, image, "Designs, and what changes"))
    return "\n\n".join("\n".join([name, *table.aligned()]) for name, table in tables.items()), page
