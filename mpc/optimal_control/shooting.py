"""Nonlinear program of a discrete plan for a kept interior-point solver."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array
from mpc.optimal_control.functions import symbols_of
from mpc.optimal_control.ipopt import ONE_AT_A_TIME
from mpc.problem import MPCProblem
from mpc.rollout import Given
from mpc.tolerances import INTERIOR_POINT


class ShootingProgram:
    """Program of a problem with the dynamics `step`, unknowns and rows in the order of time.

    A stage has the state, with a rate limit the input before it, with `priced` limits of states their violation; then
    inputs. What depends on p or changes from call to call is a parameter: one program serves all problems with these
    weights and limits. The solver is Ipopt, of `most` iterations and `seconds` at most; Fatrop, mostly
    faster, does not return where the model is no number.
    """

    def __init__(self, problem: MPCProblem, step: ca.Function, *, priced: bool, most: int, seconds: float) -> None:
        self._made_of = (problem, step, priced, most, seconds)
        self.priced = priced
        self.limited = problem.rate_limit is not None
        self.size_u = np.where(problem.input_extent > 0, problem.input_extent, 1.0)
        # of what a stage carries besides the state, and of what moves it
        self.carried = np.concatenate([self.size_u if self.limited else [], [1.0] if priced else []])
        self.moves = np.concatenate([self.size_u, [1.0] if priced else []])
        self._statement, self._equal = _program(self, problem, step)
        self._most, self._seconds = most, seconds

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, self._made_of

    def solve(self, law: MPCProblem, x: Array, states: Array, inputs: Array, w: Array, p: Array, given: Given, *,
              cost: float, prices: tuple[float, float]) -> tuple[Array, Array] | None:  # fmt: skip
        """Plan that the solver comes to from another; None of no numbers.

        Whether it is an optimum or where the solver stopped, a quadratic program there tells. `cost` is the size of the
        cost, `prices` are those of a violation, linear and quadratic.
        """
        N, nx, nu = law.horizon, law.nx, law.nu
        signals = {"x_ref": np.zeros((N + 1) * nx), "u_ref": np.zeros(N * nu), "u_prev": np.zeros(nu)} | given
        H, h = law.terminal_rows
        parameters = np.concatenate([
            law.state_extent, x, w.ravel(), p, signals["x_ref"], signals["u_ref"], signals["u_prev"], law.P.ravel(),
            [1 / cost], prices, law.price_units["state"], H.ravel(order="F"), h, law.price_units["terminal"],
        ])  # fmt: skip
        guess = self._placed(states / law.state_extent, inputs / self.size_u, signals["u_prev"] / self.size_u)
        if not (np.isfinite(guess).all() and np.isfinite(parameters).all()):
            return None
        with ONE_AT_A_TIME:
            found = self._solver(x0=guess, p=parameters, lbg=np.where(self._equal, 0.0, -np.inf), ubg=0.0)
        stages, end = np.split(np.asarray(found["x"]).ravel(), [-(nx + len(self.carried))])
        stages, first = stages.reshape(N, -1), nx + len(self.carried)
        scaled = np.vstack([stages[:, :nx], end[:nx]])
        return scaled * law.state_extent, stages[:, first : first + nu] * self.size_u

    def _placed(self, states: Array, inputs: Array, last: Array) -> Array:
        """Unknowns from a scaled plan, without violations."""
        N = len(inputs)
        none = [np.zeros((N + 1, 1))] * self.priced
        stages = np.hstack([states, *[np.vstack([last, inputs])] * self.limited, *none])
        return np.concatenate([np.hstack([stages[:-1], inputs, *(part[1:] for part in none)]).ravel(), stages[-1]])

    def build(self) -> None:
        """Make the solver now, before a clock runs."""
        _ = self._solver

    @cached_property
    def _solver(self) -> Any:
        """Ipopt for the statement, built on demand."""
        limit = {"ipopt.max_wall_time": self._seconds} if np.isfinite(self._seconds) else {}
        return ca.nlpsol("plan", "ipopt", self._statement, limit | {
            "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": INTERIOR_POINT, "ipopt.max_iter": self._most,
            "print_time": False, "show_eval_warnings": False, "calc_lam_p": False,
        })  # fmt: skip


def _rebuilt(problem: MPCProblem, step: ca.Function, priced: bool, most: int, seconds: float) -> ShootingProgram:
    """Program made anew, without its solver."""
    return ShootingProgram(problem, step, priced=priced, most=most, seconds=seconds)


def _program(own: ShootingProgram, law: MPCProblem, step: ca.Function) -> tuple[dict[str, Any], Array]:
    """Unknowns, parameters, cost and rows ≤ 0; which of the rows are = 0."""
    N, nx, nu, rows, ends = law.horizon, law.nx, law.nu, len(law.state_rows[1]), len(law.terminal_rows[1])
    sizes = {"size": nx, "x": nx, "w": N * step.numel_in(2), "p": step.numel_in(3), "x_ref": (N + 1) * nx,
             "u_ref": N * nu, "u_prev": nu, "P": nx * nx, "unit": 1, "prices": 2, "of_state": rows, "H": ends * nx,
             "h": ends, "of_end": ends}  # fmt: skip
    given = {name: ca.MX.sym(name, size) for name, size in sizes.items()}
    x_ref, u_ref = ca.reshape(given["x_ref"], nx, N + 1), ca.reshape(given["u_ref"], nu, N)
    w = ca.reshape(given["w"], step.numel_in(2), N)
    stages = [ca.MX.sym(f"stage_{k}", nx + len(own.carried)) for k in range(N + 1)]
    moves = [ca.MX.sym(f"moves_{k}", len(own.moves)) for k in range(N)]
    after = _next_stage(own, step)
    stage_cost, input_rows, state_rows = _of_a_stage(own, law)
    kept: list[tuple[Any, bool]] = []
    cost: Any = 0
    for k, (stage, move) in enumerate(zip(stages, moves)):
        kept.append((stages[k + 1] - after(stage, move, w[:, k], given["p"], given["size"]), True))
        if k == 0:
            last = [given["u_prev"] / own.size_u] * own.limited + [ca.MX(1, 1)] * own.priced
            kept.append((stage - ca.vertcat(given["x"] / given["size"], *last), True))
        else:
            kept.append((state_rows(stage, given["size"], given["of_state"]), False))
        kept.append((input_rows(stage, move), False))
        cost += stage_cost(stage, move, given["size"], x_ref[:, k], u_ref[:, k], given["prices"])
    x = stages[N][:nx] * given["size"]
    over = ca.reshape(given["H"], ends, nx) @ x - given["h"]
    kept.append((state_rows(stages[N], given["size"], given["of_state"]), False))
    kept.append((over / given["of_end"] - (stages[N][-1] if own.priced else 0), False))
    cost += ca.bilin(ca.reshape(given["P"], nx, nx), x - x_ref[:, N])
    order = [part for pair in zip(stages, moves) for part in pair]
    statement = {"x": ca.vertcat(*order, stages[N]), "p": ca.vertcat(*given.values()), "f": cost * given["unit"],
                 "g": ca.vertcat(*(value for value, _ in kept))}  # fmt: skip
    return statement, np.concatenate([np.full(value.numel(), equal) for value, equal in kept])


def _next_stage(own: ShootingProgram, step: ca.Function) -> ca.Function:
    """Next stage from a stage, its moves, w, p and the sizes of the states."""
    nx, nu = step.numel_in(0), step.numel_in(1)
    _, _, w, p = symbols_of(step).values()
    kind = type(w)
    stage, move, size = (kind.sym(name, n) for name, n in
                         (("stage", nx + len(own.carried)), ("move", len(own.moves)), ("size", nx)))  # fmt: skip
    moved = step(stage[:nx] * size, move[:nu] * own.size_u, w, p) / size
    parts = [moved, *[move[:nu]] * own.limited, *[move[nu:]] * own.priced]
    return ca.Function("next_stage", [stage, move, w, p, size], [ca.vertcat(*parts)], {"cse": True})


def _of_a_stage(own: ShootingProgram, law: MPCProblem) -> Iterator[ca.Function]:
    """Cost of a stage; rows of its inputs; rows of its state."""
    nx, nu = law.nx, law.nu
    sizes = {"stage": nx + len(own.carried), "move": len(own.moves), "size": nx, "x_ref": nx, "u_ref": nu, "prices": 2,
             "unit": len(law.state_rows[1])}  # fmt: skip
    stage, move, size, x_ref, u_ref, prices, unit = (ca.SX.sym(name, n) for name, n in sizes.items())
    x, u = stage[:nx] * size, move[:nu] * own.size_u
    error, effort = x - x_ref, u - u_ref
    cost = ca.bilin(law.Q, error) + ca.bilin(law.R, effort) + 2 * ca.dot(error, ca.DM(law.cross) @ effort)
    if own.priced:
        cost += prices[0] * move[nu] + prices[1] * move[nu] ** 2
    yield ca.Function("stage_cost", [stage, move, size, x_ref, u_ref, prices], [cost])
    H, h = law.input_rows
    rows = [(ca.DM(H) @ u - h) / law.row_units["input"]]
    if own.limited:
        change = (u - stage[nx : nx + nu] * own.size_u) / law.rate_limit
        rows += [change - 1, -change - 1]
    if own.priced:
        rows.append(-move[nu])
    yield ca.Function("input_rows", [stage, move], [ca.densify(ca.vertcat(*rows))])
    H, h = law.state_rows
    over = (ca.DM(H) @ x - h) / unit - (stage[-1] if own.priced else 0)
    yield ca.Function("state_rows", [stage, size, unit], [ca.densify(over)])
