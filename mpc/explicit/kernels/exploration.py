"""Compiled exploration of the graph of optimal active sets; imported only when an explicit law is computed.

It walks from facet to facet: `active_sets.py` keeps what is met, `region.py` says what a region is and `halfspace.py`
finds its facets.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from mpc.budgets import CLEARANCE
from mpc.checks import Array
from mpc.explicit.kernels.active_sets import consider, consider_parameter, flip, from_mask
from mpc.explicit.kernels.data import (
    DEPENDENT,
    DONE,
    FLAT,
    FULL,
    INFEASIBLE,
    KNOWN,
    QUEUED,
    ROWS,
    Bits,
    Facets,
    Graph,
    Ints,
    QPData,
    RegionData,
)
from mpc.explicit.kernels.halfspace import across, gram_solve, interior_point, irredundant, just_behind
from mpc.explicit.kernels.region import gram_factor, optimal_at, region_rows
from mpc.tolerances import EXCLUDED, INSIDE, PRIMAL


@njit(cache=True)
def explore(qp: QPData, graph: Graph, facets: Facets, budget: int) -> bool:
    """Process so many queued regions: store the facets of each, and queue the regions behind them.

    Returns whether memory has to grow first.
    """
    m = len(qp.D)
    n = qp.D.shape[1] - 1
    counts = graph.counts
    A = np.empty((m + len(qp.Tb), n))
    b = np.empty(m + len(qp.Tb))
    centre = np.empty(n)
    kept = np.empty(m + len(qp.Tb), np.int64)
    hits = np.empty((m + len(qp.Tb), n))
    act = np.empty(m + 1, np.int64)
    mask = np.empty(graph.masks.shape[1], np.uint64)
    while counts[DONE] < counts[QUEUED] and budget > 0:
        budget -= 1
        mask[:] = graph.masks[graph.queue[counts[DONE]]]
        k = from_mask(mask, act)
        region_rows(qp, act, k, A, b)
        radius = interior_point(A, b, np.inf, centre)
        count = irredundant(A, b, centre, kept, hits)
        room = min(len(graph.masks), len(graph.table) // 2)
        # one facet may add 20 active sets beside exchanges
        if counts[ROWS] + m + len(qp.Tb) > len(facets.rows) or counts[KNOWN] + count * (k + 20) > room:
            return True
        region = RegionData(mask, act[:k], A, b, kept[:count], hits, centre, radius)
        store(facets, counts, region)
        for number in range(count):
            if kept[number] < m:  # not the border of the parameter set
                facets.behind[facets.offsets[counts[DONE] - 1] + number] = cross(qp, graph, region, number)
    return False


@njit(cache=True)
def store(facets: Facets, counts: Ints, region: RegionData) -> None:
    """Append the facets and the centre of the next region done. There is room for them."""
    n = region.A.shape[1]
    for number, facet in enumerate(region.facets):
        facets.rows[counts[ROWS], :n] = region.A[facet]
        facets.rows[counts[ROWS], n] = region.b[facet]
        facets.hits[counts[ROWS]] = region.hits[number]
        facets.behind[counts[ROWS]] = INFEASIBLE
        counts[ROWS] += 1
    facets.offsets[counts[DONE] + 1] = counts[ROWS]
    facets.centres[counts[DONE]] = region.centre
    counts[DONE] += 1


@njit(cache=True)
def cross(qp: QPData, graph: Graph, region: RegionData, number: int) -> int:
    """Queue what lies behind one facet of a region. Returns what is known of it; FLAT when it led nowhere.

    A neighbour that differs in the row of the facet alone is found by algebra. Otherwise a point just behind the facet
    is asked: which of the sets with one row exchanged is optimal there, or else which set the QP finds there. Where the
    facet is too small for such a point, all exchanges are considered and that is all.
    """
    mask, act, A, b, facets, hits, centre, radius = region
    facet = facets[number]
    behind_it = np.empty(A.shape[1])
    work = np.empty(len(mask), np.uint64)
    kind = behind(qp, graph, A, b, mask, facet, work)
    if kind == FULL:
        return FULL
    reached = just_behind(A, b, facets, len(facets), number, hits[number], behind_it)
    if not reached:
        reached = across(A, b, facets, len(facets), facet, hits[number], min(CLEARANCE, radius), behind_it)
    if kind == DEPENDENT:
        kind = exchange(qp, graph, act, len(act), facet, mask, behind_it if reached else centre)
    if not reached:
        return FLAT
    if kind in (FULL, INFEASIBLE):
        return kind
    return FULL if consider_parameter(qp, graph, behind_it, work) == FULL else FLAT


@njit(cache=True)
def behind(qp: QPData, graph: Graph, A: Array, b: Array, mask: Bits, facet: int, work: Bits) -> int:
    """Consider the sets that differ in the rows on the hyperplane of a facet.

    Returns the kind of the set which differs in one row alone, the neighbour when it is FULL; FLAT where several rows
    lie on the hyperplane: some of their combinations lead to regions elsewhere.
    """
    m = len(qp.D)
    n = A.shape[1]
    twins = np.empty(4, np.int64)  # rows on one hyperplane whose combinations are all tried
    shared = 0
    for i in range(m):
        close = abs(b[i] - b[facet]) < INSIDE
        for j in range(n):
            if not close:
                break
            close = abs(A[i, j] - A[facet, j]) < INSIDE
        if close and shared < len(twins):
            twins[shared] = i
            shared += 1
    kind = FLAT
    for combination in range(1, 1 << shared):
        work[:] = mask
        for s in range(shared):
            if combination >> s & 1:
                flip(work, twins[s])
        kind = consider(qp, graph, work)
    return kind if shared == 1 else FLAT


@njit(cache=True)
def exchange(qp: QPData, graph: Graph, act: Ints, k: int, entering: int, mask: Bits, theta: Array) -> int:
    """Consider sets in which the entering row replaces another. One with a positive coefficient has to leave.

    Returns FULL when one of them that has a region is optimal at θ, a point behind the facet, INFEASIBLE when θ is,
    because none can leave, and FLAT otherwise; of any other point the answer means nothing.
    """
    L = np.empty((k, k))
    coefficient = np.empty(k)
    gram_factor(qp.gram, act, k, L)
    for a in range(k):
        coefficient[a] = qp.gram[act[a], entering]
    gram_solve(L, k, coefficient)
    swapped = np.empty(len(mask), np.uint64)
    members = np.empty(len(qp.D), np.int64)
    if excluded(qp, act, k, entering, coefficient, theta):
        return INFEASIBLE
    kind = FLAT
    for a in range(k):
        if coefficient[a] > PRIMAL:
            swapped[:] = mask
            flip(swapped, entering)
            flip(swapped, act[a])
            found = consider(qp, graph, swapped) == FULL
            if found and kind != FULL and optimal_at(qp, members, from_mask(swapped, members), theta):
                kind = FULL
    return kind


@njit(cache=True)
def excluded(qp: QPData, act: Ints, k: int, entering: int, coefficient: Array, theta: Array) -> bool:
    """Whether no v holds the entering row and the active ones at θ: Farkas multipliers, with room for their rounding.

    What is left of the entering row, times any v that is not EXCLUDED times larger than the bounds, does not count.
    """
    n = len(theta)
    left = qp.M[entering].copy()
    total: float = qp.D[entering, n]
    for j in range(n):
        total += qp.D[entering, j] * theta[j]
    size = 1.0 + abs(total)
    for a in range(k):
        if coefficient[a] > PRIMAL:
            return False
        share = min(coefficient[a], 0.0)
        bound = qp.D[act[a], n]
        for j in range(n):
            bound += qp.D[act[a], j] * theta[j]
        total -= share * bound
        size = max(size, abs(bound))
        for j in range(len(left)):
            left[j] -= share * qp.M[act[a], j]
    length = 0.0
    for j in range(len(left)):
        length += left[j] * left[j]
    least: float = -EXCLUDED * size * np.sqrt(length)
    return total < least
