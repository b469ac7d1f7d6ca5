"""Boxes, sizes, emptiness and nearest points of sets {v : Hv <= h}."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mpc.checks import Array, Flags
from mpc.dense_qp import DenseQP
from mpc.tolerances import EPS, NEGLIGIBLE, PRIMAL, ROUNDED_SUM


def box_of(H: Array, h: Array) -> tuple[Array, Array] | None:
    """Bounds (low, high) of an axis-aligned {v : Hv <= h}, else None."""
    if (np.count_nonzero(H, axis=1) != 1).any():
        return None
    low = np.full(H.shape[1], -np.inf)
    high = np.full(H.shape[1], np.inf)
    for row, bound in zip(H, h):
        j = int(np.flatnonzero(row)[0])
        if row[j] > 0:
            high[j] = min(high[j], bound / row[j])
        else:
            low[j] = max(low[j], bound / row[j])
    return low, high


def along_axes(H: Array, h: Array, *, farthest: bool = False) -> Array:
    """Distance (n,) along each axis to a row; 0 without.

    A row that misses the origin by the rounding of the farthest one is taken to go through it. One that sees an axis by
    the rounding of what else it sees, as a polygon by sines, does not see it.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        seen = np.abs(H) / np.abs(H).max(axis=0, initial=0.0)
        seen = seen > ROUNDED_SUM * np.nanmax(seen, axis=1, keepdims=True, initial=0.0)
        crossing = np.abs(h[:, None] / np.where(seen, H, 0.0))
    crossing[~np.isfinite(crossing)] = 0.0
    reach = np.asarray(crossing.max(axis=0, initial=0.0))
    if farthest:
        return reach
    crossing[crossing <= ROUNDED_SUM * reach] = np.inf
    nearest = crossing.min(axis=0, initial=np.inf)
    return np.where(np.isfinite(nearest), nearest, 0.0)


def is_empty(H: Array, h: Array) -> bool:
    """Whether no point satisfies Hv <= h."""
    box = box_of(H, h)
    if box is not None:
        low, high = box
        size = np.maximum(np.abs(low), np.abs(high))
        return bool((low - high > PRIMAL * np.where(np.isfinite(size), size, 0.0)).any())
    extent = along_axes(H, h)
    metric = np.diag(1 / np.where(extent > 0, extent, 1.0) ** 2)
    return DenseQP(metric, H).solve(np.zeros(H.shape[1]), h, confirm_infeasible=True).infeasible


def nearest_points(V: Array, H: Array, h: Array) -> Array:
    """Points (n, nu) of {v : Hv <= h} nearest to rows of V, in units of the set."""
    return projection(H, h)(V)


def projection(H: Array, h: Array) -> Callable[[Array], Array]:
    """Function of rows V: `nearest_points` of one set, for many calls."""
    box = box_of(H, h)
    if box is not None:
        low, high = box
        return lambda V: np.asarray(np.minimum(np.maximum(V, low), high))  # np.clip takes four times as long
    extent = along_axes(H, h)
    metric = 1 / np.where(extent > 0, extent, 1.0)

    def nearest(V: Array) -> Array:
        """Points (n, nu) by a program each."""
        near = np.empty(V.shape)
        for k, v in enumerate(V):
            distance = float(np.abs(v * metric).max())
            shrunk = v * metric / max(1.0, distance * np.sqrt(EPS))  # so far away only the direction counts
            near[k] = DenseQP(np.eye(len(v)), H / metric).solve(-shrunk, h).z / metric
        return near

    return nearest


@dataclass(frozen=True, eq=False)
class Limits:
    """Half-spaces (H, h) of "state", "terminal" and "input"; rates (nu,) or None; input matrix (nx, nu)."""

    B: Array
    sets: dict[str, tuple[Array, Array]]
    rate: Array | None
    horizon: int

    def input_extent(self) -> Array:
        """Size (nu,) of each input by bound or rate; 0 without limit."""
        extent = along_axes(*self.sets["input"])
        if self.rate is None:
            return extent
        return np.where(extent > 0, np.minimum(extent, self.horizon * self.rate), self.rate)

    def state_extent(self) -> Array:
        """Size (nx,) of each state by bounds or limited inputs; 0 without."""
        inputs = self.input_extent()
        limited = (inputs > 0) | ~self.B.any(axis=0)
        moved = np.abs(self.B) @ inputs
        moved[self.B[:, ~limited].any(axis=1)] = 0.0
        return first_positive(along_axes(*self.sets["state"]), along_axes(*self.sets["terminal"]), moved)

    def reaches(self) -> dict[str, Array]:
        """Extent of each set along its rows; 1 without any."""
        states = self.state_extent()
        ends = first_positive(along_axes(*self.sets["terminal"]), states)
        extents = {"state": states, "terminal": ends, "input": self.input_extent()}
        found = {kind: np.abs(H) @ extents[kind] for kind, (H, _) in self.sets.items()}
        return {kind: np.where(reach == 0, 1.0, reach) for kind, reach in found.items()}

    def price_units(self) -> dict[str, Array]:
        """Unit of each row of each set, see `MPCProblem.price_units`."""
        reaches, own = self.reaches(), self.own()
        units = {kind: np.where(own[kind], np.abs(h), reaches[kind]) for kind, (_, h) in self.sets.items()}
        if self.rate is not None:
            units["rate"] = np.tile(self.rate, 2)
        return units

    def own(self) -> dict[str, Flags]:
        """Whether each row is priced in units of its bound."""
        reaches = self.reaches()
        return {kind: np.asarray(np.abs(h) > NEGLIGIBLE * reaches[kind]) for kind, (_, h) in self.sets.items()}


def first_positive(*sizes: Array) -> Array:
    """First positive one of several sizes, entry by entry; 0 for none."""
    first = np.zeros_like(sizes[0])
    for size in sizes:
        first = np.where(first > 0, first, size)
    return first
