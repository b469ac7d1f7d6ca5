"""Quadratic costs and polytopes as a phase, for the solver that any phase has."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array
from mpc.halfspaces import box_of
from mpc.optimal_control.phase import Phase
from mpc.problem import MPCProblem
from mpc.rollout import Given, disturbance, references


def quadratic_phase(law: MPCProblem, step: ca.Function) -> Phase:
    """Phase of a problem with the dynamics `step`, for `quadratic_parameters` and `quadratic_columns`.

    Limits of states share one violation a step, which has a price: it is an input, and at the next step a state.
    """
    nx, nu, nw, N, soft = law.nx, law.nu, law.nw, law.horizon, priced(law)
    rows, ends, np_ = len(law.state_rows[1]), len(law.terminal_rows[1]), step.numel_in(3)
    cuts = np.cumsum([0, np_, nx * nx, rows, ends * nx, ends, 2]).tolist()
    box = box_of(*law.input_rows)

    def given(p: Any) -> tuple[Any, ...]:
        """p, P in sizes of states, units of state rows, end rows in these sizes and bounds, prices."""
        return tuple(ca.vertsplit(p, cuts))

    def dynamics(x: Any, u: Any, w: Any, p: Any) -> Any:
        return ca.vertcat(step(x[:nx], u[:nu], w[:nw], p[:np_]), *[u[nu:]] * soft)

    def stage_cost(x: Any, u: Any, w: Any, p: Any) -> Any:
        error, effort = x[:nx] - w[nw : nw + nx], u[:nu] - w[nw + nx :]
        cost = ca.bilin(law.Q, error) + ca.bilin(law.R, effort) + 2 * ca.dot(error, ca.DM(law.cross) @ effort)
        return cost + ca.dot(given(p)[5], ca.vertcat(u[nu], u[nu] ** 2)) if soft else cost

    def terminal_cost(x: Any, w: Any, p: Any) -> Any:
        return ca.bilin(ca.reshape(given(p)[1], nx, nx), (x[:nx] - w[nw : nw + nx]) / law.state_extent)

    def path(x: Any, u: Any, p: Any) -> Any:
        (H, h), (HU, hU) = law.state_rows, law.input_rows
        of_states = (ca.DM(H) @ x[:nx] - h) / given(p)[2] - (x[nx] if soft else 0)
        of_inputs = (ca.DM(HU) @ u[:nu] - hU) / law.row_units["input"]
        return ca.vertcat(*[of_states] * (rows > 0), *[of_inputs] * (box is None))

    def boundary(x: Any, p: Any) -> Any:
        _, _, _, H, h, _ = given(p)
        return ca.reshape(H, ends, nx) @ (x[:nx] / law.state_extent) - h - (x[nx] if soft else 0)

    low, high = (np.full(nu, -np.inf), np.full(nu, np.inf)) if box is None else box
    limited = rows > 0 or box is None
    return Phase(
        dynamics, nx + soft, nu + soft, stage_cost=stage_cost, terminal_cost=terminal_cost, duration=N, discrete=True,
        u_bounds=(np.append(low, np.zeros(soft)), np.append(high, np.full(soft, np.inf))),
        signal=np.zeros((N + 1, nw + nx + nu)), path=path if limited else None,
        boundary=boundary if ends else None, boundary_bounds=(-np.inf, 0.0) if ends else (0.0, 0.0),
    )  # fmt: skip


def priced(law: MPCProblem) -> int:
    """Violations that a stage carries: 1 with limits of states."""
    return int(len(law.state_rows[1]) + len(law.terminal_rows[1]) > 0)


def quadratic_parameters(law: MPCProblem, p: Array, prices: tuple[float, float], size: Array) -> Array:
    """Parameters of `quadratic_phase` for parameters p, prices and its sizes (nx,) of states."""
    (H, h), unit = law.terminal_rows, law.price_units["terminal"]
    H = (H * size / unit[:, None]).ravel(order="F")
    return np.concatenate([p, (size[:, None] * law.P * size).ravel(), law.price_units["state"], H, h / unit, prices])


def quadratic_columns(law: MPCProblem, x: Array, states: Array, inputs: Array,
                      given: Given) -> tuple[Array, Given, Array, Array]:  # fmt: skip
    """State, signals, states and inputs of `quadratic_phase` for those of a plan."""
    N, soft = law.horizon, priced(law)
    w, (x_ref, u_ref) = disturbance(law, given), references(law, given)
    signal = np.hstack([np.vstack([w, 0 * w[:1]]), x_ref, np.vstack([u_ref, 0 * u_ref[:1]])])
    zero, last = np.zeros((N + 1, soft)), given.get("u_prev", np.zeros(law.nu))
    signals = {"w": signal, "t": np.zeros(1), "u_prev": np.append(last, np.zeros(soft))}
    return np.append(x, np.zeros(soft)), signals, np.hstack([states, zero]), np.hstack([inputs, zero[1:]])
