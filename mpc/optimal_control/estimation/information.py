"""Covariance of parameters, and combinations that data leave open."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space, qr
from scipy.sparse import block_array, csc_matrix, csr_matrix, eye_array, vstack
from scipy.sparse.linalg import splu

from mpc.checks import Array
from mpc.optimal_control.functions import symbols_of
from mpc.optimal_control.program import NonlinearProgram, PhasePart
from mpc.optimal_control.solution import Solution
from mpc.tolerances import NAMED_SHARE, NEGLIGIBLE, ROUNDED_SUM, TOLD, TOLD_APART


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
    def found(self) -> Resolved:
        """What the data tell."""
        return resolved(self.slopes @ self.directions)

    @property
    def rank(self) -> int:
        """Number of combinations of which the data tell anything."""
        return int(self.found.parts.shape[1])

    @property
    def modes(self) -> tuple[Array, Array]:
        """Singular values (k,), falling, and their combinations (m, k)."""
        nothing, parts = self.found.nothing, self.found.parts
        modes, values, _ = np.linalg.svd(parts, full_matrices=False)
        whole = np.hstack([modes[:, ::-1], nothing])
        return np.concatenate([1 / values[::-1], np.zeros(nothing.shape[1])]), self.directions @ whole

    @property
    def told(self) -> NDArray[np.bool_]:
        """Combinations (k,) of which the data tell anything."""
        return np.arange(self.directions.shape[1]) < self.rank

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
        parts = self.directions @ self.found.parts * deviation
        found = parts @ parts.T
        lost = (np.abs(self.directions @ self.found.of_nothing) > NEGLIGIBLE).any(axis=1)
        found[lost] = found[:, lost] = np.nan
        found[lost, lost] = np.inf
        return np.asarray(found * self.units * self.units[:, None])


class Resolved(NamedTuple):
    """Combinations that slopes tell, and others."""

    parts: Array  # (k, rank): a root of the covariance by unit noise, across the latter
    nothing: Array  # (k, k − rank): orthonormal
    of_nothing: Array  # (k, k − rank): orthonormal, by changes of the outputs alike


def resolved(slopes: Array) -> Resolved:
    """What slopes (values, k) tell, whatever the sizes of unknowns.

    A column that is rounding beside the largest tells nothing.
    """
    root = np.linalg.qr(slopes, mode="r")
    length = np.linalg.norm(root, axis=0)
    some = length > ROUNDED_SUM * length.max(initial=0.0)
    unit = np.where(some, length, 1.0)
    _, found, V = np.linalg.svd(np.where(some, root / unit, 0.0))
    values = np.zeros(len(unit))
    values[: len(found)] = found
    told = values > TOLD_APART * values.max(initial=0.0)
    of_nothing = V[~told].T
    nothing = np.linalg.qr(of_nothing / unit[:, None])[0]
    parts = V[told].T / unit[:, None] / values[told]
    return Resolved(parts - nothing @ (nothing.T @ parts), nothing, of_nothing)


def information(solution: Solution, residual: ca.Function, p_size: Array,
                measured: int | None) -> tuple[Information, Information]:  # fmt: skip
    """Information at the optimum, by the linearised dynamics.

    First along limits that hold, then along all that are reached. Noise that is not known has the variance that as many
    `measured` values leave.
    Limits that act along trajectories bind the unknowns, but where a disturbance may keep them: there only bounds of
    the unknowns themselves count. Time and memory grow in proportion to the mesh.

    References
    ----------
    Bierman, *Factorization Methods for Discrete Sequential Estimation*, Academic Press 1977: square roots of
    information.
    """
    program, v = solution.program, solution.unknowns
    p = np.arange(program.parameters.start, program.parameters.stop)
    firsts = [part.first + np.arange(part.layout.nx) for part in program.parts]
    unknowns = np.concatenate([p, *firsts])
    sizes, free = program.scale[unknowns], program.lower[unknowns] < program.upper[unknowns]
    units: Array = sizes.copy()
    own = np.maximum(np.abs(v[p]), np.abs(p_size))
    units[: len(p)] = np.where(own > 0, own, units[: len(p)])
    in_units: Array = np.where(free, units / sizes, 0.0)
    courses = _courses(program, v, residual)
    ends = np.cumsum([len(p), *map(len, firsts)])
    own_columns = [np.r_[first:last, : len(p)] for first, last in pairwise(ends)]  # of each first state and p
    roots = [np.asarray(np.linalg.qr(course.residuals, mode="r")) for course in courses]
    slopes = np.vstack([_placed(root, at, in_units) for root, at in zip(roots, own_columns)])
    spread = resolved(slopes).parts
    noise = 1.0 if measured is None else 2 * solution.cost / (measured - spread.shape[1])
    stops = [_stopped(solution, unknowns, np.eye(len(unknowns)), np.arange(len(unknowns)), in_units, spread, noise)]
    for part, course, at in zip(program.parts, courses, own_columns):
        if not part.layout.nu:
            stops.append(_stopped(solution, course.places, course.moves, at, in_units, spread, noise))
    reached, holds = (np.concatenate(one) for one in zip(*stops))
    directions, still = (null_space(rows[:, free], rcond=NEGLIGIBLE) for rows in (reached[holds], reached))
    chosen = unknowns[free]
    names = _names(program, chosen, firsts)
    known = Information(chosen, names, v[chosen], units[free], directions, slopes[:, free])
    return known, replace(known, directions=still)


def _placed(rows: Array, at: NDArray[np.int64], in_units: Array) -> Array:
    """Rows (k, m) by all unknowns in units, from those by some."""
    found = np.zeros((len(rows), len(in_units)))
    found[:, at] = rows * in_units[at]
    return found


def _stopped(solution: Solution, places: NDArray[np.int64], moves: Array, at: NDArray[np.int64], in_units: Array,
             spread: Array, noise: float) -> tuple[Array, NDArray[np.bool_]]:  # fmt: skip
    """Moves (k, m) of places that bounds stop, and which these hold.

    These push by more than noise of a variance explains, over a deviation of their place and over its size.
    """
    program, push = solution.program, solution.multipliers["bounds"][places]
    low, high, v = program.lower[places], program.upper[places], solution.unknowns[places]
    size = program.scale[places]
    room, push = np.where(push > 0, high - v, v - low) / size, np.abs(push) * size
    deviation = np.linalg.norm((moves * in_units[at]) @ spread[at], axis=1)
    reach = TOLD * np.linalg.norm(moves * in_units[at], axis=1)
    holds = (push * deviation > np.sqrt(noise)) & (push * reach > noise)
    reached = (low < high) & (push * deviation**2 > room)
    return _placed(moves[reached], at, in_units), holds[reached]


class _Course(NamedTuple):
    """Changes of an experiment by its first state and p, all in sizes of the unknowns."""

    places: NDArray[np.int64]  # (n,): of the unknowns that follow
    moves: Array  # (n, nx + np): of these
    residuals: Array  # (k, nx + np): of whitened residuals, and of the inputs by roots of their price


def linearised(program: NonlinearProgram, v: Array, residual: ca.Function) -> Iterator[tuple[PhasePart, Any, Any]]:
    """Experiments with sparse slopes (k, n) of prices and (m, n) of dynamics.

    Priced are whitened residuals, then inputs, which are disturbances.
    """
    slope = csr_matrix(program.derivatives.jacobian[1](v)[1].sparse())
    slope = slope.multiply(program.scale).multiply(1 / program.row_scale[:, None]).tocsr()
    price = program.derivatives.hessian(v, 1.0, np.zeros(len(program.row_lower))).sparse().diagonal()
    for part in program.parts:
        inputs = part.first + np.flatnonzero(part.coordinates[0] >= part.layout.nx)
        prices = np.sqrt(price[inputs]) * program.scale[inputs]
        roots = csr_matrix((prices, inputs, np.arange(len(inputs) + 1)), (len(inputs), len(v)))
        yield part, vstack([_sampled(part, program, v, residual), roots]).tocsc(), slope[part.defects].tocsc()


def augmented(priced: Any, dynamics: Any) -> Any:
    """Matrix of the conditions of least squares, without products.

    Björck, *Numerical Methods for Least Squares Problems*, SIAM 1996, section 1.4.2.
    """
    return block_array(
        [[None, priced.T, dynamics.T], [priced, -eye_array(priced.shape[0]), None], [dynamics, None, None]],
        format="csc",
    )


def _courses(program: NonlinearProgram, v: Array, residual: ca.Function) -> list[_Course]:
    """Linearised experiments, whose disturbances follow by least squares."""
    p, found = np.arange(program.parameters.start, program.parameters.stop), []
    for part, priced, dynamics in linearised(program, v, residual):
        cut = part.first + part.layout.nx
        given, rest = np.r_[part.first : cut, p], np.arange(cut, part.last)
        right = vstack([csc_matrix((len(rest), len(given))), priced[:, given], dynamics[:, given]]).toarray()
        solved = splu(augmented(priced[:, rest], dynamics[:, rest])).solve(-right)
        moves, residuals, _ = np.split(solved, [len(rest), len(rest) + priced.shape[0]])
        found.append(_Course(rest, moves, residuals))
    return found


def _sampled(part: PhasePart, program: NonlinearProgram, v: Array, residual: ca.Function) -> Any:
    """Sparse changes (k, n) of the whitened residuals by all unknowns, in their sizes."""
    s, p = symbols_of(residual), program.parameters
    value = residual(*s.values())
    slopes = ca.Function("slopes", list(s.values()), [ca.vec(ca.jacobian(value, ca.vertcat(s["x"], s["p"])))])
    times, y, w, places = part.samples
    t = part.phase.start_time + times[None]
    H = np.asarray(slopes(v[places].T, w.T, v[p], t, y.T), dtype=float).T
    H = H.reshape(len(places), -1, value.numel()).transpose(0, 2, 1)
    columns = np.hstack([places, np.tile(np.arange(p.start, p.stop), (len(places), 1))])
    entries, width = H * program.scale[columns][:, None], columns.shape[1]
    every = columns.repeat(value.numel(), axis=0).ravel()
    ends = width * np.arange(len(places) * value.numel() + 1)
    return csr_matrix((entries.ravel(), every, ends), (len(ends) - 1, len(v)))


def _names(program: NonlinearProgram, unknowns: NDArray[np.int64], firsts: list[NDArray[np.int64]]) -> tuple[str, ...]:
    """Names of parameters and first states."""
    named = dict(zip(range(program.parameters.start, program.parameters.stop), program.problem.p_names))
    for k, (part, first) in enumerate(zip(program.parts, firsts)):
        of = f" of experiment {k + 1}" if len(firsts) > 1 else ""
        named |= {int(i): f"first {name}{of}" for i, name in zip(first, part.phase.state_names)}
    return tuple(named[int(i)] for i in unknowns)
