"""One step of sequential quadratic programming for a discrete plan: linearise along it, condense, solve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from mpc.checks import Array
from mpc.dense_qp import DenseQP
from mpc.optimal_control.discrete_model import DiscreteModel
from mpc.problem import MPCProblem
from mpc.rollout import Given, cost_of, relative_violations

TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class Step:
    """What one quadratic program says of a plan.

    Attributes
    ----------
    states, inputs : (N + 1, nx) and (N, nu) arrays
        What it moves the plan by.
    defects : float
        Largest gap in the plan between a state and what the model makes of the one before it, in sizes of the states.
    stationarity : float
        Of the plan with the multipliers of the program, relative to the gradients that balance; or how far inputs
        would still move, in parts of their limits, where that is less.
    decrease : float
        Of the cost and the price of the gaps, as the program promises it.
    gap_price, limit_price : float
        What a merit must charge for a gap of one size, and for a limit violated by one unit.
    relaxed : bool
        Whether limits of states had to be relaxed.
    solved : bool
        Whether the program was.
    """

    states: Array
    inputs: Array
    defects: float
    stationarity: float
    decrease: float
    gap_price: float
    limit_price: float
    relaxed: bool
    solved: bool


class Sequential:
    """The quadratic programs of a statement: cost and limits of `problem`, the dynamics of `model`."""

    def __init__(self, problem: MPCProblem, model: DiscreteModel) -> None:
        self.problem = problem
        self.model = model
        N, nu = problem.horizon, problem.nu
        self.n = N * nu
        H, h = problem.input_rows
        self._input_rows = np.kron(np.eye(N), H)
        self._input_bounds = np.tile(h, N)
        self._moves = np.kron(np.eye(N) - np.eye(N, k=-1), np.eye(nu))
        self._weights = np.concatenate([np.tile(problem.Q, (N, 1, 1)), problem.P[None]])
        self._efforts = 2 * np.kron(np.eye(N), problem.R)
        self.size = problem.state_extent
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

    def step(self, x: Array, states: Array, inputs: Array, w: Array, p: Array, given: Given, dear: float) -> Step:
        """The quadratic program at a plan of states (N + 1, nx) and inputs (N, nu), from the state x (nx,).

        `dear` is the price of a violation that cannot be avoided.
        """
        problem, N = self.problem, self.problem.horizon
        next_states, A, B = self.model.linearised(states[:-1], inputs, w, p)
        gaps = next_states - states[1:]
        G, drift = self._responses(A, B, gaps, x - states[0])
        error, effort = self.deviations(states + drift, inputs, given)
        weighted = self._weights @ G
        flat = G.reshape(-1, self.n)
        H = 2 * flat.T @ weighted.reshape(-1, self.n) + self._efforts
        pulls = [2 * error.ravel() @ weighted.reshape(-1, self.n), self._efforts @ effort.ravel()]
        gradient = pulls[0] + pulls[1]
        if problem.S is not None:
            cross = np.einsum("kin,ij->knj", G[:-1], problem.S).transpose(1, 0, 2).reshape(self.n, self.n)
            H = H + 2 * (cross + cross.T)
            gradient = gradient + 2 * (error[:-1] @ problem.S).ravel() + 2 * cross @ effort.ravel()
        rows, bounds = self._limits(states + drift, inputs, G, given)
        z, limit_price, relaxed, solved = self._solve(H, gradient, rows, bounds, dear)
        moved = drift + (G @ z)
        curvature = H @ z
        balance = max(*(float(np.abs(pull).max()) for pull in pulls), float(np.abs(gradient + curvature).max()), TINY)
        extent = np.tile(np.where(problem.input_extent > 0, problem.input_extent, np.inf), N)
        still = float(np.abs(z / extent).max()) if np.isfinite(extent).all() else np.inf
        costates = np.abs(2 * error @ problem.Q).max() if len(error) else 0.0
        distance = float(np.abs(gaps / self.size).max(initial=0.0))
        first = float(np.abs((x - states[0]) / self.size).max())
        return Step(
            states=moved, inputs=z.reshape(N, -1), defects=max(distance, first),
            stationarity=min(float(np.abs(curvature).max()) / balance, still),
            decrease=float(-(gradient @ z + 0.5 * z @ curvature)),
            gap_price=2.0 * float(costates * self.size.max() * N), limit_price=limit_price, relaxed=relaxed,
            solved=solved,
        )  # fmt: skip

    def _responses(self, A: Array, B: Array, gaps: Array, first: Array) -> tuple[Array, Array]:
        """How states answer to inputs, (N + 1, nx, N nu), and where gaps alone take them, (N + 1, nx)."""
        N, nx, nu = B.shape
        G = np.zeros((N + 1, nx, self.n))
        drift = np.empty((N + 1, nx))
        drift[0] = first
        for k in range(N):
            G[k + 1, :, : k * nu] = A[k] @ G[k, :, : k * nu]
            G[k + 1, :, k * nu : (k + 1) * nu] = B[k]
            drift[k + 1] = A[k] @ drift[k] + gaps[k]
        return G, drift

    def deviations(self, states: Array, inputs: Array, given: Given) -> tuple[Array, Array]:
        """States and inputs from their references, where there are some."""
        error = states - given["x_ref"].reshape(states.shape) if "x_ref" in given else states
        return error, inputs - given["u_ref"].reshape(inputs.shape) if "u_ref" in given else inputs

    def _limits(self, states: Array, inputs: Array, G: Array, given: Given) -> tuple[Array, Array]:
        """Rows and bounds of the moves: inputs, rates, then states and the end."""
        problem = self.problem
        H, h = problem.state_rows
        end, at_end = problem.terminal_rows
        rows = [self._input_rows]
        bounds = [self._input_bounds - self._input_rows @ inputs.ravel()]
        if problem.rate_limit is not None:
            moves = self._moves @ inputs.ravel()
            moves[: problem.nu] -= given["u_prev"]
            limit = np.tile(problem.rate_limit, problem.horizon)
            rows += [self._moves, -self._moves]
            bounds += [limit - moves, limit + moves]
        rows += [(H @ G[1:]).reshape(-1, self.n), end @ G[-1]]
        bounds += [(h - states[1:] @ H.T).ravel(), at_end - end @ states[-1]]
        return np.vstack(rows), np.concatenate(bounds)

    def _solve(
        self, H: Array, gradient: Array, rows: Array, bounds: Array, dear: float
    ) -> tuple[Array, float, bool, bool]:
        """Moves, what a violated limit must cost, whether limits of states were relaxed, and whether it was solved."""
        if self.problem.soft is not None:
            z, solved = self._priced(H, gradient, rows, bounds, *self.problem.soft)
            return z, 0.0, False, solved
        result = DenseQP(H, rows, self._units).solve(gradient, bounds)
        if not result.infeasible or not len(self._prices):
            own = result.multipliers[len(rows) - len(self._prices) :] * self._prices
            price = np.bincount(self._step_of, own, minlength=1).max(initial=0.0)
            return result.z, 2.0 * float(price), False, not result.infeasible
        z, solved = self._priced(H, gradient, rows, bounds, dear, dear)
        return z, dear, True, solved

    def _priced(self, H: Array, gradient: Array, rows: Array, bounds: Array, linear: float,
                quadratic: float) -> tuple[Array, bool]:  # fmt: skip
        """The moves where the largest violation of every step has a price, and whether they were found."""
        N, n = self.problem.horizon, self.n
        columns = np.zeros((len(rows), N))
        first = len(rows) - len(self._prices)
        columns[first + np.arange(len(self._prices)), self._step_of] = -self._prices
        slack = np.hstack([np.zeros((N, n)), -np.eye(N)])
        qp = DenseQP(
            block_diag(H, 2 * quadratic * np.eye(N)), np.vstack([np.hstack([rows, columns]), slack]),
            np.concatenate([self._units, np.ones(N)]),
        )  # fmt: skip
        result = qp.solve(np.concatenate([gradient, np.full(N, linear)]), np.concatenate([bounds, np.zeros(N)]))
        return result.z[:n], not result.infeasible

    def merit(self, x: Array, states: Array, inputs: Array, w: Array, p: Array, given: Given,
              prices: tuple[float, float]) -> float:  # fmt: skip
        """Cost of a plan, with its gaps and, where limits are hard, its violations at their prices."""
        gaps = (self.model.along(states[:-1], inputs, w, p) - states[1:]) / self.size
        first = (x - states[0]) / self.size
        cost = cost_of(self.problem, inputs, states, given) + prices[0] * float(
            np.abs(gaps).sum() + np.abs(first).sum()
        )
        if self.problem.soft is not None:
            return cost
        return cost + prices[1] * float(relative_violations(self.problem, states, self.problem.price_units).sum())
