"""Plots of a comparison: return against time, and the landscape."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from ccdtools.arrays import Array
from ccdtools.co_design.landscape import Landscape
from ccdtools.co_design.tolerances import DEEPEST_SHOWN, NOT_WORSE_PERCENT
from ccdtools.figure_style import BOUND, NOT_WORSE_STRIP, blank, draw_map, label, styled
from ccdtools.plants.design_space import DesignSpace

COLOURS = (  # Okabe and Ito, and five more
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#3D3D3D", "#8A8A00", "#6A3D9A", "#B15928",
    "#A0205F",
)  # fmt: skip
MARKERS = "osD^vPX*<>h"


def plot_methods(comparison: Any) -> Figure:
    """Plot returns against time and designs of a `MethodComparison`.

    Designs of more than two parameters are shown in parts of their ranges.
    """
    rows = [row for row in comparison.rows if row.result is not None]
    with styled():
        figure = blank(10.5, 5.0)
        left, right = figure.subplots(1, 2, width_ratios=(1, 1.1))
        looks = {row.name: (COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)])
                 for i, row in enumerate(comparison.rows)}  # fmt: skip
        _returns(left, comparison, rows, looks)
        shown = _axes_of(comparison.problem.design)
        if len(shown) == 1:
            _curve(right, comparison, rows, looks, shown[0])
        elif len(shown) == 2:
            _map(right, comparison, rows, looks, shown)
        else:
            _ranges(right, comparison, rows, looks, shown)
        handles = [Line2D([], [], color=looks[row.name][0], marker=looks[row.name][1], ls="none", ms=7, mec="white",
                          mew=0.6, label=row.name) for row in rows]  # fmt: skip
        figure.legend(handles=handles, loc="outside lower center", ncols=min(6, len(handles)), frameon=False)
    return figure


def _returns(ax: Axes, comparison: Any, rows: Sequence[Any], looks: dict[str, Any]) -> None:
    """Reference's return and paired differences to it, against the time of a method."""
    level = comparison[comparison.reference].closed_loop.summary.mean
    size = comparison.size
    strip = NOT_WORSE_PERCENT / 100 * size
    ax.axhspan(level - strip, level + strip, color=NOT_WORSE_STRIP, lw=0, zorder=0)
    ax.annotate(f"within 0.5 % of {comparison.reference}", (0.985, level - strip), (0, -2),
                xycoords=("axes fraction", "data"), textcoords="offset points", ha="right", va="top", fontsize=7,
                color="#4F7A4F")  # fmt: skip
    known = [row for row in rows if row.difference is not None]
    gaps = np.array([row.difference.mean for row in known])
    lowest = level + max(gaps.min(initial=0.0), gaps.max(initial=0.0) - DEEPEST_SHOWN * size)
    room = 0.08 * (level + gaps.max(initial=0.0) - lowest) + 2 * strip
    for row in known:
        colour, marker = looks[row.name]
        value = level + row.difference.mean
        if value < lowest - 1e-9 * size:
            ax.plot(row.result.seconds, lowest - 0.55 * room, marker="v", color=colour, ms=8, mec="white", mew=0.6)
            ax.annotate(f"{value:.4g}", (row.result.seconds, lowest - 0.55 * room), (7, 0), va="center", fontsize=7,
                        textcoords="offset points", color=colour)  # fmt: skip
            continue
        low, high = (level + end for end in row.difference.ci95)
        ax.errorbar(row.result.seconds, value, yerr=[[value - low], [high - value]], color=colour, marker=marker,
                    ms=8, mec="white", mew=0.6, capsize=3, lw=1.4)  # fmt: skip
    ax.set_xscale("log")
    ax.set_ylim(lowest - room, level + gaps.max(initial=0.0) + room)
    low, high = ax.get_xlim()
    ax.set_xlim(low / 1.2, high * 1.4)
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 50 * low else (1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set(xlabel="time [s]", ylabel="return in closed loop", title="What a method finds, and how long it takes")


def _axes_of(space: DesignSpace) -> list[int]:
    """Parameters that can be chosen."""
    lower, upper = space.outermost
    return [int(i) for i in np.flatnonzero(upper > lower)]


def _landscape(comparison: Any, shown: Sequence[int]) -> tuple[list[Array], Array]:
    """Axes and returns of saturated LQR; NaN without LQR or with lost runs."""
    space = comparison.problem.design
    lower, upper = space.outermost
    ranges = [np.linspace(lower[i], upper[i], {1: 41, 2: 13}[len(shown)]) for i in shown]  # designs per axis
    axes: list[Array] = [np.unique(np.round(values)) if space.whole[i] else values for i, values in zip(shown, ranges)]
    over = np.stack(np.meshgrid(*axes), axis=-1)
    held = space.settled(space.allowed.rounded(np.zeros(space.dim)))
    grid = np.broadcast_to(held, (*over.shape[:-1], space.dim)).copy()
    grid[..., list(shown)] = over
    landscape = Landscape(comparison.problem, np.random.default_rng(comparison.seed))
    returns = landscape.returns(space.to_unit(grid.reshape(-1, space.dim))).reshape(grid.shape[:-1])
    best = np.nanmax(np.where(np.isfinite(returns), returns, np.nan)) if np.isfinite(returns).any() else 0.0
    return axes, np.where(returns > best - 20 * comparison.size, returns, np.nan)


def _curve(ax: Axes, comparison: Any, rows: Sequence[Any], looks: dict[str, Any], i: int) -> None:
    """Landscape over one parameter, with the design of each method."""
    space = comparison.problem.design
    (values,), returns = _landscape(comparison, [i])
    ax.plot(values, returns, color="#9FB8CC", lw=4, alpha=0.8, solid_capstyle="round", zorder=1,
            marker="_" if space.whole[i] else None, ls="none" if space.whole[i] else "-")  # fmt: skip
    best = float(np.nanmax(returns))
    levels = []
    for row in rows:
        colour, marker = looks[row.name]
        p = row.result.design[i]
        level = float(np.interp(p, values, np.nan_to_num(returns, nan=best - comparison.size)))
        levels.append(level)
        ax.plot([p, p], [0.0, 0.04], transform=ax.get_xaxis_transform(), color=colour, lw=1.5, zorder=3)
        ax.plot(p, level, marker, color=colour, ms=9, mec="white", mew=0.7, zorder=4)
    shown = returns[np.isfinite(returns)]
    lowest = max(shown.min(), best - max(DEEPEST_SHOWN * comparison.size, 1.3 * (best - min(levels))))
    spread = best - lowest
    ax.set_ylim(lowest - 0.05 * spread, best + 0.12 * spread)
    for edge in values[[0, -1]]:
        ax.axvline(edge, **BOUND)
    ax.set(xlabel=space.labels[i], ylabel="return of saturated LQR", title="The designs on the landscape of LQR")


def _map(ax: Axes, comparison: Any, rows: Sequence[Any], looks: dict[str, Any], shown: Sequence[int]) -> None:
    """Landscape over two parameters, with the paths of the methods."""
    space = comparison.problem.design
    (x, y), returns = _landscape(comparison, shown)
    draw_map(ax, x, y, np.nan_to_num(returns), np.isfinite(returns), label="return of saturated LQR",
             whole=bool(space.whole[list(shown)].any()))  # fmt: skip
    for rank, row in enumerate(rows):
        colour, marker = looks[row.name]
        way = _way(row)[:, list(shown)]
        ax.plot(*way.T, "-", color="white", lw=2.2, alpha=0.7, zorder=3)
        ax.plot(*way.T, "-", color=colour, lw=1.1, zorder=3)
        # those that ended in one place are seen inside one another
        ax.plot(*row.result.design[list(shown)], marker, color=colour, ms=max(14 - 1.1 * rank, 5), mec="white", mew=0.8,
                zorder=4 + rank, clip_on=False)  # fmt: skip
    ax.set(xlabel=space.labels[shown[0]], ylabel=space.labels[shown[1]],
           title="The ways of the designs on the landscape of LQR")  # fmt: skip


def _ranges(ax: Axes, comparison: Any, rows: Sequence[Any], looks: dict[str, Any], shown: Sequence[int]) -> None:
    """Draw where in its range each parameter ended, one row each."""
    space = comparison.problem.design
    middle = (len(rows) - 1) / 2
    for y, i in enumerate(shown):
        ax.plot([0, 1], [y, y], color="#E3E3E3", lw=7, solid_capstyle="butt", zorder=0)
        for rank, row in enumerate(rows):
            colour, marker = looks[row.name]
            height = y + min(0.12, 0.7 / len(rows)) * (rank - middle)
            ax.plot(space.to_unit(row.result.design)[i], height, marker, color=colour, ms=7, mec="white", mew=0.6,
                    clip_on=False, zorder=4)  # fmt: skip
        for end, side, place in ((space.lower[i], "left", 0.0), (space.upper[i], "right", 1.0)):
            ax.annotate(f"{end:g}", (place, y), (0, -24), textcoords="offset points", ha=side, va="center", fontsize=7,
                        color="#666666")  # fmt: skip
    ax.set_yticks(range(len(shown)), [label(space.labels[i]) for i in shown])
    ax.set(xlim=(-0.02, 1.02), ylim=(len(shown) - 0.4, -0.6), xlabel="part of the range",
           title="Where the designs ended")  # fmt: skip
    ax.grid(False, axis="y")


def _way(row: Any) -> Array:
    """Successive best designs (k, np) of a method, with its end."""
    history = row.result.history
    values = np.where(history.diverged > 0, -np.inf, np.nan_to_num(history.model_return, nan=-np.inf))
    best = np.maximum.accumulate(values)
    better = np.r_[True, best[1:] > best[:-1]]
    return np.vstack([history.design[better], row.result.design])


def plot_trade_off(found: Any) -> Figure:
    """Plot gain by control over design cost, and designs over price."""
    space = found.space
    shown = _axes_of(space)
    with styled():
        figure = blank(10.5, 4.4)
        left, *others = figure.subplot_mosaic(
            [["front", f"p{k}"] for k in range(len(shown))], width_ratios=(1.2, 1)
        ).values()  # fmt: skip
        order = np.argsort(found.design_costs)
        left.plot(found.design_costs[order], found.control_returns[order], "-", color="#9FB8CC", lw=1.5, zorder=1)
        ends = found.intervals
        left.errorbar(found.design_costs, found.control_returns, yerr=np.abs(ends.T - found.control_returns),
                      fmt="none", ecolor="#9FB8CC", capsize=2, lw=1, zorder=2)  # fmt: skip
        points = left.scatter(found.design_costs, found.control_returns, c=np.arange(len(found.values)), cmap="viridis",
                              s=52, edgecolors="white", linewidths=0.7, zorder=3)  # fmt: skip
        off = ~found.efficient
        left.plot(found.design_costs[off], found.control_returns[off], "x", color="#B00020", ms=9, zorder=4,
                  label="another is better in both")  # fmt: skip
        for value, x, y in zip(found.values, found.design_costs, found.control_returns):
            left.annotate(f"{value:g}", (x, y), (5, -9), textcoords="offset points", fontsize=7, color="#444444")
        if off.any():
            left.legend()
        left.margins(0.08)
        left.set(xlabel="cost of the design, at price 1" if found.priced else "cost of the design",
                 ylabel="return without it",
                 title=f"What control brings against what the design costs; numbers: {found.word}")  # fmt: skip
        colours = points.cmap(points.norm(np.arange(len(found.values))))
        for ax, i in zip(others, shown):
            ax.plot(found.values, found.designs[:, i], "-", color="#9FB8CC", lw=1.5, zorder=1)
            ax.scatter(found.values, found.designs[:, i], c=colours, s=32, edgecolors="white", linewidths=0.6, zorder=3)
            for edge in (space.lower[i], space.upper[i]):
                ax.axhline(edge, **BOUND)
            ax.set_ylabel(label(space.labels[i]))
            ax.yaxis.set_major_locator(MaxNLocator(4))
            if (found.values > 0).all() and found.values.max() > 20 * found.values.min():
                ax.set_xscale("log")
            ax.tick_params(labelbottom=ax is others[-1])
        others[-1].set_xlabel(found.word)
        figure.align_ylabels(others)
    return figure
