"""Pictures of a run; the only module here that imports matplotlib. Nothing is shown, everything is returned."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator
from numpy.typing import NDArray

from ccdtools.arrays import Array
from ccdtools.co_design.result import History
from ccdtools.plants.design_space import DesignSpace
from ccdtools.studies.report.tables import NEGLIGIBLE, NOT_WORSE, percent_of_reference
from invariant_sets import Polytope, plot_polytope

COLOURS = {  # Okabe and Ito: told apart by colour-blind readers
    "LQR": "#0072B2", "learned": "#D55E00", "learned (sampled)": "#E69F00",
    "MPC": "#009E73", "PID": "#CC79A7", "passive": "#7F7F7F",
}  # fmt: skip
OTHERS = ("#56B4E9", "#8C564B", "#BCBD22", "#17BECF")
BOUND: dict[str, Any] = {"color": "#444444", "lw": 0.9, "ls": (0, (5, 3))}
DPI = 130


def controller_colours(names: Sequence[str]) -> dict[str, str]:
    """One colour per controller, the same in every figure."""
    strangers = [name for name in dict.fromkeys(names) if name not in COLOURS]
    return COLOURS | {name: OTHERS[i % len(OTHERS)] for i, name in enumerate(strangers)}


def generation_colour(k: int, count: int) -> Any:
    """Colour of the k-th of `count` designs in time order."""
    return colormaps["viridis"](0.85 * k / max(count - 1, 1))


def blank(width: float, height: float, *, quick: bool = False) -> Figure:
    """An empty figure of that size [inch], marked in its corner if the run was quick."""
    figure = Figure(figsize=(width, height), layout="constrained")
    if quick:
        figure.text(0.003, 0.003, "QUICK", ha="left", va="bottom", fontsize=8, weight="bold", color="#B00020")
    return figure


def png(figure: Figure) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def plot_history(
    figure: Figure, histories: Sequence[History], chosen: Sequence[int], space: DesignSpace, judges: Sequence[str]
) -> list[Axes]:
    """Return (top) and design (below) over the iterations of every co-design, one column per generation.

    Parameters
    ----------
    histories : sequence of History
    chosen : sequence of int
        The row of each history that was returned; a star marks it.
    judges : sequence of str
        What each return was measured on.
    """
    columns = len(histories)
    grid = figure.subplots(1 + space.dim, columns, squeeze=False, sharex="col")
    for g, history in enumerate(histories):
        top, colour = grid[0, g], generation_colour(g + 1, columns + 1)
        top.set_title(f"generation {g + 1}\n{judges[g]}", fontsize=9)
        top.fill_between(
            history.iteration, history.model_return - history.std, history.model_return + history.std,
            color=colour, alpha=0.15, lw=0,
        )  # fmt: skip
        _course(top, history.iteration, history.model_return, chosen[g], colour)
        for i in range(space.dim):
            ax = grid[1 + i, g]
            _bounds(ax, space.lower[i], space.upper[i])
            _course(ax, history.iteration, history.design[:, i], chosen[g], colour)
        grid[-1, g].set_xlabel("iteration")
        grid[-1, g].xaxis.set_major_locator(MaxNLocator(5, integer=True))
    grid[0, 0].set_ylabel("return")
    for i, (name, unit) in enumerate(zip(space.names, space.units)):
        grid[1 + i, 0].set_ylabel(_with_unit(name, unit))
    return [_light(ax) for ax in grid.flat]


def _course(ax: Axes, steps: Array, values: Array, chosen: int, colour: Any) -> None:
    ax.plot(steps, values, "-o", color=colour, ms=2.5, lw=1.5)
    ax.plot(steps[chosen], values[chosen], "*", color="#D4A017", mec="k", mew=0.6, ms=13, zorder=5)


def _bounds(ax: Axes, lower: float, upper: float) -> None:
    room = 0.08 * (upper - lower)
    ax.set_ylim(lower - room, upper + room)
    for edge, beyond in ((lower, lower - room), (upper, upper + room)):
        ax.axhline(edge, **BOUND)
        ax.axhspan(min(edge, beyond), max(edge, beyond), facecolor="#EEEEEE", edgecolor="#CCCCCC", hatch="///", lw=0)


def plot_sets(
    ax: Axes, sets: Mapping[str, Polytope], *, frame: Polytope, labels: tuple[str, str], legend: bool = False
) -> list[Any]:
    """Planar sets by name over their frame X (dashed)."""
    style = {"facecolor": "none", "edgecolor": BOUND["color"], "linestyle": (0, (5, 3)), "label": "X", "zorder": 4}
    artists = [plot_polytope(frame, ax=ax, **style)]
    for k, (name, shown) in enumerate(sets.items()):
        if shown.is_empty:
            continue  # a slice can miss its set
        colour = generation_colour(k, len(sets))
        artists.append(plot_polytope(shown, ax=ax, facecolor=(*colour[:3], 0.10), edgecolor=colour, lw=1.8, label=name))
    lower, upper = frame.bounding_box()
    room = 0.06 * (upper - lower)
    ax.set(xlabel=labels[0], ylabel=labels[1])
    ax.set(xlim=(lower[0] - room[0], upper[0] + room[0]), ylim=(lower[1] - room[1], upper[1] + room[1]))
    if legend:
        ax.figure.legend(handles=artists, loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    _light(ax)
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
    """Inputs over the plane of two states: one row per input, each surface and their difference (first − second).

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
            mesh = ax.pcolormesh(*x, values[..., row], cmap=colours, vmin=-top, vmax=top, shading="nearest",
                                 rasterized=True)  # fmt: skip
            plot_polytope(outline, ax=ax, facecolor="none", edgecolor="k", lw=1.3)
            ax.set_title(title, fontsize=9)
            ax.set(xlabel=labels[0], xlim=x[0][[0, -1]], ylim=x[1][[0, -1]])
            _small(figure.colorbar(mesh, ax=ax, shrink=0.9, label=unit).ax)
        grid[row, 0].set_ylabel(labels[1])
    return [_small(ax) for ax in grid.flat]


def plot_trajectories(
    figure: Figure,
    columns: Mapping[str, Mapping[str, Array]],
    time: Array,
    *,
    labels: Sequence[str],
    limits: tuple[Array, Array],
    time_label: str,
) -> list[Axes]:
    """Mean and band of every signal, one column per design, one colour per controller.

    Parameters
    ----------
    columns : mapping of title to mapping of controller to (3, T, signals) array
        Low, mean and high.
    limits : lower and upper (signals,) arrays
        Drawn dashed where they are in sight.
    """
    names = list(next(iter(columns.values())))
    colours = controller_colours(names)
    grid = figure.subplots(len(labels), len(columns), squeeze=False, sharex=True, sharey="row")
    for c, (title, controllers) in enumerate(columns.items()):
        for name, (low, mean, high) in controllers.items():
            for row in range(len(labels)):
                ax = grid[row, c]
                ax.fill_between(time, low[:, row], high[:, row], color=colours[name], alpha=0.18, lw=0)
                ax.plot(time, mean[:, row], color=colours[name], lw=1.3, label=name, ls="-" if name == "LQR" else "--")
        grid[0, c].set_title(title, fontsize=9)
        grid[-1, c].set_xlabel(time_label)
    for row, label in enumerate(labels):
        low, high = grid[row, 0].get_ylim()
        for edge in (limits[0][row], limits[1][row]):
            if low - 0.05 * (high - low) <= edge <= high + 0.05 * (high - low):
                for ax in grid[row]:
                    ax.axhline(edge, **BOUND)
        grid[row, 0].set_ylabel(label)
    grid[0, 0].legend(fontsize=8, ncols=len(names), loc="best", framealpha=0.8)
    figure.align_ylabels()
    return [_light(ax) for ax in grid.flat]


def plot_quantiles(
    figure: Figure, time: Array, errors: Array, quantiles: Array, levels: Sequence[float], *,
    labels: Sequence[str], time_label: str,
) -> list[Axes]:  # fmt: skip
    """Learned quantiles (T, levels, nx) with the logged one-step errors (T, nx), one row per state."""
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
        ax.set_ylabel(f"e: {label}", fontsize=9)
        ax.set_title(f"{inside.mean():.0%} inside", loc="right", fontsize=8, pad=3)
    grid[-1].set_xlabel(time_label)
    handles, names = grid[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", fontsize=8, ncols=4, frameon=False)
    figure.align_ylabels()
    return [_light(ax) for ax in grid]


def plot_comparison(figure: Figure, rows: Sequence[Mapping[str, Any]]) -> list[Axes]:
    """Paired difference to LQR in per cent of |LQR|, with its interval: generations below, plants beside each other.

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
        model = next((row["model"] for row in chosen.values()), plant)
        grid[r, c].set_title(f"{'start' if g == 0 else f'generation {g}'}: {_plant_title(plant, model)}", fontsize=9)
    _per_cent_axis(grid[0, 0], min(ends), max(ends))
    grid[0, 0].set_yticks(range(len(names)), names)
    grid[0, 0].set_ylim(len(names) - 0.5, -0.5)
    for ax in grid[-1]:
        ax.set_xlabel("return beside LQR's [% of |LQR|], right is better")
    return [_light(ax) for ax in grid.flat]


def _differences(ax: Axes, names: Sequence[str], chosen: Mapping[str, Mapping[str, Any]]) -> list[float]:
    """Draw one panel; the ends of its intervals."""
    colours, ends = controller_colours(names), []
    ax.axvspan(-100 * NOT_WORSE, 0, color="#DDEBDD", lw=0, zorder=0)
    ax.axvline(0, color=COLOURS["LQR"], lw=1.4)
    for y, name in enumerate(names):
        row = chosen.get(name)
        percent = None if row is None else percent_of_reference(row, chosen.get("LQR"))
        if percent is not None:
            mean, low, high = percent
            ends += [low, high]
            bar = [[mean - low], [high - mean]]
            ax.errorbar(mean, y, xerr=bar, fmt="o", color=colours[name], ms=6, capsize=4, lw=2)
            note = f"{mean:+.3g} %" if abs(mean) >= NEGLIGIBLE else "0 %"
        else:
            note = "–" if row is None else f"{row['diverged']:.0%} diverged" if row["diverged"] else "no pairs"
        weight = "bold" if name == "learned" else "normal"
        ax.annotate(note, (1.015, y), xycoords=("axes fraction", "data"), va="center", fontsize=8, weight=weight)
    return ends


def _per_cent_axis(ax: Axes, low: float, high: float) -> None:
    """Linear between −1 and 1 per cent, logarithmic beyond."""
    ax.set_xscale("symlog", linthresh=1.0, linscale=1.5)
    ax.set_xlim(min(1.6 * low, -2.0), max(1.6 * high, 2.0))
    powers = 10.0 ** np.arange(0, 9)
    ax.xaxis.set_major_locator(FixedLocator([*-powers[::-1], 0, *powers]))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _plant_title(plant: str, model: str) -> str:
    return "real plant" if plant == "real" else "nominal model" if model == "nominal" else model


def plot_landscape_curve(
    ax: Axes, designs: Array, mean: Array, interval: Array, diverged: Array, paths: Sequence[Array], *, label: str,
    allowed: float,
) -> list[Any]:  # fmt: skip
    """LQR's return over one design parameter, with the paths of the design drawn on it.

    Parameters
    ----------
    designs, mean, interval, diverged : (k,) arrays
        `interval` is the half-width of the 95 % interval of the mean.
    paths : sequence of (m,) arrays
        One per generation.
    allowed : float
        Designs where a larger fraction diverges are shaded, and do not set the scale.
    """
    fine = diverged <= allowed
    colour = COLOURS["LQR"]
    artists: list[Any] = [ax.fill_between(designs, mean - interval, mean + interval, color=colour, alpha=0.2, lw=0)]
    artists += ax.plot(designs, mean, color=colour, label="LQR at this design")
    edges = np.r_[designs[0], (designs[1:] + designs[:-1]) / 2, designs[-1]]
    for i in np.flatnonzero(~fine):
        ax.axvspan(edges[i], edges[i + 1], color="#DDDDDD", lw=0, zorder=0)
    spread = np.ptp(mean[fine]) if fine.any() else 1.0
    if fine.any():
        ax.set_ylim(mean[fine].min() - 0.1 * spread - 1e-9, mean[fine].max() + 0.15 * spread + 1e-9)
    for g, path in enumerate(paths):
        artists += _path(ax, path, np.interp(path, designs, mean), g, len(paths), line="none")
    for edge in designs[[0, -1]]:
        ax.axvline(edge, **BOUND)
    ax.set(xlabel=label, ylabel="return, nominal model")
    ax.legend(fontsize=8)
    _light(ax)
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
) -> list[Any]:
    """LQR's return over two design parameters, with the paths of the design.

    Parameters
    ----------
    x, y : (k,) and (m,) arrays
    mean, fine : (m, k) arrays
        Designs that are not fine (too many runs diverge) stay blank.
    paths : sequence of (n, 2) arrays
    """
    shown = np.ma.masked_where(~fine, mean)
    artists: list[Any] = []
    if shown.count() > 3:
        levels = np.unique(np.quantile(shown.compressed(), np.linspace(0, 1, 16)))
        if len(levels) > 1:
            filled = ax.contourf(x, y, shown, levels=levels, cmap="Blues_r")
            ax.contour(x, y, shown, levels=levels, colors="white", linewidths=0.5)
            bar = ax.figure.colorbar(filled, ax=ax, label="return of LQR, nominal model")
            _small(bar.ax).yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}"))
            artists.append(filled)
            top = np.unravel_index(shown.argmax(), shown.shape)
            artists += ax.plot(
                x[top[1]], y[top[0]], "o", mfc="none", mec="k", mew=1.8, ms=21, label="best of the grid", clip_on=False
            )
    for g, path in enumerate(paths):
        artists += _path(ax, path[:, 0], path[:, 1], g, len(paths))
    ax.set(xlabel=labels[0], ylabel=labels[1])
    room = 0.03
    ax.set_xlim(x[0] - room * np.ptp(x), x[-1] + room * np.ptp(x))
    ax.set_ylim(y[0] - room * np.ptp(y), y[-1] + room * np.ptp(y))
    ax.legend(fontsize=8, loc="best", markerscale=0.5)
    _small(ax)
    return artists


def _path(ax: Axes, x: Array, y: Array, g: int, count: int, *, line: str = "-") -> list[Any]:
    colour = colormaps["autumn"](0.75 * g / max(count - 1, 1))
    way = ax.plot(x, y, ls=line, marker="o", color=colour, ms=4, lw=1.5, label=f"path of generation {g + 1}", zorder=4)
    start = ax.plot(x[0], y[0], "s", color=colour, mec="k", ms=8, zorder=5)
    end = ax.plot(x[-1], y[-1], "*", color=colour, mec="k", ms=15, zorder=6)
    return [*way, *start, *end]


def _light(ax: Axes) -> Axes:
    ax.grid(True, color="#E3E3E3", lw=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    return _small(ax)


def _small(ax: Axes) -> Axes:
    ax.tick_params(labelsize=8)
    for axis in (ax.xaxis, ax.yaxis):
        axis.label.set_fontsize(9)
    return ax


def _with_unit(name: str, unit: str) -> str:
    return name if unit == "-" else f"{name} [{unit}]"
