"""MPC problem stage by stage in scaled variables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpc.checks import Array
from mpc.feedback import block_lengths
from mpc.problem import MPCProblem
from mpc.rollout import Given, no_faster, pushes
from mpc.tolerances import FIRST_GUESS_SHARE, NEGLIGIBLE


@dataclass(frozen=True, eq=False)
class QPStage:
    """ξ⁺ = Aξ + Bν + c at cost ½ξ'Hxξ + gx'ξ + ½ν'Hvν + gv'ν + ξ'Hcν, Cν + Dξ <= d.

    ξ is (x, last input) where the last input matters, ν is (u, t) with t >= 0 the largest violation of the step where
    it has a price; `nu` is the number of entries of u in ν, zero where the input is held and at the end.
    """

    A: Array
    B: Array
    c: Array
    Hx: Array
    gx: Array
    Hv: Array
    gv: Array
    C: Array
    D: Array
    d: Array
    nu: int
    Hc: Array

    def slopes(self, state: Array, variables: Array) -> tuple[Array, Array]:
        """Slope of the cost by ξ and by ν."""
        by_state = self.Hx @ state + self.gx + self.Hc @ variables
        return by_state, self.Hv @ variables + self.gv + self.Hc.T @ state


class StagewiseQP:
    """Stages of a problem from the first state x (nx,) and signals over the horizon, and conversion of units.

    price : (linear, quadratic), of the largest relative violation of each step; None makes the state constraints hard;
    input_size : (nu,), by default what the first state and the references ask for.
    """

    def __init__(
        self, problem: MPCProblem, x: Array, given: Given, price: tuple[float, float] | None,
        input_size: Array | None = None,
    ):  # fmt: skip
        self.problem = problem
        self.price = price
        self.state_size = problem.state_size
        self.input_size = _input_size(problem, x, given) if input_size is None else input_size
        self.memory = problem.nu if problem.rate_limit is not None or problem.blocks is not None else 0
        self.n = problem.nx + self.memory
        self.Q, self.P = (np.asarray(w) * self.state_size * self.state_size[:, None] for w in (problem.Q, problem.P))
        self.R = np.asarray(problem.R) * self.input_size * self.input_size[:, None]
        self.S = problem.stage_weight[: problem.nx, problem.nx :] * self.input_size * self.state_size[:, None]
        self.cost = float(np.trace(self.Q) + np.trace(self.R)) or 1.0
        self.held = np.concatenate([np.arange(length) > 0 for length in block_lengths(problem)])
        last = given.get("u_prev", np.zeros(problem.nu))[: self.memory] / self.input_size[: self.memory]
        self.start = np.concatenate([x / self.state_size, last])
        self.push = pushes(problem, given) / self.state_size
        N = problem.horizon
        self.x_ref = (
            given["x_ref"].reshape(N + 1, -1) / self.state_size if "x_ref" in given else np.zeros((N + 1, problem.nx))
        )
        self.u_ref = given["u_ref"].reshape(N, -1) / self.input_size if "u_ref" in given else np.zeros((N, problem.nu))
        self.stages = [self._stage(k) for k in range(N + 1)]

    def first_guess(self, inputs: Array) -> list[Array]:
        """Strictly admissible variables of every stage near inputs (N, nu)."""
        # towards the middle, within less than the rate limit
        scaled = FIRST_GUESS_SHARE * np.asarray(inputs)
        if self.problem.rate_limit is not None:
            last = self.start[self.problem.nx :] * self.input_size
            scaled = no_faster(scaled, last, FIRST_GUESS_SHARE * self.problem.rate_limit, self.held)
        scaled = scaled / self.input_size
        return [
            np.concatenate([scaled[k] if stage.nu else [], np.zeros(len(stage.gv) - stage.nu)])
            for k, stage in enumerate(self.stages)
        ]

    def plan(self, states: list[Array], variables: list[Array], x: Array) -> tuple[Array, Array]:
        """Inputs (N, nu) and states (N + 1, nx) in plant units."""
        inputs = np.empty((self.problem.horizon, self.problem.nu))
        for k in range(self.problem.horizon):
            inputs[k] = states[k][self.problem.nx :] if self.held[k] else variables[k][: self.problem.nu]
        unscaled = np.array(states)[:, : self.problem.nx] * self.state_size
        unscaled[0] = x
        return inputs * self.input_size, unscaled

    def _stage(self, k: int) -> QPStage:
        """Stage of step k."""
        nx = self.problem.nx
        nu = self.problem.nu
        n = self.n
        last = self.problem.horizon
        free = 0 if k == last or self.held[k] else nu
        priced = int(self.price is not None and k > 0)
        Hx = np.zeros((n, n))
        gx = np.zeros(n)
        Hv = np.zeros((free + priced,) * 2)
        gv = np.zeros(free + priced)
        Hc = np.zeros((n, free + priced))
        weight = 2 * (self.P if k == last else self.Q) / self.cost
        Hx[:nx, :nx] = weight
        gx[:nx] = -weight @ self.x_ref[k]
        if self.price is not None and priced:
            gv[-1] = self.price[0] / self.cost
            Hv[-1, -1] = 2 * self.price[1] / self.cost
        if k < last:
            R = 2 * self.R / self.cost
            S = 2 * self.S / self.cost
            by_input = -R @ self.u_ref[k] - S.T @ self.x_ref[k]
            gx[:nx] -= S @ self.u_ref[k]
            if free:
                Hv[:nu, :nu] = R
                gv[:nu] = by_input
                Hc[:nx, :nu] = S
            else:  # the input is one of the states
                Hx[nx:, nx:] = R
                gx[nx:] = by_input
                Hx[:nx, nx:] = S
                Hx[nx:, :nx] = S.T
        A, B, c = self._dynamics(k, free, priced)
        return QPStage(A, B, c, Hx, gx, Hv, gv, *self._rows(k, free, priced), free, Hc)

    def _dynamics(self, k: int, free: int, priced: int) -> tuple[Array, Array, Array]:
        """Dynamics (A, B, c) of the step after k; zero at the end."""
        nx = self.problem.nx
        n = self.n
        m = self.memory
        A = np.zeros((n, n))
        B = np.zeros((n, free + priced))
        c = np.zeros(n)
        if k == self.problem.horizon:
            return A, B, c
        A[:nx, :nx] = self.problem.A / self.state_size[:, None] * self.state_size
        drive = self.problem.B / self.state_size[:, None] * self.input_size
        if free:
            B[:nx, :free] = drive
            B[nx:, :m] = np.eye(m)
        else:
            A[:nx, nx:] = drive
            A[nx:, nx:] = np.eye(m)
        c[:nx] = self.push[k]
        return A, B, c

    def _rows(self, k: int, free: int, priced: int) -> tuple[Array, Array, Array]:
        """Rows (C, D, d) of step k in units of their bounds."""
        nx, n, width = self.problem.nx, self.n, self.n + free + priced
        rows = [np.zeros((0, width))]  # on (ξ, ν)
        bounds = [np.zeros(0)]
        units = self.problem.row_units if self.problem.soft is None else self.problem.price_units
        if free:
            H, h = self.problem.rows_at("input", k)
            J = np.zeros((len(h), width))
            J[:, n : n + free] = H * self.input_size / units["input"][:, None]
            rows.append(J)
            bounds.append(h / units["input"])
            if self.problem.rate_limit is not None:
                both = np.vstack([np.eye(free), -np.eye(free)]) * self.input_size / units["rate"][:, None]
                J = np.zeros((2 * free, width))
                J[:, n : n + free] = both
                J[:, nx:n] = -both
                rows.append(J)
                bounds.append(np.ones(2 * free))
        for kind in ["state"] * (k > 0) + ["terminal"] * (k == self.problem.horizon):
            H, h = self.problem.rows_at(kind, k)
            J = np.zeros((len(h), width))
            J[:, width - priced :] = -1.0
            J[:, :nx] = H * self.state_size / units[kind][:, None]
            rows.append(J)
            bounds.append(h / units[kind])
        rows.append(-np.eye(width)[width - priced :])
        bounds.append(np.zeros(priced))
        D, C = (np.ascontiguousarray(part) for part in np.split(np.vstack(rows), [n], axis=1))
        return C, D, np.concatenate(bounds)


def _input_size(problem: MPCProblem, x: Array, given: Given) -> Array:
    """Size (nu,) of the inputs by limits or weights.

    Limits of 1e6 on an input say nothing of its size, and a solver's tolerance is a part of it.
    """
    N = problem.horizon
    reach = np.abs(x) + NEGLIGIBLE * problem.state_size
    asked = np.zeros(problem.nu)
    if "x_ref" in given:
        reach = reach + np.abs(given["x_ref"].reshape(N + 1, -1)).max(axis=0)
    if "u_ref" in given:
        asked = np.abs(given["u_ref"].reshape(N, -1)).max(axis=0)
    spent = float(np.sqrt(reach @ np.abs(problem.P) @ reach))
    if problem.S is not None:  # u = -R⁻¹S'x may cost nothing together with x, where alone it costs as much as x
        spent += float(np.sqrt(reach @ np.abs(problem.Q) @ reach))
    weight = np.sqrt(np.diag(np.asarray(problem.R)))
    regulated = np.where(weight > 0, spent / np.where(weight > 0, weight, 1.0) + asked, np.inf)
    size = np.minimum(np.where(problem.input_extent > 0, problem.input_extent, np.inf), regulated)
    return np.where(np.isfinite(size) & (size > 0), size, 1.0)
