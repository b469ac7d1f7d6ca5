"""Figures of returns: changes, iterations, and differences to LQR."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ccdtools import figure_style as style
from ccdtools.arrays import Array, Indices
from ccdtools.evidence.percent import share, signed_percent
from ccdtools.studies.names import SOURCES
from ccdtools.studies.report.finished_run import FinishedRun, ReportFigure
from ccdtools.studies.report.formatting import generation_name, place
from ccdtools.studies.report.gains import gain_percent
from ccdtools.studies.report.summary import COST, Change, in_first_place
from ccdtools.studies.report.verdicts import percent_of_reference
from ccdtools.studies.tolerances import NOT_WORSE_PERCENT

WORDS = {"better": "#1B7F3B", "worse": "#B00020", "same": "#7F7F7F", "open": "#7F7F7F"}
SOURCE_COLOURS = ("#3D3D3D", "#D55E00", "#E69F00", "#0072B2")


def changes(run: FinishedRun) -> list[ReportFigure]:
    """Figure of the changes from LQR at the start, and their sources."""
    rows = in_first_place(run.results)
    places = run.results["gains"]
    figure = style.blank(11, 1.0 + 0.36 * max(len(rows), 2 * len(places)), quick=run.quick)
    left, right = figure.subplots(1, 2)
    _draw_changes(left, rows)
    _draw_gains(right, places)
    caption = (
        "From LQR at the start design to what is deployed at the end, on the real plant and the same disturbances. "
        "Left: the cost in every place, and every other number where the plant was deployed, with 95 % intervals. "
        "Right: the gain in return by what brought it."
    )
    return [ReportFigure("changes", "What changed", caption, figure)]


def _draw_changes(ax: style.Axes, rows: Sequence[Change]) -> None:
    ax.axvline(0, color="#444444", lw=1)
    for y, row in enumerate(rows):
        note = row.text
        if row.percent is not None:
            _interval(ax, row.percent, y, WORDS[row.word], size=7)
            note = signed_percent(row.percent[0])
        ax.annotate(note, (1.015, y), xycoords=("axes fraction", "data"), va="center", fontsize=8)
    several = len({row.place for row in rows}) > 1
    _rows(ax, [f"{row.name}, {row.place}" if row.name == COST and several else row.name for row in rows])
    ax.set_xlabel("change from LQR at the start design [%]; less is better")


def _draw_gains(ax: style.Axes, places: Sequence[Mapping[str, Any]]) -> None:
    for i, source in enumerate(SOURCES[1:]):
        parts = [(gain_percent(place, source) or (0.0,))[0] for place in places]
        ax.barh(np.arange(len(places)) + (i - 1.5) * 0.2, parts, 0.19, color=SOURCE_COLOURS[i], label=source)
    ax.axvline(0, color="#444444", lw=1)
    ax.set_yticks(range(len(places)), [place["place"] for place in places])
    ax.set_ylim(len(places) - 0.4, -0.6)
    ax.set_xlabel("gain in return, by source\n[% of what control costs LQR at the start design]")
    ax.figure.legend(*ax.get_legend_handles_labels(), loc="outside upper right", ncols=4, frameon=False)


def history(run: FinishedRun) -> list[ReportFigure]:
    """Figure of return and free design parameters over the iterations."""
    space = run.problem.design
    designed = np.flatnonzero(space.free).tolist()
    figure = style.blank(max(5.5, min(3.4 * run.last + 1, 15)), 1.2 + 1.7 * (1 + space.dim), quick=run.quick)
    grid = figure.subplots(1 + len(designed), run.last, squeeze=False, sharex="col")
    for g, (course, chosen, generation) in enumerate(zip(run.histories, run.chosen, run.results["generations"])):
        top = grid[0, g]
        colour = style.generation_colour(g + 1)
        top.set_title(f"{generation_name(g + 1)}\n{place(generation)}", color=colour)
        low, high = course.model_return - course.std, course.model_return + course.std
        top.fill_between(course.iteration, low, high, color=colour, alpha=0.15, lw=0)
        _draw_course(top, course.iteration, course.model_return, chosen, colour)
        for ax, i in zip(grid[1:, g], designed):
            _draw_bounds(ax, space.lower[i], space.upper[i])
            _draw_course(ax, course.iteration, course.design[:, i], chosen, colour)
        grid[-1, g].set_xlabel("iteration")
        style.whole_ticks(grid[-1, g], 5)
    grid[0, 0].set_ylabel("return")
    for ax, i in zip(grid[1:, 0], designed):
        ax.set_ylabel(space.labels[i])
    caption = (
        "Return (mean and one standard deviation over the evaluation runs) and design at every evaluation of the "
        "co-designs; the star marks the design that was deployed, dashed lines are the bounds of the design. "
        "Returns of different columns are measured on different models and do not compare."
    )
    return [ReportFigure("history", "Return and design", caption, figure)]


def _draw_course(ax: style.Axes, steps: Indices, values: Array, chosen: int, colour: Any) -> None:
    ax.plot(steps, values, "-o", color=colour, ms=2.5, lw=1.5)
    ax.plot(steps[chosen], values[chosen], "*", color=style.CHOSEN, mec="k", mew=0.6, ms=13, zorder=5)


def _draw_bounds(ax: style.Axes, lower: float, upper: float) -> None:
    room = 0.08 * (upper - lower)
    ax.set_ylim(lower - room, upper + room)
    for edge, beyond in ((lower, lower - room), (upper, upper + room)):
        ax.axhline(edge, **style.BOUND)
        ax.axhspan(min(edge, beyond), max(edge, beyond), facecolor="#EEEEEE", edgecolor="#CCCCCC", hatch="///", lw=0)


def comparison(run: FinishedRun) -> list[ReportFigure]:
    """Figure of every controller's paired difference to LQR in per cent of |LQR|."""
    rows = run.results["comparison"]
    figure = style.blank(10, 0.8 + 2.0 * (run.last + 1), quick=run.quick)
    generations = sorted({row["generation"] for row in rows})
    plants = list(dict.fromkeys(row["plant"] for row in rows))
    names = [name for name in dict.fromkeys(row["controller"] for row in rows) if name != "LQR"]
    grid = figure.subplots(len(generations), len(plants), squeeze=False, sharey=True, sharex=True)
    ends = [0.0]
    for (r, g), (c, plant) in ((a, b) for a in enumerate(generations) for b in enumerate(plants)):
        chosen = {row["controller"]: row for row in rows if row["generation"] == g and row["plant"] == plant}
        ends += _draw_differences(grid[r, c], names, chosen)
        where = place(next(iter(chosen.values())))
        grid[r, c].set_title(f"{generation_name(g)}: {where}", color=style.generation_colour(g))
    grid[0, 0].set_xscale("symlog", linthresh=1.0, linscale=1.5)
    powers = 10.0 ** np.arange(0, 9)
    marks = [*-powers[::-1], 0, *powers]
    grid[0, 0].set_xticks(marks, [f"{mark:g}" for mark in marks])
    grid[0, 0].set_xticks([], minor=True)
    grid[0, 0].set_xlim(min(1.6 * min(ends), -2.0), max(1.6 * max(ends), 2.0))
    _rows(grid[0, 0], names)
    for ax in grid[-1]:
        ax.set_xlabel("difference to LQR's return [% of |LQR|]; right is better")
    caption = (
        "Return beside LQR at the same design, paired on common random numbers, with 95 % intervals (linear between "
        "−1 and 1 %, logarithmic beyond): the learned policy should touch or pass the line at zero; the green strip "
        "counts as not worse."
    )
    return [ReportFigure("comparison", "Controllers beside LQR", caption, figure)]


def _draw_differences(ax: style.Axes, names: Sequence[str], chosen: Mapping[str, Mapping[str, Any]]) -> list[float]:
    """Draw one panel and return the ends of its intervals."""
    colours = style.controller_colours(names)
    ends: list[float] = []
    ax.axvspan(-NOT_WORSE_PERCENT, 0, color=style.NOT_WORSE_STRIP, lw=0, zorder=0)
    ax.axvline(0, color=style.COLOURS["LQR"], lw=1.4)
    for y, name in enumerate(names):
        row = chosen.get(name)
        percent = None if row is None else percent_of_reference(row, chosen.get("LQR"))
        if percent is not None:
            ends += percent[1:]
            _interval(ax, percent, y, colours[name], size=6)
            note = signed_percent(percent[0])
        else:
            note = "–" if row is None else f"{share(row['diverged'])} diverged" if row["diverged"] else "no pairs"
        weight = "bold" if name == "learned" else "normal"
        ax.annotate(note, (1.015, y), xycoords=("axes fraction", "data"), va="center", fontsize=8, weight=weight)
    return ends


def _interval(ax: style.Axes, percent: tuple[float, float, float], y: int, colour: str, *, size: int) -> None:
    mean, low, high = percent
    ax.errorbar(mean, y, xerr=[[mean - low], [high - mean]], fmt="o", color=colour, ms=size, capsize=4, lw=2)


def _rows(ax: style.Axes, names: Sequence[str]) -> None:
    """Name the rows of an axis, from the top down."""
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.5)
