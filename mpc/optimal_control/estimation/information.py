"""Covariance of parameters, and combinations that data leave open."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space, qr
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from mpc.checks import Array
from mpc.optimal_control.functions import symbols_of
from mpc.optimal_control.phase import signal_at
from mpc.optimal_control.program import NonlinearProgram, PhasePart
from mpc.optimal_control.solution import Solution
from mpc.tolerances import LEAST_INTERVAL, NAMED_SHARE, NEGLIGIBLE, TOLD, TOLD_APART


@dataclass(frozen=True, eq=False)
class Information:
    """Sensitivities of whitened residuals by unknowns, parameters before first states."""

    places: NDArray[np.int64]  # (m,): of the unknowns in the program; those that are given are left out
    names: tuple[str, ...]
    values: Array  # (m,): estimates of the unknowns
    units: Array  # (m,): their sizes
    directions: Array  # (m, k): orthonormal, in these units: those that limits which act leave free
    slopes: Array  # (values, m): of the residuals, by unknowns in their units

    @cached_property
    def modes(self) -> tuple[Array, Array]:
        """Singular values (k,), falling, and their combinations (m, k)."""
        _, found, V = np.linalg.svd(self.slopes @ self.directions, full_matrices=True)
        values = np.zeros(self.directions.shape[1])
        values[: len(found)] = found[: len(values)]
        return values, self.directions @ V.T

    @property
    def told(self) -> NDArray[np.bool_]:
        """Combinations (k,) of which the data tell anything."""
        values, _ = self.modes
        return np.asarray(values > TOLD_APART * values.max(initial=0.0))

    def named(self, deviation: float) -> tuple[dict[str, float], ...]:
        """Combinations left open by noise of a deviation: shares by name.

        Those of which the data tell nothing in sizes of the estimates, as few names in each as may be.
        """
        values, modes = self.modes
        nothing = modes[:, ~self.told]
        if nothing.size:
            pivots = qr(nothing.T, pivoting=True, mode="r")[1][: nothing.shape[1]]
            nothing = nothing @ np.linalg.inv(nothing[pivots])
            nothing *= (self.units / np.maximum(np.abs(self.values), NEGLIGIBLE * self.units))[:, None]
        weak = self.told & (values * TOLD < deviation)
        found = []
        for mode in (*nothing.T, *modes[:, weak].T):
            mode = mode / np.linalg.norm(mode)
            strong = np.flatnonzero(np.abs(mode) >= NAMED_SHARE * np.abs(mode).max())
            found.append({self.names[i]: round(float(mode[i]), 3) for i in strong})
        return tuple(found)

    def covariance(self, deviation: float) -> Array:
        """Covariance (m, m) at noise of a deviation.

        Variances are infinite and the rest NaN where nothing is told.
        """
        values, modes = self.modes
        told = self.told
        parts = modes[:, told] / values[told] * deviation
        found = parts @ parts.T
        lost = (np.abs(modes[:, ~told]) > NEGLIGIBLE).any(axis=1)
        found[lost] = found[:, lost] = np.nan
        found[lost, lost] = np.inf
        return np.asarray(found * self.units * self.units[:, None])


def information(solution: Solution, residual: ca.Function) -> Information:
    """Information at the optimum, by the linearised dynamics.

    Limits that act along trajectories bind the unknowns, but where a disturbance may keep them: there only bounds of
    the unknowns themselves count.
    """
    program, v = solution.program, solution.unknowns
    free = program.lower < program.upper
    p = np.arange(program.parameters.start, program.parameters.stop)
    firsts = [part.first + np.arange(part.layout.nx) for part in program.parts]
    unknowns = np.concatenate([p, *firsts])
    unknowns = unknowns[free[unknowns]]
    inputs = np.concatenate([_of(part, states=False) for part in program.parts])
    moves = _moves(program, v, np.concatenate([unknowns, inputs]))
    rows = np.vstack([_sampled(part, solution, residual, moves) for part in program.parts])
    units = program.scale[unknowns].copy()
    own = np.abs(np.maximum(np.abs(v[p]), np.abs(np.asarray(program.problem.p_guess))))[free[p]]
    units[: len(own)] = np.where(own > 0, own, units[: len(own)])
    count = len(unknowns)
    if len(inputs):
        curvature = program.derivatives.hessian(v, 1.0, np.zeros(len(program.row_lower))).sparse().diagonal()
        rows = np.vstack([rows, moves[inputs] * np.sqrt(curvature[inputs])[:, None]])
        Q, _ = np.linalg.qr(rows[:, count:])
        rows = rows[:, :count] - Q @ (Q.T @ rows[:, :count])
    spread = moves[:, :count] * units @ np.linalg.pinv(rows * units, rcond=TOLD_APART)  # by unit noise
    push = solution.multipliers["bounds"]
    room = np.where(push > 0, program.upper - v, v - program.lower)
    # held by a bound is what would move further without it
    acting = np.flatnonzero(free & (np.abs(push) * np.square(spread).sum(axis=1) > room))
    acting = np.intersect1d(acting, unknowns) if len(inputs) else acting
    held = moves[acting, :count] * units / program.scale[acting, None]
    directions = null_space(held, rcond=NEGLIGIBLE) if len(held) else np.eye(count)
    names = _names(program, unknowns, firsts)
    return Information(unknowns, names, v[unknowns], units, directions, rows * units)


def _of(part: PhasePart, *, states: bool) -> NDArray[np.int64]:
    """Places of a phase's inputs, or of its states but the first."""
    of, _ = part.coordinates
    chosen = np.flatnonzero((of < part.layout.nx) == states)
    return np.asarray(part.first + (chosen[part.layout.nx :] if states else chosen))


def _moves(program: NonlinearProgram, v: Array, by: NDArray[np.int64]) -> Array:
    """Changes (n, m) of all unknowns by m of them."""
    states = np.concatenate([_of(part, states=True) for part in program.parts])
    rows = np.concatenate([np.arange(part.defects.start, part.defects.stop) for part in program.parts])
    slope = csc_matrix(program.derivatives.jacobian[1](v)[1].sparse())[rows]
    size, of_rows = program.scale[states], program.row_scale[rows]
    square = slope[:, states].multiply(size).multiply(1 / of_rows[:, None])
    found = np.zeros((len(v), len(by)))
    found[by, np.arange(len(by))] = 1.0
    found[states] = -size[:, None] * splu(csc_matrix(square)).solve(slope[:, by].toarray() / of_rows[:, None])
    return found


def _sampled(part: PhasePart, solution: Solution, residual: ca.Function, moves: Array) -> Array:
    """Changes (n · ny, m) of the whitened residuals of a phase."""
    s = symbols_of(residual)
    value = residual(*s.values())
    slopes = ca.Function("slopes", list(s.values()), [ca.vec(ca.jacobian(value, ca.vertcat(s["x"], s["p"])))])
    x, w, t, y, places = samples_of(part, solution)
    H = np.asarray(slopes(x.T, w.T, solution.p, t[None], y.T), dtype=float).T
    H = H.reshape(len(x), -1, value.numel())
    p = np.arange(solution.program.parameters.start, solution.program.parameters.stop)
    both = np.stack([moves[np.concatenate([at, p])] for at in places])
    return np.asarray(np.einsum("nzy,nzm->nym", H, both).reshape(-1, moves.shape[1]))


def samples_of(part: PhasePart, solution: Solution) -> tuple[Array, Array, Array, Array, NDArray[np.int64]]:
    """States, signals, times, data and places (n, ·) of a phase's samples."""
    times, known = part.phase.samples
    at = np.searchsorted(part.mesh, times / part.phase.duration[0] - LEAST_INTERVAL)
    places = part.first + part.layout.column * at[:, None] + np.arange(part.layout.nx)
    t = part.phase.start_time + times
    return solution.unknowns[places], signal_at(part.phase, t), t, known, places


def _names(program: NonlinearProgram, unknowns: NDArray[np.int64], firsts: list[NDArray[np.int64]]) -> tuple[str, ...]:
    """Names of parameters and first states."""
    named = dict(zip(range(program.parameters.start, program.parameters.stop), program.problem.p_names))
    for k, (part, first) in enumerate(zip(program.parts, firsts)):
        of = f" of experiment {k + 1}" if len(firsts) > 1 else ""
        named |= {int(i): f"first {name}{of}" for i, name in zip(first, part.phase.state_names)}
    return tuple(named[int(i)] for i in unknowns)
