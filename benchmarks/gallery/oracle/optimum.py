"""The best design of a landscape J(p) over its box, and its other valleys."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.optimize import minimize

from gallery.oracle.statement import Array, Statement

POINTS = {1: 201, 2: 41, 3: 9}
SAME = 0.02  # of the box: two optima nearer than this are one
EXACT = 1e-5  # of the box, to which an optimum is polished


@dataclass(frozen=True)
class Landscape:
    """Local optima of J, the best first, and the corner where it is worst.

    Attributes
    ----------
    designs : (k, np) array
    returns : (k,) array
    worst_corner : (np,) array
    worst_return : float
    """

    designs: Array
    returns: Array
    worst_corner: Array
    worst_return: float


def landscape(s: Statement, value: Callable[[Array], float], *, points: int | None = None) -> Landscape:
    """All local optima that a dense grid over the unit box shows, each polished, and the worst corner."""
    dim = len(s.lower)
    n = points or POINTS[dim]
    axis = np.linspace(0.0, 1.0, n)
    grid = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), axis=-1)
    values = np.apply_along_axis(lambda v: value(s.from_unit(v)), -1, grid)
    peaks = grid[values >= maximum_filter(values, size=3, mode="nearest")]
    polished = [_polished(s, value, v, 1.0 / (n - 1)) for v in peaks]
    order = sorted(polished, key=lambda found: -found[1])
    kept: list[tuple[Array, float]] = []
    for v, best in order:
        if all(np.abs(v - other).max() > SAME for other, _ in kept):
            kept.append((v, best))
    corners = s.corners()
    at_corners = [value(p) for p in corners]
    worst = int(np.argmin(at_corners))
    designs = np.array([s.from_unit(v) for v, _ in kept])
    return Landscape(designs, np.array([best for _, best in kept]), corners[worst], at_corners[worst])


def _polished(s: Statement, value: Callable[[Array], float], v: Array, radius: float) -> tuple[Array, float]:
    """A local optimum (in the unit box) near v, and its return."""
    start = np.vstack([v, *(np.clip(v + radius * (0.5 - (v > 0.5)) * 2 * e, 0, 1) for e in np.eye(len(v)))])
    found = minimize(
        lambda z: -value(s.from_unit(z)), v, method="Nelder-Mead", bounds=[(0.0, 1.0)] * len(v),
        options={"initial_simplex": start, "xatol": EXACT, "fatol": 1e-9 * abs(value(s.from_unit(v)))},
    )  # fmt: skip
    return np.clip(found.x, 0.0, 1.0), -float(found.fun)
