"""Picture and page of an experiment."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np
from matplotlib.ticker import LogFormatter

from ccdtools.arrays import Array
from ccdtools.comparison.compared import Compared
from ccdtools.figure_style import blank, controller_colours, label, png, styled
from ccdtools.pages import page_of, picture_of
from ccdtools_ground.door import has_method


def plot_experiment(experiment: Any, figure: Any = None) -> Any:
    """Plot gains over the baseline, profiles of returns, and times per step.

    Parameters
    ----------
    experiment : Experiment
    figure : matplotlib Figure, optional
        Where to draw; a new one by default.

    Returns
    -------
    matplotlib Figure

    Raises
    ------
    InputError
        If `figure` is given and is none.
    """
    cells = list(experiment)
    others = [cell for cell in cells if cell.names[0] != experiment.baseline]
    names = list(dict.fromkeys(cell.names[0] for cell in cells))
    colours = controller_colours(names)
    with styled():
        lines = sum(_row_name(cell).count("\n") + 1.5 for cell in others) + sum(label(one).count("\n") for one in names)
        figure = blank(11.0, 3.0 + 0.13 * lines) if figure is None else figure
        has_method("figure", figure, "subplots", "a matplotlib Figure, or None for a new one")
        if figure.get_layout_engine() is None:
            figure.set_layout_engine("constrained")
        gains, profile, times = figure.subplots(1, 3, width_ratios=(1.3, 1, 0.8))
        _plot_gains(gains, others, colours, experiment.baseline)
        _plot_profiles(profile, experiment, colours)
        _plot_times(times, cells, colours)
        figure.legend(*profile.get_legend_handles_labels(), fontsize="small", loc="outside lower center", ncols=5)
    return figure


def page(experiment: Any) -> str:
    """Page in HTML of what was compared, with verdicts, figure, table and notes."""
    verdicts = "".join(
        f"<p><b>{escape(', '.join(name for name in kind if name))}</b>: {escape(verdict)}</p>"
        for kind, verdict in experiment.verdicts.items()
    )
    picture = picture_of(png(plot_experiment(experiment)), "Gains, profiles and times")
    return page_of(
        f"Comparison with {experiment.baseline}",
        f"{experiment.header.html}{verdicts}{picture}{experiment._repr_html_()}",
    )


def _row_name(cell: Compared) -> str:
    """Names of a cell, wrapped."""
    return label(", ".join(name for name in cell.names if name))


def _plot_gains(ax: Any, cells: list[Compared], colours: dict[str, str], baseline: str) -> None:
    """Gain over the baseline with its interval, a row per cell."""
    rows = np.arange(len(cells))
    for row, cell in zip(rows, cells):
        found = cell.evidence
        if not np.isfinite(found.gain.mean):
            why = cell.word if cell.seeds else "not made"
            ax.text(0.02, row, why, transform=ax.get_yaxis_transform(), va="center", fontsize="small")
        mean, low, high = (100 * value / (found.size or np.nan) for value in (found.gain.mean, *found.gain.ci95))
        ax.plot([low, high], [row, row], color=colours[cell.names[0]], lw=1.5)
        ax.plot(mean, row, "o", color=colours[cell.names[0]], ms=4)
    ax.axvline(0.0, color="#444444", lw=0.9)
    ax.set_yticks(rows, [_row_name(cell) for cell in cells])
    ax.set_ylim(max(len(cells), 1) - 0.5, -0.5)
    ax.set_xscale("symlog", linthresh=1.0)  # one far behind hides no difference between the others
    ax.set_xlabel(f"gain over {label(baseline)} [%],\n95 % interval")


def _plot_profiles(ax: Any, experiment: Any, colours: dict[str, str]) -> None:
    """Share of runs with at least such a return; lost ones have none."""
    levels = {cell.names[1:]: cell.value.mean for cell in experiment if cell.names[0] == experiment.baseline}
    found: dict[str, list[Array]] = {}
    for one in experiment.records:
        for cell in one.cells:
            level = levels.get((one.design, cell.scenario, cell.plant), np.nan)
            relative = 100 * (cell.returns - level) / (abs(level + cell.design_cost) or np.nan)
            found.setdefault(one.controller, []).append(np.where(cell.lost | np.isnan(relative), -np.inf, relative))
    every = np.concatenate([np.zeros(0), *(part for parts in found.values() for part in parts)])
    shown = every[np.isfinite(every)]
    low, high = np.quantile(shown if len(shown) else [0.0], [0.01, 0.99])
    for k, name in enumerate(dict.fromkeys(one.controller for one in experiment.records)):
        values = np.sort(np.concatenate(found.get(name, [np.zeros(0)])))
        above = 1 - np.arange(len(values)) / max(len(values), 1)
        made = any(one.made for one in experiment.records if one.controller == name)
        told = label(name if np.isfinite(values).any() else f"{name}: {'no run ended' if made else 'not made'}")
        ax.step(
            values, above, color=colours[name], label=told, where="pre", ls=("--", "-.", ":")[k % 3 - 1] if k else "-"
        )
    ax.set_xlim((low, high) if low < high else (low - 1, high + 1))  # per cent
    ax.set_xlabel(f"return less the mean of\n{label(experiment.baseline)} [%]")
    ax.set_ylabel("share of runs above")


def _plot_times(ax: Any, cells: list[Compared], colours: dict[str, str]) -> None:
    """Median and 99th percentile of the time per step."""
    names = [name for name in colours if any(len(cell.times) for cell in cells if cell.names[0] == name)]
    for row, name in enumerate(names):
        times = np.concatenate([cell.times for cell in cells if cell.names[0] == name])
        median, most = 1e6 * np.quantile(times, [0.5, 0.99])
        ax.plot([median, most], [row, row], color=colours[name], lw=1.5)
        ax.plot(median, row, "o", color=colours[name], ms=4)
    ax.set_yticks(range(len(names)), map(label, names))
    ax.set_ylim(max(len(names), 1) - 0.5, -0.5)
    ax.set_xscale("log")
    ax.xaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.0, 0.4)))  # decades, as by default
    ax.set_xlabel("µs a step:\nmedian to 99th percentile")
