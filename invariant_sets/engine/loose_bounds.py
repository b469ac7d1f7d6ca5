"""Bounds that say almost nothing, as 1e20 for "no limit": states and inputs are cut to what can play a part.

A bound is loose where it lets one step move a coordinate by far more than the states are wide there. In units of such
bounds nothing else could be seen, so they are replaced by boxes that hold every trajectory of a few steps.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from invariant_sets.engine.local_problem import LinearSystem
from invariant_sets.polytope import Polytope
from invariant_sets.tolerances import FLAT, LOOSE

Array = np.ndarray
_ROOM = 0.1  # of its width: by how much a box is larger than need be, so that its sides touch nothing


def without_loose_bounds(system: LinearSystem, X: Polytope, U: Polytope,
                         target: Polytope | None = None) -> tuple[LinearSystem, Polytope, Polytope]:
    """Return the same problem with X and U cut to what can play a part in reaching a target in one step.

    Without a target, in staying in X for nx steps. Where U has to be cut, inputs that move the state alike become one.
    """
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
    n = X.dim
    nu = U.dim
    lifted = _trajectories(system, X, U, X if target is None else target, n if target is None else 1)
    if lifted.is_empty:
        return system, X, U
    eye = np.eye(lifted.dim)[:n + nu]
    upper = lifted.support(eye)
    lower = -lifted.support(-eye)
    room = _ROOM * np.where(np.isfinite(upper - lower), upper - lower, 0.0)
    box = Polytope.from_bounds(lower - room, upper + room)
    return system, _cut(X, box.projection(np.arange(n))), _cut(U, box.projection(np.arange(n, n + nu)))


def _trajectories(system: LinearSystem, X: Polytope, U: Polytope, target: Polytope, steps: int) -> Polytope:
    """Return all (x, u₀, …) with so many steps in X and the last state in the target, under the mean disturbance."""
    n, nu = system.B.shape
    drift = np.zeros(n) if system.disturbances is None else system.disturbances.mean(axis=0)
    M = np.hstack([np.eye(n), np.zeros((n, steps * nu))])
    c = np.zeros(n)
    lifted = X.preimage(M)
    for step in range(steps):
        inputs = np.zeros((nu, n + steps * nu))
        inputs[:, n + step * nu:n + (step + 1) * nu] = np.eye(nu)
        M = system.A @ M + system.B @ inputs
        c = system.A @ c + drift
        after = X if step < steps - 1 else target
        lifted = lifted.intersection(U.preimage(inputs)).intersection(after.preimage(M, c))
    return lifted


def _independent_inputs(system: LinearSystem, U: Polytope, width: Array) -> tuple[LinearSystem, Polytope]:
    """Return the system with as many inputs as B has independent columns, in units of `width` (n,), and their set."""
    left, values, vt = np.linalg.svd(system.B / width[:, None], full_matrices=False)
    rank = int((values > FLAT * values.max(initial=0.0)).sum())
    if rank in (0, U.dim):
        return system, U
    moves = width[:, None] * left[:, :rank]
    return replace(system, B=moves), U.affine_map(values[:rank, None] * vt[:rank])


def _cut(P: Polytope, box: Polytope) -> Polytope:
    """Return P cut by a box, by the rows that are felt."""
    cut = P.intersection(box)
    body = cut._body
    return cut if body is None else Polytope._of(body.rows, body=body)
