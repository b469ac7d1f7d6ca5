"""Sequential quadratic programming for discrete plans."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from mpc.checks import Array
from mpc.dense_qp import DenseQP
from mpc.exceptions import NotConvexError
from mpc.feedback import stabilising_weights
from mpc.optimal_control.condensing import compile_kernels, gains_along, moved, pulled
from mpc.optimal_control.discrete_model import DiscreteModel
from mpc.problem import MPCProblem
from mpc.rollout import Given, cost_of, deviations
from mpc.tolerances import COST_ROUNDING, FEASIBLE, PRIMAL, ROUNDED_SUM

Along = tuple[Array, Array, Array, Array, Array]

TINY = float(np.finfo(float).tiny)  # a divisor that stands for zero


@dataclass(frozen=True, eq=False)
class Step:
    """Result of one quadratic program for a plan."""

    # by what it moves the plan: (N + 1, nx) and (N, nu)
    states: Array
    inputs: Array
    gains: Array  # (N, nu, nx): of the feedback along the plan that keeps it together
    size: float  # largest move, in sizes of states and inputs
    # the largest gap in the plan between a state and what the model makes of the one before it, in sizes of the states
    defects: float
    # of the plan with the multipliers of the program, relative to the gradients that balance; or, where that is less,
    # how far inputs would still move, in parts of their limits, and what part of the cost that would save
    stationarity: float
    relaxed: bool  # whether limits of states had to be relaxed
    solved: bool
    newton: bool = False  # whether its Hessian was the Lagrangian's
    _pulled: Callable[[], Array] = lambda: np.zeros(0)
    _curved: Callable[[Array], _Program | None] = lambda costates: None

    @cached_property
    def costates(self) -> Array:
        """Costates (N, nx) of the states from the second on, of the plan after the step."""
        return self._pulled()

    @property
    def strict(self) -> bool:
        """Whether the Lagrangian's Hessian is positive definite along limits that push: no saddle."""
        return self._curved(self.costates) is not None


@dataclass(frozen=True, eq=False)
class _Program:
    """Minimise ½ z'Hz + (by_state + by_input)'z within limits.

    z is the v of `moved`; H is block diagonal with `blocks` (b, n/b, n/b).

    Where states and inputs are at their references, only rounding is left of a linear cost of the size `lost` and of a
    cost of `lost_cost`.
    """

    plan: tuple[Array, Array]
    start: tuple[Array, Array]  # the plan of z = 0
    along: Along  # (A, B, gains, gaps, first): arguments of `moved` but for v
    given: Given
    bend: Array  # (N + 1, nx + nu, nx + nu): of the Lagrangian's Hessian, what the costs do not make
    blocks: Array
    roots: Array  # blocks of T for which y, z = Ty, has the Hessian 1
    by_state: Array
    by_input: Array
    lost: Array
    lost_cost: float

    @property
    def gradient(self) -> Array:
        """Linear cost."""
        return self.by_state + self.by_input

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape (b, n/b) of variables."""
        return self.blocks.shape[:2]

    def moves(self, z: Array) -> tuple[Array, Array]:
        """Moves (N + 1, nx) of states and (N, nu) of inputs."""
        by_state, by_input = moved(*self.along, z.reshape(1, len(self.plan[1]), -1))
        return by_state[0], by_input[0]

    def curvature(self, z: Array) -> Array:
        """Product Hz (n,)."""
        return np.asarray(self.blocks @ z.reshape(*self.shape, 1)).ravel()


class Sequential:
    """Quadratic programs of `problem` with the dynamics of `model`.

    Its variables are v = du + K dx with the gains of the regulator along the plan, for which the Hessian is block
    diagonal and an unstable model does no harm (Rossiter, Kouvaritakis and Rice, Automatica 34(1), 1998). A program
    begins with the limits that act in the plan and takes in what its solution passes, and what is nearest until it has
    twice as many, until it passes none: its dense part grows with the limits that act, all else with the horizon.
    """

    def __init__(self, problem: MPCProblem, model: DiscreteModel) -> None:
        self.problem = problem
        self.model = model
        self.n = problem.horizon * problem.nu
        N = problem.horizon
        self._weights = weights_along(N, problem.Q, problem.R, problem.cross, problem.P)
        self._regulated = weights_along(N, *stabilising_weights(problem))
        self._separate = np.array_equal(self._weights, self._regulated)
        self._extent = np.where(problem.input_extent > 0, problem.input_extent, np.inf)
        self.size = problem.state_extent
        self.input_size = np.where(problem.input_extent > 0, problem.input_extent, 1.0)
        prices = problem.price_units
        self._prices = np.concatenate([np.tile(prices["state"], N), prices["terminal"]])
        self._rows = _rows(problem)
        compile_kernels()
        A, B = (np.tile(matrix, (N, 1, 1)) for matrix in (problem.A, problem.B))
        rest = np.zeros((N + 1, problem.nx)), np.zeros((N, problem.nu))
        if self._program(rest, (A, B, rest[0][1:], rest[0][0]), {}, np.zeros_like(self._weights)) is None:
            got = "one along the model at rest that is not positive definite; some input is free of cost"
            cure = "Make R positive definite, or let Q and P see every input."
            raise NotConvexError("Hessian", got, "a positive definite one", cure, 0.0)

    def step(
        self, x: Array, states: Array, inputs: Array, w: Array, p: Array, given: Given, dear: float, *,
        relaxed: bool = False, costates: Array | None = None,
    ) -> Step:  # fmt: skip
        """Quadratic program at a plan (N + 1, nx), (N, nu) from x (nx,).

        `dear` is the price of a violation that cannot be avoided, or with `relaxed` of every one: linear and quadratic.
        With `costates` (N, nx) it has the model's curvature, where it is then convex along the model.
        """
        after, A, B = self.model.linearised(states[:-1], inputs, w, p)
        gaps = after - states[1:]
        defects = max(_largest(gaps / self.size), _largest((x - states[0]) / self.size))
        none = np.zeros((self.problem.horizon, self.problem.nu, self.problem.nx))
        failed = Step(states, inputs, none, np.inf, defects, np.inf, False, False)
        if not all(np.isfinite(part).all() for part in (after, A, B)):
            return failed
        about = (states, inputs), (A, B, gaps, x - states[0]), given
        curved = partial(self._curved, *about, dear, w, p)
        newton = None if costates is None else curved(costates)
        program = newton or self._program(*about, np.zeros_like(self._weights))
        if program is None:
            return failed
        z, relaxed, solved, *pushes = self._solve(program, dear, relaxed)
        moves, change = program.moves(z)
        gains, blocks = program.along[2], program.blocks
        curvature = program.curvature(z)
        unit = 1 / np.sqrt(np.diagonal(blocks, axis1=1, axis2=2)).ravel()  # so that inputs of any units count alike
        parts = (program.by_state, program.by_input, program.gradient + curvature)
        balance = max(*(_largest(part * unit) for part in parts), _largest(program.lost * unit), TINY)
        stationarity = _largest(curvature * unit) / balance
        still = _largest(change / self._extent) if np.isfinite(self._extent).all() else np.inf
        if still < stationarity:
            gain = -float(program.gradient @ z + 0.5 * z @ curvature)
            cost = max(abs(cost_of(self.problem, *program.start[::-1], given)), program.lost_cost, TINY)
            stationarity = min(stationarity, max(still, abs(gain) / cost))
        costs = partial(self._costates, program, moves, change, *pushes)
        size = max(_largest(moves / self.size), _largest(change / self.input_size))
        found = moves, change, gains, size, defects, stationarity
        return Step(*found, relaxed, solved, newton is not None, costs, curved)

    def _curved(self, plan: tuple[Array, Array], about: tuple[Array, ...], given: Given, dear: float, w: Array,
                p: Array, costates: Array) -> _Program | None:  # fmt: skip
        """Program with the model's curvature, None where it is not convex along the limits that push."""
        bend = self._held(plan, about, costates, dear, given)
        bend[:-1] += self.model.curvature(plan[0][:-1], plan[1], w, p, costates)
        return self._program(plan, about, given, bend)

    def _held(self, plan: tuple[Array, Array], about: tuple[Array, ...], costates: Array, dear: float,
              given: Given) -> Array:  # fmt: skip
        """Curvature (N + 1, nx + nu, nx + nu) that a price of moves across limits which push adds.

        No move along them pays it, so what the program comes to is the same, and the Hessian is positive definite where
        it is along the limits (Debreu, Econometrica 20, 1952).
        """
        A, B = about[:2]
        rows, (N, nx, nu) = self._rows, B.shape
        by_state, by_input = self._slopes(*deviations(*plan, given))
        push = np.zeros((N + 1, nx + nu))
        push[1:, :nx] = costates - by_state[1:]
        push[1:-1, :nx] -= (costates[1:, None] @ A[1:])[:, 0]
        push[:-1, nx:] = -by_input - (costates[:, None] @ B)[:, 0]
        near = np.flatnonzero(self._room(*plan, given) <= FEASIBLE * rows.units)
        sides = np.hstack([rows.by_state[near], rows.by_input[near]])
        acting = ((sides * push[rows.steps[near]]).sum(axis=1) > 0) & ~rows.by_before[near].any(axis=1)
        sides, near = sides[acting] / rows.units[near[acting], None], near[acting]
        found = np.zeros_like(self._weights)
        np.add.at(found, rows.steps[near], 2 * dear * sides[:, :, None] * sides[:, None])
        return found

    def _costates(self, program: _Program, moves: Array, change: Array, taken: Array, pushes: Array) -> Array:
        """Costates (N, nx) of the states from the second on, for the multipliers of the rows taken."""
        rows, N = self._rows, self.problem.horizon
        error, effort = deviations(program.plan[0] + moves, program.plan[1] + change, program.given)
        by_state, by_input = self._slopes(error, effort, _weighed(program.bend, moves, change))
        by_input = np.vstack([by_input, 0 * by_input[:1]])
        steps, push = rows.steps[taken], pushes[:, None]
        np.add.at(by_state, steps, push * rows.by_state[taken])
        np.add.at(by_input, steps, push * rows.by_input[taken])
        np.add.at(by_input, steps - 1, push * rows.by_before[taken])
        return np.asarray(pulled(*program.along[:3], by_state[None], by_input[None, :N].copy())[1][0, 1:])

    def _hessian(self, A: Array, B: Array, gains: Array, weights: Array) -> Array:
        """Hessian (1, n, n) by v."""
        problem, n, N = self.problem, self.n, self.problem.horizon
        units, nothing = np.eye(n).reshape(n, N, problem.nu), np.zeros(problem.nx)
        states, inputs = moved(A, B, gains, np.zeros((N, problem.nx)), nothing, units)
        Z = np.concatenate([states, np.append(inputs, 0 * inputs[:, :1], axis=1)], axis=2).transpose(1, 2, 0)
        H = 2 * Z.reshape(-1, n).T @ (weights @ Z).reshape(-1, n)
        return np.asarray((H + H.T) / 2)[None]

    def _program(self, plan: tuple[Array, Array], about: tuple[Array, ...], given: Given,
                 bend: Array) -> _Program | None:  # fmt: skip
        """Program in v about the plan of v = 0; None where it is not convex, or no numbers."""
        A, B, gaps, first = about
        weights = self._weights + bend / 2
        try:
            gains, deviating = gains_along(A, B, weights if self._separate else self._regulated)
            blocks = 2 * deviating if self._separate else self._hessian(A, B, gains, weights)
            roots = _roots(blocks)
        except np.linalg.LinAlgError:  # not convex, or slopes so steep that their products are no numbers
            return None
        if not np.isfinite(roots).all():
            return None
        along = A, B, gains, gaps, first
        drift, lead = moved(*along, np.zeros((1, *plan[1].shape)))
        states, inputs = plan[0] + drift[0], plan[1] + lead[0]
        error, effort = deviations(states, inputs, given)
        slopes = [self._slopes(error, effort, _weighed(bend, drift[0], lead[0]))]
        lost_cost = 0.0
        if "x_ref" in given or "u_ref" in given:
            slopes.append(self._slopes(states - error, inputs - effort))
            lost_cost = rounding_of_cost(self.problem, given)
        # what states cost and what inputs cost, apart
        by_state = np.concatenate([np.stack([of_states, 0 * of_states]) for of_states, _ in slopes])
        by_input = np.concatenate([np.stack([0 * of_inputs, of_inputs]) for _, of_inputs in slopes])
        own, other, *lost = pulled(*along[:3], by_state, by_input)[0].reshape(-1, self.n)
        left = COST_ROUNDING * np.abs(lost).sum(axis=0) if lost else np.zeros(self.n)
        return _Program(plan, (states, inputs), along, given, bend, blocks, roots, own, other, left, lost_cost)

    def _slopes(self, error: Array, effort: Array, bent: Any = 0.0) -> tuple[Array, Array]:
        """Slopes of the cost by states (N + 1, nx) and inputs (N, nu); `bent` is what the curvature adds."""
        along = 2 * _weighed(self._weights, error, effort) + bent
        return along[:, : self.problem.nx], along[:-1, self.problem.nx :]

    def _room(self, states: Array, inputs: Array, given: Given) -> Array:
        """Room (m,) that a plan leaves to each limit: inputs, rates, states, end."""
        problem = self.problem
        H, h = problem.input_rows
        room = [(h - inputs @ H.T).ravel()]
        if problem.rate_limit is not None:
            moves = np.diff(inputs, axis=0, prepend=given["u_prev"][None])
            room += [(problem.rate_limit - moves).ravel(), (problem.rate_limit + moves).ravel()]
        H, h = problem.state_rows
        end, at_end = problem.terminal_rows
        return np.concatenate([*room, (h - states[1:] @ H.T).ravel(), at_end - end @ states[-1]])

    def _solve(self, program: _Program, dear: float, relaxed: bool) -> tuple[Array, bool, bool, Array, Array]:
        """Variables, whether limits were relaxed, whether it was solved, rows taken in and their multipliers."""
        if self.problem.soft is not None:
            return self._within(program, self.problem.soft, False)
        if not relaxed:
            found = self._within(program, None, False)
            if found[2] or not len(self._prices):
                return found
        return self._within(program, (dear, dear), True)

    def _within(self, program: _Program, price: Any, relaxed: bool) -> tuple[Array, bool, bool, Array, Array]:
        """Solution as of `_solve`, violations at a linear and quadratic price or not allowed."""
        rows, n = self._rows, self.n
        q, size = _times(program.roots, program.gradient[None])[0], 0.0
        if price is not None:  # a violation of this size has the quadratic cost ½
            size = 1 / np.sqrt(2 * price[1])
            q = np.concatenate([q, np.full(self.problem.horizon, price[0] * size)])
        others, bounds = len(rows.units) - len(self._prices), self._room(*program.start, program.given)
        fresh = np.flatnonzero(self._room(*program.plan, program.given) <= PRIMAL * rows.units)
        taken, matrix = np.zeros(0, dtype=int), np.zeros((0, len(q)))
        while True:
            more, least = np.zeros((len(fresh), len(q))), np.zeros((0, len(q)))
            more[:, :n] = _times(program.roots, rows.pulled(program.along, fresh))
            taken, matrix = np.concatenate([taken, fresh]), np.vstack([matrix, more])
            if price is not None:
                of_states = np.flatnonzero(taken >= others)
                places = n + rows.steps[taken[of_states]] - 1
                matrix[of_states, places] = -self._prices[taken[of_states] - others] * size
                least = -np.eye(len(q))[np.unique(places)]
            sides = np.concatenate([bounds[taken], np.zeros(len(least))])
            units = np.concatenate([rows.units[taken], np.ones(len(least))])
            y, pushes, solved = _least(q, np.vstack([matrix, least]), sides, units)
            z = (program.roots @ y[:n].reshape(*program.shape, 1)).ravel()
            moves, change = program.moves(z)
            room = self._room(program.plan[0] + moves, program.plan[1] + change, program.given) / rows.units
            room[taken] = np.inf
            passed = np.count_nonzero(room < -PRIMAL)
            if not (solved and passed):
                return z, relaxed, solved, taken, pushes[: len(taken)]
            fresh = np.argsort(room)[: min(max(passed, len(taken)), len(room) - len(taken))]


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of all limits, each of one step (m,).

    They are slopes by its state (m, nx), its input and the input before it (m, nu).
    """

    steps: Array
    by_state: Array
    by_input: Array
    by_before: Array
    units: Array

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


def _rows(problem: MPCProblem) -> _Rows:
    """Rows of the limits in the order of `Sequential._room`."""
    N, nx, nu = problem.horizon, problem.nx, problem.nu
    H, end, acting = problem.state_rows[0], problem.terminal_rows[0], problem.input_rows[0]
    units = problem.row_units
    parts = [(np.arange(N), np.zeros((len(acting), nx)), acting, 0 * acting, units["input"])]
    if problem.rate_limit is not None:
        one, rate = np.eye(nu), np.asarray(problem.rate_limit)
        parts += [(np.arange(N), np.zeros((nu, nx)), sign * one, -sign * one, rate) for sign in (1, -1)]
    for steps, rows, unit in ((np.arange(1, N + 1), H, units["state"]), (np.array([N]), end, units["terminal"])):
        none = np.zeros((len(rows), nu))
        parts.append((steps, rows, none, none, unit))
    each = [(np.repeat(steps, len(unit)), *(np.tile(one, (len(steps), 1)) for one in rows), np.tile(unit, len(steps)))
            for steps, *rows, unit in parts]  # fmt: skip
    found = _Rows(*(np.concatenate(part) for part in zip(*each)))
    found.by_before[found.steps == 0] = 0.0  # that input is known
    return found


def weights_along(N: int, Q: Array, R: Array, S: Array, P: Array) -> Array:
    """Weights (N + 1, nx + nu, nx + nu) of every step and the end."""
    found = np.tile(np.block([[Q, S], [S.T, R]]), (N + 1, 1, 1))
    found[N] = 0.0
    found[N, : len(Q), : len(Q)] = P
    return found


def _weighed(weights: Array, states: Array, inputs: Array) -> Array:
    """Products (N + 1, nx + nu) of matrices with states (N + 1, nx) and inputs (N, nu)."""
    return np.asarray(weights @ np.hstack([states, np.vstack([inputs, 0 * inputs[:1]])])[:, :, None])[:, :, 0]


def _roots(blocks: Array) -> Array:
    """Roots T with T'HT = 1 of blocks of H (b, n/b, n/b), an error where one is not positive definite."""
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
    result = DenseQP(np.eye(len(own)), seen.T, units).solve(own, bounds)
    return basis @ (result.z + own) - q, result.multipliers, not result.infeasible


def rounding_of_cost(problem: MPCProblem, given: Given) -> float:
    """Cost of states and inputs at their references but for rounding."""
    nothing = np.zeros((problem.horizon + 1, problem.nx)), np.zeros((problem.horizon, problem.nu))
    error, effort = deviations(*nothing, given)
    return COST_ROUNDING**2 * cost_of(problem, effort, error, {})


def _largest(values: Array) -> float:
    """Largest size of an entry."""
    return float(np.abs(values).max(initial=0.0))
