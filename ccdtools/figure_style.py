"""Style of every figure, and maps of a return."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

import matplotlib
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes as Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure as Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ccdtools.arrays import Array

COLOURS = {  # Okabe and Ito: told apart by colour-blind readers
    "LQR": "#0072B2", "learned": "#D55E00", "learned (sampled)": "#E69F00",
    "MPC": "#009E73", "PID": "#CC79A7", "passive": "#7F7F7F",
}  # fmt: skip
OTHERS = ("#56B4E9", "#BCBD22", "#17BECF", "#9467BD")  # controllers that are not listed above
GENERATIONS = ("#3D3D3D", "#6A3D9A", "#B15928", "#8A8A00", "#1B7F79", "#A0205F")  # the start, generation 1, 2, …
OTHER_DESIGNS: tuple[tuple[str, Any], ...] = (
    ("#9A9A9A", (0, (1, 1.5))), ("#9A9A9A", (0, (6, 2, 1, 2))), ("#C4C4C4", "-"), ("#C4C4C4", (0, (3, 2))),
)  # fmt: skip
LINES: dict[str, dict[str, Any]] = {  # LQR broad and pale below, so that it is seen where the learned policy equals it
    "LQR": {"lw": 4.0, "alpha": 0.45, "solid_capstyle": "round", "zorder": 2},
    "learned": {"lw": 1.1, "zorder": 3},
}
BOUND: dict[str, Any] = {"color": "#444444", "lw": 0.9, "ls": (0, (5, 3))}
NOT_WORSE_STRIP = "#DDEBDD"
CHOSEN = "#D4A017"  # star of the iterate that was returned
INSIDE = re.compile(r"(?<![,:]) ")  # spaces within a value
SETTINGS: Any = {
    "axes.grid": True, "axes.axisbelow": True, "axes.spines.top": False, "axes.spines.right": False,
    "axes.labelsize": 9, "axes.titlesize": 9, "grid.color": "#E3E3E3", "grid.linewidth": 0.6,
    "xtick.labelsize": 8, "ytick.labelsize": 8, "legend.fontsize": 8, "legend.framealpha": 0.8,
    "axes.unicode_minus": True, "hatch.linewidth": 0.5,
}  # fmt: skip


def styled() -> AbstractContextManager[None]:
    """Settings for figures that are made or saved within."""
    return rc_context(SETTINGS)


class Picture(Figure):
    """Figure that a notebook shows by itself."""

    def _repr_png_(self) -> bytes:
        return png(self)


def blank(width: float, height: float, *, quick: bool = False) -> Figure:
    """Empty figure of that size [inch], marked if the run was quick."""
    figure = Picture(figsize=(width, height), layout="constrained")
    if quick:
        figure.text(0.003, 0.003, "QUICK", ha="left", va="bottom", fontsize=8, weight="bold", color="#B00020")
    return figure


def png(figure: Figure) -> bytes:
    """Figure as a PNG file."""
    buffer = io.BytesIO()
    with styled():
        figure.savefig(buffer, format="png", dpi=130)  # dots per inch
    return buffer.getvalue()


def label(text: str) -> str:
    """Name of a vertical axis, wrapped."""
    return textwrap.fill(text, 20, break_long_words=False)  # characters beside a low axis


def title(text: str) -> str:
    """Title of a column, wrapped between the values of a design."""
    return textwrap.fill(INSIDE.sub("\N{NO-BREAK SPACE}", text), 64, break_long_words=False)  # characters


def controller_colours(names: Sequence[str]) -> dict[str, str]:
    """One colour per controller, the same in every figure."""
    strangers = [name for name in dict.fromkeys(names) if name not in COLOURS]
    return COLOURS | {name: OTHERS[i % len(OTHERS)] for i, name in enumerate(strangers)}


def generation_colour(generation: int) -> str:
    """Colour of a generation, the same in every figure; 0 is the start."""
    return GENERATIONS[generation % len(GENERATIONS)]


def whole_ticks(ax: Axes, most: int = 10) -> None:
    """Mark a horizontal axis at whole numbers, in at most so many intervals."""
    ax.xaxis.set_major_locator(MaxNLocator(most, integer=True))


def without_grid(ax: Axes) -> Axes:
    """Axes for a map: framed, no grid."""
    ax.grid(False)
    ax.spines[:].set_visible(True)
    return ax


def draw_map(
    ax: Axes, x: Array, y: Array, mean: Array, fine: NDArray[np.bool_], *, label: str, whole: bool = False
) -> list[Any]:
    """Draw levels of a return and mark the best of the grid.

    Parameters
    ----------
    x, y : (k,) and (m,) arrays
    mean, fine : (m, k) arrays
    label : str
        Of the colour bar.
    whole : bool
        Whether a parameter is a whole number: every design of the grid then is a cell, with nothing between them.
    """
    shown = np.ma.masked_where(~fine, mean)
    without_grid(ax)
    artists: list[Any] = []
    if shown.count() > 3 and np.ptp(shown.compressed()) > 0:
        low, high = np.quantile(shown.compressed(), [1 - 0.9, 1.0])  # the worst tenth has one colour
        levels = MaxNLocator(12).tick_values(float(low), float(high))
        filled: Any
        if whole:
            colours = BoundaryNorm(levels, matplotlib.colormaps["Blues_r"].N, extend="min")
            filled = ax.pcolormesh(x, y, shown, cmap="Blues_r", norm=colours, shading="nearest", ec="white", lw=0.5)
        else:
            filled = ax.contourf(x, y, shown, levels=levels, cmap="Blues_r", extend="min")
            ax.contour(x, y, shown, levels=filled.levels, colors="white", linewidths=0.5, linestyles="solid")
        without_grid(ax.figure.colorbar(filled, ax=ax, label=label).ax)
        artists.append(filled)
        top = np.unravel_index(shown.argmax(), shown.shape)
        artists += ax.plot(
            x[top[1]], y[top[0]], "o", mfc="none", mec="k", mew=1.8, ms=21, label="best of the grid", clip_on=False
        )
    for set_limits, axis in ((ax.set_xlim, x), (ax.set_ylim, y)):
        gaps = np.diff(axis)[[0, -1]] / 2 if whole else np.full(2, 0.03 * np.ptp(axis))
        set_limits(axis[0] - gaps[0], axis[-1] + gaps[1])
    return artists
