"""Compiled active sets: bit masks in a hash table; `region.py` says what their regions are.

A region is queued once, when its active set is first considered.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from mpc.checks import Array
from mpc.explicit.kernels.data import FLAT, FULL, INFEASIBLE, KNOWN, QUEUED, Bits, Graph, Ints, QPData
from mpc.explicit.kernels.halfspace import interior_point
from mpc.explicit.kernels.region import optimal_set, region_rows
from mpc.tolerances import TIE


@njit(cache=True)
def to_mask(act: Ints, k: int, mask: Bits) -> None:
    """Write the active set as bits."""
    for q in range(len(mask)):
        mask[q] = np.uint64(0)
    for a in range(k):
        mask[act[a] >> 6] |= np.uint64(1) << np.uint64(act[a] & 63)


@njit(cache=True)
def flip(mask: Bits, i: int) -> None:
    """Exchange the membership of row i."""
    mask[i >> 6] ^= np.uint64(1) << np.uint64(i & 63)


@njit(cache=True)
def from_mask(mask: Bits, act: Ints) -> int:
    """Write the members of a bit mask in increasing order. Returns their number."""
    k = 0
    for q in range(len(mask)):
        word = mask[q]
        for s in range(64):
            if word >> np.uint64(s) & np.uint64(1):
                act[k] = 64 * q + s
                k += 1
    return k


@njit(cache=True)
def find(masks: Bits, table: Ints, mask: Bits) -> np.int64:
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
def rehash(masks: Bits, table: Ints, count: int) -> None:
    """Fill an empty hash table with the masks known so far."""
    for index in range(count):
        table[find(masks, table, masks[index])] = index


@njit(cache=True)
def consider(qp: QPData, graph: Graph, mask: Bits) -> int:
    """Kind of an active set: looked up, or found out and, when FULL, queued."""
    slot = find(graph.masks, graph.table, mask)
    if graph.table[slot] >= 0:
        known: int = graph.kinds[graph.table[slot]]
        return known
    m = len(qp.D)
    n = qp.D.shape[1] - 1
    act = np.empty(m, np.int64)
    k = from_mask(mask, act)
    A = np.empty((m + len(qp.Tb), n))
    b = np.empty(m + len(qp.Tb))
    centre = np.empty(n)
    kind = region_rows(qp, act, k, A, b)
    if kind == FULL and interior_point(A, b, 0.0, centre) == 0.0:
        kind = FLAT
    index = graph.counts[KNOWN]
    graph.counts[KNOWN] += 1
    graph.table[slot] = index
    graph.kinds[index] = kind
    graph.masks[index] = mask
    if kind == FULL:
        graph.queue[graph.counts[QUEUED]] = index
        graph.counts[QUEUED] += 1
    return kind


@njit(cache=True)
def consider_parameter(qp: QPData, graph: Graph, theta: Array, mask: Bits) -> int:
    """Kind of the active set of the QP at θ, of several the one that counts; INFEASIBLE where there is none."""
    kind = INFEASIBLE
    act = np.empty(len(qp.D) + 1, np.int64)
    for shift in (0.0, TIE, 10.0 * TIE):
        k = optimal_set(qp, theta, shift, act)
        if k < 0:
            return kind
        to_mask(act, k, mask)
        kind = consider(qp, graph, mask)
        if kind == FULL:
            return kind
    return kind
