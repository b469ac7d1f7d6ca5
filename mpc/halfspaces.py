"""Small questions about a set {v : Hv <= h}: its box, its size along the axes, emptiness, nearest points."""

from __future__ import annotations

import numpy as np

from mpc.checks import Array
from mpc.dense_qp import DenseQP
from mpc.tolerances import EMPTY, FAR, ROUNDED_ZERO


def box_of(H: Array, h: Array) -> tuple[Array, Array] | None:
    """Bounds (low, high) of {v : Hv <= h} when every row concerns one entry, infinite where there is none."""
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
    """Distance (n,) from the origin to the nearest (or farthest) row along each axis; 0 where no bound crosses it.

    A row that misses the origin by the rounding of the farthest one is taken to go through it.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        crossing = np.abs(h[:, None] / H)
    crossing[~np.isfinite(crossing)] = 0.0
    reach = np.asarray(crossing.max(axis=0, initial=0.0))
    if farthest:
        return reach
    crossing[crossing <= ROUNDED_ZERO * reach] = np.inf
    nearest = crossing.min(axis=0, initial=np.inf)
    return np.where(np.isfinite(nearest), nearest, 0.0)


def is_empty(H: Array, h: Array) -> bool:
    """Whether no point satisfies Hv <= h; for other sets than boxes by the verdict of two solvers."""
    box = box_of(H, h)
    if box is not None:
        low, high = box
        size = np.maximum(np.abs(low), np.abs(high))
        return bool((low - high > EMPTY * np.where(np.isfinite(size), size, 0.0)).any())
    extent = along_axes(H, h)
    metric = np.diag(1 / np.where(extent > 0, extent, 1.0) ** 2)
    return DenseQP(metric, H).solve(np.zeros(H.shape[1]), h, confirm_infeasible=True).infeasible


def nearest_points(V: Array, H: Array, h: Array) -> Array:
    """Points (n, nu) of {v : Hv <= h} nearest to the rows of V; exact for a box, else see `nearest_point`."""
    box = box_of(H, h)
    if box is not None:
        return np.asarray(np.clip(V, *box), dtype=np.float64)
    return np.array([nearest_point(v, H, h) for v in V]).reshape(V.shape)


def nearest_point(v: Array, H: Array, h: Array) -> Array:
    """Point of {v : Hv <= h} nearest to v in units of the set, or to v shrunk when v is very far away."""
    extent = along_axes(H, h)
    metric = 1 / np.where(extent > 0, extent, 1.0)
    distance = float(np.abs(v * metric).max())
    shrunk = v * metric * min(1.0, FAR / max(distance, np.finfo(float).tiny))
    return DenseQP(np.eye(len(v)), H / metric).solve(-shrunk, h).z / metric
