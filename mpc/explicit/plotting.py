"""Plots of explicit laws; the only file that imports matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array, as_array
from mpc.exceptions import InputError

if TYPE_CHECKING:
    from mpc.explicit.explicit import ExplicitMPC


def plot_explicit(
    law: ExplicitMPC, what: str = "regions", *, axes: tuple[int, int] = (0, 1), at: ArrayLike | None = None,
    component: int = 0, points: int = 201, ax: Any = None,
) -> Any:  # fmt: skip
    """Draw the regions, the law or the value function over two of the parameters.

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
        raise InputError(f"what is {what!r}, expected 'regions', 'law' or 'value'.")
    if len({*axes}) != 2 or len(axes) != 2 or not all(0 <= i < law.nt for i in axes):
        raise InputError(f"axes are {axes}, expected two different numbers below {law.nt}, one per parameter.")
    ax = plt.subplots(layout="constrained")[1] if ax is None else ax
    p = law.partition
    base = p.centre if at is None else as_array("at", at, (law.nt,))
    labels = [f"{name}[{i}]" for name, size in p.problem.parameters for i in range(size)]
    ax.set(xlabel=labels[axes[0]], ylabel=labels[axes[1]], title=f"{what}, {len(law)} regions")
    if what == "regions":
        return _polygons(law, axes, base, ax)
    grid = [np.linspace(p.centre[i] - p.half[i], p.centre[i] + p.half[i], points) for i in axes]
    theta = np.tile(base, (points * points, 1))
    theta[:, axes[0]], theta[:, axes[1]] = (g.ravel() for g in np.meshgrid(*grid))
    u, outside = law.evaluate(theta)
    height = np.where(outside, np.nan, u[:, component]) if what == "law" else law.value(theta)
    height = np.ma.masked_invalid(height.reshape(points, points))
    drawn = ax.contourf(*grid, height, levels=30, cmap="viridis")
    ax.figure.colorbar(drawn, ax=ax, label=f"u[{component}]" if what == "law" else "cost")
    return drawn


def _polygons(law: ExplicitMPC, axes: tuple[int, int], base: Array, ax: Any) -> list[Any]:
    import matplotlib.pyplot as plt

    p = law.partition
    colours = plt.get_cmap("tab20")(law.law_number % 20)
    drawn: list[Any] = []
    for r in range(len(law)):
        rows = slice(p.offsets[r], p.offsets[r + 1])
        cut = p.H[rows][:, axes]
        left = p.h[rows] - p.H[rows] @ base + cut @ base[list(axes)]
        corners = _corners(cut * p.half[list(axes)], left - cut @ p.centre[list(axes)])
        if len(corners) >= 3:
            drawn += ax.fill(
                *(corners * p.half[list(axes)] + p.centre[list(axes)]).T, facecolor=colours[r], edgecolor="k", lw=0.4
            )
    return drawn


def _corners(A: Array, b: Array) -> Array:
    """Corners of a polygon {A x <= b}, in order around it; all intersections of two sides that lie in it."""
    i, j = np.triu_indices(len(A), 1)
    determinant = A[i, 0] * A[j, 1] - A[i, 1] * A[j, 0]
    crossing = np.abs(determinant) > 1e-12
    i, j, determinant = i[crossing], j[crossing], determinant[crossing]
    x = np.column_stack([b[i] * A[j, 1] - b[j] * A[i, 1], A[i, 0] * b[j] - A[j, 0] * b[i]]) / determinant[:, None]
    x = x[(x @ A.T <= b + 1e-9).all(axis=1)]
    if not len(x):
        return x
    around = x - x.mean(axis=0)
    return x[np.argsort(np.arctan2(around[:, 1], around[:, 0]))]
