"""Plots of explicit laws."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array, as_array, as_count
from mpc.exceptions import InputError
from mpc.explicit.piecewise_law import PiecewiseLaw


def plot_explicit(
    law: PiecewiseLaw, what: str = "regions", *, axes: tuple[int, int] = (0, 1), at: ArrayLike | None = None,
    component: int = 0, points: int = 201, ax: Any = None,
) -> Any:  # fmt: skip
    """Draw regions, law or value function over two parameters.

    Parameters
    ----------
    law : ExplicitMPC
        What to draw.
    what : "regions", "law" or "value"
        Polygons in colours that differ by law, or filled contours of the input or of the cost.
    axes : (int, int)
        Parameters on the horizontal and vertical axis.
    at : (nt,) array, optional
        Values of the other parameters; the centre of the set by default.
    component : int
        Input drawn by "law".
    points : int
        Grid points along each axis, for "law" and "value".
    ax : matplotlib Axes, optional
        Where to draw; a new figure by default.

    Returns
    -------
    list of Polygon, or QuadContourSet
        The artists.
    """
    import matplotlib.pyplot as plt

    if what not in ("regions", "law", "value"):
        raise InputError("what", repr(what), "'regions', 'law' or 'value'")
    pair = tuple(axes) if isinstance(axes, (tuple, list, np.ndarray)) else ()
    if len(pair) != 2 or not all(_is_index(i, law.nt) for i in pair) or pair[0] == pair[1]:
        raise InputError("axes", repr(axes), f"two different numbers below {law.nt}, one per parameter")
    first, second = int(pair[0]), int(pair[1])
    if not _is_index(component, law.nu):
        raise InputError("component", repr(component), f"the number of an input, below {law.nu}")
    points = as_count("points", points)
    if ax is not None and not hasattr(ax, "add_patch"):
        raise InputError("ax", type(ax).__name__, "matplotlib Axes")
    ax = plt.subplots(layout="constrained")[1] if ax is None else ax
    p = law.partition
    base = p.centre if at is None else as_array("at", at, (law.nt,))
    labels = [f"{name}[{i}]" for name, size in p.problem.parameters for i in range(size)]
    ax.set(xlabel=labels[first], ylabel=labels[second], title=f"{what}, {len(law)} regions")
    if what == "regions":
        return _polygons(law, (first, second), base, ax)
    grid = [np.linspace(p.centre[i] - p.half[i], p.centre[i] + p.half[i], points) for i in (first, second)]
    theta = np.tile(base, (points * points, 1))
    across, up = np.meshgrid(*grid)
    theta[:, first] = across.ravel()
    theta[:, second] = up.ravel()
    u, outside = law.evaluate(theta)
    height = np.where(outside, np.nan, u[:, component]) if what == "law" else law.value(theta)
    height = np.ma.masked_invalid(height.reshape(points, points))
    drawn = ax.contourf(*grid, height, levels=30, cmap="viridis")
    ax.figure.colorbar(drawn, ax=ax, label=f"u[{component}]" if what == "law" else "cost")
    return drawn


def _is_index(value: Any, count: int) -> bool:
    """Whether a value is one of 0 … count - 1."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(0 <= value < count)


def _polygons(law: PiecewiseLaw, axes: tuple[int, int], base: Array, ax: Any) -> list[Any]:
    """Regions that the section cuts, as polygons."""
    import matplotlib.pyplot as plt

    from invariant_sets import Polytope

    p = law.partition
    pair = list(axes)
    colours = plt.get_cmap("tab20")(law.law_number % 20)
    drawn: list[Any] = []
    for r in range(len(law)):
        rows = slice(p.offsets[r], p.offsets[r + 1])
        cut = p.H[rows][:, pair]
        left = p.h[rows] - p.H[rows] @ base + cut @ base[pair]
        section = Polytope(cut * p.half[pair], left - cut @ p.centre[pair])
        if section.is_empty or section.affine_dim < 2:
            continue
        corners = section.vertices
        around = corners - corners.mean(axis=0)
        corners = corners[np.argsort(np.arctan2(around[:, 1], around[:, 0]))] * p.half[pair] + p.centre[pair]
        drawn += ax.fill(*corners.T, facecolor=colours[r], edgecolor="k", lw=0.4)
    return drawn
