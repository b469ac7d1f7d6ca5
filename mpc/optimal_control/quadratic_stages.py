"""Quadratic costs and polytopes along a plan of a nonlinear model, for quadratic programs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np

from mpc.checks import Array
from mpc.exceptions import NotConvexError
from mpc.feedback import stabilising_weights
from mpc.optimal_control.condensing import compile_kernels
from mpc.optimal_control.discrete_model import DiscreteModel
from mpc.optimal_control.local_statement import Local, Multipliers, Rows, both
from mpc.optimal_control.step_program import convex
from mpc.problem import MPCProblem
from mpc.rollout import Given, cost_of, deviations, disturbance, references
from mpc.tolerances import COST_ROUNDING


@dataclass(frozen=True, eq=False)
class QuadraticStages:
    """Statement of `problem` with the dynamics of `model` for parameters p (np,)."""

    problem: MPCProblem
    model: DiscreteModel
    p: Array

    def __post_init__(self) -> None:
        problem, N = self.problem, self.problem.horizon
        compile_kernels()
        rest = np.zeros((N + 1, problem.nx)), np.zeros((N, problem.nu))
        A, B = (np.tile(matrix, (N, 1, 1)) for matrix in (problem.A, problem.B))
        if not convex(self._local(*rest, (A, B, rest[0][1:], rest[0][0]), {"u_prev": rest[1][0]})):
            got = "one along the model at rest that is not positive definite; some input is free of cost"
            cure = "Make R positive definite, or let Q and P see every input."
            raise NotConvexError("Hessian", got, "a positive definite one", cure, 0.0)

    @cached_property
    def sizes(self) -> tuple[Array, Array]:
        """Sizes of states and inputs."""
        extent = self.problem.input_extent
        return self.problem.state_extent, np.where(extent > 0, extent, 1.0)

    @cached_property
    def rows(self) -> Rows:
        """Rows of inputs, rates, states, end."""
        problem, N, nx, nu = self.problem, self.problem.horizon, self.problem.nx, self.problem.nu
        H, end, acting = problem.state_rows[0], problem.terminal_rows[0], problem.input_rows[0]
        units, prices = problem.row_units, problem.price_units
        parts: list[tuple[Any, ...]] = [
            (np.arange(N), np.zeros((len(acting), nx)), acting, 0 * acting, units["input"], None)
        ]
        if problem.rate_limit is not None:
            one, rate = np.eye(nu), np.asarray(problem.rate_limit)
            parts += [(np.arange(N), np.zeros((nu, nx)), sign * one, -sign * one, rate, None) for sign in (1, -1)]
        for steps, rows, name in ((np.arange(1, N + 1), H, "state"), (np.array([N]), end, "terminal")):
            none = np.zeros((len(rows), nu))
            parts.append((steps, rows, none, none, units[name], prices[name]))
        return Rows.of_kinds(parts)

    @cached_property
    def _weights(self) -> Array:
        """Weights of the cost."""
        problem = self.problem
        return weights_along(problem.horizon, problem.Q, problem.R, problem.cross, problem.P)

    @cached_property
    def _regulated(self) -> Array | None:
        """Weights of gains where those of the cost let predictions grow."""
        weights = weights_along(self.problem.horizon, *stabilising_weights(self.problem))
        return None if np.array_equal(weights, self._weights) else weights

    def at(self, x: Array, states: Array, inputs: Array, given: Given) -> Local:
        """Statement at a plan (N + 1, nx), (N, nu) from x (nx,)."""
        after, A, B = self.model.linearised(states[:-1], inputs, disturbance(self.problem, given), self.p)
        return self._local(states, inputs, (A, B, after - states[1:], x - states[0]), given)

    def _local(self, states: Array, inputs: Array, about: tuple[Array, Array, Array, Array], given: Given) -> Local:
        """Statement at a plan with its linearised model."""
        problem, nx = self.problem, self.problem.nx

        def slopes(error: Array, effort: Array) -> tuple[Array, Array]:
            """Slopes of the cost by states and inputs."""
            along = 2 * (self._weights @ both(error, effort)[:, :, None])[:, :, 0]
            return along[:, :nx], along[:-1, nx:]

        def hessian(multipliers: Multipliers) -> Array:
            """Hessian of the Lagrangian."""
            w, found = disturbance(problem, given), 2 * self._weights
            found[:-1] += self.model.curvature(states[:-1], inputs, w, self.p, multipliers.costates)
            return found

        error, effort = deviations(states, inputs, given)
        referred, extent = "x_ref" in given or "u_ref" in given, problem.input_extent
        return Local(
            states, inputs, about, *slopes(error, effort), lambda: 2 * self._weights, hessian, self.rows,
            self._room(states, inputs, given), self.sizes, np.where(extent > 0, extent, np.inf),
            cache(lambda: cost_of(problem, inputs, states, given)),
            np.tile((np.inf, np.inf) if problem.soft is None else problem.soft, (self.rows.violations, 1)),
            regulated=self._regulated, lost=slopes(states - error, inputs - effort) if referred else None,
            lost_cost=rounding_of_cost(problem, given) if referred else 0.0,
        )  # fmt: skip

    def _room(self, states: Array, inputs: Array, given: Given) -> Array:
        """Room (m,) that a plan leaves to each limit."""
        problem = self.problem
        H, h = problem.input_rows
        room = [(h - inputs @ H.T).ravel()]
        if problem.rate_limit is not None:
            moves = np.diff(inputs, axis=0, prepend=given["u_prev"][None])
            room += [(problem.rate_limit - moves).ravel(), (problem.rate_limit + moves).ravel()]
        H, h = problem.state_rows
        end, at_end = problem.terminal_rows
        return np.concatenate([*room, (h - states[1:] @ H.T).ravel(), at_end - end @ states[-1]])


def weights_along(N: int, Q: Array, R: Array, S: Array, P: Array) -> Array:
    """Weights (N + 1, nx + nu, nx + nu) of every step and the end."""
    found = np.tile(np.block([[Q, S], [S.T, R]]), (N + 1, 1, 1))
    found[N] = 0.0
    found[N, : len(Q), : len(Q)] = P
    return found


def rounding_of_cost(problem: MPCProblem, given: Given) -> float:
    """Cost of states and inputs at their references but for rounding."""
    states, inputs = references(problem, given)
    return COST_ROUNDING**2 * cost_of(problem, inputs, states, {})
