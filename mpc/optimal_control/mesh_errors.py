"""Errors of a solution between its mesh points."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from mpc.budgets import CLOSER_LOOKS, LIMIT_CHECKS, OBSTACLE_DOUBLINGS
from mpc.checks import Array
from mpc.optimal_control.phase_solution import PhaseSolution, rows_of_signal, rows_within, stepped
from mpc.optimal_control.program import NonlinearProgram
from mpc.optimal_control.schemes import Collocation, MultipleShooting
from mpc.plan import Residuals
from mpc.tolerances import LEAST_MOVE, LIMIT_PASSED, NEGLIGIBLE, PRIMAL, ROUNDED_SUM


class Missed(NamedTuple):
    """Errors (N,) of the intervals of a phase."""

    dynamics: Array  # relative
    cost: Array
    saved: Array  # of the cost by inputs at a bound


def mesh_errors(
    program: NonlinearProgram, phase: PhaseSolution, multipliers: dict[str, Array], residuals: Residuals
) -> Missed:
    """Errors of a phase's dynamics and cost over each interval.

    Those of the dynamics are beside the largest value of a state, or a hundred times its extent where that is less;
    beside rounding of its size in the program, where it rests.
    For collocation the integral of |dx/dt − f(x, u)| along the polynomials, with inputs that are cut at their bounds
    where they would cross them between the points; for shooting the difference that half the integration step makes,
    or with CVODES a hundredth of its tolerance. The cost feels that by the costates, λ·(f − dx/dt), and by its own
    quadrature, prices of soft limits among it, of inputs alone by polynomials or straight lines, which misses less;
    by collocation also limits that are passed between the points, by their multipliers, and inputs that would be at a
    bound there, by the Hamiltonian. Zero for discrete dynamics; infinite where the dynamics are not finite between the
    points.

    References
    ----------
    Betts, "Practical Methods for Optimal Control Using Nonlinear Programming", 3rd ed., SIAM 2020, section 4.7; Becker
    and Rannacher, "An optimal control approach to a posteriori error estimation", Acta Numerica 10, 2001; Agamawi,
    Hager and Rao, "Mesh refinement method for solving bang-bang optimal control problems", AIAA SciTech Forum 2020.
    """
    scheme, N = phase.part.scheme, phase.part.intervals
    if phase.part.phase.discrete:
        return Missed(*np.zeros((3, N)))
    moved = np.abs(phase.stages.rates).max(axis=(0, 1)) * phase.duration
    along = _states(phase)
    largest, extent = np.abs(along).max(axis=0), np.ptp(along, axis=0)
    size = np.maximum(np.minimum(largest, extent / LEAST_MOVE), NEGLIGIBLE * np.maximum(largest, moved))
    scale = _scales(program, phase, range(len(size)))
    size = np.where(largest > ROUNDED_SUM * scale, size, np.maximum(size, PRIMAL * scale))
    with np.errstate(over="ignore", invalid="ignore"):  # of what is no number between the points
        if isinstance(scheme, Collocation):
            found = _by_residual(program, phase, scheme, multipliers, residuals)
        else:
            found = _by_finer_steps(phase, scheme, multipliers)
    relative = found.dynamics / np.where(size > 0, size, 1.0)
    worst, cost = relative.max(axis=1), np.abs(found.cost)
    return Missed(*(np.asarray(np.where(np.isfinite(value), value, np.inf)) for value in (worst, cost, found.saved)))


def _by_residual(
    program: NonlinearProgram, phase: PhaseSolution, scheme: Collocation, multipliers: dict[str, Array],
    residuals: Residuals,
) -> Missed:  # fmt: skip
    """Integrals ∫ |dx/dt − f| (N, nx) per interval, and cost errors."""
    part, N = phase.part, phase.part.intervals
    tau, weights = np.polynomial.legendre.leggauss(max(8, 2 * scheme.stages))  # Gauss points
    pieces = -(-rows_of_signal(part) // N)  # of an interval, on average
    tau = (np.arange(pieces)[:, None] + 0.5 * (tau + 1)).ravel() / pieces
    weights = np.tile(0.5 * weights / pieces, pieces)
    h, basis = np.diff(phase.times), scheme.basis(tau)
    k, at = np.repeat(np.arange(N), len(tau)), np.tile(tau, N)
    x, u = phase.states_within(k, at), np.clip(phase.inputs_within(k, at), *part.phase.u_bounds)
    times = phase.times[k] + h[k] * at
    given = np.einsum("tj,kji->kti", basis, phase.stages.rates)
    missed = phase.evaluated(part.functions.dynamics, x, u, times).reshape(given.shape) - given
    later = scheme.matrix[int(scheme.continuous_inputs) :] / scheme.matrix[-1]
    costates = np.einsum("mj,kmi->kji", later, multipliers["rows"][part.defects].reshape(N, len(later), -1))
    of_cost = np.einsum("t,tj,kji,kti->k", weights, basis, costates, missed, optimize=True)
    stages, places, f = phase.stages, phase.stages.times.ravel(), part.functions
    states, inputs = (values.reshape(len(places), values.shape[2]) for values in (stages.states, stages.inputs))

    def uncounted(cost: Any, along: Array) -> Array:
        fine = phase.evaluated(cost, x, along, times).reshape(N, -1) @ weights
        return np.asarray(fine - phase.evaluated(cost, states, inputs, places).reshape(N, -1) @ scheme.matrix[-1])

    priced, by_lines = (uncounted(f.price_of_inputs, along) for along in (u, _lines(scheme, stages.inputs[k], at)))
    less = np.where(np.abs(by_lines) < np.abs(priced), by_lines - priced, 0.0)
    of_cost = of_cost + phase.weight * (uncounted(f.priced.stage_cost, u) + less)
    passed = np.maximum(_beyond(phase, k + at), 0.0).reshape(-1, N, len(tau))
    prices = _prices(phase, multipliers)
    of_limits = np.einsum("t,tj,kjm,mkt->k", weights, np.maximum(basis, 0.0), prices, passed, optimize=True)
    along = np.einsum("tj,kji->kti", basis, costates).reshape(x.shape)
    low, high = (np.stack(part.unknowns(side)[3]) for side in (program.lower, program.upper))  # (points, nu, N)
    bounds = np.stack([low.max(axis=0), high.min(axis=0)])[:, :, k]
    saved = h * (_saved(phase, x, u, times, along, bounds).reshape(N, -1) @ weights)
    reach = np.where(np.isfinite(high - low), high - low, 0.0) / np.stack(part.unknowns(program.scale)[3])
    left = program.cost_scale * (residuals.complementarity + residuals.stationarity * reach).sum(axis=(0, 1))
    of_cost = np.abs(of_cost) + of_limits
    return Missed(
        h[:, None] * np.einsum("t,kti->ki", weights, np.abs(missed)), h * of_cost, np.maximum(saved - left, 0.0)
    )


def _saved(phase: PhaseSolution, x: Array, u: Array, times: Array, costates: Array, bounds: Array) -> Array:
    """What inputs nearly at their bounds (2, nu, n) save of the Hamiltonian (n,).

    One at a time, where it passes no hard limit by that.
    """
    functions = phase.part.functions.priced

    def hamiltonian(inputs: Array) -> Array:
        value = (costates * phase.evaluated(functions.dynamics, x, inputs, times).reshape(x.shape)).sum(axis=1)
        return np.asarray(value + phase.weight * phase.evaluated(functions.stage_cost, x, inputs, times).ravel())

    def over(inputs: Array) -> Array:
        known, hard = functions.path is not None, np.isinf(functions.path_prices[0])
        return np.maximum(_over_path(phase, x, inputs, times)[hard], 0.0) if known else np.zeros((0, len(x)))

    own, passed = hamiltonian(u), over(u)
    least = own
    for side, i in zip(*np.nonzero(np.isfinite(bounds).all(axis=2))):
        other = u.copy()
        other[:, i] += (1 - LIMIT_PASSED) * (bounds[side, i] - u[:, i])
        least = np.fmin(least, np.where((over(other) <= passed).all(axis=0), hamiltonian(other), np.inf))
    return np.asarray(own - least)


def _prices(phase: PhaseSolution, multipliers: dict[str, Array]) -> Array:
    """Sizes (N, points, m) of the limits' multipliers, per time."""
    part, m = phase.part, len(phase.part.functions.path_names)
    N, points = part.shares.shape
    path = np.zeros((N, points, m))
    shared = int(part.scheme.continuous_inputs)
    path[:, shared:] = multipliers["rows"][part.path].reshape(N, points - shared, m)
    if shared:
        path[1:, 0] = path[:-1, -1]
    states = np.stack(part.unknowns(multipliers["bounds"])[2]).transpose(2, 0, 1)[:, :, phase.part.phase.bounded]
    return np.asarray(np.abs(np.concatenate([path, states], axis=2)) / (phase.duration * part.shares[:, :, None]))


def _by_finer_steps(phase: PhaseSolution, scheme: MultipleShooting, multipliers: dict[str, Array]) -> Missed:
    """Differences (N, nx) by finer integration, also from row to row of a signal's table, and cost errors."""
    part, x, u = phase.part, phase.states[:-1].T, phase.stages.inputs[:, 0].T
    steps = scheme.substeps if scheme.integrator == "rk4" else 1
    finer, priced = replace(scheme, tolerance=0.01 * scheme.tolerance), replace(part, functions=part.functions.priced)
    (_, cost), (states, finer_cost) = (
        stepped(of, x, u, phase.p, phase.times, one, count)
        for of, one, count in ((part, scheme, steps), (priced, finer, max(2 * steps, rows_within(part))))
    )
    h, inputs = np.diff(phase.times), np.hstack([u, u[:, -1:]]).T
    prices = phase.evaluated(part.functions.price, phase.states, inputs, phase.times).ravel()
    cost = cost + h * prices[:-1]
    cost[-1] += h[-1] * prices[-1]  # at the end, too
    ends = states[:, -1] - phase.states[1:]
    costates = multipliers["rows"][part.defects].reshape(ends.shape)
    of_cost = phase.weight * (finer_cost - cost) + (costates * ends).sum(axis=1)
    return Missed(np.abs(ends), of_cost, np.zeros(len(ends)))


class Excess(NamedTuple):
    """Largest violation of each limit between points: path, then bounded states.

    What passes a limit by the polynomial of an input alone, as where an input jumps, counts by the part of the time
    that it lasts at most: what inputs do is felt by its integral.
    """

    value: Array  # (m,): in the limit's unit
    time: Array  # (m,)
    relative: Array  # (m,): beside how much the limit changes there over the extent of states and inputs
    intervals: Array  # (N,): the largest relative excess within every interval
    names: tuple[str, ...]


def path_excess(program: NonlinearProgram, phase: PhaseSolution) -> Excess:
    """Violations of limits between the mesh points of a phase.

    Zero where they never are; of discrete dynamics there is nothing between.
    """
    sizes = _sizes(program, phase)
    m, N = sizes.shape
    bounded = phase.part.phase.bounded
    names = (*phase.part.functions.path_names, *np.asarray(phase.part.phase.state_names)[bounded].tolist())
    if not m or phase.part.phase.discrete:
        return Excess(np.zeros(m), np.full(m, phase.times[0]), np.zeros(m), np.zeros(N), names)
    mesh, table = phase.part.mesh, rows_of_signal(phase.part)
    knots = np.linspace(0, 1, table if table > 1 else 0)
    regular = (np.arange(N * LIMIT_CHECKS) + 0.5) / LIMIT_CHECKS
    both = [regular, np.interp(knots, mesh, np.arange(N + 1))]  # whose neighbours are equally far each
    both = [places for places in both if places.size]
    each = [_beyond(phase, places) for places in both]
    peaks = [(rows, places[first]) for places, (rows, first) in zip(both, map(_peaks, each))]
    places, beyond = np.concatenate(both), np.concatenate(each, axis=1)
    within = np.minimum(places.astype(int), N - 1)
    relative = np.full((m, N), -np.inf)
    np.maximum.at(relative.T, within, beyond.T)
    relative /= sizes
    rows, first = (np.concatenate(part) for part in zip(*peaks))
    value, place, local = _closer(phase, rows, first)
    k = np.minimum(place.astype(int), N - 1)
    of_size = np.where(value > LIMIT_PASSED / 10 * sizes[rows, k], value / np.minimum(sizes[rows, k], local), 0.0)
    np.maximum.at(relative, (rows, k), np.maximum(of_size, _of_obstacles(phase, place, rows, value)))
    worst = relative.argmax(axis=1)
    seen = np.where(within == worst[:, None], beyond, -np.inf)
    depth, when = np.maximum(seen.max(axis=1), 0.0), places[seen.argmax(axis=1)]
    for row, interval, at, deep in zip(rows, k, place, value):
        if interval == worst[row] and deep > depth[row]:
            depth[row], when[row] = deep, at
    intervals = np.maximum(relative, 0.0)
    return Excess(depth, _time(phase, when), intervals[np.arange(m), worst], intervals.max(axis=0), names)


def _peaks(beyond: Array) -> tuple[Any, Any]:
    """Limits and places of local maxima (m, n) that may be violations.

    Of a cone and of a parabola the maximum lies above its sample by no more than the larger drop to a neighbour.
    """
    around = np.pad(beyond, ((0, 0), (1, 1)), mode="edge")
    with np.errstate(invalid="ignore"):  # where a limit is no number it counts as infinite
        behind, ahead = beyond - around[:, :-2], beyond - around[:, 2:]
    peak = (behind >= 0) & (ahead >= 0) & ((ahead > 0) | (np.arange(beyond.shape[1]) == beyond.shape[1] - 1))
    rows, places = np.nonzero(peak & (beyond + 2 * np.maximum(behind, ahead) > 0))
    return rows, places


def _closer(phase: PhaseSolution, rows: Any, place: Array) -> tuple[Array, Array, Array]:
    """Largest violation of `rows` (k,), its place and size.

    The size is the largest change of the limit over the extents of states and inputs by its slope, where it is passed;
    infinite for bounds of states, and where it is not.
    """
    N, count = phase.part.intervals, len(rows)
    steps = np.linspace(-1, 1, LIMIT_CHECKS + 1)
    value, size, width = np.full(count, -np.inf), np.zeros(count), 1 / LIMIT_CHECKS
    extents = _extents(phase)
    for _ in range(CLOSER_LOOKS if count else 0):
        near = np.clip(place[:, None] + width * steps, 0.0, N)
        seen = _beyond(phase, near.ravel())[rows.repeat(len(steps)), np.arange(near.size)].reshape(near.shape)
        slopes = np.zeros(near.shape)
        passed = (seen > 0) & (rows < len(phase.part.functions.path_names))[:, None]
        if passed.any():
            which = rows.repeat(len(steps)).reshape(near.shape)[passed]
            slopes[passed] = np.abs(_path_slopes(phase, near[passed], which)) @ extents
        size = np.maximum(size, np.where(np.isfinite(slopes), slopes, 0.0).max(axis=1))
        best = seen.argmax(axis=1)[:, None]
        place, value = (np.take_along_axis(one, best, axis=1)[:, 0] for one in (near, seen))
        width *= 2 / LIMIT_CHECKS
    return np.maximum(value, 0.0), place, np.where(size > 0, size, np.inf)


def _path_slopes(phase: PhaseSolution, places: Array, rows: Any) -> Array:
    """Slopes (n, nx + nu) of the violations of path limits `rows` (n,) by states and inputs."""
    functions = phase.part.functions
    x, u, times = _along(phase, places)
    each = np.arange(len(places))
    slopes = phase.evaluated(functions.path_slopes, x, u, times).reshape(len(places), -1, len(functions.path_names))
    value = phase.evaluated(functions.path, x, u, times)[each, rows]
    low, high = (side[rows] for side in functions.path_bounds)
    return slopes[each, :, rows] * np.where(value - high >= low - value, 1.0, -1.0)[:, None]


def _of_obstacles(phase: PhaseSolution, places: Array, rows: Any, passed: Array) -> Array:
    """Relative violations (n,) of obstacles that are thinner than 2^OBSTACLE_DOUBLINGS times the depth.

    Depth and thickness are those along the state or input for which the obstacle is thickest beside the depth, so that
    units do not matter. Zero for all other limits, and where no state or input leads out.
    """
    found = np.zeros(len(places))
    own = np.flatnonzero((rows < len(phase.part.functions.path_names)) & (passed > 0) & np.isfinite(passed))
    if not len(own):
        return found
    x, u, times = _along(phase, places[own])
    at = np.hstack([x, u])
    factors = 2.0 ** np.arange(1, OBSTACLE_DOUBLINGS + 1)
    doublings = np.full(len(own), -1)
    for axis, slope in enumerate(_path_slopes(phase, places[own], rows[own]).T):
        with np.errstate(divide="ignore", over="ignore"):
            ahead = passed[own] / slope
        ahead[~np.isfinite(ahead)] = 0.0
        deeper = at.repeat(len(factors), axis=0)
        deeper[:, axis] += np.outer(ahead, factors - 1).ravel()
        seen = _path_violations(phase, deeper[:, : x.shape[1]], deeper[:, x.shape[1] :], times.repeat(len(factors)))
        inside = seen[rows[own].repeat(len(factors)), np.arange(len(deeper))].reshape(len(own), -1) > 0
        doublings = np.maximum(doublings, np.where(ahead == 0, -1, inside.cumprod(axis=1).sum(axis=1)))
    thin = (doublings >= 0) & (doublings < OBSTACLE_DOUBLINGS)
    found[own[thin]] = LIMIT_PASSED * 2.0 ** (OBSTACLE_DOUBLINGS - doublings[thin])
    return found


def _along(phase: PhaseSolution, places: Array) -> tuple[Array, Array, Array]:
    """States, bounded inputs and times at places (n,), counted in intervals."""
    k = np.minimum(places.astype(int), phase.part.intervals - 1)
    tau = places - k
    return phase.states_within(k, tau), np.clip(phase.inputs_within(k, tau), *phase.part.phase.u_bounds), _time(
        phase, places)  # fmt: skip


def _time(phase: PhaseSolution, places: Array) -> Array:
    """Times at places (n,)."""
    return np.interp(places, np.arange(len(phase.times)), phase.times)


def _beyond(phase: PhaseSolution, places: Array) -> Array:
    """Violation (m, n) of each limit at places (n,), counted in intervals."""
    part, scheme = phase.part, phase.part.scheme
    x, u, times = _along(phase, places)
    own = phase.part.phase.bounded
    low, high = (side[own, None] for side in part.phase.x_bounds)
    of_states: Array = np.maximum(x.T[own] - high, low - x.T[own])
    if part.functions.path is None:
        return of_states

    def of_path(inputs: Array) -> Array:
        return _path_violations(phase, x, inputs, times)

    passed = of_path(u)
    if isinstance(scheme, Collocation):
        k = np.minimum(places.astype(int), part.intervals - 1)
        tau, h = places - k, np.diff(phase.times)[k]
        between = of_path(_lines(scheme, phase.stages.inputs[k], tau))
        passed = np.maximum(np.minimum(passed, between), passed * h / phase.duration)
    return np.vstack([passed, of_states])


def _lines(scheme: Collocation, inputs: Array, tau: Array) -> Array:
    """Inputs (n, nu) at fractions (n,) of intervals, linear between points (n, stages, nu)."""
    lines = np.stack([np.interp(tau, scheme.points, one) for one in np.eye(scheme.stages)], axis=1)
    return np.asarray(np.einsum("nj,nji->ni", lines, inputs))


def _path_violations(phase: PhaseSolution, x: Array, u: Array, times: Array) -> Array:
    """Violations (m, n) of hard path limits; infinite where no number."""
    free = np.isfinite(phase.part.functions.path_prices[0])  # for a price, or as what z is solved from
    free[len(free) - phase.part.phase.algebraics :] = True
    return np.where(free[:, None], -np.inf, _over_path(phase, x, u, times))


def _over_path(phase: PhaseSolution, x: Array, u: Array, times: Array) -> Array:
    """Excess (m, n) over path limits; infinite where no number."""
    low, high = (side[:, None] for side in phase.part.functions.path_bounds)
    values = phase.evaluated(phase.part.functions.path, x, u, times).T
    values = np.maximum(values - high, low - values)
    return np.where(np.isnan(values), np.inf, values)


def _sizes(program: NonlinearProgram, phase: PhaseSolution) -> Array:
    """Sizes (m, N) of the limits of a phase."""
    part, own, extents = phase.part, phase.part.phase.bounded, _extents(phase)
    size = np.maximum(extents[own], LEAST_MOVE * _scales(program, phase, own))
    of_states = np.tile(size.reshape(-1, 1), (1, part.intervals))
    m, shared = len(part.functions.path_names), int(part.scheme.continuous_inputs)
    if not m or part.phase.discrete:
        return of_states
    stages = phase.stages
    x, u, t = (values[:, shared:] for values in (stages.states, stages.inputs, stages.times))
    at = x.reshape(t.size, -1), u.reshape(t.size, u.shape[2]), t.ravel()
    slopes = phase.evaluated(part.functions.path_slopes, *at).reshape(part.intervals, -1, len(extents), m)
    local = (np.abs(slopes) * extents[:, None]).max(axis=2).min(axis=1)
    scale = program.row_scale[part.path].reshape(part.intervals, -1, m).min(axis=1)
    return np.vstack([np.maximum(local, LEAST_MOVE * scale).T, of_states])


def _extents(phase: PhaseSolution) -> Array:
    """Extents (nx + nu,) of states and inputs along a phase."""
    return np.concatenate([np.ptp(_states(phase), axis=0), np.ptp(phase.stages.inputs, axis=(0, 1))])


def _states(phase: PhaseSolution) -> Array:
    """States (n, nx) that are known of a phase."""
    return np.vstack([phase.states, phase.stages.along.reshape(-1, phase.states.shape[1])])


def _scales(program: NonlinearProgram, phase: PhaseSolution, states: Iterable[int]) -> Array:
    """Sizes of states of a phase in the program."""
    part = phase.part
    return np.array([program.scale[part.first : part.last][part.coordinates[0] == i].max() for i in states])
