"""Compiled point location: walking the search tree, scanning regions, and pulling a parameter back to the border."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from mpc.checks import Array
from mpc.explicit.kernels.growth import side_of
from mpc.tolerances import CROSSING, FAR_AWAY, INSIDE

Ints = np.ndarray[Any, np.dtype[np.int64]]
_SHORT_BORDER = 16  # rows up to which the border is looked at before the tree


class Locator(NamedTuple):
    """Tree and regions together; see `SearchTree` and `Partition`."""

    planes: Array
    nodes: Ints
    leaf: Ints
    rows: Array
    offsets: Ints


@njit(cache=True, inline="always")
def leaf_of(locator, points, q):
    """Leaf of the tree in which point q lies."""
    node = 0
    while locator.nodes[node, 0] >= 0:
        below = side_of(locator.planes, locator.nodes[node, 0], points, q) <= 0.0
        node = locator.nodes[node, 1] if below else locator.nodes[node, 2]
    return node


@njit(cache=True, inline="always")
def holder(locator, points, q):
    """First region of its leaf that holds point q, to the tolerance INSIDE; -1 where none does."""
    node = leaf_of(locator, points, q)
    region = -1
    for e in range(locator.nodes[node, 1], locator.nodes[node, 2]):
        r = locator.leaf[e]
        inside = True
        for i in range(locator.offsets[r], locator.offsets[r + 1]):
            if side_of(locator.rows, i, points, q) > INSIDE:
                inside = False
                break
        if inside:
            region = r
            break
    return region


@njit(cache=True, inline="always")
def nearest(locator, points, q):
    """Region of its leaf outside of which point q lies least far, and how far; -1 and inf in an empty leaf."""
    node = leaf_of(locator, points, q)
    region, distance = -1, np.inf
    for e in range(locator.nodes[node, 1], locator.nodes[node, 2]):
        r = locator.leaf[e]
        worst = -np.inf
        for i in range(locator.offsets[r], locator.offsets[r + 1]):
            worst = max(worst, side_of(locator.rows, i, points, q))
            if worst >= distance:
                break
        if worst < distance:
            region, distance = r, worst
    return region, distance


@njit(cache=True, inline="always")
def pull_back(border, room, centre, points, q):
    """Move point q, if it lies beyond the border {a't <= b}, towards the centre until it is on it; whether it was.

    room : distance of the centre from each row of the border.
    """
    n = points.shape[1]
    beyond = False
    for i in range(len(border)):
        if side_of(border, i, points, q) > INSIDE:
            beyond = True
            break
    if beyond:
        far = 0.0
        for j in range(n):
            far = max(far, abs(points[q, j] - centre[j]))
        shrink = FAR_AWAY / far if far > FAR_AWAY else 1.0
        share = 1.0
        for i in range(len(border)):
            step = 0.0
            for j in range(n):
                step += border[i, j] * (points[q, j] - centre[j])
            if step * shrink * share > room[i]:
                share = room[i] / (step * shrink)
        for j in range(n):
            points[q, j] = centre[j] + share * shrink * (points[q, j] - centre[j])
    return beyond


@njit(cache=True)
def locate(locator, border, centre, points, region, outside, gap):
    """Region of every point, whether it lies beyond the border, and how far it is from its region.

    A point beyond the border is moved onto it. A gap above INSIDE says that the leaf does not hold the point.
    """
    n = points.shape[1]
    room = border[:, n].copy()
    for i in range(len(border)):
        for j in range(n):
            room[i] -= border[i, j] * centre[j]
    first = len(border) <= _SHORT_BORDER
    for q in range(len(points)):
        gap[q] = 0.0
        outside[q] = first and pull_back(border, room, centre, points, q)
        region[q] = holder(locator, points, q)
        if region[q] < 0 and not first and pull_back(border, room, centre, points, q):
            outside[q] = True
            region[q] = holder(locator, points, q)
        if region[q] < 0:
            region[q], gap[q] = nearest(locator, points, q)


@njit(cache=True)
def supporting(rows, points, kept):
    """Note in `kept` which hyperplanes have every point below them, to the tolerance CROSSING."""
    for i in range(len(rows)):
        kept[i] = True
        for q in range(len(points)):
            if side_of(rows, i, points, q) > CROSSING:
                kept[i] = False
                break


@njit(cache=True)
def apply(points, found, centre, half, law, out):
    """Rows of out: law[region] [point; 1], at the point on the border where it is outside."""
    n = points.shape[1]
    theta = np.empty(n)
    for q in range(len(points)):
        for j in range(n):
            theta[j] = centre[j] + half[j] * found.points[q, j] if found.outside[q] else points[q, j]
        r = found.region[q]
        for i in range(law.shape[1]):
            s = law[r, i, n]
            for j in range(n):
                s += law[r, i, j] * theta[j]
            out[q, i] = s
