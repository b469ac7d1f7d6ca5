"""Inner sets from points found one by one on whole trajectories."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from invariant_sets.exceptions import NumericalError
from invariant_sets.linear_programs import minimise
from invariant_sets.polytope import Polytope
from invariant_sets.projection import unit
from invariant_sets.time_limits import Deadline
from invariant_sets.tolerances import TINY

Array = np.ndarray


@dataclass(frozen=True)
class Trajectories:
    """All x₀, …, x_N of x⁺ = A x + B u within state and input sets.

    Attributes
    ----------
    A, B : arrays
        Dynamics.
    first, between, last : Polytope
        Sets of x₀, of x₁, …, x_{N−1}, and of x_N.
    U : Polytope
        Input set.
    steps : int
        N, at least one.
    """

    A: Array
    B: Array
    first: Polytope
    between: Polytope
    last: Polytope
    U: Polytope
    steps: int


def inner_hull(trajectories: Trajectories, at: int, deadline: Deadline) -> Polytope | None:
    """Hull of extreme states at time `at` (0 or N), or None.

    None, too, where the linear program over all steps would be too large.

    One linear program a point, in the coordinates of the bodies of x₀ and U. Every point belongs to a trajectory that
    respects all sets, so their hull is inside the set of all such states.
    """
    steps = trajectories.steps
    rows_a_step = len(trajectories.U.b) + len(trajectories.between.b) + 2 * len(trajectories.between.b_eq)
    if steps * rows_a_step * (trajectories.first.dim + steps * trajectories.U.dim) > 2_000_000:  # more than a second
        return None
    states = (trajectories.first, *[trajectories.between] * (steps - 1), trajectories.last)
    first = trajectories.first.body
    inputs = trajectories.U.body
    if first is None or inputs is None:
        return None
    n = len(first.centre)
    k = first.basis.shape[1]
    q = inputs.basis.shape[1]
    maps = [np.hstack([first.basis, np.zeros((n, steps * q))])]
    offsets = [first.centre]
    for step in range(steps):
        moved = trajectories.A @ maps[-1]
        moved[:, k + step * q:k + (step + 1) * q] += trajectories.B @ inputs.basis
        maps.append(moved)
        offsets.append(trajectories.A @ offsets[-1] + trajectories.B @ inputs.centre)
    rows = [np.hstack([np.zeros((steps * len(inputs.g), k)), np.kron(np.eye(steps), inputs.F)])]
    right = [np.tile(inputs.g, steps)]
    for S, M, c in zip(states, maps, offsets):
        F = np.vstack([S.A, S.A_eq, -S.A_eq])
        g = np.concatenate([S.b, S.b_eq, -S.b_eq])
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
    for d in directions / np.maximum(np.abs(M).sum(axis=1), TINY):
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
