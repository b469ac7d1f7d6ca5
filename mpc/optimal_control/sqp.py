"""Sequential quadratic programming for discrete plans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from mpc.checks import Array
from mpc.dense_qp import DenseQP
from mpc.feedback import stabilising_weights
from mpc.optimal_control.condensing import compile_kernels, gains_along, responses
from mpc.optimal_control.discrete_model import DiscreteModel
from mpc.problem import MPCProblem
from mpc.rollout import Given, cost_of, deviations
from mpc.tolerances import COST_ROUNDING

TINY = float(np.finfo(float).tiny)  # a divisor that stands for zero


@dataclass(frozen=True, eq=False)
class Step:
    """Result of one quadratic program for a plan."""

    # by what it moves the plan: (N + 1, nx) and (N, nu)
    states: Array
    inputs: Array
    gains: Array  # (N, nu, nx): of the feedback along the plan that keeps it together
    # the largest gap in the plan between a state and what the model makes of the one before it, in sizes of the states
    defects: float
    # of the plan with the multipliers of the program, relative to the gradients that balance; or, where that is less,
    # how far inputs would still move, in parts of their limits, and what part of the cost that would save
    stationarity: float
    relaxed: bool  # whether limits of states had to be relaxed
    solved: bool


@dataclass(frozen=True, eq=False)
class _Program:
    """Minimise ½ z'Hz + (by_state + by_input)'z subject to rows z <= bounds.

    Where states and inputs are at their references, only rounding is left of a linear cost of the size `lost` and of a
    cost of `lost_cost`.
    """

    H: Array
    by_state: Array
    by_input: Array
    lost: Array
    lost_cost: float
    rows: Array
    bounds: Array

    @property
    def gradient(self) -> Array:
        """Linear cost."""
        return self.by_state + self.by_input


class Sequential:
    """Quadratic programs of `problem` with the dynamics of `model`.

    Its variables are v = du + K dx with the gains of the regulator along the plan, for which the Hessian is block
    diagonal and an unstable model does no harm (Rossiter, Kouvaritakis and Rice, Automatica 34(1), 1998).
    """

    def __init__(self, problem: MPCProblem, model: DiscreteModel) -> None:
        self.problem = problem
        self.model = model
        self.n = problem.horizon * problem.nu
        N = problem.horizon
        self._regulated = tuple(np.array(weight, order="C") for weight in stabilising_weights(problem))
        own = (problem.Q, problem.R, problem.cross, problem.P)
        self._separate = all(np.array_equal(one, other) for one, other in zip(own, self._regulated))
        self._weights = np.concatenate([np.tile(problem.Q, (N, 1, 1)), problem.P[None]])
        self._extent = np.where(problem.input_extent > 0, problem.input_extent, np.inf)
        self.size = problem.state_extent
        self.input_size = np.where(problem.input_extent > 0, problem.input_extent, 1.0)
        units, prices = problem.row_units, problem.price_units
        self._state_units = np.concatenate([np.tile(units["state"], N), units["terminal"]])
        self._prices = np.concatenate([np.tile(prices["state"], N), prices["terminal"]])
        self._step_of = np.concatenate(
            [np.repeat(np.arange(N), len(units["state"])), np.full(len(units["terminal"]), N - 1)]
        )
        parts = [np.tile(units["input"], N), self._state_units]
        if problem.rate_limit is not None:
            parts.insert(1, np.tile(problem.rate_limit, 2 * N))
        self._units = np.concatenate(parts)
        compile_kernels()

    def step(
        self, x: Array, states: Array, inputs: Array, w: Array, p: Array, given: Given, dear: float, *,
        relaxed: bool = False,
    ) -> Step:  # fmt: skip
        """Quadratic program at a plan (N + 1, nx), (N, nu) from x (nx,).

        `dear` is the price of a violation that cannot be avoided, or with `relaxed` of every one: linear and quadratic.
        """
        after, A, B = self.model.linearised(states[:-1], inputs, w, p)
        gaps = after - states[1:]
        defects = max(_largest(gaps / self.size), _largest((x - states[0]) / self.size))
        none = np.zeros((self.problem.horizon, self.problem.nu, self.problem.nx))
        failed = Step(states, inputs, none, defects, np.inf, False, False)
        if not all(np.isfinite(part).all() for part in (after, A, B)):
            return failed
        try:
            gains, deviating = gains_along(A, B, *self._regulated)
        except np.linalg.LinAlgError:  # slopes so steep that their products are no numbers
            return failed
        G, F, drift, lead = responses(A, B, gains, gaps, x - states[0])
        curved = _diagonal(2 * deviating) if self._separate else self._hessian(G, F)
        program = self._program(states + drift, inputs + lead, G, F, curved, given)
        if not all(np.isfinite(part).all() for part in (program.H, program.gradient, program.rows, program.bounds)):
            return failed
        z, relaxed, solved = self._solve(program, dear, relaxed)
        moved, change = drift + G @ z, lead + F @ z
        curvature = program.H @ z
        unit = 1 / np.sqrt(np.diag(program.H))  # so that inputs of any units count alike
        parts = (program.by_state, program.by_input, program.gradient + curvature)
        balance = max(*(_largest(part * unit) for part in parts), _largest(program.lost * unit), TINY)
        stationarity = _largest(curvature * unit) / balance
        still = _largest(change / self._extent) if np.isfinite(self._extent).all() else np.inf
        if still < stationarity:
            gain = -float(program.gradient @ z + 0.5 * z @ curvature)
            cost = max(abs(cost_of(self.problem, inputs + lead, states + drift, given)), program.lost_cost, TINY)
            stationarity = min(stationarity, max(still, abs(gain) / cost))
        return Step(moved, change, gains, defects, stationarity, relaxed, solved)

    def _hessian(self, G: Array, F: Array) -> Array:
        """Hessian by v, for state responses G and input responses F."""
        problem, n = self.problem, self.n
        flat, acting = G.reshape(-1, n), F.reshape(-1, n)
        H = 2 * (flat.T @ (self._weights @ G).reshape(-1, n) + acting.T @ (problem.R @ F).reshape(-1, n))
        across = (problem.cross @ F).reshape(-1, n)
        cross = flat[: len(across)].T @ across
        H = H + 2 * (cross + cross.T)
        return np.asarray((H + H.T) / 2)

    def _program(self, states: Array, inputs: Array, G: Array, F: Array, H: Array, given: Given) -> _Program:
        """Program in v about the plan of v = 0."""
        problem, n = self.problem, self.n
        error, effort = deviations(states, inputs, given)
        flat, acting = G.reshape(-1, n), F.reshape(-1, n)
        by_state, by_input = self._slopes(error, effort)
        lost, lost_cost = np.zeros(n), 0.0
        if "x_ref" in given or "u_ref" in given:
            x_ref, u_ref = states - error, inputs - effort
            of_states, of_inputs = self._slopes(x_ref, u_ref)
            terms = np.abs(of_states).ravel() @ np.abs(flat) + np.abs(of_inputs).ravel() @ np.abs(acting)
            lost = COST_ROUNDING * terms
            lost_cost = rounding_of_cost(problem, given)
        rows, bounds = self._limits(states, inputs, G, F, given)
        return _Program(H, by_state.ravel() @ flat, by_input.ravel() @ acting, lost, lost_cost, rows, bounds)

    def _slopes(self, error: Array, effort: Array) -> tuple[Array, Array]:
        """Slopes of the cost by states (N + 1, nx) and inputs (N, nu)."""
        problem = self.problem
        by_state = 2 * (self._weights @ error[:, :, None])[:, :, 0]
        by_state[:-1] += 2 * effort @ problem.cross.T
        return by_state, 2 * effort @ problem.R + 2 * error[:-1] @ problem.cross

    def _limits(self, states: Array, inputs: Array, G: Array, F: Array, given: Given) -> tuple[Array, Array]:
        """Rows and bounds of v: inputs, rates, states, end."""
        problem, n = self.problem, self.n
        H, h = problem.input_rows
        rows = [(H @ F).reshape(-1, n)]
        bounds = [(h - inputs @ H.T).ravel()]
        if problem.rate_limit is not None:
            moves = np.diff(inputs, axis=0, prepend=given["u_prev"][None]).ravel()
            answers = np.diff(F, axis=0, prepend=np.zeros((1, problem.nu, n))).reshape(-1, n)
            limit = np.tile(problem.rate_limit, problem.horizon)
            rows += [answers, -answers]
            bounds += [limit - moves, limit + moves]
        H, h = problem.state_rows
        end, at_end = problem.terminal_rows
        rows += [(H @ G[1:]).reshape(-1, n), end @ G[-1]]
        bounds += [(h - states[1:] @ H.T).ravel(), at_end - end @ states[-1]]
        return np.vstack(rows), np.concatenate(bounds)

    def _solve(self, program: _Program, dear: float, relaxed: bool) -> tuple[Array, bool, bool]:
        """Variables, whether limits were relaxed, whether it was solved."""
        if self.problem.soft is not None:
            return self._priced(program, *self.problem.soft, False)
        if relaxed:
            return self._priced(program, dear, dear, True)
        result = DenseQP(program.H, program.rows, self._units).solve(program.gradient, program.bounds)
        if not result.infeasible or not len(self._prices):
            return result.z, False, not result.infeasible
        return self._priced(program, dear, dear, True)

    def _priced(self, program: _Program, linear: float, quadratic: float, relaxed: bool) -> tuple[Array, bool, bool]:
        """Solution as of `_solve`, with priced violations per step."""
        N, n, m = self.problem.horizon, self.n, len(program.rows)
        columns = np.zeros((m, N))
        columns[m - len(self._prices) + np.arange(len(self._prices)), self._step_of] = -self._prices
        slack = np.hstack([np.zeros((N, n)), -np.eye(N)])
        qp = DenseQP(
            block_diag(program.H, 2 * quadratic * np.eye(N)), np.vstack([np.hstack([program.rows, columns]), slack]),
            np.concatenate([self._units, np.ones(N)]),
        )  # fmt: skip
        result = qp.solve(
            np.concatenate([program.gradient, np.full(N, linear)]), np.concatenate([program.bounds, np.zeros(N)])
        )
        return result.z[:n], relaxed, not result.infeasible


def rounding_of_cost(problem: MPCProblem, given: Given) -> float:
    """Cost of states and inputs at their references but for rounding."""
    nothing = np.zeros((problem.horizon + 1, problem.nx)), np.zeros((problem.horizon, problem.nu))
    error, effort = deviations(*nothing, given)
    return COST_ROUNDING**2 * cost_of(problem, effort, error, {})


def _diagonal(blocks: Array) -> Array:
    """Block diagonal matrix (N m, N m) of blocks (N, m, m)."""
    N, m, _ = blocks.shape
    whole = np.zeros((N, m, N, m))
    whole[np.arange(N), :, np.arange(N)] = blocks
    return whole.reshape(N * m, N * m)


def _largest(values: Array) -> float:
    """Largest size of an entry."""
    return float(np.abs(values).max(initial=0.0))
