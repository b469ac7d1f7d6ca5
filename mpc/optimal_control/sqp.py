"""Sequential quadratic programming for discrete plans of any statement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np

from mpc.checks import Array
from mpc.dense_qp import DenseQP
from mpc.optimal_control.condensing import moved, pulled
from mpc.optimal_control.local_statement import Local, Multipliers, Rows, largest
from mpc.optimal_control.step_program import (
    TINY,
    Program,
    by_moves,
    by_roots,
    condensed,
    priced_across,
    prices_across,
    program_about,
)
from mpc.plan import Plan
from mpc.tolerances import COST_ROUNDING, FEASIBLE, KKT, NEGLIGIBLE, OPTIMAL, PRIMAL


@dataclass(frozen=True, eq=False)
class Step:
    """Result of one quadratic program for a plan."""

    local: Local  # at the plan
    # by what it moves the plan: (N + 1, nx) and (N, nu)
    states: Array
    inputs: Array
    gains: Array  # (N, nu, nx): of the feedback along the plan that keeps it together
    size: float  # largest move, in sizes of states and inputs
    defects: float  # of the plan, see `Local`
    # of the plan with the multipliers of the program, relative to the gradients that balance; or, where that is less,
    # how far inputs would still move, in parts of their limits, and what part of the cost that would save
    stationarity: float
    saved: float  # what part of the cost the step saves
    relaxed: bool  # whether limits of states had to be relaxed
    program: Program
    _balanced: Callable[[], Multipliers]

    @cached_property
    def multipliers(self) -> Multipliers:
        """Multipliers of the plan after the step."""
        return self._balanced()

    @cached_property
    def error(self) -> float:
        """Larger of gaps and stationarity, no number where one is none."""
        return float(np.maximum(self.defects, self.stationarity))

    @cached_property
    def hessian(self) -> Array:
        """Lagrangian's Hessian at the plan, with its own multipliers."""
        own, on = self.program, self.multipliers
        return own.hessian if own.curves_as(self.local, on) else self.local.hessian(on)

    @cached_property
    def falls(self) -> bool:
        """Whether the Lagrangian's Hessian falls in a direction along limits that push: a saddle."""
        if self.strict or self._curved(self._nothing):
            return False
        return not self.changes_pushed or self._falling[0] < 0

    @property
    def changes_pushed(self) -> bool:
        """Whether limits of changes of inputs push, which no block of a Hessian sees."""
        return bool(self.multipliers.pushes[self.local.rows.by_before.any(axis=1)].any())

    @property
    def strict(self) -> bool:
        """Whether it is positive definite along limits that push."""
        return self._curved(np.zeros(self.hessian.shape[:2]))

    @property
    def falling(self) -> tuple[Array, Array]:
        """Moves along which it falls most, by as much as the cost."""
        value, (states, inputs) = self._falling
        size = np.sqrt(2 * self._cost / max(-value, TINY))
        return size * states, size * inputs

    @property
    def _cost(self) -> float:
        """Size of the cost, also where that vanishes."""
        return max(abs(self.local.cost()), COST_ROUNDING * self.local.cost_size)

    @cached_property
    def _nothing(self) -> Array:
        """What (N + 1, nx + nu) falls on the diagonal and saves nothing."""
        own = np.abs(np.diagonal(self.hessian, axis1=1, axis2=2))
        extent, nx = self.local.extent, self.local.states.shape[1]
        found = NEGLIGIBLE**2 * own
        found[:, nx:] += COST_ROUNDING * np.where(np.isfinite(extent), self._cost / extent**2, own[:, nx:])
        return found

    @cached_property
    def _falling(self) -> tuple[float, tuple[Array, Array]]:
        """Least eigenvalue along limits that push, in units of the program, and its moves."""
        (A, B, gaps, first), (*_, gains, _, _), unit = self.local.about, self.program.along, self.program.unit
        rows, none = self.local.rows, (0 * gaps, 0 * first)
        whole = self.hessian + self._nothing[:, :, None] * np.eye(self._nothing.shape[1])
        falls = unit[:, None] * by_moves(A, B, gains, priced_across(self.local, self._prices, whole))[0] * unit
        rates = np.flatnonzero((self.multipliers.pushes > 0) & rows.by_before.any(axis=1))
        held = rows.pulled((A, B, gains, *none), rates) * unit
        free = np.linalg.qr(held.T, mode="complete")[0][:, len(rates) :]
        values, vectors = np.linalg.eigh(free.T @ falls @ free)
        least = (unit * (free @ vectors[:, 0])).reshape(1, *self.inputs.shape)
        states, inputs = moved(A, B, gains, *none, least)
        return float(values[0]), (states[0], inputs[0])

    @cached_property
    def _prices(self) -> Array:
        """Prices (m,) of moves across limits that push."""
        own, on, local, rows = self.program, self.multipliers, self.local, self.local.rows
        price = np.append(local.priced(self.relaxed, own.dear)[:, 1], np.inf)[rows.slots] / rows.amounts**2
        passed = np.isfinite(price) & (on.pushes > 0) & (local.room < -FEASIBLE * rows.units)
        return np.where(passed, price, prices_across(local, own.dear, on.pushes, self.relaxed))

    def _curved(self, more: Array) -> bool:
        """Whether it, with more (N + 1, nx + nu) on its diagonal, rises along limits that push."""
        if self.program.hessian is self.hessian:
            return True
        whole = self.hessian + more[:, :, None] * np.eye(more.shape[1])
        return condensed(self.local, self._prices, whole) is not None


def next_step(local: Local, dear: float, *, relaxed: bool = False, times: float = 1.0,
              multipliers: Multipliers | None = None, last: Step | None = None) -> Step | None:  # fmt: skip
    """Move of a plan, without one at an optimum; None where no program is solved.

    `dear`, so many `times`, is the price of a violation that cannot be avoided, or with `relaxed` of every one: linear
    and quadratic.
    With `multipliers` it has the Lagrangian's Hessian, where that is then convex along the model. They are those of the
    step before, `last`, where there is one.

    Its variables are v = du + K dx with the gains of the regulator along the plan, for which the Hessian is block
    diagonal and an unstable model does no harm (Rossiter, Kouvaritakis and Rice, Automatica 34(1), 1998). A program
    begins with the limits that act in the plan and a third more, the nearest, and takes in what its solution passes,
    and what is nearest until it has twice as many, until it passes none: its dense part grows with the limits that act,
    all else with the horizon.
    """
    known = np.concatenate([part.ravel() for part in (*local.about, local.by_state, local.by_input)])
    if not np.isfinite(known).all() or np.isnan(local.room).any():
        return None
    if last is not None and multipliers is not None and last.program.proper:
        confirmed = _confirmed(local, times * dear, multipliers, last)
        if confirmed.error <= KKT:
            return confirmed
    tried = [multipliers, None]
    if multipliers is not None and multipliers.hessian is not None:
        tried.insert(1, replace(multipliers, hessian=None))
    program = next(filter(None, (program_about(local, dear, one, relaxed) for one in tried)), None)
    if program is None:
        return None
    z, relaxed, solved, *pushes = _solve(program, times * dear, relaxed)
    if not solved:
        return None
    moves, change = program.moves(z)
    curvature = program.curvature(z)
    parts = (program.by_state, program.by_input, program.gradient + curvature, program.lost)
    balance = max(*(largest(part * program.unit) for part in parts), TINY)
    gain = -float(program.gradient @ z + 0.5 * z @ curvature)
    balanced = cache(partial(program.multipliers, moves, change, *pushes))
    size = max(largest(moves / local.sizes[0]), largest(change / local.sizes[1]))
    stationarity = program.unrest(largest(curvature * program.unit) / balance, change, gain)
    if stationarity <= KKT:
        left = max(program.unmet(balance, *pushes), balanced().pulling)
        stationarity = max(stationarity, program.unrest(left, change, gain), 0.0 if program.proper else size)
    found = local, moves, change, program.along[2], size, local.defects, stationarity, program.saved(gain)
    return Step(*found, relaxed, program, balanced)


def carried(plan: Plan, rows: Rows) -> Multipliers | None:
    """Multipliers that a plan carries for these rows."""
    if plan.costates is None or plan.pushes is None:
        return None
    if (len(plan.costates), len(plan.pushes)) != (len(plan.inputs), len(rows.steps)):
        return None
    fits = plan.hessian is not None and plan.hessian.shape[:2] == (len(plan.states), rows.sides.shape[1])
    return Multipliers(plan.costates, plan.pushes, plan.hessian if fits else None)


def _confirmed(local: Local, dear: float, multipliers: Multipliers, last: Step) -> Step:
    """Step that does not move, with its residuals.

    Gradients are weighed as in the program before. A row that pushes has no room, and a violation its price.
    """
    program, rows, pushes = last.program, local.rows, multipliers.pushes
    none = np.zeros_like(local.by_state), np.zeros_like(local.by_input)
    parts = (local.by_state, none[1]), (none[0], local.by_input), rows.pushed(pushes, *none)
    by_state, by_input = (np.stack(side) for side in zip(*parts))
    each = pulled(*local.about[:2], program.along[2], by_state, by_input)[0].reshape(len(parts), -1)
    balance = max(largest(each * program.unit), largest(program.lost * program.unit), TINY)
    gradient, roots = each.sum(axis=0), program.roots
    y = by_roots(roots, gradient[None]).reshape(*roots.shape[:2], 1)
    z = (roots @ y).reshape(1, *none[1].shape)
    change = moved(*local.about[:2], program.along[2], none[0][1:], none[0][0], z)[1]
    room, prices, force = local.room / rows.units, local.priced(last.relaxed, dear), pushes * rows.units
    strongest, unbalanced = max(largest(force), TINY), 0.0
    given = np.isfinite(prices[:, 0])
    if given.any():
        soft = np.flatnonzero(np.append(given, False)[rows.slots])
        slots, over, of_slots = rows.slots[soft], np.zeros(len(prices)), np.zeros(len(prices))
        np.maximum.at(over, slots, -local.room[soft] / rows.amounts[soft])
        np.add.at(of_slots, slots, rows.amounts[soft] * pushes[soft])
        room[soft] += rows.amounts[soft] * over[slots] / rows.units[soft]
        price = np.where(given, prices[:, 0] + 2 * np.where(given, prices[:, 1], 0.0) * over, 0.0)
        strongest = max(strongest, largest(price[over > 0]))
        apart = (of_slots - price) / strongest
        unbalanced = largest(np.where(over > 0, np.minimum(np.abs(apart), over), np.maximum(apart, 0.0)))
    left = np.maximum(np.minimum(room, force / strongest), -room)
    return replace(
        last, local=local, states=none[0], inputs=none[1], size=0.0, saved=0.0,
        defects=max(local.defects, left.max(initial=0.0), unbalanced, multipliers.pulling),
        stationarity=program.unrest(largest(gradient * program.unit) / balance, change, 0.5 * float((y * y).sum())),
        _balanced=lambda: multipliers,
    )  # fmt: skip


def _solve(program: Program, dear: float, relaxed: bool) -> tuple[Any, ...]:
    """Variables, whether limits were relaxed, whether it was solved, rows taken in and their multipliers."""
    local = program.local
    hard = bool(np.isinf(local.prices).any())
    if not (relaxed and hard):
        z, solved, *rows = _within(program, local.prices)
        if solved or not hard:
            return z, False, solved, *rows
    z, solved, *rows = _within(program, local.priced(True, dear))
    return z, True, solved, *rows


def _within(program: Program, prices: Array) -> tuple[Array, bool, Any, Array]:
    """Solution as of `_solve`, with violations at a price, if finite."""
    local, rows, n = program.local, program.local.rows, len(program.by_state)
    given = np.isfinite(prices[:, 0])
    size = 1 / np.sqrt(2 * prices[given, 1])  # a violation of this size has the quadratic cost ½
    q = np.concatenate([by_roots(program.roots, program.gradient[None])[0], prices[given, 0] * size])
    acting = np.where(program.held > 0, -np.inf, local.room / rows.units)
    near = np.count_nonzero(acting <= PRIMAL)
    fresh = np.argsort(acting)[: near + near // 3]
    taken, matrix = np.zeros(0, dtype=int), np.zeros((0, len(q)))
    y, pushes, solved = -q, np.zeros(0), True
    while True:
        if len(fresh):
            more = np.zeros((len(fresh), len(q)))
            more[:, :n] = by_roots(program.roots, rows.pulled(program.along, fresh))
            taken, matrix = np.concatenate([taken, fresh]), np.vstack([matrix, more])
            violations = np.append(np.where(given, np.cumsum(given) - 1, -1), -1)[rows.slots[taken]]
            soft = np.flatnonzero(violations >= 0)
            slots, passing = violations[soft], np.unique(violations[soft])
            matrix[soft, n + slots] = -rows.amounts[taken[soft]] * size[slots]
            least = np.zeros((len(passing), len(q)))
            least[np.arange(len(least)), n + passing] = -1.0
            bounds = local.room[taken] - rows.along(*program.start, taken)
            sides = np.concatenate([bounds, np.zeros(len(least))])
            units = np.concatenate([rows.units[taken], np.ones(len(least))])
            y, pushes, solved = _least(q, np.vstack([matrix, least]), sides, units)
        z = (program.roots @ y[:n].reshape(*program.roots.shape[:2], 1)).ravel()
        room = (local.room - rows.along(*program.moves(z))) / rows.units
        room[taken] = np.inf
        passed = np.count_nonzero(room < -PRIMAL)
        if not (solved and passed):
            return z, solved, taken, pushes[: len(taken)]
        fresh = np.argsort(room)[: min(max(passed, len(taken)), len(room) - len(taken))]


def _least(q: Array, rows: Array, bounds: Array, units: Array) -> tuple[Array, Array, bool]:
    """Minimiser of ½ y'y + q'y subject to rows y <= bounds, multipliers, and whether there is one.

    Only what the rows see of y is a matter of them.
    """
    basis, seen = np.linalg.qr(rows.T)
    own = q @ basis
    result = DenseQP(np.eye(len(own)), seen.T, units, second=False).solve(own, bounds)
    solved = not result.infeasible and result.residuals.worst <= OPTIMAL
    return basis @ (result.z + own) - q, result.multipliers, solved
