"""Compiled point location: building the search tree, walking it, and checking membership."""

from __future__ import annotations

import numpy as np
from numba import njit

from mpc.explicit.kernels.halfspace import interior_point, project

BELOW, ABOVE, BOTH = 1, 2, 3


@njit(cache=True)
def sides(rows, offsets, centres, planes, tol):
    """On which side of every hyperplane each region lies: (n_planes, n_regions), bit 1 below, bit 2 above."""
    count, n = len(offsets) - 1, planes.shape[1] - 1
    side = np.zeros((len(planes), count), np.uint8)
    theta, work, lam = np.empty(n), np.empty(n + 1, np.int64), np.empty(n + 1)
    largest = 0
    for r in range(count):
        largest = max(largest, offsets[r + 1] - offsets[r])
    A, b = np.empty((largest + 1, n)), np.empty(largest + 1)
    for r in range(count):
        m = offsets[r + 1] - offsets[r]
        A[:m] = rows[offsets[r] : offsets[r + 1], :n]
        b[:m] = rows[offsets[r] : offsets[r + 1], n]
        for p in range(len(planes)):
            s = -planes[p, n]
            for j in range(n):
                s += planes[p, j] * centres[r, j]
            sign = 1.0 if s < 0.0 else -1.0  # look for a point on the side where the centre is not
            near, far = (BELOW, ABOVE) if s < 0.0 else (ABOVE, BELOW)
            for j in range(n):
                A[m, j] = -sign * planes[p, j]
            b[m] = -sign * planes[p, n] - tol
            other = project(A, b, m + 1, centres[r], 1e-13, theta, work, lam) >= 0
            side[p, r] = near | far if other else near
    return side


@njit(cache=True)
def centres_of(rows, offsets):
    """A point well inside every region, (n_regions, n)."""
    n = rows.shape[1] - 1
    centres = np.zeros((len(offsets) - 1, n))
    for r in range(len(offsets) - 1):
        part = rows[offsets[r] : offsets[r + 1]]
        interior_point(np.ascontiguousarray(part[:, :n]), np.ascontiguousarray(part[:, n]), centres[r])
    return centres


@njit(cache=True)
def _best_plane(side, members):
    """Hyperplane that leaves the fewest regions on its fuller side, then the fewest cut; -1 when none helps."""
    size = len(members)
    best, score, total = -1, size, 2 * size + 1
    for p in range(len(side)):
        low, high = 0, 0
        for r in members:
            low += side[p, r] & 1
            high += side[p, r] >> 1
            if max(low, high) > score:
                break
        worse = max(low, high)
        if worse < score or (worse == score and worse < size and low + high < total):
            best, score, total = p, worse, low + high
    return best


@njit(cache=True)
def _reachable(members, rows, offsets, centres, path, depth, tol):
    """The members that meet the polytope of a node, given by the `depth` half-spaces on the path to it."""
    n = centres.shape[1]
    largest = 0
    for r in members:
        largest = max(largest, offsets[r + 1] - offsets[r])
    A, b = np.empty((largest + depth, n)), np.empty(largest + depth)
    A[:depth], b[:depth] = path[:depth, :n], path[:depth, n] - tol
    theta, work, lam = np.empty(n), np.empty(n + 1, np.int64), np.empty(n + 1)
    kept, count = np.empty(len(members), np.int64), 0
    for r in members:
        m = offsets[r + 1] - offsets[r]
        A[depth : depth + m] = rows[offsets[r] : offsets[r + 1], :n]
        b[depth : depth + m] = rows[offsets[r] : offsets[r + 1], n]
        if project(A, b, depth + m, centres[r], 1e-13, theta, work, lam) >= 0:
            kept[count] = r
            count += 1
    return kept[:count]


@njit(cache=True)
def grow(side, laws, planes, rows, offsets, centres, limit):
    """Binary search tree over hyperplanes (Tøndel, Johansen and Bemporad, Automatica 39(5), 2003), built depth first.

    Returns `nodes` (k, 3): hyperplane, child below, child above; a leaf has hyperplane -1 and its regions in
    leaf_regions[second : third].
    """
    count, n = side.shape[1], centres.shape[1]
    nodes, parent = np.empty((limit, 3), np.int64), np.full(limit, -1)
    stack, top, used = np.zeros(limit, np.int64), 1, 1
    path = np.empty((limit, n + 1))
    starts, ends = np.zeros(limit, np.int64), np.zeros(limit, np.int64)  # region lists of the nodes, in `pool`
    pool, filled = np.arange(count), count
    ends[0] = count
    leaf, leaf_end = np.empty(count, np.int64), 0
    while top > 0:
        top -= 1
        node = stack[top]
        members = pool[starts[node] : ends[node]].copy()
        filled = starts[node]  # depth first: what lies behind in the pool belongs to finished nodes
        depth, child = 0, node
        while parent[child] >= 0:
            up = parent[child]
            sign = 1.0 if nodes[up, 1] == child else -1.0
            for j in range(n + 1):
                path[depth, j] = sign * planes[nodes[up, 0], j]
            depth, child = depth + 1, up
        if depth > 1:
            members = _reachable(members, rows, offsets, centres, path, depth, 1e-9)
        size = len(members)
        single = True
        for a in range(1, size):
            single = single and laws[members[a]] == laws[members[0]]
        best = -1 if single or used + 2 > limit else _best_plane(side, members)
        if best < 0:
            if leaf_end + size > len(leaf):
                leaf = np.concatenate((leaf, np.empty(len(leaf) + size, np.int64)))
            leaf[leaf_end : leaf_end + size] = members
            nodes[node, 0], nodes[node, 1], nodes[node, 2] = -1, leaf_end, leaf_end + size
            leaf_end += size
            continue
        if filled + 2 * size > len(pool):
            pool = np.concatenate((pool, np.empty(len(pool) + 2 * size, np.int64)))
        nodes[node, 0], nodes[node, 1], nodes[node, 2] = best, used, used + 1
        for bit in range(2):
            starts[used + bit] = filled
            for r in members:
                if side[best, r] >> bit & 1:
                    pool[filled] = r
                    filled += 1
            ends[used + bit] = filled
            parent[used + bit] = node
            stack[top] = used + bit
            top += 1
        used += 2
    return nodes[:used].copy(), leaf[:leaf_end].copy()


@njit(cache=True)
def locate(points, planes, nodes, leaf, border, rows, offsets, tol, region, distance):
    """Region of every point and how far outside of it the point lies (<= tol: inside), by the tree.

    A point across the border gets a region of its leaf and an infinite distance; region -1 is a leaf without any.
    """
    n = points.shape[1]
    for q in range(len(points)):
        outside = False
        for i in range(len(border)):
            s = -border[i, n]
            for j in range(n):
                s += border[i, j] * points[q, j]
            if s > tol:
                outside = True
                break
        node = 0
        while nodes[node, 0] >= 0:
            p = nodes[node, 0]
            s = -planes[p, n]
            for j in range(n):
                s += planes[p, j] * points[q, j]
            node = nodes[node, 1] if s <= 0.0 else nodes[node, 2]
        best, nearest = -1, np.inf
        if outside:
            region[q] = leaf[nodes[node, 1]] if nodes[node, 1] < nodes[node, 2] else -1
            distance[q] = np.inf
            continue
        for e in range(nodes[node, 1], nodes[node, 2]):
            r = leaf[e]
            worst = -np.inf
            for i in range(offsets[r], offsets[r + 1]):
                s = -rows[i, n]
                for j in range(n):
                    s += rows[i, j] * points[q, j]
                if s > worst:
                    worst = s
                    if worst >= nearest:
                        break
            if worst < nearest:
                best, nearest = r, worst
            if nearest <= tol:
                break
        region[q], distance[q] = best, nearest


@njit(cache=True)
def apply(points, region, law, out):
    """Rows of out: law[region] [point; 1]."""
    n = points.shape[1]
    for q in range(len(points)):
        r = region[q]
        for i in range(law.shape[1]):
            s = law[r, i, n]
            for j in range(n):
                s += law[r, i, j] * points[q, j]
            out[q, i] = s
