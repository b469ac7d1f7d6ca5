"""Compiled growth of the search tree, node after node in the order of their depth.

A region is represented by its centre and one point on each facet; those in the cell of a node say cheaply on which side
of a hyperplane the region lies. Where they do not say it, a projection decides, so that no region is lost.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from mpc.budgets import POINTS_OF_REGION, TRIES
from mpc.checks import Array
from mpc.explicit.kernels.data import Bits, Ints
from mpc.explicit.kernels.halfspace import interior_point, project, side
from mpc.tolerances import PRIMAL, ROUNDED_SUM, SAME_HYPERPLANE_DIGITS

NODES, NEXT, POOL, LEAF = range(4)  # positions in `Growth.counts`


class Regions(NamedTuple):
    """Region r: facets rows[offsets[r] : offsets[r + 1]], points[starts[r] : starts[r + 1]], number of its law."""

    rows: Array
    offsets: Ints
    points: Array
    starts: Ints
    laws: Ints


class Growth(NamedTuple):
    """A tree as far as it has grown.

    nodes : (capacity, 3) facet row, child below, child above, or -1 and a part of `leaf`; parents : (capacity,);
    first, last : (capacity,) part of `pool` with the regions of a node not yet looked at; pool, inside : regions,
    and which of their points lie in the cell, as bits; leaf : regions of the leaves; counts : NODES made, the NEXT to
    look at, entries of POOL and LEAF.
    """

    nodes: Ints
    parents: Ints
    first: Ints
    last: Ints
    pool: Ints
    inside: Bits
    leaf: Ints
    counts: Ints


@njit(cache=True)
def points_of(rows: Array, offsets: Ints, points: Array, starts: Ints) -> None:
    """Fill in the centre of every region and one point on each of its facets."""
    n = rows.shape[1] - 1
    point = np.empty(n)
    work = np.empty(n + 1, np.int64)
    lam = np.empty(n + 1)
    for r in range(len(offsets) - 1):
        k = offsets[r + 1] - offsets[r]
        A = np.empty((k, n))
        b = np.empty(k)
        for i in range(k):
            for j in range(n):
                A[i, j] = rows[offsets[r] + i, j]
            b[i] = rows[offsets[r] + i, n]
        centre = points[starts[r]]
        interior_point(A, b, np.inf, centre)
        for f in range(starts[r + 1] - starts[r] - 1):
            # the facet is the set above its own half-space
            for j in range(n):
                A[f, j] = -A[f, j]
            b[f] = -b[f]
            if project(A, b, k, centre, ROUNDED_SUM, point, work, lam) < 0:
                point[:] = centre
            for j in range(n):
                A[f, j] = -A[f, j]
                points[starts[r] + 1 + f, j] = point[j]
            b[f] = -b[f]


@njit(cache=True)
def score(regions: Regions, members: Ints, inside: Bits, row: int) -> float:
    """Score of a hyperplane that divides a node's members by their points: the fewer on the fuller side the better."""
    low = 0
    high = 0
    stride = 1 + len(members) // 400  # about 400 members score a hyperplane
    for e in range(0, len(members), stride):
        r = members[e]
        below = False
        above = False
        for q in range(min(POINTS_OF_REGION, regions.starts[r + 1] - regions.starts[r])):
            if inside[e] >> np.uint64(q) & np.uint64(1):
                s = side(regions.rows, row, regions.points[regions.starts[r] + q])
                below = below or s < -PRIMAL
                above = above or s > PRIMAL
                if below and above:
                    break
        low += below
        high += above
    return max(low, high) + 0.5 * (low + high)


@njit(cache=True)
def same_plane(rows: Array, i: int, j: int) -> bool:
    """Whether two rows are one hyperplane, up to sign."""
    gap: float = min(np.abs(rows[i] - rows[j]).max(), np.abs(rows[i] + rows[j]).max())
    return gap < 0.1**SAME_HYPERPLANE_DIGITS


@njit(cache=True)
def best_rows(regions: Regions, members: Ints, inside: Bits, node: int, best: Ints) -> int:
    """Write the facet rows that divide the members best into `best`, the best first. Returns their number."""
    scores = np.empty(len(best))
    found = 0
    thorough = len(best) == TRIES  # else rows of one score count as one hyperplane
    total = 0
    for r in members:
        total += regions.offsets[r + 1] - regions.offsets[r]
    few = len(members) <= 24  # every facet is tried
    state = np.uint64(node + 1)
    for c in range(total if few else 64):
        if few:
            rest = c
            e = 0
            while rest >= regions.offsets[members[e] + 1] - regions.offsets[members[e]]:
                rest -= regions.offsets[members[e] + 1] - regions.offsets[members[e]]
                e += 1
            row = regions.offsets[members[e]] + rest
        else:
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            r = members[np.int64(state >> np.uint64(33)) % len(members)]
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            row = regions.offsets[r] + np.int64(state >> np.uint64(33)) % (regions.offsets[r + 1] - regions.offsets[r])
        value = score(regions, members, inside, row)
        at = found
        while at > 0 and scores[at - 1] > value:
            at -= 1
        equal = at
        while (
            thorough and equal > 0 and scores[equal - 1] == value and not same_plane(regions.rows, best[equal - 1], row)
        ):
            equal -= 1
        if equal > 0 and scores[equal - 1] == value:
            continue
        if at < len(best):
            for move in range(min(found, len(best) - 1), at, -1):
                best[move] = best[move - 1]
                scores[move] = scores[move - 1]
            best[at] = row
            scores[at] = value
            found = min(found + 1, len(best))
    return found


@njit(cache=True)
def reaches(regions: Regions, r: int, inside: np.uint64, row: int, sign: float, A: Array, b: Array, depth: int) -> bool:
    """Whether region r, within the cell given by the first `depth` rows of A, b, has a part where sign * side <= 0."""
    n = A.shape[1]
    nearest = np.inf
    start = regions.starts[r]
    for q in range(min(POINTS_OF_REGION, regions.starts[r + 1] - regions.starts[r])):
        if inside >> np.uint64(q) & np.uint64(1):
            s = sign * side(regions.rows, row, regions.points[regions.starts[r] + q])
            if s < -PRIMAL:
                return True
            if s < nearest:
                nearest = s
                start = regions.starts[r] + q
    if sign < 0 and regions.offsets[r] <= row < regions.offsets[r + 1]:
        return False  # its own facet
    k = regions.offsets[r + 1] - regions.offsets[r]
    for j in range(n):
        A[depth, j] = sign * regions.rows[row, j]
    b[depth] = sign * regions.rows[row, n] - PRIMAL
    for i in range(k):
        for j in range(n):
            A[depth + 1 + i, j] = regions.rows[regions.offsets[r] + i, j]
        b[depth + 1 + i] = regions.rows[regions.offsets[r] + i, n]
    theta = np.empty(n)
    work = np.empty(n + 1, np.int64)
    lam = np.empty(n + 1)
    return project(A, b, depth + 1 + k, regions.points[start], ROUNDED_SUM, theta, work, lam) >= 0


@njit(cache=True)
def cell_of(regions: Regions, growth: Growth, node: int, more: int) -> tuple[int, Array, Array]:
    """Half-spaces Aθ <= b on the path to a node, drawn in by PRIMAL, with room for some more: their number, A, b."""
    n = regions.points.shape[1]
    depth = 0
    child = node
    while growth.parents[child] >= 0:
        child = growth.parents[child]
        depth += 1
    A = np.empty((depth + more, n))
    b = np.empty(depth + more)
    depth = 0
    child = node
    while growth.parents[child] >= 0:
        up = growth.parents[child]
        sign = 1.0 if growth.nodes[up, 1] == child else -1.0
        for j in range(n):
            A[depth, j] = sign * regions.rows[growth.nodes[up, 0], j]
        b[depth] = sign * regions.rows[growth.nodes[up, 0], n] - PRIMAL
        depth += 1
        child = up
    return depth, A, b


@njit(cache=True)
def divide(regions: Regions, growth: Growth, members: Ints, inside: Bits, row: int, A: Array, b: Array,
           depth: int, start: int) -> tuple[int, int]:  # fmt: skip
    """Write the members below and then above a hyperplane into the pool from `start`. Returns the two numbers."""
    filled = start
    for bit in range(2):
        sign = 1.0 if bit == 0 else -1.0
        for e in range(len(members)):
            r = members[e]
            if not reaches(regions, r, inside[e], row, sign, A, b, depth):
                continue
            kept = np.uint64(0)
            for q in range(min(POINTS_OF_REGION, regions.starts[r + 1] - regions.starts[r])):
                here = inside[e] >> np.uint64(q) & np.uint64(1)
                if here and sign * side(regions.rows, row, regions.points[regions.starts[r] + q]) <= PRIMAL:
                    kept |= np.uint64(1) << np.uint64(q)
            growth.pool[filled] = r
            growth.inside[filled] = kept
            filled += 1
        if bit == 0:
            low = filled - start
    return low, filled - start - low


@njit(cache=True)
def grow(regions: Regions, growth: Growth, bucket: int, budget: int) -> bool:
    """Look at nodes in turn, until none is left or the budget of region tests is spent.

    Returns whether memory has to grow first. A node becomes a leaf when its regions share one law, are not more than
    `bucket`, or no hyperplane divides them.
    """
    counts = growth.counts
    largest = 0
    for r in range(len(regions.offsets) - 1):
        largest = max(largest, regions.offsets[r + 1] - regions.offsets[r])
    best = np.empty(TRIES if len(regions.laws) <= 500 else 4, np.int64)  # more tries take longer then
    while counts[NEXT] < counts[NODES] and budget > 0:
        node = counts[NEXT]
        size = growth.last[node] - growth.first[node]
        if (counts[NODES] + 2 > len(growth.nodes) or counts[POOL] + 2 * size > len(growth.pool)
                or counts[LEAF] + size > len(growth.leaf)):  # fmt: skip
            return True
        budget -= size
        members = growth.pool[growth.first[node] : growth.last[node]]
        inside = growth.inside[growth.first[node] : growth.last[node]]
        single = True
        for r in members:
            single = single and regions.laws[r] == regions.laws[members[0]]
        row = -1
        low = 0
        high = 0
        if not single and size > bucket:
            depth, A, b = cell_of(regions, growth, node, 1 + largest)
            for attempt in range(best_rows(regions, members, inside, node, best)):
                low, high = divide(regions, growth, members, inside, best[attempt], A, b, depth, counts[POOL])
                if low < size and high < size:
                    row = best[attempt]
                    break
        growth.nodes[node, 0] = row
        counts[NEXT] += 1
        if row < 0:
            growth.nodes[node, 1] = counts[LEAF]
            growth.nodes[node, 2] = counts[LEAF] + size
            growth.leaf[counts[LEAF] : counts[LEAF] + size] = members
            counts[LEAF] += size
            continue
        child = counts[NODES]
        growth.nodes[node, 1] = child
        growth.nodes[node, 2] = child + 1
        growth.parents[child] = node
        growth.parents[child + 1] = node
        growth.first[child] = counts[POOL]
        growth.last[child] = counts[POOL] + low
        growth.first[child + 1] = counts[POOL] + low
        growth.last[child + 1] = counts[POOL] + low + high
        counts[POOL] += low + high
        counts[NODES] += 2
    return False
