"""Quadratic program about a plan, in moves along a feedback."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mpc.checks import Array
from mpc.optimal_control.condensing import gains_along, moved, pulled
from mpc.optimal_control.local_statement import Along, Local, Multipliers, both, largest
from mpc.tolerances import COST_ROUNDING, FEASIBLE, KKT, ROUNDED_SUM, VIOLATION_PRICE

TINY = float(np.finfo(float).tiny)  # a divisor that stands for zero


@dataclass(frozen=True, eq=False)
class Program:
    """Minimise ½ z'Hz + (by_state + by_input)'z within limits.

    z is the v of `moved`; H is block diagonal with `blocks` (b, n/b, n/b).
    """

    local: Local
    dear: float
    along: Along  # (A, B, gains, gaps, first): arguments of `moved` but for v
    hessian: Array  # (N + 1, nx + nu, nx + nu): of the Lagrangian
    held: Array  # (m,): prices of moves across rows from their aims, half of what they add to the Hessian
    aims: Array
    blocks: Array
    roots: Array  # blocks of T for which y, z = Ty, has the Hessian 1
    start: tuple[Array, Array]  # moves of z = 0
    by_state: Array
    by_input: Array
    lost: Array
    of: Multipliers | None  # of its Hessian, where that is the Lagrangian's

    def curves_as(self, local: Local, on: Multipliers) -> bool:
        """Whether its Hessian is the Lagrangian's at a plan and with multipliers that are hardly others."""
        plan, before = self.local, self.of
        if before is None or before.hessian is not None:  # of another plan
            return False
        k = before.costates.shape[1]  # a plan carries those of its states
        size = np.abs(on.costates[:, :k]).max(axis=0, initial=0.0)
        pairs = (
            (plan.states, local.states, local.sizes[0]), (plan.inputs, local.inputs, local.sizes[1]),
            (before.costates, on.costates[:, :k], size), (before.pushes, on.pushes, on.pushes),
        )  # fmt: skip
        return all((np.abs(now - then) <= KKT**0.5 * unit).all() for then, now, unit in pairs)

    @property
    def proper(self) -> bool:
        """Whether no Hessian stands in for the Lagrangian's."""
        return self.of is not None or self.local.regulated is not None

    @property
    def gradient(self) -> Array:
        """Linear cost."""
        return self.by_state + self.by_input

    @cached_property
    def unit(self) -> Array:
        """Sizes (n,) of z in which inputs of any units count alike."""
        return np.asarray(1 / np.sqrt(np.diagonal(self.blocks, axis1=1, axis2=2)).ravel())

    def moves(self, z: Array) -> tuple[Array, Array]:
        """Moves (N + 1, nx) of states and (N, nu) of inputs."""
        by_state, by_input = moved(*self.along, z.reshape(1, len(self.local.inputs), -1))
        return by_state[0], by_input[0]

    def curvature(self, z: Array) -> Array:
        """Product Hz (n,)."""
        return np.asarray(self.blocks @ z.reshape(*self.blocks.shape[:2], 1)).ravel()

    def unmet(self, balance: float, taken: Any, pushes: Array) -> float:
        """What limits push that the step alone meets: they balance no gradient of the plan."""
        rows = self.local.rows
        room = self.local.room[taken] / rows.units[taken]
        far = (pushes > 0) & (room > KKT)
        force = np.abs(rows.pulled(self.along, taken[far]) * self.unit).max(axis=1, initial=0.0) * pushes[far] / balance
        return float(np.minimum(room[far], force).max(initial=0.0))

    def unrest(self, found: float, change: Array, gain: float) -> float:
        """Stationarity, see `Step`, where a gradient is left that a move makes vanish."""
        local = self.local
        still = largest(change / local.extent) if np.isfinite(local.extent).all() else np.inf
        if still >= found:
            return found
        return min(found, max(still, self.saved(gain)))

    def saved(self, gain: float) -> float:
        """What part of the cost that is."""
        return abs(gain) / max(abs(self.local.cost()), self.local.lost_cost, TINY)

    def multipliers(self, moves: Array, change: Array, taken: Array, pushes: Array) -> Multipliers:
        """Multipliers of the plan after moves, for those of the rows taken."""
        local = self.local
        found = self.pushing(moves, change, taken, pushes)
        force = found * local.rows.units
        slopes = bent(local, self.hessian, moves, change)
        by_state, by_input = local.rows.pushed(np.maximum(found, 0.0), *slopes)
        costates = pulled(*self.along[:3], by_state[None], by_input[None])[1][0, 1:]
        pulling = max(-force.min(initial=0.0), 0.0) / max(force.max(initial=0.0), TINY)
        return Multipliers(costates, np.maximum(found, 0.0), pulling=pulling)

    def pushing(self, moves: Array, change: Array, taken: Any, pushes: Array) -> Array:
        """Multipliers (m,) of all rows after moves, negative of those that pull."""
        found = np.zeros(len(self.local.room))
        found[taken] = pushes
        return np.asarray(found + 2 * self.held * (self.local.rows.along(moves, change) - self.aims))


def program_about(local: Local, dear: float, on: Multipliers | None, relaxed: bool = False) -> Program | None:
    """Program about v = 0, None where it is not convex."""
    A, B, gaps, first = local.about
    rows, held = local.rows, np.zeros(len(local.room)) if on is None else prices_across(local, dear, on.pushes, relaxed)
    hessian = None if on is None else on.hessian
    try:
        if hessian is None:
            hessian = local.convex() if on is None else local.hessian(on)
    except np.linalg.LinAlgError:  # slopes so steep that their products are no numbers
        return None
    found = condensed(local, held, hessian)
    if found is None or not found[-1]:
        return None
    whole, gains, blocks, roots, _ = found
    along = A, B, gains, gaps, first
    drift, lead = (part[0] for part in moved(*along, np.zeros((1, *local.inputs.shape))))
    aims = np.where(held > 0, np.maximum(local.room, 0.0), 0.0)  # where a limit that pushes is met
    pushed = rows.pushed(-2 * held * aims, *bent(local, whole, drift, lead))
    slopes = [pushed, *([] if local.lost is None else [local.lost])]
    # what states cost and what inputs cost, apart
    by_state = np.array([part for of_states, _ in slopes for part in (of_states, 0 * of_states)])
    by_input = np.array([part for _, of_inputs in slopes for part in (0 * of_inputs, of_inputs)])
    own, other, *lost = pulled(*along[:3], by_state, by_input)[0].reshape(len(by_state), -1)
    left = COST_ROUNDING * np.abs(lost).sum(axis=0) if lost else np.zeros(len(own))
    return Program(local, dear, along, hessian, held, aims, blocks, roots, (drift, lead), own, other, left, on)


def prices_across(local: Local, dear: float, pushes: Array, relaxed: bool) -> Array:
    """Prices (m,) of moves across limits that push.

    No move along them pays it, so what the program comes to is the same, and the Hessian is positive definite where it
    is along the limits (Debreu, Econometrica 20, 1952).
    """
    rows = local.rows
    room = local.room / rows.units
    acting = (pushes > 0) & (local.hard & (not relaxed) | (room >= -FEASIBLE)) & ~rows.by_before.any(axis=1)
    return np.where(acting, np.maximum(dear, VIOLATION_PRICE * pushes * rows.units) / rows.units**2, 0.0)


def condensed(local: Local, held: Array, hessian: Array) -> tuple[Array, Array, Array, Array, bool] | None:
    """Hessian priced across rows, gains, blocks by v, their roots, whether these are more than rounding.

    None where blocks are not positive definite, or no numbers.
    """
    (A, B, _, _), whole = local.about, priced_across(local, held, hessian)
    try:
        weights, own = (whole / 2, True) if local.regulated is None else (local.regulated, False)
        gains, deviating, rounded = gains_along(A, B, weights, own)
        blocks = 2 * deviating if own else by_moves(A, B, gains, whole)
        roots = _roots(blocks)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(roots).all():
        return None
    known = True
    if own:
        least = 2 * (rounded + ROUNDED_SUM * np.diagonal(deviating, axis1=1, axis2=2))
        known = bool((np.diagonal(roots, axis1=1, axis2=2) ** -2.0 > least).all())
    return whole, gains, blocks, roots, known


def priced_across(local: Local, held: Array, hessian: Array) -> Array:
    """Hessian priced across rows."""
    near, whole = np.flatnonzero(held), hessian.copy()
    sides = local.rows.sides[near]
    np.add.at(whole, local.rows.steps[near], 2 * held[near, None, None] * sides[:, :, None] * sides[:, None])
    return whole


def by_moves(A: Array, B: Array, gains: Array, hessian: Array) -> Array:
    """Hessian (1, n, n) by v."""
    N, nx, nu = B.shape
    n = N * nu
    states, inputs = moved(A, B, gains, np.zeros((N, nx)), np.zeros(nx), np.eye(n).reshape(n, N, nu))
    Z = np.concatenate([states, np.append(inputs, 0 * inputs[:, :1], axis=1)], axis=2).transpose(1, 2, 0)
    H = Z.reshape(-1, n).T @ (hessian @ Z).reshape(-1, n)
    return np.asarray((H + H.T) / 2)[None]


def bent(local: Local, hessian: Array, moves: Array, change: Array) -> tuple[Array, Array]:
    """Slopes (N + 1, nx) and (N, nu) after moves, by a Hessian."""
    by_both = (hessian @ both(moves, change)[:, :, None])[:, :, 0]
    nx = moves.shape[1]
    return local.by_state + by_both[:, :nx], local.by_input + by_both[:-1, nx:]


def _roots(blocks: Array) -> Array:
    """Roots T with T'HT = 1 of positive definite blocks of H (b, n/b, n/b)."""
    diagonal = np.diagonal(blocks, axis1=1, axis2=2)
    if not (diagonal > 0).all():
        raise np.linalg.LinAlgError
    unit = 1 / np.sqrt(diagonal)
    scaled = blocks * unit[:, :, None] * unit[:, None, :]
    lower = np.linalg.cholesky(scaled + ROUNDED_SUM * np.eye(scaled.shape[1]))
    return np.asarray(np.linalg.inv(lower).transpose(0, 2, 1) * unit[:, :, None])


def by_roots(roots: Array, rows: Array) -> Array:
    """Rows (c, n) by y, where these are by z = Ty."""
    blocks = rows.reshape(len(rows), *roots.shape[:2]).transpose(1, 0, 2) @ roots
    return np.asarray(blocks.transpose(1, 0, 2).reshape(rows.shape))


def convex(local: Local) -> bool:
    """Whether the program without multipliers is convex."""
    return program_about(local, 0.0, None) is not None
