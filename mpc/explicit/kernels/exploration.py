"""Compiled exploration of the graph of optimal active sets; imported only when an explicit law is computed.

Active sets are bit masks in a hash table; `region_kernels.py` says what a region is, `halfspace_kernels.py` finds its
facets. A region is queued once, when its active set is first considered.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from mpc.explicit.kernels.halfspace import across, interior_point, irredundant, project
from mpc.explicit.kernels.region import DEPENDENT, FLAT, FULL, gram_factor, gram_solve, optimal_set, region_rows

DONE, GROW, PAUSED = 0, 1, 2  # why the exploration returned
SAME = 1e-7  # normals and offsets closer than this describe the same hyperplane


@njit(cache=True)
def to_mask(act, k, mask):
    """Write the active set as bits."""
    for q in range(len(mask)):
        mask[q] = np.uint64(0)
    for a in range(k):
        mask[act[a] >> 6] |= np.uint64(1) << np.uint64(act[a] & 63)


@njit(cache=True)
def from_mask(mask, act):
    """Write the members of a bit mask in increasing order; returns their number."""
    k = 0
    for q in range(len(mask)):
        word = mask[q]
        for s in range(64):
            if word >> np.uint64(s) & np.uint64(1):
                act[k] = 64 * q + s
                k += 1
    return k


@njit(cache=True)
def find(masks, table, mask):
    """Slot of a mask in the hash table: where it is, or where it would go."""
    h = np.uint64(14695981039346656037)
    for q in range(len(mask)):
        h = (h ^ mask[q]) * np.uint64(1099511628211)
        h ^= h >> np.uint64(29)
    size = len(table)
    slot = np.int64(h & np.uint64(size - 1))
    while table[slot] >= 0:
        same = True
        for q in range(len(mask)):
            if masks[table[slot], q] != mask[q]:
                same = False
                break
        if same:
            return slot
        slot = (slot + 1) & (size - 1)
    return slot


@njit(cache=True)
def consider(gram, M, D, TA, Tb, mask, masks, kinds, table, queue, counts):
    """Kind of an active set: looked up, or found out and, when FULL, queued."""
    slot = find(masks, table, mask)
    if table[slot] >= 0:
        return kinds[table[slot]]
    m, n = len(D), D.shape[1] - 1
    act = np.empty(m, np.int64)
    k = from_mask(mask, act)
    A, b, centre = np.empty((m + len(Tb), n)), np.empty(m + len(Tb)), np.empty(n)
    kind = region_rows(gram, D, TA, Tb, M.shape[1], act, k, A, b)
    if kind == FULL and interior_point(A, b, centre) == 0.0:
        kind = FLAT
    index = counts[0]
    counts[0] += 1
    table[slot] = index
    kinds[index] = kind
    for q in range(len(mask)):
        masks[index, q] = mask[q]
    if kind == FULL:
        queue[counts[1]] = index
        counts[1] += 1
    return kind


@njit(cache=True)
def explore(gram, M, D, TA, Tb, masks, kinds, table, queue, counts, offsets, rows, budget):
    """Process queued regions: find the facets of each, and the optimal active sets behind every facet.

    counts: [sets known, regions queued, regions processed, facet rows stored].
    """
    m, n = len(D), D.shape[1] - 1
    words = masks.shape[1]
    A, b, centre = np.empty((m + len(Tb), n)), np.empty(m + len(Tb)), np.empty(n)
    facets, twins = np.empty(m + len(Tb), np.int64), np.empty(m + len(Tb), np.int64)
    act, trial, theta = np.empty(m + 1, np.int64), np.empty(m + 1, np.int64), np.empty(n)
    mask, flipped = np.empty(words, np.uint64), np.empty(words, np.uint64)
    one = np.uint64(1)
    while counts[2] < counts[1]:
        if budget == 0:
            return PAUSED
        budget -= 1
        mask[:] = masks[queue[counts[2]]]
        k = from_mask(mask, act)
        region_rows(gram, D, TA, Tb, M.shape[1], act, k, A, b)
        interior_point(A, b, centre)
        count = irredundant(A, b, centre, facets)
        if counts[3] + count > len(rows) or counts[0] + count * (k + 20) > min(len(masks), len(table) // 2):
            return GROW
        for a in range(count):
            for j in range(n):
                rows[counts[3], j] = A[facets[a], j]
            rows[counts[3], n] = b[facets[a]]
            counts[3] += 1
        offsets[counts[2] + 1] = counts[3]
        counts[2] += 1
        for a in range(count):
            facet = facets[a]
            if facet >= m:
                continue  # the border of the parameter set
            found = False
            # rows that share the hyperplane: any combination of them may change membership
            shared = 0
            for i in range(m):
                close = abs(b[i] - b[facet]) < SAME
                for j in range(n):
                    close = close and abs(A[i, j] - A[facet, j]) < SAME
                if close and shared < 4:
                    twins[shared] = i
                    shared += 1
            for combination in range(1, 1 << shared):
                flipped[:] = mask
                for s in range(shared):
                    if combination >> s & 1:
                        flipped[twins[s] >> 6] ^= one << np.uint64(twins[s] & 63)
                kind = consider(gram, M, D, TA, Tb, flipped, masks, kinds, table, queue, counts)
                found = found or kind == FULL
                if kind == DEPENDENT and shared == 1:
                    swapped = exchange(gram, M, D, TA, Tb, act, k, facet, mask, masks, kinds, table, queue, counts)
                    found = found or swapped
            if not found and across(A, b, facets, count, facet, theta):
                kt = optimal_set(M, D, theta, trial)
                if kt >= 0:
                    to_mask(trial, kt, flipped)
                    consider(gram, M, D, TA, Tb, flipped, masks, kinds, table, queue, counts)
    return DONE


@njit(cache=True)
def exchange(gram, M, D, TA, Tb, act, k, entering, mask, masks, kinds, table, queue, counts):
    """Replace a member of a dependent active set by the entering row: one with a positive coefficient has to leave."""
    L, coefficient = np.empty((k, k)), np.empty(k)
    gram_factor(gram, act, k, L)
    for a in range(k):
        coefficient[a] = gram[act[a], entering]
    gram_solve(L, k, coefficient)
    one = np.uint64(1)
    swapped = np.empty(len(mask), np.uint64)
    found = False
    for a in range(k):
        if coefficient[a] > 1e-9:
            swapped[:] = mask
            swapped[entering >> 6] ^= one << np.uint64(entering & 63)
            swapped[act[a] >> 6] ^= one << np.uint64(act[a] & 63)
            kind = consider(gram, M, D, TA, Tb, swapped, masks, kinds, table, queue, counts)
            found = found or kind == FULL
    return found


@njit(cache=True)
def seed(J, h, gram, M, D, TA, Tb, targets, masks, kinds, table, queue, counts):
    """Queue the active sets at feasible parameters near the targets; J [θ; v] <= h is the joint set with unit rows.

    Returns the number of targets for which a feasible parameter was found.
    """
    mj, nj = J.shape
    n = D.shape[1] - 1
    joint, c = np.empty(nj), np.zeros(nj)
    work, lam = np.empty(nj + 1, np.int64), np.empty(nj + 1)
    shrunk, act = np.empty(mj), np.empty(len(D) + 1, np.int64)
    mask = np.empty(masks.shape[1], np.uint64)
    hits = 0
    for t in range(len(targets)):
        c[:n] = targets[t]
        margin = 1e-2
        while margin > 1e-9:
            for i in range(mj):
                shrunk[i] = h[i] - margin
            if project(J, shrunk, mj, c, 1e-12, joint, work, lam) >= 0:
                hits += 1
                k = optimal_set(M, D, joint[:n], act)
                if k >= 0:
                    to_mask(act, k, mask)
                    consider(gram, M, D, TA, Tb, mask, masks, kinds, table, queue, counts)
                break
            margin *= 0.1
        if hits == 0:
            break  # infeasible from one target is infeasible from all
    return hits


@njit(cache=True)
def rehash(masks, table, count):
    """Fill an empty hash table with the masks known so far."""
    for index in range(count):
        table[find(masks, table, masks[index])] = index
