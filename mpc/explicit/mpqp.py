"""Solves a parametric QP for every parameter at once: a partition into polytopes with an affine law on each."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from mpc.checks import Array, as_halfspaces
from mpc.exceptions import InputError
from mpc.explicit.equality_elimination import eliminate, equality_pairs
from mpc.explicit.scaled_qp import LeastDistance, least_distance
from mpc.parametric_qp import ParametricQP

_CHUNK = 500  # regions between two looks at the clock
_SEEDS, _ROUNDS = 8, 10  # parameters from which the exploration starts, and how often new ones are drawn


class MPQPStatus(Enum):
    """How the exploration ended; the value is the advice."""

    COMPLETE = "Complete: every region behind every facet was explored."
    INFEASIBLE = "No parameter of the set is feasible, or only a flat part. Ask `LinearMPC.explain` what conflicts."
    REGION_LIMIT = "Stopped at `max_regions`: the partition has holes. Raise the limit, shorten N or block moves."
    TIME_LIMIT = "Stopped at `time_limit`: the partition has holes. Raise the limit, shorten N or block moves."

    @property
    def advice(self) -> str:
        """What to do about it."""
        return self.value


@dataclass(frozen=True, eq=False, repr=False)
class Partition:
    """Solution of a multiparametric QP.

    Attributes
    ----------
    problem : ParametricQP
        What was solved.
    status : MPQPStatus
        Whether the whole parameter set was explored.
    active_sets : tuple of tuple of int
        Rows of `problem.G` that are active in each region.
    H, h : (n_halfspaces, nt) and (n_halfspaces,) array
        Facets of all regions, Hθ <= h in the units of θ.
    offsets : (n_regions + 1,) int array
        Region r owns the rows offsets[r] : offsets[r + 1].
    law : (n_regions, nz, nt + 1) array
        Minimiser z = law[r] [θ; 1].
    centre, half : (nt,) arrays
        Scaling θ = centre + half * t that takes the parameter set into [-1, 1]; H * half has unit rows.
    solve_time : float
        Wall time [s].
    """

    problem: ParametricQP
    status: MPQPStatus
    active_sets: tuple[tuple[int, ...], ...]
    H: Array
    h: Array
    offsets: np.ndarray[Any, np.dtype[np.int64]]
    law: Array
    centre: Array
    half: Array
    solve_time: float

    @property
    def scaled_rows(self) -> Array:
        """Facets [H, h] in the scaled parameter t, unit normals: (n_halfspaces, nt + 1)."""
        return np.ascontiguousarray(np.hstack([self.H * self.half, (self.h - self.H @ self.centre)[:, None]]))

    def __len__(self) -> int:
        return len(self.active_sets)

    def __repr__(self) -> str:
        return f"Partition({len(self)} regions, {self.status.name}, {1e3 * self.solve_time:.1f} ms)"

    def multipliers(self, region: int) -> Array:
        """Multiplier law (m, nt + 1) of one region: λ = law [θ; 1], zero for inactive rows.

        Of two rows that make an equality the first carries the multiplier, of either sign.
        """
        problem, act = self.problem, list(self.active_sets[region])
        law = np.zeros((problem.m, problem.nt + 1))
        if act:
            G = problem.G[act]
            right = np.hstack([problem.S[act], problem.w[act, None]])
            right = right + G @ np.linalg.solve(problem.H, np.hstack([problem.F, problem.f[:, None]]))
            # least squares: rows of equalities may repeat each other
            law[act] = -np.linalg.lstsq(G @ np.linalg.solve(problem.H, G.T), right, rcond=1e-13)[0]
        return law


def solve_mpqp(
    problem: ParametricQP, theta_set: Any, *, compiled: bool = True, max_regions: int = 100_000,
    time_limit: float = np.inf,
) -> Partition:  # fmt: skip
    """Partition of `theta_set` into critical regions of the QP, each with its affine minimiser.

    Explores the graph whose nodes are optimal active sets and whose edges change one constraint, from facet to facet;
    where the rows of a neighbour are dependent one constraint is exchanged, where hyperplanes coincide every
    combination is tried, and where the algebra finds no neighbour the QP is solved just across the facet.

    Parameters
    ----------
    problem : ParametricQP
        Strictly convex; see `LinearMPC.build`.
    theta_set : Polytope
        Bounded set of parameters of full dimension, in the order of `problem.parameters`.
    compiled : bool
        False runs a slow, independent implementation in NumPy, for checking.
    max_regions : int
        Limit on the number of regions.
    time_limit : float
        Limit on the wall time [s].

    Returns
    -------
    Partition
        Its status says whether it is complete.

    Raises
    ------
    InputError
        `theta_set` has the wrong dimension, is empty, flat or unbounded.

    References
    ----------
    Arnström and Axehill, *A high-performant multi-parametric quadratic programming solver*, IEEE CDC 2024 (connected
    graph of optimal active sets); Tøndel, Johansen and Bemporad, Automatica 39(3), 2003 (neighbours across a facet).
    Facets are found by Clarkson's redundancy removal. Assumes H positive definite.
    """
    start = time.perf_counter()
    TA, Tb = as_halfspaces("theta_set", theta_set, problem.nt)
    if not max_regions >= 1 or not time_limit > 0:
        raise InputError(f"max_regions and time_limit must be positive, got {max_regions} and {time_limit}.")
    pairs = equality_pairs(problem)
    if pairs:
        return _with_equalities(problem, pairs, theta_set, compiled, max_regions, time_limit, start)
    data = least_distance(problem, TA, Tb)
    if compiled:
        found = _explore(data, max_regions, start + time_limit)
    else:
        from mpc.explicit.reference import explore_all

        found = explore_all(data, max_regions, start + time_limit)
    status, active_sets, rows, offsets = found
    H, h = data.unscale_rows(rows)
    law = data.law(active_sets)
    originals = tuple(tuple(int(i) for i in data.origin[list(act)]) for act in active_sets)
    return Partition(
        problem, status, originals, H, h, offsets, law, data.centre, data.half, time.perf_counter() - start
    )


def _with_equalities(
    problem: ParametricQP, pairs: list[tuple[int, int]], theta_set: Any, compiled: bool, max_regions: int,
    time_limit: float, start: float,
) -> Partition:  # fmt: skip
    """Solve in the directions the equalities leave free; one row of each pair is active everywhere."""
    reduced, N, T, origin = eliminate(problem, pairs)
    found = solve_mpqp(reduced, theta_set, compiled=compiled, max_regions=max_regions, time_limit=time_limit)
    always = tuple(i for i, _ in pairs)
    active = tuple(tuple(sorted((*always, *(int(i) for i in origin[list(act)])))) for act in found.active_sets)
    law = N @ found.law + T
    return replace(found, problem=problem, active_sets=active, law=law, solve_time=time.perf_counter() - start)


Found = tuple[MPQPStatus, list[tuple[int, ...]], Array, np.ndarray[Any, np.dtype[np.int64]]]


def _explore(data: LeastDistance, max_regions: int, deadline: float) -> Found:
    from mpc.explicit.kernels import exploration as kernels

    m, n = data.D.shape[0], data.D.shape[1] - 1
    capacity = 1024
    masks = np.zeros((capacity, max(1, (m + 63) // 64)), dtype=np.uint64)
    kinds, queue = np.zeros(capacity, dtype=np.int8), np.zeros(capacity, dtype=np.int64)
    table = np.full(4 * capacity, -1, dtype=np.int64)
    offsets, rows = np.zeros(capacity + 1, dtype=np.int64), np.empty((16 * capacity, n + 1))
    counts = np.zeros(4, dtype=np.int64)
    fixed = (data.gram, data.M, data.D, data.TA, data.Tb)
    rng = np.random.default_rng(0)
    for _ in range(_ROUNDS):  # more only where every parameter found lies on the border of regions
        targets = rng.uniform(-1, 1, size=(_SEEDS, n))
        hits = kernels.seed(data.J, data.Jb, data.gram, *fixed[1:], targets, masks, kinds, table, queue, counts)
        if counts[1] or not hits:
            break
    status = MPQPStatus.COMPLETE if counts[1] else MPQPStatus.INFEASIBLE
    while counts[2] < counts[1]:
        budget = min(_CHUNK, max_regions - int(counts[2]))
        code = kernels.explore(*fixed, masks, kinds, table, queue, counts, offsets, rows, budget)
        if code == kernels.GROW:
            masks, kinds, queue, offsets, rows = (_doubled(a) for a in (masks, kinds, queue, offsets, rows))
            table = np.full(4 * len(masks), -1, dtype=np.int64)
            kernels.rehash(masks, table, counts[0])
        if counts[2] < counts[1] and counts[2] >= max_regions:
            status = MPQPStatus.REGION_LIMIT
            break
        if counts[2] < counts[1] and time.perf_counter() > deadline:
            status = MPQPStatus.TIME_LIMIT
            break
    done = int(counts[2])
    return status, _members(masks[queue[:done]], m), rows[: counts[3]].copy(), offsets[: done + 1].copy()


def _doubled(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.concatenate([array, np.zeros_like(array)])


def _members(masks: np.ndarray[Any, np.dtype[np.uint64]], m: int) -> list[tuple[int, ...]]:
    """Active sets as tuples, from bit masks."""
    bits = np.unpackbits(np.ascontiguousarray(masks).view(np.uint8), axis=1, bitorder="little")[:, :m]
    return [tuple(int(i) for i in np.flatnonzero(row)) for row in bits]
