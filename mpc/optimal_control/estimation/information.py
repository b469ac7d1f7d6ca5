"""Covariance of parameters, and combinations that data leave open."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space, qr
from scipy.sparse import csr_matrix

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
        _, found, V = np.linalg.svd(np.linalg.qr(self.slopes @ self.directions, mode="r"))
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
    the unknowns themselves count. Time and memory grow in proportion to the mesh.

    References
    ----------
    Bierman, *Factorization Methods for Discrete Sequential Estimation*, Academic Press 1977: square roots of
    information, here carried from the last point of each experiment to its first.
    """
    program, v = solution.program, solution.unknowns
    p = np.arange(program.parameters.start, program.parameters.stop)
    firsts = [part.first + np.arange(part.layout.nx) for part in program.parts]
    unknowns = np.concatenate([p, *firsts])
    sizes, free = program.scale[unknowns], program.lower[unknowns] < program.upper[unknowns]
    units: Array = sizes.copy()
    own = np.abs(np.maximum(np.abs(v[p]), np.abs(np.asarray(program.problem.p_guess))))
    units[: len(p)] = np.where(own > 0, own, units[: len(p)])
    in_units: Array = np.where(free, units / sizes, 0.0)
    courses = _courses(solution)
    ends = np.cumsum([len(p), *map(len, firsts)])
    own_columns = [np.r_[first:last, : len(p)] for first, last in pairwise(ends)]  # of each first state and p
    roots = [course.root(_sampled(course.part, solution, residual)) for course in courses]
    slopes = np.vstack([_placed(root, at, in_units) for root, at in zip(roots, own_columns)])
    # of the unknowns in units, by unit noise
    spread = np.asarray(np.linalg.pinv(slopes, rcond=TOLD_APART), dtype=float)
    held = [_held(solution, unknowns, np.eye(len(unknowns)), np.arange(len(unknowns)), in_units, spread)]
    for course, at in zip(courses, own_columns):
        if not course.part.layout.nu:
            held.append(_held(solution, *course.moves(), at, in_units, spread))
    acting = np.vstack(held)[:, free]
    directions = null_space(acting, rcond=NEGLIGIBLE) if len(acting) else np.eye(int(free.sum()))
    chosen = unknowns[free]
    names = _names(program, chosen, firsts)
    return Information(chosen, names, v[chosen], units[free], directions, slopes[:, free])


def _placed(rows: Array, at: NDArray[np.int64], in_units: Array) -> Array:
    """Rows (k, m) by all unknowns in units, from those by some."""
    found = np.zeros((len(rows), len(in_units)))
    found[:, at] = rows * in_units[at]
    return found


def _held(solution: Solution, places: NDArray[np.int64], moves: Array, at: NDArray[np.int64], in_units: Array,
          spread: Array) -> Array:  # fmt: skip
    """Moves (k, m) of places that would go further without bounds."""
    program, push = solution.program, solution.multipliers["bounds"][places]
    low, high, v = program.lower[places], program.upper[places], solution.unknowns[places]
    size = program.scale[places]
    room = np.where(push > 0, high - v, v - low) / size
    variance = np.square((moves * in_units[at]) @ spread[at]).sum(axis=1)
    return _placed(moves[(low < high) & (np.abs(push) * size * variance > room)], at, in_units)


@dataclass(frozen=True, eq=False)
class _Course:
    """Linearised dynamics of an experiment, all in sizes of the unknowns.

    An interval's states, but the first, follow from what is `given`: inputs that begin in it, its first node, and p.
    """

    part: PhasePart
    places: NDArray[np.int64]  # (N, states): of the states that follow
    states: Array  # (N, states, given): how they follow
    next: Array  # (N, node + np, given): the next node and p
    weights: Array  # (N, inputs): of the inputs that begin in an interval, roots of their price
    at_start: Array  # (inputs,): the same of the first node

    def root(self, sampled: list[Array]) -> Array:
        """Square root (k, nx + np) of the information on first state and p."""
        nx, node = self.part.layout.nx, self.part.layout.node
        found = sampled[-1]
        for seen, following, weights in zip(sampled[-2::-1], self.next[::-1], self.weights[::-1]):
            rows = found @ following
            found = _without(np.vstack([rows, np.pad(seen, ((0, 0), (len(weights), 0)))]), weights)
        first = [*range(nx, node), *range(nx), *range(node, found.shape[1])]
        return _without(found[:, first], self.at_start)

    def moves(self) -> tuple[NDArray[np.int64], Array]:
        """Places (k,) of states after the first, and their changes (k, nx + np)."""
        found, at = [], np.eye(self.next.shape[1])
        for states, following in zip(self.states, self.next):
            found.append(states @ at)
            at = following @ at
        return self.places.ravel(), np.vstack(found)


def _without(rows: Array, weights: Array) -> Array:
    """Rows of the other unknowns, at least squares over the first."""
    few = len(weights)
    priced = np.hstack([np.diag(weights), np.zeros((few, rows.shape[1] - few))])
    return np.asarray(np.linalg.qr(np.vstack([priced, rows]), mode="r"))[few:, few:]


def _courses(solution: Solution) -> list[_Course]:
    """Linearised dynamics of each experiment."""
    program, v = solution.program, solution.unknowns
    slope = csr_matrix(program.derivatives.jacobian[1](v)[1].sparse())
    price = program.derivatives.hessian(v, 1.0, np.zeros(len(program.row_lower))).sparse().diagonal()
    count, found = program.parameters.stop - program.parameters.start, []
    for part in program.parts:
        layout, N = part.layout, part.intervals
        nx, node, width = layout.nx, layout.node, layout.column + layout.node
        rows = np.arange(part.defects.start, part.defects.stop)
        entry = slope[rows].tocoo()
        interval, row = np.divmod(entry.row, len(rows) // N)
        column = entry.col - part.first - layout.column * interval
        column = np.where(entry.col < program.parameters.start, column, width + entry.col - program.parameters.start)
        blocks = np.zeros((N, len(rows) // N, width + count))
        blocks[interval, row, column] = entry.data * program.scale[entry.col] / program.row_scale[rows][entry.row]
        of, local = part.coordinates[0][:width], np.arange(width)
        follow, begin = local[(of < nx) & (local >= nx)], local[(of >= nx) & (local >= node)]
        given = np.r_[begin, :node, width : width + count]
        states = -np.linalg.solve(blocks[:, :, follow], blocks[:, :, given])
        after = np.zeros((N, node + count, len(given)))
        after[:, :nx] = states[:, -nx:]
        after[:, nx:node, len(begin) - node + nx : len(begin)] = np.eye(node - nx)
        after[:, node:, len(begin) + node :] = np.eye(count)
        firsts = part.first + layout.column * np.arange(N)[:, None]
        weights = [np.sqrt(price[at]) * program.scale[at] for at in (firsts + begin, part.first + np.arange(nx, node))]
        found.append(_Course(part, firsts + follow, states, after, *weights))
    return found


def _sampled(part: PhasePart, solution: Solution, residual: ca.Function) -> list[Array]:
    """Changes (k, node + np) of the whitened residuals at each node."""
    s = symbols_of(residual)
    value = residual(*s.values())
    slopes = ca.Function("slopes", list(s.values()), [ca.vec(ca.jacobian(value, ca.vertcat(s["x"], s["p"])))])
    x, w, t, y, places = samples_of(part, solution)
    H = np.asarray(slopes(x.T, w.T, solution.p, t[None], y.T), dtype=float).T
    H = H.reshape(len(x), -1, value.numel()).transpose(0, 2, 1)
    scale, p = solution.program.scale, solution.program.parameters
    by_nodes = np.zeros((*H.shape[:2], part.layout.node + len(solution.p)))
    by_nodes[:, :, : part.layout.nx] = H[:, :, : part.layout.nx] * scale[places][:, None]
    by_nodes[:, :, part.layout.node :] = H[:, :, part.layout.nx :] * scale[p]
    at = (places[:, 0] - part.first) // part.layout.column
    cuts = H.shape[1] * np.searchsorted(at, np.arange(1, part.intervals + 1))
    return np.split(by_nodes.reshape(-1, by_nodes.shape[2]), cuts)


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
