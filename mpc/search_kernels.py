"""Compiled point location: building the search tree, walking it, and checking membership."""

from __future__ import annotations

import numpy as np
from numba import njit

from .kernels import interior_point, project

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
def grow(side, laws, limit):
    """Binary search tree over hyperplanes (Tøndel, Johansen and Bemporad, Automatica 39(5), 2003).

    Every inner node takes the hyperplane that leaves the fewest regions on its fuller side. Returns `nodes` (k, 3):
    hyperplane, child below, child above; a leaf has hyperplane -1 and its regions in leaf_regions[second : third].
    """
    planes, count = side.shape
    nodes = np.empty((limit, 3), np.int64)
    stack_node = np.empty(limit, np.int64)
    stack_start = np.empty(limit, np.int64)
    pool = np.empty(64 * count + 64, np.int64)  # region lists of the nodes still to be split
    leaf = np.empty(64 * count + 64, np.int64)
    leaf_end, pool_end, used, depth = 0, count, 1, 1
    for r in range(count):
        pool[r] = r
    stack_node[0], stack_start[0] = 0, 0
    below, above = np.empty(count, np.int64), np.empty(count, np.int64)
    while depth > 0:
        depth -= 1
        node, start = stack_node[depth], stack_start[depth]
        size = pool_end - start
        members = pool[start:pool_end].copy()
        pool_end = start
        single = True
        for a in range(1, size):
            single = single and laws[members[a]] == laws[members[0]]
        best, score, spread = -1, size, 2 * size + 1
        if not single:
            for p in range(planes):
                low, high = 0, 0
                for a in range(size):
                    s = side[p, members[a]]
                    low += s & 1
                    high += s >> 1
                    if low >= score + 1 or high >= score + 1:
                        break
                worse = max(low, high)
                if worse < score or (worse == score and worse < size and low + high < spread):
                    best, score, spread = p, worse, low + high
        if best < 0 or used + 2 > limit:
            if leaf_end + size > len(leaf):
                leaf = np.concatenate((leaf, np.empty(len(leaf) + size, np.int64)))
            leaf[leaf_end : leaf_end + size] = members
            nodes[node, 0], nodes[node, 1], nodes[node, 2] = -1, leaf_end, leaf_end + size
            leaf_end += size
            continue
        low, high = 0, 0
        for a in range(size):
            if side[best, members[a]] & 1:
                below[low] = members[a]
                low += 1
            if side[best, members[a]] & 2:
                above[high] = members[a]
                high += 1
        nodes[node, 0], nodes[node, 1], nodes[node, 2] = best, used, used + 1
        if pool_end + low + high > len(pool):
            pool = np.concatenate((pool, np.empty(len(pool) + low + high, np.int64)))
        # depth first: the list of the child on top of the stack is at the end of the pool
        stack_node[depth], stack_start[depth] = used, pool_end
        pool[pool_end : pool_end + low] = below[:low]
        pool_end += low
        stack_node[depth + 1], stack_start[depth + 1] = used + 1, pool_end
        pool[pool_end : pool_end + high] = above[:high]
        pool_end += high
        depth += 2
        used += 2
    return nodes[:used].copy(), leaf[:leaf_end].copy()


@njit(cache=True)
def locate(points, planes, nodes, leaf, rows, offsets, tol, region, distance):
    """Region of every point and how far outside of it the point lies (<= tol: inside), by the tree."""
    n = points.shape[1]
    for q in range(len(points)):
        node = 0
        while nodes[node, 0] >= 0:
            p = nodes[node, 0]
            s = -planes[p, n]
            for j in range(n):
                s += planes[p, j] * points[q, j]
            node = nodes[node, 1] if s <= 0.0 else nodes[node, 2]
        best, nearest = -1, np.inf
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
