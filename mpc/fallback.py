"""What a controller answers when its problem has no solution: relaxed constraints first, the regulator last."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mpc.checks import Array
from mpc.condensing import state_units
from mpc.dense_qp import DenseQP, QPResult
from mpc.exceptions import NotStabilisableError
from mpc.parametric_qp import ParametricQP
from mpc.plan import Plan, Residuals, Status
from mpc.relaxation import least_violation, nearest_points

if TYPE_CHECKING:
    from mpc.linear_mpc import LinearMPC


def relax(
    mpc: LinearMPC, problem: ParametricQP, solver: DenseQP, q: Array, b: Array
) -> tuple[QPResult, Status, float] | None:
    """Solution with state constraints relaxed by the least amount, its status and the largest relaxation.

    None when the other constraints conflict among themselves.
    """
    units = state_units(mpc, problem.labels)
    found = least_violation(problem, units, q, b)
    if found is None:
        return None
    relaxed, point = found
    for margin in (0.0, 1e-6, 1e-4, 1e-2):  # the least relaxation is feasible by a hair's breadth
        wider = relaxed + margin * units * (relaxed > b)
        result = solver.solve(q, wider, doubt=margin == 1e-2)
        if not result.infeasible:
            break
    else:
        result = replace(result, z=point)
    # nothing to relax: the first verdict was wrong
    status = Status.SOFTENED if (wider - b > 1e-7 * units).any() else Status.SOLVED
    return result, status, float(np.max(wider - b, initial=0.0))


def saturated_regulator(mpc: LinearMPC, x: Array, start: float) -> Plan:
    """Plan of the saturated regulator, for conflicting input constraints and numbers that overflow."""
    try:
        gain = mpc.gain
    except NotStabilisableError:
        gain = np.zeros((mpc.nu, mpc.nx))
    inputs, states = np.zeros((mpc.horizon, mpc.nu)), np.empty((mpc.horizon + 1, mpc.nx))
    states[0] = x
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(mpc.horizon):
            inputs[k] = nearest_points(_finite(-gain @ states[k])[None], *mpc.input_rows)[0]
            states[k + 1] = _finite(mpc.A @ states[k] + mpc.B @ inputs[k])
        violation = excess(mpc, states)
    unknown = Residuals(np.inf, np.inf, np.inf, np.inf)
    duration = time.perf_counter() - start
    return Plan(inputs, states, np.inf, Status.INFEASIBLE, unknown, violation, duration, "LQR")


def excess(mpc: LinearMPC, states: Array) -> float:
    """Largest violation of a state or terminal constraint, in the units of its bound."""
    (H, h), (HT, hT) = mpc.state_rows, mpc.terminal_rows
    along = float(np.max(_finite(states[1:] @ H.T) - h, initial=0.0))
    return max(along, float(np.max(_finite(HT @ states[-1]) - hT, initial=0.0)))


def rollout(mpc: LinearMPC, x: Array, inputs: Array, w: Array | None) -> Array:
    """States (N + 1, nx) of the model under given inputs and, where there is one, the previewed disturbance."""
    states = np.empty((mpc.horizon + 1, mpc.nx))
    states[0] = x
    push = np.zeros((mpc.horizon, mpc.nx)) if w is None else w.reshape(mpc.horizon, -1) @ mpc.E.T
    for k, u in enumerate(inputs):
        states[k + 1] = _finite(mpc.A @ states[k] + mpc.B @ u + push[k])
    return states


def cost_of(mpc: LinearMPC, inputs: Array, states: Array, given: dict[str, Array]) -> float:
    """Cost of inputs and states, measured from their references where there are some."""
    error = states - given["x_ref"].reshape(states.shape) if "x_ref" in given else states
    effort = inputs - given["u_ref"].reshape(inputs.shape) if "u_ref" in given else inputs
    Q, R, P = np.asarray(mpc.Q), np.asarray(mpc.R), np.asarray(mpc.P)
    return float(np.sum(error[:-1] @ Q * error[:-1]) + np.sum(effort @ R * effort) + error[-1] @ P @ error[-1])


def _finite(v: Array) -> Array:
    largest = float(np.finfo(float).max) / 4
    return np.nan_to_num(v, nan=0.0, posinf=largest, neginf=-largest)
