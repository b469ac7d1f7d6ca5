"""Sets, policies and trajectories on axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ccdtools import figure_style as look
from ccdtools.arrays import Array
from ccdtools.figure_style import BOUND, COLOURS, LINES, controller_colours, without_grid
from invariant_sets import Polytope, plot_polytope


def plot_sets(
    ax: Axes,
    sets: Mapping[str, Polytope],
    lines: Mapping[str, tuple[str, Any]],
    *,
    frame: Polytope,
    labels: tuple[str, str],
    filled: str = "",
) -> list[Any]:
    """Plot planar sets by name over their frame X (dashed).

    Parameters
    ----------
    lines : mapping of name to (colour, line style)
    filled : str
        Name of the set that is shaded.
    """
    style = {"facecolor": "none", "edgecolor": BOUND["color"], "linestyle": BOUND["ls"], "label": "X", "zorder": 4}
    artists = [plot_polytope(frame, ax=ax, **style)]
    for name, shown in sets.items():
        if shown.is_empty:
            continue  # a slice can miss its set
        colour, dashes = lines[name]
        face = f"{colour}22" if name == filled else "none"
        artists.append(
            plot_polytope(shown, ax=ax, facecolor=face, edgecolor=colour, linestyle=dashes, lw=1.8, label=name)
        )
    lower, upper = frame.bounding_box()
    room = 0.06 * (upper - lower)
    ax.set(xlabel=labels[0], ylabel=labels[1])
    ax.set(xlim=(lower[0] - room[0], upper[0] + room[0]), ylim=(lower[1] - room[1], upper[1] + room[1]))
    return artists


def plot_surfaces(
    figure: Figure,
    x: tuple[Array, Array],
    surfaces: Mapping[str, Array],
    *,
    outline: Polytope,
    labels: tuple[str, str],
    inputs: Sequence[str],
) -> list[Axes]:
    """Plot inputs over two states: each surface and their difference.

    Parameters
    ----------
    x : two (k,) and (m,) arrays
        Grid of the states.
    surfaces : mapping of two names to (m, k, nu) arrays
    outline : Polytope
        X_fea at the design.
    """
    (first, one), (second, two) = surfaces.items()
    grid = figure.subplots(len(inputs), 3, squeeze=False, sharex=True, sharey=True)
    for row, unit in enumerate(inputs):
        largest = max(np.abs(one[..., row]).max(), np.abs(two[..., row]).max(), 1e-12)
        gap = max(np.abs(one - two)[..., row].max(), 1e-12)
        for ax, title, values, top, colours in (
            (grid[row, 0], first, one, largest, "RdBu_r"),
            (grid[row, 1], second, two, largest, "RdBu_r"),
            (grid[row, 2], f"{first} − {second}", one - two, gap, "PuOr_r"),
        ):
            mesh = without_grid(ax).pcolormesh(
                *x, values[..., row], cmap=colours, vmin=-top, vmax=top, shading="nearest", rasterized=True
            )
            plot_polytope(outline, ax=ax, facecolor="none", edgecolor="k", lw=1.3)
            ax.set_title(title)
            ax.set(xlabel=labels[0], xlim=x[0][[0, -1]], ylim=x[1][[0, -1]])
            without_grid(figure.colorbar(mesh, ax=ax, shrink=0.9, label=unit).ax)
        grid[row, 0].set_ylabel(labels[1])
    return list(grid.flat)


def plot_trajectories(
    figure: Figure,
    columns: Mapping[str, Mapping[str, Array]],
    time: Array,
    *,
    labels: Sequence[str],
    limits: Sequence[tuple[Array, Array]],
    time_label: str,
    title_colours: Sequence[str] = (),
) -> list[Axes]:
    """Plot mean and band of every signal, one column per design.

    Parameters
    ----------
    columns : mapping of title to mapping of controller to (3, T, signals) array
        Low, mean and high; T of them where a column is shorter than `time`.
    limits : sequence of lower and upper (signals,) arrays
        Of each column, drawn dashed where they are in sight.
    title_colours : sequence of str
        Of the column titles.
    """
    names = list(next(iter(columns.values())))
    colours = controller_colours(names)
    grid = figure.subplots(len(labels), len(columns), squeeze=False, sharex="col", sharey="row")
    for c, (title, controllers) in enumerate(columns.items()):
        for name, (low, mean, high) in controllers.items():
            for row in range(len(labels)):
                ax = grid[row, c]
                own = time[: len(mean)]
                ax.fill_between(own, low[:, row], high[:, row], color=colours[name], alpha=0.15, lw=0)
                ax.plot(own, mean[:, row], color=colours[name], label=name, **LINES.get(name, {}))
        grid[0, c].set_title(look.title(title), color=title_colours[c] if title_colours else "k")
        grid[-1, c].set_xlabel(time_label)
    for row, label in enumerate(labels):
        low, high = grid[row, 0].get_ylim()
        for ax, both in zip(grid[row], limits, strict=True):
            for edge in (both[0][row], both[1][row]):
                if low - 0.05 * (high - low) <= edge <= high + 0.05 * (high - low):
                    ax.axhline(edge, **BOUND)
        grid[row, 0].set_ylabel(look.label(label))
    grid[0, 0].legend(ncols=len(names), loc="best")
    figure.align_ylabels()
    return list(grid.flat)


def plot_quantiles(
    figure: Figure, time: Array, errors: Array, quantiles: Array, levels: Sequence[float], *,
    labels: Sequence[str], time_label: str,
) -> list[Axes]:  # fmt: skip
    """Plot learned quantiles (T, levels, nx) and logged one-step errors (T, nx)."""
    grid = figure.subplots(len(labels), 1, squeeze=False, sharex=True)[:, 0]
    outer = f"{levels[0]:g} to {levels[-1]:g} quantile"
    for i, (ax, label) in enumerate(zip(grid, labels)):
        inside = (errors[:, i] >= quantiles[:, 0, i]) & (errors[:, i] <= quantiles[:, -1, i])
        ax.fill_between(
            time, quantiles[:, 0, i], quantiles[:, -1, i], color=COLOURS["learned"], alpha=0.25, lw=0, label=outer
        )
        ax.plot(time, quantiles[:, len(levels) // 2, i], color=COLOURS["learned"], lw=1.3, label="median")
        ax.plot(time, errors[:, i], ".-", color="k", lw=0.5, ms=3.5, label="logged error")
        ax.plot(time[~inside], errors[~inside, i], "o", mfc="none", mec=COLOURS["LQR"], ms=6, label="outside")
        ax.set_ylabel(look.label(f"error of {label}"))
        ax.set_title(f"{inside.mean():.0%} inside", loc="right", fontsize=8, pad=3)
    grid[-1].set_xlabel(time_label)
    handles, names = grid[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=4, frameon=False)
    figure.align_ylabels()
    return list(grid)
