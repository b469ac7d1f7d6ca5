"""Statement of a discrete plan's costs and limits about a plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mpc.checks import Array, Flags
from mpc.optimal_control.condensing import pulled
from mpc.tolerances import RUNAWAY, WELL_SIZED

Along = tuple[Array, Array, Array, Array, Array]


@dataclass(frozen=True, eq=False)
class Multipliers:
    """Costates (N, nx) of later states; multipliers (m,) of limits.

    The Lagrangian's Hessian (N + 1, nx + nu, nx + nu) is that of the plan that they were carried from.
    """

    costates: Array
    pushes: Array
    hessian: Array | None = None
    pulling: float = 0.0  # of limits that would pull, and were left out, beside the strongest that pushes


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of all limits, each of one step (m,).

    They are slopes by its state (m, nx), its input and the input before it (m, nu). A row with a slot ≥ 0 may be passed
    by the violation of that number, times its amount; at one step later it is the row `later`.
    """

    steps: Any
    by_state: Array
    by_input: Array
    by_before: Array
    units: Array
    slots: Any
    amounts: Array
    later: Any

    def pulled(self, along: Along, which: Any) -> Array:
        """Rows (c, n) by v."""
        N, nx, nu = along[1].shape
        count = np.arange(len(which))
        steps = self.steps[which]
        by_state, by_input = np.zeros((len(which), N + 1, nx)), np.zeros((len(which), N + 1, nu))
        by_state[count, steps] = self.by_state[which]
        by_input[count, steps - 1] = self.by_before[which]
        by_input[count, steps] += self.by_input[which]
        return np.asarray(pulled(*along[:3], by_state, by_input[:, :N].copy())[0].reshape(len(which), N * nu))

    def along(self, moves: Array, change: Array, which: Any = slice(None)) -> Array:
        """Changes (m,) of some rows by moves (N + 1, nx), (N, nu)."""
        steps = self.steps[which]
        found = np.asarray(np.einsum("ij,ij->i", self.sides[which], both(moves, change)[steps]))
        return found + np.einsum("ij,ij->i", self.by_before[which], change[steps - 1]) if self._before else found

    def pushed(self, pushes: Array, by_state: Array, by_input: Array) -> tuple[Array, Array]:
        """Slopes with those of the rows times multipliers."""
        which, found, nx = np.flatnonzero(pushes), both(by_state, by_input), by_state.shape[1]
        steps, push = self.steps[which], pushes[which, None]
        np.add.at(found, steps, push * self.sides[which])
        np.add.at(found[:, nx:], steps - 1, push * self.by_before[which])
        return found[:, :nx].copy(), found[:-1, nx:].copy()

    @classmethod
    def of_kinds(cls, kinds: list[tuple[Any, ...]]) -> Rows:
        """Rows of kinds (steps (s,), by_state (r, nx), by_input, by_before, units (r,), amounts (r,)).

        Those of a step that have amounts share a violation.
        """
        first, found = 0, []
        for steps, *sides, units, amounts in kinds:
            own = first + np.arange(len(steps) * len(units))
            later = np.where(own + len(units) < first + own.size, own + len(units), own)
            soft = np.full(own.size, -1) if amounts is None else np.repeat(steps, len(units)) - 1
            of_rows = [np.tile(side, (len(steps), 1)) for side in sides]
            amounts = np.ones(len(units)) if amounts is None else amounts
            found.append((np.repeat(steps, len(units)), *of_rows, np.tile(units, len(steps)), soft,
                          np.tile(amounts, len(steps)), later))  # fmt: skip
            first += own.size
        rows = cls(*(np.concatenate(part) for part in zip(*found)))
        rows.by_before[rows.steps == 0] = 0.0  # that input is known
        return rows

    @cached_property
    def violations(self) -> int:
        """Number of violations."""
        return int(self.slots.max(initial=-1)) + 1

    @cached_property
    def sides(self) -> Array:
        """Slopes (m, nx + nu) by state and input."""
        return np.hstack([self.by_state, self.by_input])

    @cached_property
    def _before(self) -> bool:
        """Whether any row sees the input before."""
        return bool(self.by_before.any())


@dataclass(frozen=True, eq=False)
class Local:
    """Statement at a plan (N + 1, nx), (N, nu)."""

    states: Array
    inputs: Array
    about: tuple[Array, Array, Array, Array]  # A, B, gaps of the model, and how far the state is from the plan's first
    by_state: Array  # slopes (N + 1, nx) and (N, nu) of the cost
    by_input: Array
    convex: Callable[[], Array]  # Hessian (N + 1, nx + nu, nx + nu) of the cost, or one that is convex in its place
    hessian: Callable[[Multipliers], Array]  # of the Lagrangian
    rows: Rows
    room: Array  # (m,)
    sizes: tuple[Array, Array]  # of states and inputs
    extent: Array  # (nu,): of limits of inputs, infinite where there are none
    cost: Callable[[], float]
    prices: Array  # linear and quadratic (s, 2), of violations; infinite where limits are hard
    regulated: Array | None = None  # weights of the gains, where not those of the cost
    # slopes of which only rounding is left where states and inputs are at their references, and their cost
    lost: tuple[Array, Array] | None = None
    lost_cost: float = 0.0
    cost_size: float = 0.0  # of costs that vanish
    told: Array | None = None  # units (m,) of rows by what bounds tell, where these are others

    @cached_property
    def defects(self) -> float:
        """Largest gap in the plan, in what its states move.

        Where that is rounding, in the least that is none.
        """
        moves, values = np.ptp(self.states, axis=0), np.maximum(self.sizes[0], np.abs(self.states).max(axis=0))
        return max(largest(part / np.maximum(moves, WELL_SIZED * values / RUNAWAY)) for part in self.about[2:])

    @property
    def force(self) -> float:
        """Largest slope of the cost, in sizes, and its size without any."""
        slopes = (largest(self.by_state * self.sizes[0]), largest(self.by_input * self.sizes[1]))
        return max(slopes) or self.cost_size or 1.0

    @property
    def hard(self) -> Flags:
        """Limits (m,) that are hard."""
        return np.asarray(np.isinf(np.append(self.prices[:, 0], np.inf))[self.rows.slots])

    @property
    def passed(self) -> tuple[float, float]:
        """Largest violation of a hard limit, absolute and relative."""
        return self._over(np.ones_like(self.room)), self._over(self.rows.units)

    @property
    def passed_beside_told(self) -> float:
        """Largest violation, beside told sizes."""
        return self._over(self.rows.units if self.told is None else self.told)

    def _over(self, units: Array) -> float:
        """Largest violation of hard limits, in units (m,)."""
        over = np.where(self.hard, np.maximum(-self.room, 0.0), 0.0)
        return float(np.nan_to_num(over / units, nan=np.inf).max(initial=0.0))

    def priced(self, relaxed: bool, dear: float) -> Array:
        """Prices of violations, `dear` of relaxed hard limits."""
        return np.where(np.isinf(self.prices) & relaxed, dear, self.prices)


def both(states: Array, inputs: Array) -> Array:
    """States (N + 1, nx) beside inputs (N, nu), none at the end."""
    nx = states.shape[1]
    found = np.zeros((len(states), nx + inputs.shape[1]))
    found[:, :nx], found[:-1, nx:] = states, inputs
    return found


def largest(values: Array) -> float:
    """Largest size of an entry."""
    return float(np.abs(values).max(initial=0.0))
