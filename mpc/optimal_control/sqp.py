"""Sequential quadratic programming for discrete plans of any statement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from mpc.checks import Array
from mpc.dense_qp import DenseQP
from mpc.optimal_control.condensing import gains_along, moved, pulled
from mpc.optimal_control.local_statement import Along, Local, Multipliers, Rows, both, largest
from mpc.plan import Plan
from mpc.tolerances import COST_ROUNDING, FEASIBLE, KKT, NEGLIGIBLE, OPTIMAL, PRIMAL, ROUNDED_SUM, VIOLATION_PRICE

TINY = float(np.finfo(float).tiny)  # a divisor that stands for zero


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
    relaxed: bool  # whether limits of states had to be relaxed
    program: _Program
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
        falls = unit[:, None] * _by_moves(A, B, gains, _priced(self.local, self._prices, whole))[0] * unit
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
        return np.where(passed, price, _held(local, own.dear, on.pushes, self.relaxed))

    def _curved(self, more: Array) -> bool:
        """Whether it, with more (N + 1, nx + nu) on its diagonal, rises along limits that push."""
        if self.program.hessian is self.hessian:
            return True
        whole = self.hessian + more[:, :, None] * np.eye(more.shape[1])
        return _condensed(self.local, self._prices, whole) is not None


@dataclass(frozen=True, eq=False)
class _Program:
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

    def unrest(self, force: Array, balance: float, change: Array, gain: float) -> float:
        """Stationarity, see `Step`, where a move makes a gradient (n,) vanish."""
        local, found = self.local, largest(force * self.unit) / balance
        still = largest(change / local.extent) if np.isfinite(local.extent).all() else np.inf
        if still >= found:
            return found
        return min(found, max(still, abs(gain) / max(abs(local.cost()), local.lost_cost, TINY)))

    def multipliers(self, moves: Array, change: Array, taken: Array, pushes: Array) -> Multipliers:
        """Multipliers of the plan after moves, for those of the rows taken."""
        local = self.local
        found = np.zeros(len(local.room))
        found[taken] = pushes
        found += 2 * self.held * (local.rows.along(moves, change) - self.aims)
        slopes = _bent(local, self.hessian, moves, change)
        by_state, by_input = local.rows.pushed(np.maximum(found, 0.0), *slopes)
        return Multipliers(pulled(*self.along[:3], by_state[None], by_input[None])[1][0, 1:], np.maximum(found, 0.0))


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
    if last is not None and multipliers is not None:
        confirmed = _confirmed(local, times * dear, multipliers, last)
        if confirmed.error <= KKT:
            return confirmed
    tried = [multipliers, None]
    if multipliers is not None and multipliers.hessian is not None:
        tried.insert(1, replace(multipliers, hessian=None))
    program = next(filter(None, (_program(local, dear, one, relaxed) for one in tried)), None)
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
    stationarity = program.unrest(curvature, balance, change, gain)
    size = max(largest(moves / local.sizes[0]), largest(change / local.sizes[1]))
    found = local, moves, change, program.along[2], size, local.defects, stationarity
    balanced = partial(program.multipliers, moves, change, *pushes)
    return Step(*found, relaxed, program, balanced)


def carried(plan: Plan, rows: Rows) -> Multipliers | None:
    """Multipliers that a plan carries for these rows."""
    if plan.costates is None or plan.pushes is None:
        return None
    if (len(plan.costates), len(plan.pushes)) != (len(plan.inputs), len(rows.steps)):
        return None
    fits = plan.hessian is not None and plan.hessian.shape[:2] == (len(plan.states), rows.sides.shape[1])
    return Multipliers(plan.costates, plan.pushes, plan.hessian if fits else None)


def convex(local: Local) -> bool:
    """Whether the program without multipliers is convex."""
    return _program(local, 0.0, None) is not None


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
    y = _times(roots, gradient[None]).reshape(*roots.shape[:2], 1)
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
        last, local=local, states=none[0], inputs=none[1], size=0.0,
        defects=max(local.defects, left.max(initial=0.0), unbalanced),
        stationarity=program.unrest(gradient, balance, change, 0.5 * float((y * y).sum())),
        _balanced=lambda: multipliers,
    )  # fmt: skip


def _held(local: Local, dear: float, pushes: Array, relaxed: bool) -> Array:
    """Prices (m,) of moves across limits that push.

    No move along them pays it, so what the program comes to is the same, and the Hessian is positive definite where it
    is along the limits (Debreu, Econometrica 20, 1952).
    """
    rows = local.rows
    room = local.room / rows.units
    acting = (pushes > 0) & (local.hard & (not relaxed) | (room >= -FEASIBLE)) & ~rows.by_before.any(axis=1)
    return np.where(acting, np.maximum(dear, VIOLATION_PRICE * pushes * rows.units) / rows.units**2, 0.0)


def _program(local: Local, dear: float, on: Multipliers | None, relaxed: bool = False) -> _Program | None:
    """Program about v = 0, None where it is not convex."""
    A, B, gaps, first = local.about
    rows, held = local.rows, np.zeros(len(local.room)) if on is None else _held(local, dear, on.pushes, relaxed)
    hessian = None if on is None else on.hessian
    try:
        if hessian is None:
            hessian = local.convex() if on is None else local.hessian(on)
    except np.linalg.LinAlgError:  # slopes so steep that their products are no numbers
        return None
    condensed = _condensed(local, held, hessian)
    if condensed is None:
        return None
    whole, gains, blocks, roots = condensed
    along = A, B, gains, gaps, first
    drift, lead = (part[0] for part in moved(*along, np.zeros((1, *local.inputs.shape))))
    aims = np.where(held > 0, np.maximum(local.room, 0.0), 0.0)  # where a limit that pushes is met
    bent = rows.pushed(-2 * held * aims, *_bent(local, whole, drift, lead))
    slopes = [bent, *([] if local.lost is None else [local.lost])]
    # what states cost and what inputs cost, apart
    by_state = np.array([part for of_states, _ in slopes for part in (of_states, 0 * of_states)])
    by_input = np.array([part for _, of_inputs in slopes for part in (0 * of_inputs, of_inputs)])
    own, other, *lost = pulled(*along[:3], by_state, by_input)[0].reshape(len(by_state), -1)
    left = COST_ROUNDING * np.abs(lost).sum(axis=0) if lost else np.zeros(len(own))
    return _Program(local, dear, along, hessian, held, aims, blocks, roots, (drift, lead), own, other, left, on)


def _condensed(local: Local, held: Array, hessian: Array) -> tuple[Array, Array, Array, Array] | None:
    """Hessian priced across rows, gains, blocks by v and their roots.

    None where blocks are not positive definite, or no numbers.
    """
    (A, B, _, _), whole = local.about, _priced(local, held, hessian)
    try:
        gains, deviating = gains_along(A, B, whole / 2 if local.regulated is None else local.regulated)
        blocks = 2 * deviating if local.regulated is None else _by_moves(A, B, gains, whole)
        roots = _roots(blocks)
    except np.linalg.LinAlgError:
        return None
    return (whole, gains, blocks, roots) if np.isfinite(roots).all() else None


def _priced(local: Local, held: Array, hessian: Array) -> Array:
    """Hessian priced across rows."""
    near, whole = np.flatnonzero(held), hessian.copy()
    sides = local.rows.sides[near]
    np.add.at(whole, local.rows.steps[near], 2 * held[near, None, None] * sides[:, :, None] * sides[:, None])
    return whole


def _by_moves(A: Array, B: Array, gains: Array, hessian: Array) -> Array:
    """Hessian (1, n, n) by v."""
    N, nx, nu = B.shape
    n = N * nu
    states, inputs = moved(A, B, gains, np.zeros((N, nx)), np.zeros(nx), np.eye(n).reshape(n, N, nu))
    Z = np.concatenate([states, np.append(inputs, 0 * inputs[:, :1], axis=1)], axis=2).transpose(1, 2, 0)
    H = Z.reshape(-1, n).T @ (hessian @ Z).reshape(-1, n)
    return np.asarray((H + H.T) / 2)[None]


def _bent(local: Local, hessian: Array, moves: Array, change: Array) -> tuple[Array, Array]:
    """Slopes (N + 1, nx) and (N, nu) after moves, by a Hessian."""
    by_both = (hessian @ both(moves, change)[:, :, None])[:, :, 0]
    nx = moves.shape[1]
    return local.by_state + by_both[:, :nx], local.by_input + by_both[:-1, nx:]


def _solve(program: _Program, dear: float, relaxed: bool) -> tuple[Any, ...]:
    """Variables, whether limits were relaxed, whether it was solved, rows taken in and their multipliers."""
    local = program.local
    hard = bool(np.isinf(local.prices).any())
    if not (relaxed and hard):
        z, solved, *rows = _within(program, local.prices)
        if solved or not hard:
            return z, False, solved, *rows
    z, solved, *rows = _within(program, local.priced(True, dear))
    return z, True, solved, *rows


def _within(program: _Program, prices: Array) -> tuple[Array, bool, Any, Array]:
    """Solution as of `_solve`, with violations at a price, if finite."""
    local, rows, n = program.local, program.local.rows, len(program.by_state)
    given = np.isfinite(prices[:, 0])
    size = 1 / np.sqrt(2 * prices[given, 1])  # a violation of this size has the quadratic cost ½
    q = np.concatenate([_times(program.roots, program.gradient[None])[0], prices[given, 0] * size])
    acting = np.where(program.held > 0, -np.inf, local.room / rows.units)
    near = np.count_nonzero(acting <= PRIMAL)
    fresh = np.argsort(acting)[: near + near // 3]
    taken, matrix = np.zeros(0, dtype=int), np.zeros((0, len(q)))
    y, pushes, solved = -q, np.zeros(0), True
    while True:
        if len(fresh):
            more = np.zeros((len(fresh), len(q)))
            more[:, :n] = _times(program.roots, rows.pulled(program.along, fresh))
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


def _roots(blocks: Array) -> Array:
    """Roots T with T'HT = 1 of positive definite blocks of H (b, n/b, n/b)."""
    diagonal = np.diagonal(blocks, axis1=1, axis2=2)
    if not (diagonal > 0).all():
        raise np.linalg.LinAlgError
    unit = 1 / np.sqrt(diagonal)
    scaled = blocks * unit[:, :, None] * unit[:, None, :]
    lower = np.linalg.cholesky(scaled + ROUNDED_SUM * np.eye(scaled.shape[1]))
    return np.asarray(np.linalg.inv(lower).transpose(0, 2, 1) * unit[:, :, None])


def _times(roots: Array, rows: Array) -> Array:
    """Rows (c, n) by y, where these are by z = Ty."""
    blocks = rows.reshape(len(rows), *roots.shape[:2]).transpose(1, 0, 2) @ roots
    return np.asarray(blocks.transpose(1, 0, 2).reshape(rows.shape))


def _least(q: Array, rows: Array, bounds: Array, units: Array) -> tuple[Array, Array, bool]:
    """Minimiser of ½ y'y + q'y subject to rows y <= bounds, multipliers, and whether there is one.

    Only what the rows see of y is a matter of them.
    """
    basis, seen = np.linalg.qr(rows.T)
    own = q @ basis
    result = DenseQP(np.eye(len(own)), seen.T, units, second=False).solve(own, bounds)
    solved = not result.infeasible and result.residuals.worst <= OPTIMAL
    return basis @ (result.z + own) - q, result.multipliers, solved
