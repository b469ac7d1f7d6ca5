"""Inner sets from points found one by one on whole trajectories."""

from __future__ import annotations

import numpy as np

from invariant_sets.exceptions import NumericalError
from invariant_sets.linear_programs import minimise
from invariant_sets.polytope import Polytope
from invariant_sets.projection import unit
from invariant_sets.system_checks import LinearSystem
from invariant_sets.time_limits import Deadline

Array = np.ndarray


def state_maps(system: LinearSystem, steps: int) -> tuple[list[Array], list[Array]]:
    """Matrices M and c of the states M (x, u₀, …) + c of trajectories under the mean disturbance."""
    n, nu = system.B.shape
    mean = np.zeros(n) if system.disturbances is None else system.disturbances.mean(axis=0)
    moves = [np.hstack([np.eye(n), np.zeros((n, steps * nu))])]
    drift = [np.zeros(n)]
    for step in range(steps):
        M = system.A @ moves[-1]
        M[:, n + step * nu : n + (step + 1) * nu] = system.B
        moves.append(M)
        drift.append(system.A @ drift[-1] + mean)
    return moves, drift


def inner_hull(
    deadline: Deadline,
    *,
    system: LinearSystem,
    sets: tuple[Polytope, Polytope, Polytope],
    U: Polytope,
    steps: int,
    at: int,
) -> Polytope | None:
    """Hull of extreme states x₀ or x_N of trajectories, or None.

    None, too, where the linear program over all steps would be too large.

    One linear program a point, in the coordinates of the bodies of x₀ and U. Every point belongs to a trajectory that
    respects all sets, so their hull is inside the set of all such states.

    Parameters
    ----------
    deadline : Deadline
        No point is sought after it.
    system : LinearSystem
        Dynamics; of the disturbances the mean acts.
    sets : three Polytopes
        Sets of x₀, of x₁, …, x_{N−1}, and of x_N.
    U : Polytope
        Input set.
    steps, at : int
        N, at least one, and 0 or N, the time of the states.
    """
    from scipy.linalg import block_diag

    start, between, last = sets
    rows_a_step = len(U.b) + len(between.b) + 2 * len(between.b_eq)
    if steps * rows_a_step * (start.dim + steps * U.dim) > 2_000_000:  # more than a second
        return None
    states = (start, *[between] * (steps - 1), last)
    first = start.body
    inputs = U.body
    if first is None or inputs is None:
        return None
    moves, drift = state_maps(system, steps)
    basis = block_diag(first.basis, *[inputs.basis] * steps)
    centre = np.concatenate([first.centre, np.tile(inputs.centre, steps)])
    maps = [M @ basis for M in moves]
    offsets = [M @ centre + c for M, c in zip(moves, drift)]
    rows = [np.hstack([np.zeros((steps * len(inputs.g), first.basis.shape[1])), np.kron(np.eye(steps), inputs.F)])]
    right = [np.tile(inputs.g, steps)]
    for S, M, c in zip(states, maps, offsets):
        F, g = S.one_sided
        rows.append(F @ M)
        right.append(g - F @ c)
    R = np.vstack(rows)
    r = np.concatenate(right)
    used = np.linalg.norm(R, axis=1) > 0.0
    points = _extreme_points(maps[at], offsets[at], unit(R[used], r[used]), deadline)
    return Polytope.from_vertices(np.array(points)) if points else None


def _extreme_points(M: Array, c: Array, rows: tuple[Array, Array], deadline: Deadline) -> list[Array]:
    """Extreme states M z + c, along axes and random directions."""
    n = len(c)
    rng = np.random.default_rng(0)
    directions = np.vstack([np.eye(n), -np.eye(n), rng.standard_normal((200, n))])
    points: list[Array] = []
    for d in directions / np.maximum(np.abs(M).sum(axis=1), np.finfo(float).tiny):
        if deadline.passed:
            break
        cost = d @ M
        size = float(np.linalg.norm(cost))
        try:
            z = minimise(-cost / size, *rows)[1] if size > 0.0 else None
        except NumericalError:
            continue
        if z is not None:
            points.append(M @ z + c)
    return points
