"""Compiled places in the parameter set: where an exploration starts, and where it looks for holes."""

from __future__ import annotations

import numpy as np
from numba import njit

from mpc.budgets import INSETS
from mpc.checks import Array
from mpc.explicit.kernels.active_sets import consider_parameter
from mpc.explicit.kernels.data import DONE, INFEASIBLE, Facets, Flags, Graph, Ints, QPData
from mpc.explicit.kernels.halfspace import margin_at, project, violation
from mpc.tolerances import ROUNDED_SUM


@njit(cache=True)
def seed(qp: QPData, graph: Graph, J: Array, h: Array, targets: Array, found: Array) -> int:
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
            if project(J, shrunk, mj, c, 10.0 * ROUNDED_SUM, joint, work, lam) >= 0:
                found[hits] = joint[:n]
                consider_parameter(qp, graph, found[hits], mask)
                hits += 1
                break
        if hits == 0:
            break  # infeasible from one target is infeasible from all
    return hits


@njit(cache=True)
def look_at(qp: QPData, graph: Graph, targets: Array) -> Flags:
    """Queue the active sets at the targets. Return which targets lie in the parameter set and are feasible."""
    mask = np.empty(graph.masks.shape[1], np.uint64)
    feasible = np.zeros(len(targets), np.bool_)
    for t in range(len(targets)):
        if margin_at(qp.TA, qp.Tb, targets[t]) >= 0.0:
            feasible[t] = consider_parameter(qp, graph, targets[t], mask) != INFEASIBLE
    return feasible


@njit(cache=True)
def behind_facets(facets: Facets, chosen: Ints, owners: Ints, draws: Array, nearest: float, farthest: float,
                  points: Array) -> None:  # fmt: skip
    """Points behind the chosen facets of their owners, half of them at the nearest distance, others up to the farthest.

    Each draw in [0, 1) holds a direction along the facet from the point hit, a share of the way to its end, and a
    distance.
    """
    n = points.shape[1]
    direction = np.empty(n)
    decades = np.log(farthest / nearest)
    for p in range(len(points)):
        facet = chosen[p % len(chosen)]
        owner = owners[p % len(chosen)]
        along = 0.0
        for j in range(n):
            direction[j] = 2.0 * draws[p, j] - 1.0
            along += facets.rows[facet, j] * direction[j]
        length = 0.0
        for j in range(n):
            direction[j] -= along * facets.rows[facet, j]
            length += direction[j] * direction[j]
        across = 2.0 * np.sqrt(n / max(length, ROUNDED_SUM))  # of the parameter set
        first = -across
        last = across
        for i in range(facets.offsets[owner], facets.offsets[owner + 1]):
            slack = facets.rows[i, n]
            rate = 0.0
            for j in range(n):
                slack -= facets.rows[i, j] * facets.hits[facet, j]
                rate += facets.rows[i, j] * direction[j]
            if i != facet and rate > ROUNDED_SUM:
                last = min(last, max(slack, 0.0) / rate)
            elif i != facet and rate < -ROUNDED_SUM:
                first = max(first, max(slack, 0.0) / rate)
        way = first + draws[p, n] * (last - first)
        step = nearest
        if draws[p, n + 1] > 0.5:
            step *= np.exp(decades * (2.0 * draws[p, n + 1] - 1.0))
        for j in range(n):
            points[p, j] = facets.hits[facet, j] + way * direction[j] + step * facets.rows[facet, j]


@njit(cache=True)
def covered(facets: Facets, counts: Ints, points: Array, distance: float) -> Flags:
    """Points that lie in a region that is done, or not farther outside one than a distance (bool)."""
    inside = np.zeros(len(points), np.bool_)
    for p in range(len(points)):
        for r in range(counts[DONE]):
            if violation(facets.rows, facets.offsets[r], facets.offsets[r + 1], points[p], distance) <= distance:
                inside[p] = True
                break
    return inside
