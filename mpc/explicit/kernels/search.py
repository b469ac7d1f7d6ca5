"""Compiled point location: walking the search tree, scanning regions, and pulling a parameter back to the border."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from mpc.checks import Array
from mpc.explicit.kernels.data import Flags, Ints
from mpc.explicit.kernels.halfspace import side, violation
from mpc.tolerances import CROSSING, INSIDE, NO_BOUND


@njit(cache=True)
def leaf_of(planes: Array, nodes: Ints, t: Array) -> int:
    """Leaf of the tree in which t lies."""
    node = 0
    while nodes[node, 0] >= 0:
        node = nodes[node, 1] if side(planes, nodes[node, 0], t) <= 0.0 else nodes[node, 2]
    return node


@njit(cache=True)
def holder(rows: Array, offsets: Ints, members: Ints, t: Array) -> int:
    """First of the member regions that holds t, to the tolerance INSIDE; -1 where none does."""
    r: int
    for r in members:
        if violation(rows, offsets[r], offsets[r + 1], t, INSIDE) <= INSIDE:
            return r
    return -1


@njit(cache=True)
def of_one_law(number: Ints, members: Ints) -> int:
    """First of the member regions if all have the same law; -1 where they do not, or there is none."""
    for r in members:
        if number[r] != number[members[0]]:
            return -1
    return members[0] if len(members) > 0 else -1


@njit(cache=True)
def nearest(rows: Array, offsets: Ints, t: Array) -> tuple[int, float]:
    """First of all regions that holds t, and 0. Where none does, the one it lies least far outside of, and how far."""
    region, distance = -1, np.inf
    for r in range(len(offsets) - 1):
        worst = violation(rows, offsets[r], offsets[r + 1], t, distance)
        if worst <= INSIDE:
            return r, 0.0
        if worst < distance:
            region, distance = r, worst
    return region, distance


@njit(cache=True)
def is_beyond(columns: Array, height: Array, t: Array) -> bool:
    """Whether t lies beyond the border, given by its columns. All rows at once is faster than one after another."""
    for i in range(len(height)):
        height[i] = -columns[len(t), i]
    for j in range(len(t)):
        for i in range(len(height)):
            height[i] += columns[j, i] * t[j]
    beyond = False
    for i in range(len(height)):
        beyond |= height[i] > INSIDE
    return beyond


@njit(cache=True)
def pull_back(columns: Array, room: Array, inner: Array, t: Array) -> None:
    """Move t, which lies beyond the border, along the line to `inner` until it is on the border.

    room : distance of `inner` from each row of the border.
    """
    far = 0.0
    for j in range(len(t)):
        t[j] -= inner[j]
        far = max(far, abs(t[j]))
    shrink = 2.0 / far if far > 2.0 else 1.0  # the parameters fill a box two wide: only the direction counts
    for j in range(len(t)):
        t[j] *= shrink
    share = 1.0
    for i in range(len(room)):
        step = 0.0
        for j in range(len(t)):
            step += columns[j, i] * t[j]
        if step * share > room[i]:
            share = room[i] / step
    for j in range(len(t)):
        t[j] = inner[j] + share * t[j]


@njit(cache=True, error_model="numpy")
def search(where: tuple[Any, ...], points: Array, laws: tuple[Array, Ints, Array],
           found: tuple[Ints, Flags, Array]) -> None:  # fmt: skip
    """Fill in region, outside and input of every point: law[region] [point; 1], outside at the border and limited.

    where : tree, regions, border, the point within it towards which points beyond are pulled, and scaling, all in
    scaled parameters t = (θ - centre) / half. See `SearchTree` and `Partition`.
    The arrays are taken out of their tuples first: inside the loop that would cost more than the search.
    """
    planes, nodes, leaf, rows, offsets, border, inner, centre, half = where
    law, number, limits = laws
    region, outside, u = found
    n = points.shape[1]
    t, height = np.empty(n), np.empty(len(border))
    columns = np.ascontiguousarray(border.T)
    room = border[:, n].copy()
    for j in range(n):
        room -= border[:, j] * inner[j]
    border_first = len(border) <= 32  # a short border is looked at before the tree
    for q in range(len(points)):
        for j in range(n):
            t[j] = min(max((points[q, j] - centre[j]) / half[j], -NO_BOUND), NO_BOUND)
        beyond = border_first and is_beyond(columns, height, t)
        if beyond:
            pull_back(columns, room, inner, t)
        node = leaf_of(planes, nodes, t)
        members = leaf[nodes[node, 1] : nodes[node, 2]]
        r = of_one_law(number, members) if beyond else -1  # on the border: it lies in one of them
        if r < 0:
            r = holder(rows, offsets, members, t)
        if r < 0 and not border_first and is_beyond(columns, height, t):
            beyond = True
            pull_back(columns, room, inner, t)
            node = leaf_of(planes, nodes, t)
            r = holder(rows, offsets, leaf[nodes[node, 1] : nodes[node, 2]], t)
        if r < 0:
            r, gap = nearest(rows, offsets, t)
            beyond = beyond or gap > INSIDE
        region[q] = r
        outside[q] = beyond
        for j in range(n):
            t[j] = centre[j] + half[j] * t[j] if beyond else points[q, j]
        for i in range(law.shape[1]):
            s = law[r, i, n]
            for j in range(n):
                s += law[r, i, j] * t[j]
            u[q, i] = min(max(s, limits[0, i]), limits[1, i]) if beyond else s


@njit(cache=True)
def supporting(rows: Array, points: Array, kept: Flags) -> None:
    """Note in `kept` which hyperplanes have every point below them, to the tolerance CROSSING."""
    for i in range(len(rows)):
        kept[i] = True
        for q in range(len(points)):
            if side(rows, i, points[q]) > CROSSING:
                kept[i] = False
                break
