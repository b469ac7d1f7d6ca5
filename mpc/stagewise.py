"""An MPC problem solved stage by stage, for plants that run away over the horizon.

When the inputs cannot hold an unstable plant, its states grow by many orders of magnitude, and no dense or sparse QP
over the whole horizon keeps the digits of the inputs. A Riccati recursion does: it sees one step at a time, and an input
at its limit has no feedback. State and terminal constraints enter as squared violations.

Reference: Tassa, Mansard and Todorov, *Control-limited differential dynamic programming*, IEEE ICRA 2014, applied to a
linear model, for which it is a projected Newton method.
"""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import numpy as np

from mpc.checks import Array
from mpc.feedback import block_lengths
from mpc.problem import MPCProblem
from mpc.rollout import Given, finite, pushes
from mpc.tolerances import NO_PROGRESS, PRIMAL, REGULAR, STAGEWISE

_MOST_SWEEPS = 60
_STEPS = (1.0, 0.5, 0.25, 0.1, 0.02)  # step lengths tried in turn
_NO_BOUND = 1e30


@dataclass(frozen=True, eq=False)
class StagewisePlan:
    """Inputs (N, nu) and states (N + 1, nx), and the largest Newton step left, in units of the inputs [-]."""

    inputs: Array
    states: Array
    step: float

    @property
    def converged(self) -> bool:
        """Whether every input stands where its own quadratic model has its minimum."""
        return self.step <= STAGEWISE


@dataclass(frozen=True, eq=False)
class _Model:
    """Newton model of the remaining cost at one trajectory: steps (N, nu) and gains (N, nu, n) of every stage."""

    steps: Array
    gains: Array


class StagewiseSolver:
    """Minimises the cost plus linear * s + quadratic * s², for the `weights` (linear, quadratic) of violations.

    With soft constraints s is the largest relative violation of each step, as in `LinearMPC`; otherwise the squares of
    all violations are summed, which is smooth.

    The state of the recursion is (x, last input) where a rate limit or move blocking needs the last input.
    """

    def __init__(self, problem: MPCProblem, x: Array, given: Given, weights: tuple[float, float]):
        nx, nu, N = problem.nx, problem.nu, problem.horizon
        self.problem = problem
        self.linear, self.quadratic = weights
        self.N = N
        self.nx = nx
        memory = nu if problem.rate_limit is not None or problem.blocks is not None else 0
        self.n = nx + memory
        self.A = np.zeros((self.n, self.n))
        self.A[:nx, :nx] = problem.A
        self.B = np.vstack([problem.B, np.eye(nu)[:memory]])
        self.start = np.concatenate([x, given.get("u_prev", np.zeros(nu))[:memory]])
        self.push = pushes(problem, given)
        self.x_ref = given["x_ref"].reshape(N + 1, nx) if "x_ref" in given else np.zeros((N + 1, nx))
        self.u_ref = given["u_ref"].reshape(N, nu) if "u_ref" in given else np.zeros((N, nu))
        lengths = block_lengths(problem)
        self.held = np.concatenate([np.arange(length) > 0 for length in lengths])
        self.C, self.d, self.D = self._input_rows()
        self.unit = self._input_unit()

    def solve(self, inputs: Array) -> StagewisePlan:
        """Plan from a first guess of the inputs; its `step` says how well it converged."""
        inputs, states = self._forward(inputs, None, None, 0.0)
        cost = self._cost(inputs, states)
        for _ in range(_MOST_SWEEPS):
            model = self._backward(inputs, states)
            step = float(np.abs(model.steps / self.unit).max())
            if not np.isfinite(step) or step <= NO_PROGRESS:
                break
            for length in _STEPS:
                tried, reached = self._forward(inputs, states, model, length)
                value = self._cost(tried, reached)
                if value <= cost + NO_PROGRESS * abs(cost):
                    break
            else:
                break
            inputs, states, cost = tried, reached, value
        return StagewisePlan(inputs, states[:, : self.nx], step if np.isfinite(step) else np.inf)

    def _input_rows(self) -> tuple[Array, Array, Array]:
        """(C, d, D) of the constraints C u <= d + D ξ of one stage, rows in units of their bounds."""
        H, h = self.problem.input_rows
        units = self.problem.row_units["input"]
        C, d = H / units[:, None], h / units
        D = np.zeros((len(h), self.n))
        if self.problem.rate_limit is not None:
            both = np.vstack([np.eye(self.problem.nu), -np.eye(self.problem.nu)]) / self.problem.row_units["rate"][:, None]
            C = np.vstack([C, both])
            d = np.concatenate([d, np.ones(len(both))])
            D = np.vstack([D, np.hstack([np.zeros((len(both), self.nx)), both])])
        return C, d, D

    def _input_unit(self) -> Array:
        """Size (nu,) in which steps of the inputs are judged; what the regulator would use where there is no bound."""
        extent = self.problem.input_extent
        R = np.diag(np.asarray(self.problem.R))
        typical = np.sqrt(np.max(self.start[: self.nx] ** 2 * np.diag(np.asarray(self.problem.Q)), initial=0.0))
        other = np.where(R > 0, typical / np.sqrt(np.where(R > 0, R, 1.0)), 1.0)
        return np.where(extent > 0, extent, np.where(other > 0, other, 1.0))

    def _penalty(self, k: int, x: Array) -> tuple[float, Array, Array]:
        """Value, gradient and Hessian of the price of violations at step k."""
        sets = [("state", self.problem.state_rows)] + [("terminal", self.problem.terminal_rows)] * (k == self.N)
        units = np.concatenate([self.problem.row_units[kind] for kind, _ in sets])
        rows = np.vstack([H for _, (H, _) in sets]) / units[:, None]
        over = rows @ x - np.concatenate([h for _, (_, h) in sets]) / units
        which = np.flatnonzero(over > 0)
        if self.problem.soft is not None and len(which):
            which = np.array([int(np.argmax(over))])
        rows, over = rows[which], over[which]
        value = float(self.linear * over.sum() + self.quadratic * over @ over)
        return value, (self.linear + 2 * self.quadratic * over) @ rows, 2 * self.quadratic * rows.T @ rows

    def _cost(self, inputs: Array, states: Array) -> float:
        """Cost with the penalty."""
        error, effort = states[:, : self.nx] - self.x_ref, inputs - self.u_ref
        Q, R, P = (np.asarray(w) for w in (self.problem.Q, self.problem.R, self.problem.P))
        cost = np.sum(error[:-1] @ Q * error[:-1]) + np.sum(effort @ R * effort) + error[-1] @ P @ error[-1]
        return float(cost) + sum(self._penalty(k, states[k, : self.nx])[0] for k in range(1, self.N + 1))

    def _state_model(self, k: int, xi: Array) -> tuple[Array, Array]:
        """Gradient (n,) and Hessian (n, n) of the cost of step k in ξ."""
        weight = np.asarray(self.problem.P if k == self.N else self.problem.Q)
        gradient, hessian = np.zeros(self.n), np.zeros((self.n, self.n))
        _, slope, curvature = self._penalty(k, xi[: self.nx]) if k else (0.0, 0.0, 0.0)
        gradient[: self.nx] = 2 * weight @ (xi[: self.nx] - self.x_ref[k]) + slope
        hessian[: self.nx, : self.nx] = 2 * weight + curvature
        return gradient, hessian

    def _backward(self, inputs: Array, states: Array) -> _Model:
        """Riccati recursion with the limits of each stage."""
        R = 2 * np.asarray(self.problem.R)
        steps, gains = np.zeros_like(inputs), np.zeros((self.N, self.problem.nu, self.n))
        v, V = self._state_model(self.N, states[self.N])
        for k in reversed(range(self.N)):
            gu = R @ (inputs[k] - self.u_ref[k]) + self.B.T @ v
            Huu, Hux = R + self.B.T @ V @ self.B, self.B.T @ V @ self.A
            gx, Hxx = self._state_model(k, states[k])
            gx, Hxx = gx + self.A.T @ v, Hxx + self.A.T @ V @ self.A
            if self.held[k]:
                gains[k][:, self.nx :] = np.eye(self.problem.nu)
            else:
                room = self.d + self.D @ states[k] - self.C @ inputs[k]
                steps[k], gains[k] = self._stage(Huu, Hux, gu, room)
            s, K = steps[k], gains[k]
            v = gx + K.T @ (Huu @ s + gu) + Hux.T @ s
            V = Hxx + K.T @ Huu @ K + K.T @ Hux + Hux.T @ K
            V = (V + V.T) / 2
        return _Model(steps, gains)

    def _stage(self, Huu: Array, Hux: Array, gu: Array, room: Array) -> tuple[Array, Array]:
        """Step and gain of one stage: the QP in the input alone, and feedback where no limit is active."""
        scale = 1 / np.sqrt(np.maximum(np.diag(Huu), np.finfo(float).tiny))
        M = Huu * scale * scale[:, None] + REGULAR * np.eye(len(gu))
        rows = self.C * scale
        s, active = _small_qp(M, gu * scale, rows, room)
        free, fixed = _split(rows[active])
        particular = fixed @ self.D[active]
        K = particular - free @ np.linalg.solve(
            free.T @ M @ free, free.T @ (Hux * scale[:, None] + M @ particular)
        ) if free.shape[1] else particular  # fmt: skip
        return s * scale, K * scale[:, None]

    def _forward(self, inputs: Array, states: Array | None, model: _Model | None, length: float) -> tuple[Array, Array]:
        """Inputs and states ξ after a step of the given length, every input held within its limits."""
        new, reached = np.empty_like(inputs), np.empty((self.N + 1, self.n))
        reached[0] = self.start
        for k in range(self.N):
            u = inputs[k]
            if model is not None and states is not None:
                u = u + length * model.steps[k] + model.gains[k] @ (reached[k] - states[k])
            new[k] = reached[k, self.nx :] if self.held[k] else self._admissible(finite(u), reached[k])
            reached[k + 1] = finite(self.A @ reached[k] + self.B @ new[k])
            reached[k + 1, : self.nx] += self.push[k]
        return new, reached

    def _admissible(self, u: Array, xi: Array) -> Array:
        """The input within its limits nearest to u, in units of the inputs."""
        room = self.d + self.D @ xi - self.C @ u
        if not len(room) or room.min() >= 0:
            return u
        step, _ = _small_qp(np.eye(len(u)), np.zeros(len(u)), self.C * self.unit, room)
        return np.asarray(u + step * self.unit)


def _small_qp(M: Array, g: Array, rows: Array, room: Array) -> tuple[Array, Array]:
    """Minimiser of ½ s'Ms + g's with rows s <= room, and the mask of its active rows."""
    if not len(rows):
        return np.asarray(-np.linalg.solve(M, g)), np.zeros(0, dtype=bool)
    length = np.linalg.norm(rows, axis=1)
    size = 1 / float(length.max())  # a bound, for rows in units of their bounds
    lower = np.full(len(room), -_NO_BOUND)
    sense = np.zeros(len(room), dtype=np.int32)
    s, _, _, info = daqp.solve(
        np.ascontiguousarray(M), np.ascontiguousarray(g / size), np.ascontiguousarray(rows / length[:, None]),
        np.ascontiguousarray(room / length / size), lower, sense, primal_tol=PRIMAL, fval_bound=1e300,
    )  # fmt: skip
    return np.asarray(s) * size, np.asarray(info["lam"]) > 0


def _split(rows: Array) -> tuple[Array, Array]:
    """Basis of the directions that active rows leave free, and the pseudo-inverse of the rows."""
    if not len(rows):
        return np.eye(rows.shape[1]), np.zeros((rows.shape[1], 0))
    _, sizes, directions = np.linalg.svd(rows)
    rank = int((sizes > REGULAR * sizes[0]).sum())
    return directions[rank:].T, np.linalg.pinv(rows)
