"""Plans of a controller whose problem has no solution."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from mpc.checks import Array
from mpc.condensing import row_units
from mpc.dense_qp import DenseQP, QPResult
from mpc.exceptions import NotStabilisableError
from mpc.halfspaces import is_empty, nearest_points
from mpc.parametric_qp import ParametricQP
from mpc.plan import Plan, Residuals, Status
from mpc.problem import MPCProblem
from mpc.rollout import finite, violation_of
from mpc.tolerances import FEASIBLE, KKT, RELAXATION_MARGIN, RELAXATION_SHARES, RELAXATION_WIDER


@dataclass(frozen=True, eq=False)
class Relaxed:
    """Solution with relaxed state constraints; SOLVED where none needed it."""

    result: QPResult
    status: Status


def relax(problem: MPCProblem, qp: ParametricQP, solver: DenseQP, q: Array, b: Array) -> Relaxed | None:
    """Solution with least relaxed state constraints, or None.

    Whether the problem is infeasible is decided here, by the violation that is left when it is made least: what the QP
    solver said before is only the reason to ask.
    """
    units = row_units(problem, qp.labels)
    least = least_violation(qp, units, problem.input_extent, q, b, second=solver.second)
    if least is None:
        return None
    relaxed, point = least
    for margin in RELAXATION_WIDER:  # the least relaxation is feasible by a hair's breadth
        wider = relaxed + margin * units * (relaxed > b)
        result = solver.solve(q, wider, confirm_infeasible=margin == RELAXATION_WIDER[-1])
        if not result.infeasible:
            break
    else:
        result = replace(result, z=point)
    infeasible = (relaxed - b > FEASIBLE * units).any()
    return Relaxed(result, Status.SOFTENED if infeasible else Status.SOLVED)


def inputs_conflict(problem: MPCProblem, last_input: Array | None) -> bool:
    """Whether no input in U keeps the rate limit.

    U is convex and not empty, so an input that is in U may stay where it is.
    """
    if problem.rate_limit is None or last_input is None:
        return False
    H, h = problem.input_rows
    both = np.vstack([np.eye(problem.nu), -np.eye(problem.nu)])
    near = np.concatenate([last_input + problem.rate_limit, problem.rate_limit - last_input])
    return is_empty(np.vstack([H, both]), np.concatenate([h, near]))


def least_violation(
    qp: ParametricQP, units: Array, input_extent: Array, q: Array, b: Array, *, second: bool = True
) -> tuple[Array, Array] | None:
    """Right-hand side relaxed by least squares of violations.

    Only rows of state and terminal constraints are relaxed; input, rate and slack rows are kept (Kerrigan and
    Maciejowski, *Soft constraints and exact penalty functions in MPC*, 2000, in two stages instead of one penalty).

    Parameters
    ----------
    qp : ParametricQP
        The infeasible problem.
    units : (m,) array
        Unit in which each row is compared with the others.
    input_extent : (nu,) array
        Size of each input, 0 where it has none.
    q, b : (nz,) and (m,) array
        The QP at the parameter of interest.
    second : bool
        Whether a second solver is asked, see `DenseQP`.

    Returns
    -------
    relaxed : (m,) array
        The relaxed right-hand side.
    z : (nz,) array
        A point that satisfies it. Instead of both None when the hard rows conflict among themselves.
    """
    soft = np.array([label.kind in ("state", "terminal") for label in qp.labels], dtype=bool)
    if not soft.any():
        return None
    steps = np.array([label.step for label in qp.labels])
    last = int(steps[soft].max())
    columns = np.zeros((qp.m, last))
    columns[soft, steps[soft] - 1] = -units[soft]
    typical = typical_cost(qp, units, input_extent, q)
    for share in RELAXATION_SHARES:
        share = share / typical
        elastic = DenseQP(block_diag(share * qp.H, np.eye(last)), np.hstack([qp.G, columns]), units, second=second)
        result = elastic.solve(np.concatenate([share * q, np.zeros(last)]), b, confirm_infeasible=True)
        if result.infeasible or result.residuals.worst <= KKT:
            break
    if result.infeasible or not np.isfinite(result.z).all():
        return None
    slack = np.maximum(-columns @ result.z[qp.nz :], 0.0)
    room = RELAXATION_MARGIN * np.maximum(units, slack)
    relaxed: Array = np.where(soft, b + np.where(slack > 2 * room, slack, 0.0) + room, b)
    # what the first stage left violated by rounding is tolerated too
    z = result.z[: qp.nz]
    return relaxed + np.where(soft, np.maximum(qp.G @ z - relaxed, 0.0), 0.0), z


def typical_cost(qp: ParametricQP, units: Array, input_extent: Array, q: Array) -> float:
    """Cost of the unconstrained optimum within input bounds, at least one row unit's.

    A wide bound plays no part in it, and next to the origin, where nothing is wanted, violations still count.
    """
    curvature = np.diag(qp.H)
    size = np.full(qp.nz, np.inf)
    moves = qp.nz - sum(label.kind == "slack" for label in qp.labels)
    if moves % len(input_extent) == 0:
        size[:moves] = np.tile(np.where(input_extent > 0, input_extent, np.inf), moves // len(input_extent))
    wanted = float(np.minimum(size**2 * curvature, q**2 / curvature).sum())
    soft = np.array([label.kind in ("state", "terminal") for label in qp.labels], dtype=bool)
    moved = ((qp.G[soft] / units[soft, None]) ** 2 / curvature).sum(axis=1).max(initial=0.0)
    return max(wanted, float(1 / moved)) if moved > 0.0 else wanted or 1.0


def saturated_regulator(problem: MPCProblem, x: Array, start: float) -> Plan:
    """Plan of the saturated regulator."""
    inputs, states = regulated(problem, x, np.zeros((problem.horizon, problem.nx)))
    unknown = Residuals(np.inf, np.inf, np.inf, np.inf)
    violation = violation_of(problem, states)
    duration = time.perf_counter() - start
    return Plan(inputs, states, np.inf, Status.INFEASIBLE, unknown, violation, duration, "LQR")


def regulated(problem: MPCProblem, x: Array, push: Array) -> tuple[Array, Array]:
    """Inputs and states under the saturated regulator, or zero inputs."""
    try:
        gain = problem.gain
    except NotStabilisableError:
        gain = np.zeros((problem.nu, problem.nx))
    inputs = np.zeros((problem.horizon, problem.nu))
    states = np.empty((problem.horizon + 1, problem.nx))
    states[0] = x
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(problem.horizon):
            inputs[k] = nearest_points(finite(-gain @ states[k])[None], *problem.input_rows)[0]
            states[k + 1] = finite(problem.A @ states[k] + problem.B @ inputs[k] + push[k])
    return inputs, states
