"""Tables, picture and page of a run of one design per use."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccdtools import figure_style as style
from ccdtools.evidence.percent import number, percent_interval
from ccdtools.pages import page_of, paragraphs, picture_of
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.side_by_side import START, SideBySide
from ccdtools.studies.side_by_side_run import Trial
from ccdtools.studies.stage_storage import Stage
from ccdtools.table import Table, csv_text


def write_side_by_side(
    study: SideBySide, found: Mapping[str, Stage], trials: Mapping[str, Trial], folder: RunFolder, *, quick: bool
) -> tuple[str, Path]:
    """Write gains.csv, side_by_side.png and report.html; return what is printed, and the page's path."""
    designs = [f"{START}: {study.plant.design.describe(study.p0)}"]
    designs += [line for stage in found.values() for line in stage.values["report"]]
    image = style.png(plot_side_by_side(study, found, trials, quick=quick))
    folder.write_bytes("side_by_side.png", image)
    tables = trial_tables(trials, folder)
    shown = "".join(f"<div>{table.html}</div><br>" for table in tables)
    body = paragraphs(designs) + shown + picture_of(image, "Designs, and changes in every use")
    page = folder.write_text("report.html", page_of(study.title, body))
    return "\n\n".join(["\n".join(designs), *map(str, tables)]), page


def trial_tables(trials: Mapping[str, Trial], folder: RunFolder) -> list[Table]:
    """Tables of changes, which become gains.csv, and of metrics."""
    names = list(next(iter(next(iter(trials.values()))[0].values()))[0])
    changes = [
        (use, what, *(percent_interval(one.change.mean, one.change.ci95, one.before) for one in changed))
        for use, (_, by_question) in trials.items() for what, changed in by_question.items()
    ]  # fmt: skip
    values = [
        (use, *place, *map(number, metrics.values()), str(lost))
        for use, (by_place, _) in trials.items() for place, (metrics, lost) in by_place.items()
    ]  # fmt: skip
    right = frozenset(range(3, 4 + len(names)))
    tables = [Table(("use", "change, with its 95 % interval, of", *names), changes, right),
              Table(("use", "design", "controller", *names, "lost runs"), values, right)]  # fmt: skip
    folder.write_text("gains.csv", csv_text([dict(zip(tables[0].head, line)) for line in changes]))
    return tables


def plot_side_by_side(
    study: SideBySide, found: Mapping[str, Stage], trials: Mapping[str, Trial], *, quick: bool = False
) -> Any:
    """Plot designs in their box, and changes in every use, as a matplotlib Figure."""
    space = study.plant.design
    with style.styled():
        figure = style.blank(4.0 + 4.5 * len(trials), 5.4, quick=quick)
        first, *others = figure.subplots(1, 1 + len(trials), width_ratios=(0.7, *(1 for _ in trials)))
        for name, p in {START: study.p0, **{use: stage.arrays["design"] for use, stage in found.items()}}.items():
            first.plot(space.names, space.to_unit(p), "o-", lw=0.8, label=name)
        first.set(ylim=(-0.05, 1.05), ylabel="place in the box of designs", title="designs")
        for ax, (use, trial) in zip(others, trials.items()):
            _plot_changes(ax, use, trial)
        for ax in (first, *others):
            ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, frameon=False)
    return figure


def _plot_changes(ax: Any, use: str, trial: Trial) -> None:
    """Plot changes of metrics with their intervals, a colour per question."""
    values, by_question = trial
    names = list(next(iter(values.values()))[0])
    far = 1.0
    for i, (what, changes) in enumerate(by_question.items()):
        size = np.array([abs(one.before) or np.nan for one in changes])
        ends = np.array([(one.change.mean, *one.change.ci95) for one in changes]).reshape(-1, 3)  # none: all runs lost
        mean, low, high = 100 * ends.T / size
        at = np.arange(len(changes)) + 0.7 * (i / (len(by_question) - 1) - 0.5)
        ax.errorbar(mean, at, xerr=[mean - low, high - mean], fmt="o", ms=3.5, lw=1.2, label=what)
        far = max([far, *1.3 * np.abs(mean)])
    ax.axvline(0.0, color="#444444", lw=0.9)
    ax.set(title=use, xlim=(-far, far), ylim=(len(names) - 0.5, -0.5), xlabel="change [%], 95 % interval",
           yticks=range(len(names)), yticklabels=map(style.label, names))  # fmt: skip
