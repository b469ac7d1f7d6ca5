"""Sentences, tables, picture and page of a run on sensors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccdtools import figure_style as style
from ccdtools.comparison.metrics import MetricChange
from ccdtools.evidence.percent import number, percent_interval
from ccdtools.pages import page_of, paragraphs, picture_of
from ccdtools.studies.fitted_run import Signals
from ccdtools.studies.on_sensors import OnSensors
from ccdtools.studies.report.side_by_side_page import trial_tables
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.side_by_side import START
from ccdtools.studies.side_by_side_run import Trial
from ccdtools.studies.stage_storage import Stage
from ccdtools.table import Table

ALL, BESIDE = "all up to ", "all, for "  # begin changes from the start, and from another law


def write_fitted(
    study: OnSensors, stages: Mapping[str, Stage], trials: Mapping[str, tuple[Trial, Signals]], folder: RunFolder, *,
    quick: bool,
) -> tuple[str, Path]:  # fmt: skip
    """Write gains.csv, generations.png and report.html; return what is printed, and the page's path."""
    costs = {use: {what: rows[0] for what, rows in trial[1].items() if rows} for use, (trial, _) in trials.items()}
    said = [line for use, changes in costs.items() if (line := _headline(use, changes))]
    designs = [f"{START}: {study.plant.design.describe(study.p0)}"]
    designs += [
        f"{name}: {study.plant.design.describe(stage.arrays['design'])}; {stage.values['report'][0]}"
        for name, stage in stages.items()
    ]
    tables = [*_told(stages), *trial_tables({use: trial for use, (trial, _) in trials.items()}, folder)]
    signals = {use: shown for use, (_, shown) in trials.items()}
    image = style.png(plot_fitted(study, costs, signals, quick=quick))
    folder.write_bytes("generations.png", image)
    picture = picture_of(image, "Cost on the real plant, step by step, and the first output of one drive")
    shown = "".join(f"<div>{table.html}</div><br>" for table in tables)
    page = folder.write_text(
        "report.html", page_of(study.title, paragraphs(said) + picture + paragraphs(designs) + shown)
    )
    return "\n\n".join(["\n".join([*said, *designs]), *map(str, tables)]), page


def _headline(use: str, changes: Mapping[str, MetricChange]) -> str:
    """Change of the cost on one drive, and what it is made of."""
    parts = {what: _percent(one) for what, one in changes.items() if not what.startswith("all")}
    whole = [one for what, one in changes.items() if what.startswith(ALL)]
    if not whole:
        return ""
    made = "; ".join(f"{what} {change}" for what, change in parts.items())
    beside = "; ".join(
        f"{what.removeprefix(BESIDE)} {_percent(one)}" for what, one in changes.items() if what.startswith(BESIDE)
    )
    return (
        f"{use}: what is in service at the end costs {_percent(whole[-1])} beside LQG at the start, in turn {made}. "
        f"Beside each law at the best of its designs: {beside}."
    )


def _percent(one: MetricChange) -> str:
    """Change with its interval."""
    return percent_interval(one.change.mean, one.change.ci95, one.before)


def _told(stages: Mapping[str, Stage]) -> list[Table]:
    """Table of what the logs told of the plant."""
    head = ("generation", "unknown", "what its logs tell", "standard deviation", "status")
    lines = [
        (name, entry, number(value), number(deviation), fit["status"])
        for name, stage in stages.items() if (fit := stage.values["fit"])
        for entry, value, deviation in zip(fit["names"], fit["values"], fit["deviations"])
    ]  # fmt: skip
    return [Table(head, lines, frozenset((2, 3)))] if lines else []


def plot_fitted(
    study: OnSensors, costs: Mapping[str, Mapping[str, MetricChange]], signals: Mapping[str, Signals], *,
    quick: bool = False,
) -> Any:  # fmt: skip
    """Plot the cost of every drive, step by step, and the first output on one, as a matplotlib Figure."""
    with style.styled():
        figure = style.blank(11.0, 3.8, quick=quick)
        left, right = figure.subplots(1, 2)
        names: list[str] = []
        for place, (use, changes) in enumerate(costs.items()):
            steps = {"design": changes.get("design")} | {
                what.removeprefix(ALL): one for what, one in changes.items() if what.startswith(ALL)
            }
            known = {what: one for what, one in steps.items() if one is not None}
            names = ["LQG at the start", *known]
            ends = np.array([(one.change.mean, *one.change.ci95) for one in known.values()]).reshape(-1, 3)
            mean, low, high = (100 * np.r_[[np.zeros(3)], ends / [[abs(one.before)] for one in known.values()]]).T
            at = np.arange(len(mean)) + 0.08 * (place - (len(costs) - 1) / 2)
            left.errorbar(at, mean, yerr=[mean - low, high - mean], fmt="o-", ms=4, lw=1.2, capsize=2, label=use)
        left.axhline(0.0, color="#444444", lw=0.9)
        left.set(title="Cost on the real plant, fresh drives, sensors alone", ylabel="change of the cost [%], 95 %")
        left.set_xticks(range(len(names)), [style.label(name) for name in names])
        left.legend()
        use, shown = next(iter(signals.items()))
        for (who, y), colour in zip(shown.items(), ("#999999", style.COLOURS["learned"])):
            right.plot(study.plant.dt * np.arange(len(y)), y, color=colour, lw=1.1, label=who)
        right.set(title=f"One drive: {use}", xlabel="time [s]", ylabel=style.label(study.plant.output_names[0]))
        right.legend()
    return figure
