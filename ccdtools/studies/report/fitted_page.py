"""Page of a run on sensors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccdtools import figure_style as style
from ccdtools.arrays import Array
from ccdtools.comparison.metrics import MetricChange
from ccdtools.evidence.percent import number, percent_interval
from ccdtools.pages import page_of, paragraphs, picture_of
from ccdtools.studies.fitted_trial import DriveTrial
from ccdtools.studies.on_sensors import OnSensors
from ccdtools.studies.report.side_by_side_page import trial_tables
from ccdtools.studies.run_folder import RunFolder
from ccdtools.studies.side_by_side import START
from ccdtools.studies.stage_storage import Stage
from ccdtools.table import Table

ALL, BESIDE = "all up to ", "all, for "  # begin changes from the start, and from another law


def write_fitted(
    study: OnSensors, stages: Mapping[str, Stage], trials: Mapping[str, DriveTrial], folder: RunFolder, *, quick: bool
) -> tuple[str, Path]:  # fmt: skip
    """Write the page of a run.

    gains.csv and generations.png come with report.html; what is printed, and the page's path, are returned.
    """
    costs = {
        use: {what: rows[0] if rows else None for what, rows in one.trial[1].items()} for use, one in trials.items()
    }
    said = [_headline(use, one) for use, one in trials.items()]
    designs = [f"{START}: {study.plant.design.describe(study.p0)}"]
    designs += [
        f"{name}: {study.plant.design.describe(stage.arrays['design'])}; {stage.values['report'][0]}"
        for name, stage in stages.items()
    ]
    tables = [*_told(stages), *trial_tables({use: one.trial for use, one in trials.items()}, folder)]
    image = style.png(plot_fitted(study, costs, {use: one.signals for use, one in trials.items()}, quick=quick))
    folder.write_bytes("generations.png", image)
    picture = picture_of(image, "Cost on the real plant, step by step, and the first output of one drive")
    shown = "".join(f"<div>{table.html}</div><br>" for table in tables)
    body = paragraphs(said) + picture + paragraphs(designs) + shown
    page = folder.write_text("report.html", page_of(study.title, body))
    return "\n\n".join(["\n".join([*said, *designs]), *map(str, tables)]), page


def _headline(use: str, one: DriveTrial) -> str:
    """Change of the cost, and its parts."""
    changes = {what: rows[0] if rows else None for what, rows in one.trial[1].items()}
    whole = [change for what, change in changes.items() if what.startswith(ALL)][-1]
    start, *_, end = *one.signals, *one.signals
    said = [f"{use}: what is {end} costs {_percent(whole)} beside {start}." if whole else f"{use}: no run to compare."]
    steps = [f"{what} {_percent(change)}" for what, change in changes.items() if not what.startswith(("all,", ALL))]
    laws = [f"{what.removeprefix(BESIDE)} {_percent(change)}" for what, change in changes.items() if what[:4] == "all,"]
    said += [f"In turn: {'; '.join(steps)}."] * (whole is not None)
    said += [f"Beside each law at the best of its designs: {'; '.join(laws)}."] * (whole is not None)
    return " ".join([*said, *one.notes])


def _percent(one: MetricChange | None) -> str:
    """Change with its interval; "n/a" where no run was kept by both."""
    if one is None:
        return "n/a"
    return percent_interval(one.change.mean, one.change.ci95, one.before)


def _told(stages: Mapping[str, Stage]) -> list[Table]:
    """Table of what the logs told of the plant."""
    head = ("generation", "unknown", "estimate by the logs", "standard deviation", "status")
    lines = [
        (name, entry, *_estimate(value, deviation, fit["status"]), fit["status"])
        for name, stage in stages.items() if (fit := stage.values["fit"])
        for entry, value, deviation in zip(fit["names"], fit["values"], fit["deviations"])
    ]  # fmt: skip
    return [Table(head, lines, frozenset((2, 3)))] if lines else []


def _estimate(value: float, deviation: float | None, status: str) -> tuple[str, str]:
    """Value and deviation in words."""
    if status == "UNSOLVED":
        return "n/a", "n/a"
    return number(value), "at a bound" if deviation == 0 else number(deviation)


def plot_fitted(
    study: OnSensors, costs: Mapping[str, Mapping[str, MetricChange | None]],
    signals: Mapping[str, Mapping[str, Array]], *, quick: bool = False,
) -> Any:  # fmt: skip
    """Plot costs step by step, as a matplotlib Figure.

    Beside them stands the first output on one drive.
    """
    with style.styled():
        figure = style.blank(11.0, 3.8, quick=quick)
        left, right = figure.subplots(1, 2)
        steps = {use: _from_start(changes) for use, changes in costs.items()}
        every = next(iter(costs.values()))
        names = ["design", *(what.removeprefix(ALL) for what in every if what.startswith(ALL))]
        for place, (use, known) in enumerate(steps.items()):
            ends = np.full((1 + len(names), 3), np.nan)  # NaN where no run was kept by both
            ends[0] = 0.0
            for name, one in known.items():
                ends[1 + names.index(name)] = np.array([one.change.mean, *one.change.ci95]) / abs(one.before)
            mean, low, high = 100 * ends.T
            at = np.arange(len(mean)) + 0.08 * (place - (len(costs) - 1) / 2)
            left.errorbar(
                at, mean, yerr=[mean - low, high - mean], fmt="o-", ms=4, lw=1.2, capsize=2, label=_plain(use)
            )
        left.axhline(0.0, color="#444444", lw=0.9)
        left.set(title="Cost on the real plant, sensors alone", ylabel="change of the cost [%], 95 %")
        start = next(iter(signals.values()))
        left.set_xticks(range(1 + len(names)), [style.label(_plain(name)) for name in (next(iter(start), ""), *names)])
        left.legend()
        use, shown = next(iter(signals.items()))
        for (who, y), colour in zip(shown.items(), ("#999999", style.COLOURS["learned"])):
            right.plot(study.plant.dt * np.arange(len(y)), y, color=colour, lw=1.1, label=_plain(who))
        right.set(title=f"One drive: {_plain(use)}", xlabel="time [s]", ylabel=style.label(study.plant.output_names[0]))
        right.legend()
    return figure


def _from_start(changes: Mapping[str, MetricChange | None]) -> dict[str, MetricChange]:
    """Changes from the start, by the last step."""
    whole = {what.removeprefix(ALL): one for what, one in changes.items() if what.startswith((ALL, "design"))}
    return {what: one for what, one in whole.items() if one is not None}


def _plain(text: str) -> str:
    """Text that matplotlib shows as it is."""
    return " " * text.startswith("_") + text.replace("$", r"\$")
