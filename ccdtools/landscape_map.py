"""A return over two design parameters, drawn as a map."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ccdtools.arrays import Array
from ccdtools.figure_style import without_grid

BEST_LEVELS = 0.9  # share of the designs that the colours tell apart; the worst tenth has one colour


def draw_map(
    ax: Axes, x: Array, y: Array, mean: Array, fine: NDArray[np.bool_], *, label: str, whole: bool = False
) -> list[Any]:
    """Levels of a return, with a circle about the best of the grid; designs that are not fine stay blank.

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
        levels = _even_levels(shown.compressed())
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


def _even_levels(values: Array) -> Array:
    """About a dozen levels at equal steps from the worst of the better designs to the best."""
    low, high = np.quantile(values, [1 - BEST_LEVELS, 1.0])
    return np.asarray(MaxNLocator(12).tick_values(float(low), float(high)))
