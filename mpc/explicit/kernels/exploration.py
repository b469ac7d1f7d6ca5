"""Compiled exploration of the graph of optimal active sets; imported only when an explicit law is computed.

Active sets are bit masks in a hash table; `region.py` says what a region is, `halfspace.py` finds its facets. A region
is queued once, when its active set is first considered.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from mpc.explicit.kernels.data import (
    BORDER,
    CROSSED,
    DEPENDENT,
    DONE,
    FLAT,
    FULL,
    INFEASIBLE,
    KNOWN,
    OPEN,
    QUEUED,
    ROWS,
    RegionData,
)
from mpc.explicit.kernels.halfspace import across, interior_point, irredundant, just_behind, margin_at, project
from mpc.explicit.kernels.region import gram_factor, gram_solve, optimal_at, optimal_set, region_rows
from mpc.tolerances import EXCHANGE, EXCLUDED, INSETS, PARALLEL, PROJECTION, SAME_PLANE, TIE

FINISHED, GROW, PAUSED = 0, 1, 2  # why the exploration returned
_MARGIN = 0.1  # distance from the other facets, scaled parameters, that a point behind a facet keeps where it can
_TWINS = 4  # rows on one hyperplane whose combinations are all tried
_ROOM = 20  # active sets that one facet may add, beside exchanges


@njit(cache=True)
def to_mask(act, k, mask):
    """Write the active set as bits."""
    for q in range(len(mask)):
        mask[q] = np.uint64(0)
    for a in range(k):
        mask[act[a] >> 6] |= np.uint64(1) << np.uint64(act[a] & 63)


@njit(cache=True)
def flip(mask, i):
    """Exchange the membership of row i."""
    mask[i >> 6] ^= np.uint64(1) << np.uint64(i & 63)


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
def rehash(masks, table, count):
    """Fill an empty hash table with the masks known so far."""
    for index in range(count):
        table[find(masks, table, masks[index])] = index


@njit(cache=True)
def consider(qp, graph, mask):
    """Kind of an active set: looked up, or found out and, when FULL, queued."""
    slot = find(graph.masks, graph.table, mask)
    if graph.table[slot] >= 0:
        return graph.kinds[graph.table[slot]]
    m = len(qp.D)
    n = qp.D.shape[1] - 1
    act = np.empty(m, np.int64)
    k = from_mask(mask, act)
    A = np.empty((m + len(qp.Tb), n))
    b = np.empty(m + len(qp.Tb))
    centre = np.empty(n)
    kind = region_rows(qp, act, k, graph.tied, A, b)
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
def consider_parameter(qp, graph, theta, mask):
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


@njit(cache=True)
def explore(qp, graph, facets, budget):
    """Process so many queued regions: store the facets of each, and queue the regions behind them.

    Returns FINISHED when none is left, PAUSED when the budget is spent, GROW when memory is.
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
    while counts[DONE] < counts[QUEUED]:
        if budget <= 0:
            return PAUSED
        budget -= 1
        mask[:] = graph.masks[graph.queue[counts[DONE]]]
        k = from_mask(mask, act)
        region_rows(qp, act, k, graph.tied, A, b)
        radius = interior_point(A, b, np.inf, centre)
        count = irredundant(A, b, centre, kept, hits)
        room = min(len(graph.masks), len(graph.table) // 2)
        if counts[ROWS] + m + len(qp.Tb) > len(facets.rows) or counts[KNOWN] + count * (k + _ROOM) > room:
            return GROW
        region = RegionData(mask, act[:k], A, b, kept[:count], hits, centre, radius)
        store(facets, counts, region)
        for number in range(count):
            if kept[number] < m:  # not the border of the parameter set
                facets.state[facets.offsets[counts[DONE] - 1] + number] = cross(qp, graph, region, number)
    return FINISHED


@njit(cache=True)
def store(facets, counts, region):
    """Append the facets and the centre of the next region done; there is room for them."""
    n = region.A.shape[1]
    for number, facet in enumerate(region.facets):
        for j in range(n):
            facets.rows[counts[ROWS], j] = region.A[facet, j]
            facets.hits[counts[ROWS], j] = region.hits[number, j]
        facets.rows[counts[ROWS], n] = region.b[facet]
        facets.state[counts[ROWS]] = BORDER
        counts[ROWS] += 1
    facets.offsets[counts[DONE] + 1] = counts[ROWS]
    for j in range(n):
        facets.centres[counts[DONE], j] = region.centre[j]
    counts[DONE] += 1


@njit(cache=True)
def cross(qp, graph, region, number):
    """Queue what lies behind one facet of a region; OPEN when that is not known afterwards.

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
        return CROSSED
    reached = just_behind(A, b, facets, len(facets), number, hits[number], behind_it)
    if not reached:
        reached = across(A, b, facets, len(facets), facet, hits[number], min(_MARGIN, radius), behind_it)
    if kind == DEPENDENT:
        kind = exchange(qp, graph, act, len(act), facet, mask, behind_it if reached else centre)
    if not reached:
        return OPEN
    if kind == INFEASIBLE:
        return BORDER
    return CROSSED if kind == FULL or consider_parameter(qp, graph, behind_it, work) == FULL else OPEN


@njit(cache=True)
def behind(qp, graph, A, b, mask, facet, work):
    """Consider the sets that differ in the rows on the hyperplane of a facet.

    Returns the kind of the set which differs in one row alone, the neighbour when it is FULL; FLAT where several rows
    lie on the hyperplane: some of their combinations lead to regions elsewhere.
    """
    m = len(qp.D)
    n = A.shape[1]
    twins = np.empty(_TWINS, np.int64)
    shared = 0
    for i in range(m):
        close = abs(b[i] - b[facet]) < SAME_PLANE
        for j in range(n):
            if not close:
                break
            close = abs(A[i, j] - A[facet, j]) < SAME_PLANE
        if close and shared < _TWINS:
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
def exchange(qp, graph, act, k, entering, mask, theta):
    """Consider sets in which the entering row replaces another; one with a positive coefficient has to leave.

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
        if coefficient[a] > EXCHANGE:
            swapped[:] = mask
            flip(swapped, entering)
            flip(swapped, act[a])
            found = consider(qp, graph, swapped) == FULL
            if found and kind != FULL and optimal_at(qp, members, from_mask(swapped, members), theta):
                kind = FULL
    return kind


@njit(cache=True)
def excluded(qp, act, k, entering, coefficient, theta):
    """Whether no v holds the entering row and the active ones at θ: Farkas multipliers, with room for their rounding.

    What is left of the entering row, times any v that is not EXCLUDED times larger than the bounds, does not count.
    """
    n = len(theta)
    left = qp.M[entering].copy()
    total = qp.D[entering, n]
    for j in range(n):
        total += qp.D[entering, j] * theta[j]
    size = 1.0 + abs(total)
    for a in range(k):
        if coefficient[a] > EXCHANGE:
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
    return total < -EXCLUDED * size * np.sqrt(length)


@njit(cache=True)
def seed(qp, graph, J, h, targets, found):
    """Queue the active sets at feasible parameters near the targets; J [t; v] <= h is the joint set with unit rows.

    Writes the parameters with an interior around them into `found`; returns their number.
    """
    mj, nj = J.shape
    n = targets.shape[1]
    joint = np.empty(nj)
    c = np.zeros(nj)
    work = np.empty(nj + 1, np.int64)
    lam = np.empty(nj + 1)
    shrunk = np.empty(mj)
    mask = np.empty(graph.masks.shape[1], np.uint64)
    hits = 0
    for t in range(len(targets)):
        c[:n] = targets[t]
        for inset in INSETS:
            for i in range(mj):
                shrunk[i] = h[i] - inset
            if project(J, shrunk, mj, c, 10.0 * PROJECTION, joint, work, lam) >= 0:
                found[hits] = joint[:n]
                consider_parameter(qp, graph, found[hits], mask)
                hits += 1
                break
        if hits == 0:
            break  # infeasible from one target is infeasible from all
    return hits


@njit(cache=True)
def look_at(qp, graph, targets):
    """Queue the active sets at the targets; which of these lie in the parameter set and are feasible."""
    mask = np.empty(graph.masks.shape[1], np.uint64)
    feasible = np.zeros(len(targets), np.bool_)
    for t in range(len(targets)):
        if margin_at(qp.TA, qp.Tb, targets[t]) >= 0.0:
            feasible[t] = consider_parameter(qp, graph, targets[t], mask) != INFEASIBLE
    return feasible


@njit(cache=True)
def behind_facets(facets, chosen, owners, directions, shares, steps):
    """Points behind facets: from the point hit, along the facet in a direction a share of the way, then a step out."""
    n = directions.shape[1]
    points = np.empty((len(chosen), n))
    step = np.empty(n)
    for p in range(len(chosen)):
        facet = chosen[p]
        along = 0.0
        for j in range(n):
            along += facets.rows[facet, j] * directions[p, j]
        length = 0.0
        for j in range(n):
            step[j] = directions[p, j] - along * facets.rows[facet, j]
            length += step[j] * step[j]
        across = 2.0 * np.sqrt(n / max(length, PARALLEL))  # of the parameter set
        first = -across
        last = across
        for i in range(facets.offsets[owners[p]], facets.offsets[owners[p] + 1]):
            slack = facets.rows[i, n]
            rate = 0.0
            for j in range(n):
                slack -= facets.rows[i, j] * facets.hits[facet, j]
                rate += facets.rows[i, j] * step[j]
            if i != facet and rate > PARALLEL:
                last = min(last, max(slack, 0.0) / rate)
            elif i != facet and rate < -PARALLEL:
                first = max(first, max(slack, 0.0) / rate)
        way = first + shares[p] * (last - first)
        for j in range(n):
            points[p, j] = facets.hits[facet, j] + way * step[j] + steps[p] * facets.rows[facet, j]
    return points


@njit(cache=True)
def covered(facets, counts, points, distance):
    """Which points lie in a region that is done, or not farther outside one than a distance."""
    n = points.shape[1]
    inside = np.zeros(len(points), np.bool_)
    for p in range(len(points)):
        for r in range(counts[DONE]):
            within = True
            for i in range(facets.offsets[r], facets.offsets[r + 1]):
                s = -facets.rows[i, n]
                for j in range(n):
                    s += facets.rows[i, j] * points[p, j]
                if s > distance:
                    within = False
                    break
            if within:
                inside[p] = True
                break
    return inside
