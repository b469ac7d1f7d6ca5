"""Derivatives of a solution by held parameters and a given start."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bmat, csc_matrix, triu
from scipy.sparse.linalg import splu

from mpc.checks import Array
from mpc.optimal_control.descriptions import describe_row, describe_unknown
from mpc.optimal_control.program import NonlinearProgram
from mpc.sensitivities.plan_sensitivity import SensitivityStatus
from mpc.tolerances import AT_BOUND, BARRIER_BLUR, LEAST_CURVATURE, ROUNDED_SUM, SAME_HYPERPLANE_DIGITS


@dataclass(frozen=True, eq=False)
class PhaseSensitivity:
    """Derivatives of one phase's trajectory.

    Attributes
    ----------
    states_by_parameters, states_by_start : (N + 1, nx, np) and (N + 1, nx, nx) arrays
        At the points of the mesh, `PhaseSolution.times`, by fraction of the phase where its duration is free.
    inputs_by_parameters, inputs_by_start : (n, nu, np) and (n, nu, nx) arrays
        At `PhaseSolution.input_times`.
    """

    states_by_parameters: Array
    states_by_start: Array
    inputs_by_parameters: Array
    inputs_by_start: Array


@dataclass(frozen=True, eq=False, repr=False)
class SolutionSensitivity:
    """Derivatives of a solution by the held parameters p and the start.

    Attributes
    ----------
    status : SensitivityStatus
        With advice.
    cost_by_parameters, cost_by_start : (np,) and (nx,) arrays
        Of the optimal cost; of entries of the start that are not given, NaN.
    cost_curvature : (np, np) array
        Second derivatives of the optimal cost by the parameters.
    phases : tuple of PhaseSensitivity
    weakly_active : tuple of str
        Constraints and bounds that are met without a multiplier, or so nearly that the solver does not tell.
    """

    status: SensitivityStatus
    cost_by_parameters: Array
    cost_by_start: Array
    cost_curvature: Array
    phases: tuple[PhaseSensitivity, ...]
    weakly_active: tuple[str, ...]

    def __repr__(self) -> str:
        return f"SolutionSensitivity({len(self.cost_by_parameters)} parameters, status={self.status.name})"

    @property
    def smooth(self) -> bool:
        """Whether the derivatives hold on every side."""
        return self.status is SensitivityStatus.SMOOTH


def solution_sensitivity(
    program: NonlinearProgram, v: Array, multipliers: dict[str, Array], solved: bool
) -> SolutionSensitivity:
    """Derivatives at unknowns v (n,); see `Solution.sensitivity`."""
    held = _held(program)
    if not solved:
        return _none(program, held, SensitivityStatus.UNSOLVED, ())
    size, of_cost = program.scale, program.cost_scale
    hessian = program.derivatives.hessian(v, 1.0, multipliers["rows"]).sparse()  # its upper triangle
    W = csc_matrix(hessian + triu(hessian, 1).T).multiply(size[:, None]).multiply(size).tocsc() / of_cost
    found = program.derivatives.stationarity(v, multipliers["rows"])
    rows, gradient = (np.asarray(value, dtype=float).ravel() for value in found[:2])
    jacobian = csc_matrix(program.derivatives.jacobian[1](v)[1].sparse())
    J = jacobian.multiply(size).multiply(1 / program.row_scale[:, None]).tocsr()
    softness = np.abs(W.diagonal())
    softness = 1 / np.maximum(softness, LEAST_CURVATURE * softness.max(initial=np.finfo(float).tiny))
    on_rows, weak_rows = _acting(
        (program.row_lower - rows) / program.row_scale, (program.row_upper - rows) / program.row_scale,
        multipliers["rows"] * program.row_scale / program.cost_scale, J.multiply(J) @ softness,
    )  # fmt: skip
    on_bounds, weak_bounds = _acting(
        (program.lower - v) / program.scale, (program.upper - v) / program.scale,
        multipliers["bounds"] * program.scale / program.cost_scale, softness,
    )  # fmt: skip
    free = np.setdiff1d(np.flatnonzero(~on_bounds), held)
    of_rows = J[on_rows]
    reached = np.flatnonzero(np.diff(of_rows[:, free].tocsr().indptr) > 0)
    of_rows = of_rows[reached]
    of_rows = of_rows[_once_each(of_rows)]
    K = bmat([[W[free][:, free], of_rows[:, free].T], [of_rows[:, free], None]], format="csc")
    right = -np.vstack([W[free][:, held].toarray(), of_rows[:, held].toarray()])
    by = _solved(K, right)
    weak = [describe_row(program, int(i), v) for i in np.flatnonzero(weak_rows)]
    weak += [describe_unknown(program, int(i), v) for i in np.setdiff1d(np.flatnonzero(weak_bounds), held)]
    if by is None:
        return _none(program, held, SensitivityStatus.SINGULAR, tuple(weak))
    moves = np.zeros((len(v), len(held)))
    moves[held, np.arange(len(held))] = 1.0
    moves[free] = by[: len(free)]
    curvature = (W @ moves)[held] + (of_rows[:, held].T @ by[len(free) :])
    unit = of_cost / size[held]
    status = SensitivityStatus.ONE_SIDED if weak else SensitivityStatus.SMOOTH
    moves = moves * size[:, None] / size[held]
    return _packed(program, held, status, gradient[held], curvature * unit[:, None] / size[held], moves, tuple(weak))


def _held(program: NonlinearProgram) -> NDArray[np.int64]:
    """Unknowns to differentiate by: parameters, then given start entries."""
    first = program.parts[0].first + np.arange(program.parts[0].layout.nx)
    given = first[program.lower[first] == program.upper[first]]
    return np.concatenate([np.arange(program.parameters.start, program.parameters.stop), given])


def _acting(low: Array, high: Array, multiplier: Array, softness: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Bounds (n,) that are active, and those weakly active.

    Of bounds relative to the value, multipliers, and how far a unit force moves the value, about; all scaled.
    """
    room = np.maximum(np.where(multiplier > 0, high, -low), 0.0)
    equal = low == high
    passed = np.abs(multiplier) * softness  # how far the value would pass the bound
    inside = ~equal & np.isfinite(room) & (room > passed)
    barrier = float(np.median(np.abs(multiplier[inside]) * room[inside])) if inside.any() else 0.0
    blur = np.maximum(BARRIER_BLUR * np.sqrt(barrier * softness), AT_BOUND)
    weak = ~equal & (np.maximum(room, passed) <= blur)
    return equal | (~weak & (passed > room)), weak


def _once_each(rows: Any) -> NDArray[np.int64]:
    """Rows (n,) that are no multiple of an earlier one."""
    along = rows @ np.random.default_rng(0).normal(size=(rows.shape[1], 2))
    length = np.sqrt(np.asarray(rows.multiply(rows).sum(axis=1)).ravel())
    along = along / (np.where(along[:, 0] < 0, -1, 1) * length)[:, None]
    return np.sort(np.unique(np.round(along, SAME_HYPERPLANE_DIGITS), axis=0, return_index=True)[1])


def _solved(K: Any, right: Array) -> Array | None:
    """Solution of the KKT system; None where it is singular."""
    try:
        factor = splu(K)
    except RuntimeError:
        return None
    probe = np.random.default_rng(0).choice([-1.0, 1.0], K.shape[0])
    size = float(abs(K).sum(axis=0).max()) if K.shape[0] else 0.0
    if not float(np.abs(factor.solve(probe)).max(initial=0.0)) * size * ROUNDED_SUM < 1.0:
        return None
    found = factor.solve(right)
    return np.asarray(found + factor.solve(right - K @ found))


def _packed(program: NonlinearProgram, held: NDArray[np.int64], status: SensitivityStatus, gradient: Array,
            curvature: Array, moves: Array, weak: tuple[str, ...]) -> SolutionSensitivity:  # fmt: skip
    """Derivatives by name from moves (n, held) of all unknowns."""
    count = program.parameters.stop - program.parameters.start
    part = program.parts[0]
    start = np.full((len(moves), part.layout.nx), np.nan)
    start[:, held[count:] - part.first] = moves[:, count:]
    by_start = np.full(part.layout.nx, np.nan)
    by_start[held[count:] - part.first] = gradient[count:]
    moves = np.hstack([moves[:, :count], start])
    phases = []
    for own in program.parts:
        nodes, _, _, inputs = own.unknowns(np.arange(float(len(moves))))
        places = nodes[: own.layout.nx].T, np.stack(inputs, axis=0).transpose(2, 0, 1).reshape(-1, own.layout.nu)
        both = (np.split(moves[at.astype(int)], [count], axis=2) for at in places)
        phases.append(PhaseSensitivity(*(one for moved in both for one in moved)))
    return SolutionSensitivity(status, gradient[:count], by_start, curvature[:count, :count], tuple(phases), weak)


def _none(
    program: NonlinearProgram, held: NDArray[np.int64], status: SensitivityStatus, weak: tuple[str, ...]
) -> SolutionSensitivity:
    """Sensitivity with NaN in place of each derivative."""
    moves = np.full((len(program.lower), len(held)), np.nan)
    return _packed(
        program, held, status, np.full(len(held), np.nan), np.full((len(held), len(held)), np.nan), moves, weak
    )
