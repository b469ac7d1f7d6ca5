"""The steady state to aim at: in the sets, with outputs nearest to a reference, and of least cost among such."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from mpc.checks import Array
from mpc.dense_qp import DenseQP, QPResult
from mpc.problem import MPCProblem
from mpc.tolerances import NEGLIGIBLE, STEADY, TARGET_COST, TARGET_DRIFT


@dataclass(frozen=True, eq=False)
class Target:
    """A state and input to aim at.

    Attributes
    ----------
    state, input : (nx,) and (nu,) array
    drift : (nx,) array
        By how much the state moves away in one step under the input and the estimated disturbance.
    steady : bool
        Whether the drift is rounding; False where no state in X with an input in U stays where it is.
    """

    state: Array
    input: Array
    drift: Array
    steady: bool

    def __post_init__(self) -> None:
        for array in (self.state, self.input, self.drift):
            array.flags.writeable = False


def nearest_target(problem: MPCProblem, A: Array, B: Array, push: Array, C: Array, r: Array) -> Target:
    """The target of x⁺ = Ax + Bu + push whose outputs Cx are nearest to r; where nothing is steady, what drifts least.

    Weights and sets are those of the problem.
    """
    size = sizes_of(problem)
    # (A - I)x + Bu + push = 0, states and inputs in units of their limits
    M = np.hstack([A - np.eye(problem.nx), B]) / problem.state_extent[:, None] * size
    scaled = push / problem.state_extent
    particular = np.asarray(np.linalg.lstsq(M, -scaled, rcond=None)[0], dtype=np.float64)
    basis = null_space(M)
    basis[np.abs(basis) < STEADY] = 0.0  # what rounding left of a zero would count as a direction
    drift = M @ particular + scaled
    steady = np.abs(drift).max() <= STEADY * max(1.0, np.abs(scaled).max())
    result = _nearest(problem, C, r, particular, basis, np.zeros((len(size), len(size))))
    if result is None or result.infeasible or not steady:
        basis = np.eye(len(size))
        steady = False
        result = _nearest(problem, C, r, particular, basis, M.T @ M / TARGET_DRIFT)
    point = particular + basis @ (np.zeros(basis.shape[1]) if result is None else result.z)
    drift = (M @ point + scaled) * problem.state_extent
    state, action = np.split(point * size, [problem.nx])
    return Target(state, action, drift, bool(steady))


def sizes_of(problem: MPCProblem) -> Array:
    """Sizes (nx + nu,) of states and inputs, 1 for an input without limits."""
    return np.concatenate([problem.state_extent, np.where(problem.input_extent > 0, problem.input_extent, 1.0)])


def _nearest(problem: MPCProblem, C: Array, r: Array, particular: Array, basis: Array, drift: Array) -> QPResult | None:
    """QP over particular + basis z: output error, then cost, and the drift of those that are not steady."""
    size = sizes_of(problem)
    output = np.hstack([C, np.zeros((len(C), problem.nu))]) * size
    unit = max(float(np.linalg.norm(output)), np.finfo(float).tiny)
    W = np.zeros((len(size), len(size)))
    W[: problem.nx, : problem.nx] = problem.Q
    W[problem.nx :, problem.nx :] = problem.R
    if problem.S is not None:
        W[: problem.nx, problem.nx :] = problem.S
        W[problem.nx :, : problem.nx] = problem.S.T
    W = W * size * size[:, None]
    W = W / max(float(np.trace(W)), np.finfo(float).tiny) + NEGLIGIBLE * np.eye(len(size))
    T = output / unit
    full = T.T @ T + TARGET_COST * W + drift
    if not basis.shape[1]:
        return None
    H = basis.T @ full @ basis
    # the particular solution has the least drift, so the drift has no slope there
    q = basis.T @ (T.T @ (T @ particular - r / unit) + TARGET_COST * W @ particular)
    (HX, hX) = problem.state_rows
    (HU, hU) = problem.input_rows
    rows = np.vstack(
        [np.hstack([HX, np.zeros((len(HX), problem.nu))]), np.hstack([np.zeros((len(HU), problem.nx)), HU])]
    )
    units = np.concatenate([problem.row_units["state"], problem.row_units["input"]])
    right = np.concatenate([hX, hU]) - rows * size @ particular
    return DenseQP(H, rows * size @ basis, units).solve(q, right, confirm_infeasible=True)
