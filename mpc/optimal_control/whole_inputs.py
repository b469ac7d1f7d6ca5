"""Whole-number inputs from relaxed ones by sum-up rounding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ccdtools_ground.door import brief
from ccdtools_ground.outcome import Outcome
from mpc.checks import Array, as_array, as_count
from mpc.exceptions import InputError
from mpc.optimal_control.interval import layout_of, times_of
from mpc.optimal_control.phase import evaluated, signal_along
from mpc.optimal_control.phase_solution import PhaseSolution
from mpc.optimal_control.pieces import interval_function
from mpc.optimal_control.schemes import MultipleShooting
from mpc.optimal_control.solution import Solution
from mpc.tolerances import FEASIBLE


class RoundingStatus(Outcome):
    """Outcome of rounding a solution; the value is the advice."""

    KEPT = "The trajectory with whole inputs keeps every limit."
    VIOLATED = "A limit is violated, see `violations`: take more intervals, or solve again with a margin."
    UNDEFINED = "The trajectory with whole inputs is not finite: take more intervals."
    NOT_SOLVED = "The relaxed solution is no optimum: follow its advice first."


@dataclass(frozen=True, eq=False)
class Rounded:
    """Whole inputs (N, m), with the largest gap of an integral and its bound."""

    inputs: Array
    gap: float
    bound: float


@dataclass(frozen=True, eq=False)
class RoundedSolution(Rounded):
    """Trajectory with whole inputs, held over intervals.

    Attributes
    ----------
    times, states : (N + 1,) and (N + 1, nx) arrays
    cost : float
        Without prices of violations.
    violations : dict of str to float
        The largest of each limit that is not kept at the ends of intervals, in its unit.
    status : RoundingStatus
    """

    times: Array
    states: Array
    cost: float
    violations: dict[str, float]
    status: RoundingStatus


def sum_up_rounding(relaxed: ArrayLike, durations: ArrayLike, *, one_of: bool = False) -> Rounded:
    """Whole inputs whose integrals follow relaxed ones.

    Parameters
    ----------
    relaxed : (N, m) array
        Means over intervals. They are rounded within the whole numbers about the extremes of each column.
    durations : (N,) array
        Of the intervals [s].
    one_of : bool
        Whether exactly one of the m is 1 at a time, and the others 0; else each is rounded by itself.

    Returns
    -------
    Rounded
        max |∫(relaxed − whole) dt| is at most Δ/2, or (m − 1) Δ with `one_of`; Δ is the longest interval.

    Raises
    ------
    InputError
        If shapes disagree, a duration is not positive, or with `one_of` rows are not shares that sum to 1.

    References
    ----------
    Sager, Bock and Diehl, "The integer approximation error in mixed-integer optimal control", Mathematical Programming
    133, 2012; Sager, Reinelt and Bock, "Direct methods with maximal lower bound", Mathematical Programming 118, 2009.
    """
    a = as_array("relaxed", relaxed, (None, None))
    h = as_array("durations", durations, (len(a),))
    if not a.size or not (h > 0).all():
        raise InputError("durations", h, "positive numbers, at least one")
    if one_of and not (np.abs(a.sum(axis=1) - 1).max() <= FEASIBLE and a.min() >= -FEASIBLE):
        raise InputError("relaxed", brief(repr(a)), "rows of shares ≥ 0 that sum to 1, as `one_of` asks")
    low, high = np.floor(a.min(axis=0) + FEASIBLE), np.ceil(a.max(axis=0) - FEASIBLE)
    whole, owed, gap = np.zeros(a.shape), np.zeros(a.shape[1]), 0.0
    for k, duration in enumerate(h):
        owed += duration * np.clip(a[k], low, high)
        whole[k] = np.eye(len(owed))[owed.argmax()] if one_of else np.clip(np.floor(owed / duration + 0.5), low, high)
        owed -= duration * whole[k]
        gap = max(gap, float(np.abs(owed).max()))
    return Rounded(whole, gap, float(h.max() * (len(owed) - 1 if one_of else 0.5)))


def round_inputs(solution: Solution, *, inputs: Sequence[int] | None = None, intervals: int = 100,
                 one_of: bool = False) -> RoundedSolution:  # fmt: skip
    """Trajectory of a relaxed solution with whole inputs.

    Parameters
    ----------
    solution : Solution
        Of one phase. Algebraic variables have to be eliminated, as by `MultipleShooting`.
    inputs : sequence of int, optional
        Which are whole numbers; all by default. The others are held at their means.
    intervals : int
        Equal ones; discrete dynamics have their steps.
    one_of : bool
        Whether exactly one of `inputs` is 1 at a time.

    Raises
    ------
    InputError
        If there are other phases or algebraic unknowns, or an input that there is not.
    """
    if not isinstance(solution, Solution) or len(solution.phases) != 1 or solution.phases[0].part.phase.algebraics:
        raise InputError("solution", brief(repr(solution)), "a Solution of one phase, without algebraic unknowns")
    (found,) = solution.phases
    phase = found.part.phase
    own = list(range(phase.inputs) if inputs is None else inputs)
    if not own or sorted({*own}) != sorted(own) or not {*own} <= {*range(phase.inputs)}:
        raise InputError("inputs", own, f"places among {phase.inputs} inputs, each once")
    count = found.part.intervals if phase.discrete else as_count("intervals", intervals)
    times = np.linspace(found.times[0], found.times[-1], count + 1)
    held = np.clip(_means(found, times), *phase.u_bounds)
    rounded = sum_up_rounding(held[:, own], np.diff(times), one_of=one_of)
    held[:, own] = rounded.inputs
    states, cost = _simulated(found, times, held)
    of_p = solution.program.problem.of_parameters[0]
    violations = _violations(found, times, states, held)
    status = RoundingStatus.VIOLATED if violations else RoundingStatus.KEPT
    status = status if np.isfinite(states).all() and np.isfinite(cost) else RoundingStatus.UNDEFINED
    status = status if solution.solved_on_mesh else RoundingStatus.NOT_SOLVED
    cost += 0.0 if of_p is None else float(of_p(solution.p))
    return RoundedSolution(held, rounded.gap, rounded.bound, times, states, cost, violations, status)


def _means(found: PhaseSolution, times: Array) -> Array:
    """Means (N, nu) of the inputs between times (N + 1,)."""
    if found.part.phase.discrete:
        return found.inputs.copy()
    cuts = np.union1d(times, found.times)
    at, weights = np.polynomial.legendre.leggauss(found.stages.inputs.shape[1])
    within = cuts[:-1, None] + np.diff(cuts)[:, None] * (at + 1) / 2
    parts = np.einsum("g,kgi->ki", weights / 2, found.u(within)) * np.diff(cuts)[:, None]
    return np.asarray(np.add.reduceat(parts, np.searchsorted(cuts, times[:-1])) / np.diff(times)[:, None])


def _simulated(found: PhaseSolution, times: Array, inputs: Array) -> tuple[Array, float]:
    """States (N + 1, nx) and cost with inputs held."""
    part, f, scheme = found.part, found.part.functions, MultipleShooting(integrator="cvodes")
    layout = layout_of(part.phase, part.layout.nw, scheme)
    step = interval_function(part.phase, f, scheme, layout, len(found.p))
    w = signal_along(part.phase, times_of(layout.signals, (times - times[0]) / found.duration))
    states, cost, zero = np.full((len(times), layout.nx), np.nan), 0.0, np.zeros(layout.nx)
    states[0] = found.states[0]
    try:
        for k, (u, t, h) in enumerate(zip(inputs, times, np.diff(times))):
            end, paid, _ = step(states[k], [], u, zero, [], found.p, t, h, w[k])
            states[k + 1], cost = np.asarray(end).ravel(), cost + float(paid)
    except RuntimeError:  # CVODES stopped: the states from there on are no numbers
        cost = np.nan
    at_end = (states[-1], signal_along(part.phase, np.ones((1, 1))).T, found.p, times[-1])
    return states, found.weight * (cost + (0.0 if f.terminal_cost is None else float(f.terminal_cost(*at_end))))


def _violations(found: PhaseSolution, times: Array, states: Array, inputs: Array) -> dict[str, float]:
    """Largest violation of each limit that is not kept."""
    phase, f = found.part.phase, found.part.functions
    last = len(inputs) + (not phase.discrete)
    limits = [(phase.state_names, states, phase.x_bounds),
              ([f"end of {name}" for name in phase.state_names], states[-1:], phase.end)]  # fmt: skip
    if f.path is not None:
        held = np.vstack([inputs, inputs[-1:]])[:last]
        values = evaluated(f.path, phase, states[:last], held, times[:last], found.p)
        limits.append((f.path_names, values, f.path_bounds))
    if f.boundary is not None:
        w = signal_along(phase, np.ones((1, 1))).T
        ends = f.boundary(states[0], states[-1], w, times[0], times[-1], found.p)
        limits.append((f.boundary_names, np.asarray(ends).T, f.boundary_bounds))
    worst: dict[str, float] = {}
    for names, values, (low, high) in limits:
        beyond = np.maximum(values - high, low - values).max(axis=0)
        size = np.abs(values).max(axis=0)
        worst |= {name: float(b) for name, b, s in zip(names, beyond, size) if b > FEASIBLE * s}
    return worst
