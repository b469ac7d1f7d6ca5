"""Removal of bounds that play no part, such as 1e20.

A bound is loose where it lets one step move a coordinate by far more than the states are wide there. In units of such
bounds nothing else could be seen. Those on the states go, and the problem is that without them; those on the inputs
are replaced by a box that holds the inputs of every trajectory of a few steps.
"""

from __future__ import annotations

from dataclasses import replace
from functools import reduce

import numpy as np

from invariant_sets.engine.local_problem import LinearSystem
from invariant_sets.engine.unstable_modes import unstable_bounds
from invariant_sets.exceptions import NumericalError
from invariant_sets.polytope import Polytope
from invariant_sets.tolerances import BOX_ROOM, FLAT, LOOSE, UNSTABLE

Array = np.ndarray


def without_loose_bounds(system: LinearSystem, X: Polytope, U: Polytope,
                         target: Polytope | None = None) -> tuple[LinearSystem, Polytope, Polytope]:
    """Problem without rows and inputs that cannot matter in one step to `target`.

    Without a target, in staying in X for ever. Where U has to be cut, inputs that move the state alike become one.
    """
    system, X, U = _within_reach(system, X, U, target)
    if target is None:
        held = _within_unstable_modes(system, X, U)
        if held is not X:
            return _within_reach(system, held, U, None)
    return system, X, U


def _within_reach(system: LinearSystem, X: Polytope, U: Polytope,
                  target: Polytope | None) -> tuple[LinearSystem, Polytope, Polytope]:
    """Problem with what is felt in one step, or in nx."""
    states = X._body
    inputs = U._body
    goal = states if target is None else target._body
    if states is None or inputs is None or goal is None or not len(goal.g):
        return system, X, U
    half = states.half_widths
    if not states.bounded:  # what has no end has no bound
        half = np.where(np.isfinite(np.subtract(*X.bounding_box())), half, 0.0)
    width = LOOSE * np.where(goal.half_widths > 0.0, goal.half_widths, np.inf)
    with np.errstate(over="ignore"):
        strong = not inputs.bounded or bool((np.abs(system.B) @ inputs.half_widths > width).any())
        loose = bool((np.abs(system.A) * half > width[:, None]).any())
    if not strong and not loose:
        return system, X, U
    if strong:
        system, U = _independent_inputs(system, U, np.where(goal.half_widths > 0.0, goal.half_widths, 1.0))
    nu = U.dim
    moves, drift = _moves(system, X.dim if target is None else 1)
    lifted = _trajectories(moves, drift, X, U, X if target is None else target)
    if lifted.is_empty:
        return system, X, U
    eye = np.eye(lifted.dim)[X.dim:X.dim + nu]
    upper = lifted.support(eye)
    lower = -lifted.support(-eye)
    room = BOX_ROOM * np.where(np.isfinite(upper - lower), upper - lower, 0.0)
    return system, _felt(X, lifted, moves[:-1], drift[:-1]), _cut(U, Polytope.from_bounds(lower - room, upper + room))


def _within_unstable_modes(system: LinearSystem, X: Polytope, U: Polytope) -> Polytope:
    """X cut to where bounded inputs can hold the unstable modes.

    Raises
    ------
    NumericalError
        The rest is so thin beside X that nothing could be said of it.
    """
    from scipy.linalg import matrix_balance

    A, (units, _) = matrix_balance(system.A, permute=False, separate=True)
    if X.is_empty or not U.is_bounded or np.abs(np.linalg.eigvals(A)).max() <= 1 + UNSTABLE:
        return X
    moves = U.vertices @ system.B.T / units
    size = np.abs(moves).max() or 1.0
    disturbances = None if system.disturbances is None else system.disturbances / units / size
    D, d, group = unstable_bounds(A, moves / size, disturbances)
    D = D / units / size
    room, width = (ends[:len(d) // 2] + ends[len(d) // 2:] for ends in (X.support(D), d))
    loose = (width > 0.0) & (room > LOOSE * width) & ~np.isin(group[:len(width)], group[np.tile(np.isinf(room), 2)])
    if not loose.any():
        return X
    cut = X.intersection(Polytope(D[np.tile(loose, 2)], d[np.tile(loose, 2)]))
    if not cut.is_empty and cut.affine_dim < X.affine_dim:
        raise NumericalError("X", X.A.shape, "what inputs can hold of its unstable modes is nothing beside the others")
    return cut


def _moves(system: LinearSystem, steps: int) -> tuple[list[Array], list[Array]]:
    """Matrices M and c of the states M (x, u₀, …) + c."""
    n, nu = system.B.shape
    mean = np.zeros(n) if system.disturbances is None else system.disturbances.mean(axis=0)
    moves = [np.hstack([np.eye(n), np.zeros((n, steps * nu))])]
    drift = [np.zeros(n)]
    for step in range(steps):
        M = system.A @ moves[-1]
        M[:, n + step * nu:n + (step + 1) * nu] = system.B
        moves.append(M)
        drift.append(system.A @ drift[-1] + mean)
    return moves, drift


def _trajectories(moves: list[Array], drift: list[Array], X: Polytope, U: Polytope, target: Polytope) -> Polytope:
    """Set of (x, u₀, …) with states in X and the last in `target`."""
    steps = len(moves) - 1
    lifted = reduce(Polytope.cartesian_product, [U] * steps, X)
    for M, c, after in zip(moves[1:], drift[1:], [X] * (steps - 1) + [target]):
        lifted = lifted.intersection(after.preimage(M, c))
    return lifted


def _felt(X: Polytope, lifted: Polytope, moves: list[Array], drift: list[Array]) -> Polytope:
    """X without the rows that no trajectory comes near.

    Of a coordinate in which the trajectories have no width nothing is left that could be far away.
    """
    body = lifted._body
    assert body is not None
    far = np.abs(X.A) @ body.half_widths[:X.dim] > 0.0
    for M, c in zip(moves, drift):
        upper = lifted.support(X.A @ M)
        lower = -lifted.support(-X.A @ M)
        far &= BOX_ROOM * (X.b - X.A @ c - upper) > upper - lower
    return Polytope(X.A[~far], X.b[~far], X.A_eq, X.b_eq)


def _independent_inputs(system: LinearSystem, U: Polytope, width: Array) -> tuple[LinearSystem, Polytope]:
    """System with independent inputs in units of `width` (n,), and their set."""
    left, values, vt = np.linalg.svd(system.B / width[:, None], full_matrices=False)
    rank = int((values > FLAT * values.max(initial=0.0)).sum())
    if rank in (0, U.dim):
        return system, U
    moves = width[:, None] * left[:, :rank]
    return replace(system, B=moves), U.affine_map(values[:rank, None] * vt[:rank])


def _cut(P: Polytope, box: Polytope) -> Polytope:
    """P cut by a box, by the rows that are felt."""
    cut = P.intersection(box)
    body = cut._body
    return cut if body is None else Polytope._of(body.rows, body=body)
