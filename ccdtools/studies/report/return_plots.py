"""Plots of returns: iterations, designs and differences to LQR."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator
from numpy.typing import NDArray

from ccdtools.arrays import Array
from ccdtools.co_design.result import History
from ccdtools.evidence.percent import share, signed_percent
from ccdtools.figure_style import (
    BOUND,
    CHOSEN,
    COLOURS,
    NOT_WORSE_STRIP,
    controller_colours,
    draw_map,
    generation_colour,
)
from ccdtools.plants.design_space import DesignSpace
from ccdtools.studies.gains import SOURCES
from ccdtools.studies.report.formatting import axis_label, generation_name, place
from ccdtools.studies.report.gains import gain_percent
from ccdtools.studies.report.summary import COST, Change
from ccdtools.studies.report.verdicts import percent_of_reference
from ccdtools.studies.tolerances import NOT_WORSE_PERCENT

WORDS = {"better": "#1B7F3B", "worse": "#B00020", "same": "#7F7F7F", "open": "#7F7F7F"}
SOURCE_COLOURS = ("#3D3D3D", "#D55E00", "#E69F00", "#0072B2")


def plot_history(
    figure: Figure, histories: Sequence[History], chosen: Sequence[int], space: DesignSpace, judges: Sequence[str]
) -> list[Axes]:
    """Plot return (top) and design (below) over the iterations.

    Fixed parameters are left out.

    Parameters
    ----------
    histories : sequence of History
    chosen : sequence of int
        The row of each history that was returned; a star marks it.
    judges : sequence of str
        What each return was measured on.
    """
    columns = len(histories)
    designed = np.flatnonzero(space.free).tolist()
    grid = figure.subplots(1 + len(designed), columns, squeeze=False, sharex="col")
    for g, history in enumerate(histories):
        top = grid[0, g]
        colour = generation_colour(g + 1)
        top.set_title(f"{generation_name(g + 1)}\n{judges[g]}", color=colour)
        top.fill_between(
            history.iteration, history.model_return - history.std, history.model_return + history.std,
            color=colour, alpha=0.15, lw=0,
        )  # fmt: skip
        _course(top, history.iteration, history.model_return, chosen[g], colour)
        for row, i in enumerate(designed):
            ax = grid[1 + row, g]
            _bounds(ax, space.lower[i], space.upper[i])
            _course(ax, history.iteration, history.design[:, i], chosen[g], colour)
        grid[-1, g].set_xlabel("iteration")
        grid[-1, g].xaxis.set_major_locator(MaxNLocator(5, integer=True))
    grid[0, 0].set_ylabel("return")
    for row, i in enumerate(designed):
        grid[1 + row, 0].set_ylabel(axis_label(space.names[i], space.units[i]))
    return list(grid.flat)


def _course(ax: Axes, steps: Array, values: Array, chosen: int, colour: Any) -> None:
    """Draw a quantity over the iterations, with a star at the end."""
    ax.plot(steps, values, "-o", color=colour, ms=2.5, lw=1.5)
    ax.plot(steps[chosen], values[chosen], "*", color=CHOSEN, mec="k", mew=0.6, ms=13, zorder=5)


def _bounds(ax: Axes, lower: float, upper: float) -> None:
    """Draw the bounds of a design parameter, hatched beyond."""
    room = 0.08 * (upper - lower)
    ax.set_ylim(lower - room, upper + room)
    for edge, beyond in ((lower, lower - room), (upper, upper + room)):
        ax.axhline(edge, **BOUND)
        ax.axhspan(min(edge, beyond), max(edge, beyond), facecolor="#EEEEEE", edgecolor="#CCCCCC", hatch="///", lw=0)


def plot_comparison(figure: Figure, rows: Sequence[Mapping[str, Any]]) -> list[Axes]:
    """Plot the paired difference to LQR in per cent of |LQR|.

    Parameters
    ----------
    rows : sequence of mappings
        The comparison of results.json.
    """
    generations = sorted({row["generation"] for row in rows})
    plants = list(dict.fromkeys(row["plant"] for row in rows))
    names = [name for name in dict.fromkeys(row["controller"] for row in rows) if name != "LQR"]
    grid = figure.subplots(len(generations), len(plants), squeeze=False, sharey=True, sharex=True)
    ends = [0.0]
    for (r, g), (c, plant) in ((a, b) for a in enumerate(generations) for b in enumerate(plants)):
        chosen = {row["controller"]: row for row in rows if row["generation"] == g and row["plant"] == plant}
        ends += _differences(grid[r, c], names, chosen)
        where = place(next(iter(chosen.values())))
        grid[r, c].set_title(f"{generation_name(g)}: {where}", color=generation_colour(g))
    _per_cent_axis(grid[0, 0], min(ends), max(ends))
    grid[0, 0].set_yticks(range(len(names)), names)
    grid[0, 0].set_ylim(len(names) - 0.5, -0.5)
    for ax in grid[-1]:
        ax.set_xlabel("difference to LQR's return [% of |LQR|]; right is better")
    return list(grid.flat)


def _differences(ax: Axes, names: Sequence[str], chosen: Mapping[str, Mapping[str, Any]]) -> list[float]:
    """Draw one panel and return the ends of its intervals."""
    colours = controller_colours(names)
    ends: list[float] = []
    ax.axvspan(-NOT_WORSE_PERCENT, 0, color=NOT_WORSE_STRIP, lw=0, zorder=0)
    ax.axvline(0, color=COLOURS["LQR"], lw=1.4)
    for y, name in enumerate(names):
        row = chosen.get(name)
        percent = None if row is None else percent_of_reference(row, chosen.get("LQR"))
        if percent is not None:
            mean, low, high = percent
            ends += [low, high]
            bar = [[mean - low], [high - mean]]
            ax.errorbar(mean, y, xerr=bar, fmt="o", color=colours[name], ms=6, capsize=4, lw=2)
            note = signed_percent(mean)
        else:
            note = "–" if row is None else f"{share(row['diverged'])} diverged" if row["diverged"] else "no pairs"
        weight = "bold" if name == "learned" else "normal"
        ax.annotate(note, (1.015, y), xycoords=("axes fraction", "data"), va="center", fontsize=8, weight=weight)
    return ends


def plot_changes(ax: Axes, rows: Sequence[Change]) -> list[Any]:
    """Plot changes in per cent with their intervals."""
    artists: list[Any] = [ax.axvline(0, color="#444444", lw=1)]
    for y, row in enumerate(rows):
        note = row.text
        if row.percent is not None:
            mean, low, high = row.percent
            bar = [[mean - low], [high - mean]]
            artists.append(ax.errorbar(mean, y, xerr=bar, fmt="o", color=WORDS[row.word], ms=7, capsize=4, lw=2))
            note = signed_percent(mean)
        ax.annotate(note, (1.015, y), xycoords=("axes fraction", "data"), va="center", fontsize=8)
    several = len({row.place for row in rows}) > 1
    names = [f"{row.name}, {row.place}" if row.name == COST and several else row.name for row in rows]
    ax.set_yticks(range(len(rows)), names)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlabel("change from LQR at the start design [%]; less is better")
    return artists


def plot_gains(ax: Axes, places: Sequence[Mapping[str, Any]]) -> list[Any]:
    """Plot the gain in return by source and place."""
    artists = []
    for i, source in enumerate(SOURCES[1:]):
        parts = [(gain_percent(place, source) or (0.0,))[0] for place in places]
        offset = (i - 1.5) * 0.2
        artists.append(ax.barh(np.arange(len(places)) + offset, parts, 0.19, color=SOURCE_COLOURS[i], label=source))
    ax.axvline(0, color="#444444", lw=1)
    ax.set_yticks(range(len(places)), [place["place"] for place in places])
    ax.set_ylim(len(places) - 0.4, -0.6)
    ax.set_xlabel("gain in return [% of LQR at the start design], by source")
    ax.legend(loc="best")
    return artists


def _per_cent_axis(ax: Axes, low: float, high: float) -> None:
    """Scale an axis linearly between −1 and 1 per cent, logarithmically beyond."""
    ax.set_xscale("symlog", linthresh=1.0, linscale=1.5)
    ax.set_xlim(min(1.6 * low, -2.0), max(1.6 * high, 2.0))
    powers = 10.0 ** np.arange(0, 9)
    ax.xaxis.set_major_locator(FixedLocator([*-powers[::-1], 0, *powers]))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def plot_landscape_curve(
    ax: Axes, designs: Array, mean: Array, interval: Array, diverged: Array, paths: Sequence[Array], *, label: str,
    allowed: float, whole: bool = False,
) -> list[Any]:  # fmt: skip
    """Plot LQR's return over one design parameter, with design paths.

    Parameters
    ----------
    designs, mean, interval, diverged : (k,) arrays
        `interval` is the half-width of the 95 % interval of the mean.
    paths : sequence of (m,) arrays
        One per generation.
    allowed : float
        Designs where a larger fraction diverges are shaded, and do not set the scale.
    whole : bool
        Whether the parameter is a whole number: then nothing is drawn between its values.
    """
    fine = diverged <= allowed
    colour = COLOURS["LQR"]
    artists: list[Any] = []
    if whole:
        artists.append(ax.errorbar(designs, mean, yerr=interval, fmt="_", color=colour, ms=14, mew=2, capsize=3,
                                   label="LQR at this design"))  # fmt: skip
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    else:
        artists.append(ax.fill_between(designs, mean - interval, mean + interval, color=colour, alpha=0.2, lw=0))
        artists += ax.plot(designs, mean, color=colour, label="LQR at this design")
    edges = np.r_[designs[0], (designs[1:] + designs[:-1]) / 2, designs[-1]]
    for i in np.flatnonzero(~fine):
        ax.axvspan(edges[i], edges[i + 1], color="#DDDDDD", lw=0, zorder=0)
    spread = np.ptp(mean[fine]) if fine.any() else 1.0
    if fine.any():
        ax.set_ylim(mean[fine].min() - 0.1 * spread - 1e-9, mean[fine].max() + 0.15 * spread + 1e-9)
    for g, path in enumerate(paths):
        artists += _path(ax, path, np.interp(path, designs, mean), g, line="none")
    for edge in designs[[0, -1]]:
        ax.axvline(edge, **BOUND)
    ax.set(xlabel=label, ylabel="return, nominal model")
    ax.legend()
    return artists


def plot_landscape_map(
    ax: Axes,
    x: Array,
    y: Array,
    mean: Array,
    fine: NDArray[np.bool_],
    paths: Sequence[Array],
    *,
    labels: tuple[str, str],
    whole: bool = False,
) -> list[Any]:
    """Plot LQR's return over two design parameters, with design paths.

    Parameters
    ----------
    x, y : (k,) and (m,) arrays
    mean, fine : (m, k) arrays
        Designs that are not fine (too many runs diverge) stay blank.
    paths : sequence of (n, 2) arrays
    whole : bool
        Whether a parameter is a whole number: every design of the grid then is a cell, with nothing between them.
    """
    artists = draw_map(ax, x, y, mean, fine, label="return of LQR, nominal model", whole=whole)
    for g, path in enumerate(paths):
        artists += _path(ax, path[:, 0], path[:, 1], g)
    ax.set(xlabel=labels[0], ylabel=labels[1])
    ax.legend(loc="best", markerscale=0.5)
    return artists


def _path(ax: Axes, x: Array, y: Array, g: int, *, line: str = "-") -> list[Any]:
    """Draw the design's path through one generation: square, dots, star."""
    colour = generation_colour(g + 1)
    way = ax.plot(x, y, ls=line, marker="o", color=colour, ms=4, lw=1.5, label=f"path of generation {g + 1}", zorder=4)
    start = ax.plot(x[0], y[0], "s", color=generation_colour(g), mec="k", ms=8, zorder=5)
    end = ax.plot(x[-1], y[-1], "*", color=colour, mec="k", ms=15, zorder=6)
    return [*way, *start, *end]
