"""Multiparametric quadratic programming."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from mpc.budgets import LAWS_AT_ONCE
from mpc.checks import Array, Flags, as_count, as_seconds
from mpc.exceptions import InputError
from mpc.explicit.equality_elimination import FlatParameters, ImpliedEqualities, eliminate, implied_equalities
from mpc.explicit.exploration import explore_compiled
from mpc.explicit.partition import MPQPStatus, Partition
from mpc.explicit.region_graph import Found
from mpc.explicit.scaled_qp import ParameterSet, ScaledQP, scale_parameters, scale_qp, twins, without_far_bounds
from mpc.parametric_qp import Constraint, ParametricQP
from mpc.tolerances import FAR_OPTIMUM, INSIDE, KKT, PRIMAL, REFINED_ROW, ROUNDED_SUM, THIN

ActiveSets = list[tuple[int, ...]]


def solve_mpqp(
    problem: ParametricQP, theta_set: Any, *, max_regions: int = 100_000, time_limit: float | None = None
) -> Partition:  # fmt: skip
    """Partition of `theta_set` into critical regions with affine minimisers.

    Explores the graph whose nodes are optimal active sets and whose edges change one constraint, from facet to facet;
    where the rows of a neighbour are dependent one constraint is exchanged, where hyperplanes coincide every
    combination is tried, and where the algebra finds no neighbour the QP is solved just across the facet. Facets that
    still led nowhere, of very many some drawn at random, are looked across by the checked online solver. At the end
    points between and behind facets, near the border and anywhere are looked up, and where they lie in no region the QP
    is solved. An active set not met before is explored too. Rows that the others imply are left out first; where
    several active sets are optimal on one region, a symbolic perturbation decides: regions do not overlap.

    Parameters
    ----------
    problem : ParametricQP
        Strictly convex; see `LinearMPC.build`.
    theta_set : Polytope
        Bounded set of parameters of full dimension, in the order of `problem.parameters`.
    max_regions : int
        Limit on the number of regions.
    time_limit : float
        Limit on the wall time [s]; none if left out. The first call after an installation compiles before it counts,
        and the laws found are checked after it, which takes a tenth as long at most.

    Returns
    -------
    Partition
        Its status says whether it is complete. Regions in which the law fails its check are left out: INACCURATE,
        as where a feasible parameter was met that lies in no region (`uncovered` counts them), or where rounding
        decides whether there is a feasible one, or which of two rows is in front of the other.

    Raises
    ------
    InputError
        `theta_set` has the wrong dimension, is empty, flat or unbounded; the data are not finite; equalities leave no
        input free, or can be met at a flat set of parameters only.
    NotConvexError
        The Hessian is not positive definite.

    References
    ----------
    Arnström and Axehill, *A high-performant multi-parametric quadratic programming solver*, IEEE CDC 2024 (connected
    graph of optimal active sets); Tøndel, Johansen and Bemporad, Automatica 39(3), 2003 (neighbours across a facet).
    Facets are found by Clarkson's redundancy removal. Assumes H positive definite.
    """
    if not isinstance(problem, ParametricQP):
        raise InputError("problem", type(problem).__name__, "a ParametricQP", "See `LinearMPC.build`.")
    compile_exploration()
    return partitioned(explore_compiled, problem, theta_set, max_regions, time_limit)


def partitioned(
    explore: Callable[..., Found], problem: ParametricQP, theta_set: Any, max_regions: int, time_limit: float | None
) -> Partition:
    """Partition by an exploration of active sets."""
    start = time.perf_counter()
    most, deadline = as_count("max_regions", max_regions), start + as_seconds("time_limit", time_limit)
    domain = scale_parameters(theta_set, problem.nt)
    nearer = without_far_bounds(problem, domain)
    if nearer is not problem:
        answer = partitioned(explore, nearer, theta_set, max_regions, time_limit)
        if answer.status is MPQPStatus.COMPLETE and _satisfies(answer, problem):
            return replace(answer, problem=problem)
    qp = scale_qp(problem, domain)
    always = twins(qp.M, qp.own, qp.gram, -1.0, PRIMAL)[0].tolist()
    equalities = qp.origin[always].tolist()
    if always:
        qp = eliminate(qp, always, problem.labels)
    found = explore(qp, most, deadline)
    if found.status is MPQPStatus.INFEASIBLE:
        implied = implied_equalities(qp, deadline)
        reduced = _without(implied, qp, problem)
        if reduced is not None:
            equalities += qp.origin[implied.rows].tolist()
            qp = reduced
            found = explore(qp, most, deadline, implied.parameters)
            if not implied.exact and found.status is MPQPStatus.COMPLETE:
                found = found._replace(status=MPQPStatus.INACCURATE)
        elif implied.status is not MPQPStatus.COMPLETE:
            found = found._replace(status=implied.status)
    found, law = _without_wrong_laws(qp, found)
    hidden = qp.far > FAR_OPTIMUM or _thinnest(qp) < 2 * INSIDE
    if hidden and found.status is MPQPStatus.COMPLETE:
        found = found._replace(status=MPQPStatus.INACCURATE)
    H, h = qp.unscale_rows(found.rows)
    origin = qp.origin.tolist()
    sets = tuple(tuple(sorted((*equalities, *(origin[i] for i in act)))) for act in found.active_sets)
    duration = time.perf_counter() - start
    return Partition(
        problem, found.status, sets, H, h, found.offsets, in_units(qp, law), qp.centre, qp.half, duration,
        found.uncovered,
    )  # fmt: skip


def _satisfies(answer: Partition, problem: ParametricQP) -> bool:
    """Whether every law keeps the omitted rows on the parameter box."""
    left = np.isinf(answer.problem.w)
    gain = problem.S[left] - problem.G[left] @ answer.law[:, :, :-1]
    room = problem.w[left] - answer.law[:, :, -1] @ problem.G[left].T
    return bool((room + gain @ answer.centre >= np.abs(gain) @ answer.half).all())


def _thinnest(qp: ScaledQP) -> float:
    """Least parameter distance between opposite bounds; inf without any."""
    first, second = np.nonzero(qp.gram < PRIMAL - 1)
    slope = np.linalg.norm(qp.D[first, :-1], axis=1)
    apart = qp.D[first] + qp.D[second]
    room = apart[:, -1] + np.abs(apart[:, :-1]).sum(axis=1)
    return float((room[slope > 0] / slope[slope > 0]).min(initial=np.inf))


def _without_wrong_laws(qp: ScaledQP, found: Found) -> tuple[Found, Array]:
    """Regions whose law holds, and their laws; INACCURATE where one fails.

    A region thinner than the distance at which facets are looked across leaves no hole that would be found.
    """
    position = np.searchsorted(qp.origin, found.qp.origin).tolist()
    sets = [tuple(position[i] for i in act) for act in found.active_sets]
    law, holds = checked_laws(qp, sets, found.centres)
    if holds.all():
        return found._replace(active_sets=sets), law
    sizes = np.diff(found.offsets)
    right = np.flatnonzero(holds)
    missed = any(not _is_thin(found, int(r)) for r in np.flatnonzero(~holds))
    status = MPQPStatus.INACCURATE if missed and found.status is MPQPStatus.COMPLETE else found.status
    kept = Found(
        status, qp, [sets[r] for r in right], found.rows[np.repeat(holds, sizes)],
        np.concatenate([[0], np.cumsum(sizes[right])]), found.centres[right],
        found.uncovered,
    )  # fmt: skip
    return kept, law[right]


def _is_thin(found: Found, r: int) -> bool:
    """Whether a region is thinner than THIN; False for outside centres."""
    rows = found.rows[found.offsets[r] : found.offsets[r + 1]]
    return bool(0.0 <= (rows[:, -1] - rows[:, :-1] @ found.centres[r]).min() < THIN)


def _without(implied: ImpliedEqualities, qp: ScaledQP, problem: ParametricQP) -> ScaledQP | None:
    """Problem with these equalities eliminated; None where that is impossible."""
    if implied.status is not MPQPStatus.COMPLETE or implied.of_parameters:
        return None
    if not len(implied.rows):
        return qp
    try:
        return eliminate(qp, list(implied.rows), problem.labels)
    except FlatParameters:
        return None


def checked_laws(qp: ScaledQP, active_sets: ActiveSets, centres: Array) -> tuple[Array, Flags]:
    """Law v = law[r] [t; 1] of each active set, and whether it holds at the region's centre.

    A law holds where its active rows hold with equality, no row is violated and no multiplier negative, to `KKT`
    in units of the bounds and of the variables.
    """
    law = np.zeros((len(active_sets), qp.M.shape[1], qp.D.shape[1]))
    accepted = max(KKT / max(1.0, qp.far), ROUNDED_SUM)  # in units of how far the optimum is
    holds = np.ones(len(active_sets), dtype=bool)
    where = np.hstack([centres, np.ones((len(centres), 1))])
    sizes = -(-np.array([len(act) for act in active_sets]) // 4)  # in fours: those of similar size together
    for size in {*sizes.tolist()} - {0}:
        which = np.flatnonzero(sizes == size)
        rows, right, gram = _padded(qp, [active_sets[r] for r in which])
        law[which], missed, pull = _law(rows, right, gram)
        force = (pull @ where[which, :, None])[:, :, 0]  # minus the multipliers
        holds[which] = missed <= accepted
        holds[which] &= force.max(axis=1) <= KKT * np.maximum(1.0, np.abs(force).max(axis=1))
    return law, holds & (_violation(qp, law, where) <= accepted)


def _padded(qp: ScaledQP, active_sets: ActiveSets) -> tuple[Array, Array, Array]:
    """Padded rows of M and D and Gram matrices of active sets."""
    width = max(len(act) for act in active_sets)
    act = np.array([act + (-1,) * (width - len(act)) for act in active_sets])
    rows = qp.M[act]
    right = qp.D[act]
    gram = qp.gram[act[:, :, None], act[:, None, :]]
    none = act < 0
    if none.any():
        rows[none] = 0.0
        right[none] = 0.0
        gram[none[:, :, None] | none[:, None, :]] = 0.0
        gram[:, np.arange(width), np.arange(width)] += none
    return rows, right, gram


def _law(rows: Array, right: Array, gram: Array) -> tuple[Array, Array, Array]:
    """Least-norm solution v of rows v = right [t; 1], error and weights."""
    inverse = np.linalg.inv(gram)
    across = rows.transpose(0, 2, 1)
    pull = inverse @ right
    law = across @ pull
    law += across @ (inverse @ (right - rows @ law))  # the rounding of a nearly singular gram is taken out
    for k in np.flatnonzero(np.abs(inverse).max(axis=(1, 2)) * REFINED_ROW > 1.0):
        law[k], pull[k] = _law_by_directions(rows[k], right[k])
    size = 1.0 + np.abs(right).sum(axis=2) + np.linalg.norm(law, axis=1).sum(axis=1)[:, None]
    missed = (np.abs(rows @ law - right).sum(axis=2) / size).max(axis=1)
    return law, missed, pull


def _law_by_directions(rows: Array, right: Array) -> tuple[Array, Array]:
    """Law of one active set by a QR factorisation."""
    real = rows.any(axis=1)
    Q, R = np.linalg.qr(rows[real].T)
    along = solve_triangular(R, right[real], trans="T")
    pull = np.zeros_like(right)
    pull[real] = solve_triangular(R, along)
    return Q @ along, pull


def _violation(qp: ScaledQP, law: Array, where: Array) -> Array:
    """Largest relative violation of each law at its point."""
    parts = [np.zeros(0)]
    for first in range(0, len(law) if len(qp.M) else 0, LAWS_AT_ONCE):
        part = where[first : first + LAWS_AT_ONCE]
        v = np.einsum("rvc,rc->rv", law[first : first + LAWS_AT_ONCE], part)
        bounds = part @ qp.D.T
        size = 1.0 + np.abs(bounds) + np.linalg.norm(v, axis=1)[:, None]
        parts.append(((v @ qp.M.T - bounds) / size).max(axis=1))
    return np.concatenate(parts) if len(qp.M) else np.zeros(len(law))


def in_units(qp: ScaledQP, law: Array) -> Array:
    """Laws of v in scaled parameters as z = law [θ; 1] in units."""
    law = qp.free + qp.back @ law
    law[:, :, :-1] /= qp.half
    law[:, :, -1] -= law[:, :, :-1] @ qp.centre
    return law


@cache
def compile_exploration() -> None:
    """Compile every kernel by exploring a problem with nine regions.

    numba keeps what it has compiled on disk; a later process reads it in a second.
    """
    one, none = np.eye(2), np.zeros((2, 2))
    rows = np.vstack([one, -one])
    square = ParametricQP(
        H=one, F=-one, f=np.zeros(2), Y=none, y=np.zeros(2), c=0.0, G=rows, w=np.ones(4), S=np.zeros((4, 2)), Lz=one,
        Lt=none, l=np.zeros(2), Xz=none, Xt=one, x=np.zeros(2), nu=2, parameters=(("x", 2),),
        labels=tuple(Constraint("input", 0, i) for i in range(4)),
    )  # fmt: skip
    twice = ParameterSet(rows, np.ones(4), np.zeros(2), np.full(2, 2.0))
    explore_compiled(scale_qp(square, twice), 100, np.inf)
