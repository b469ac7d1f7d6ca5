"""How much a solution misses the dynamics and the cost between the points of its mesh."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from mpc.checks import Array
from mpc.optimal_control.interval import interval_function, layout_of, times_of
from mpc.optimal_control.phase import signal_at
from mpc.optimal_control.phase_solution import PhaseSolution
from mpc.optimal_control.schemes import Collocation, MultipleShooting

QUADRATURE = 8  # Gauss points an interval at which the dynamics are compared
TIGHTER = 0.01  # tolerance of CVODES that its result is compared with, beside its own
STILL = 1e-6  # extent of a state, beside what its rate would make of it over the phase, that is rounding


class Missed(NamedTuple):
    """What is missed over each interval, (N,) each: the dynamics, relative, and of the cost about."""

    dynamics: Array
    cost: Array


def mesh_errors(phase: PhaseSolution, p: Array) -> Missed:
    """What a phase misses of the dynamics over each interval, relative to the extent of each state, and of its cost.

    For collocation the integral of |dx/dt − f(x, u)| along the polynomials, with inputs that are cut at their bounds
    where they would cross them between the points; for shooting the difference that half the integration step makes,
    or with CVODES a hundredth of its tolerance. The cost feels that by the costates, λ·(f − dx/dt), and by its own
    quadrature. Zero for discrete dynamics; infinite where the dynamics are not finite between the points.

    References
    ----------
    Betts, "Practical Methods for Optimal Control Using Nonlinear Programming", 3rd ed., SIAM 2020, section 4.7; Becker
    and Rannacher, "An optimal control approach to a posteriori error estimation", Acta Numerica 10, 2001.
    """
    scheme, N = phase.part.scheme, phase.part.intervals
    if phase.part.phase.discrete:
        return Missed(np.zeros(N), np.zeros(N))
    moved = np.abs(phase.stages.rates).max(axis=(0, 1)) * phase.duration
    largest = np.maximum(np.abs(phase.states).max(axis=0), np.abs(phase.stages.states).max(axis=(0, 1)))
    size = np.maximum(largest, STILL * moved)
    found = _by_residual(phase, scheme, p) if isinstance(scheme, Collocation) else _by_finer_steps(phase, scheme, p)
    relative = found.dynamics / np.where(size > 0, size, 1.0)
    worst, cost = relative.max(axis=1), np.abs(found.cost)
    return Missed(*(np.asarray(np.where(np.isfinite(value), value, np.inf)) for value in (worst, cost)))


def _by_residual(phase: PhaseSolution, scheme: Collocation, p: Array) -> Missed:
    """∫ |dx/dt − f| over every interval, (N, nx), and what is missed of the cost."""
    part, N = phase.part, phase.part.intervals
    tau, weights = np.polynomial.legendre.leggauss(max(QUADRATURE, 2 * scheme.stages))
    tau, weights = 0.5 * (tau + 1), 0.5 * weights
    h, basis = np.diff(phase.times), scheme.basis(tau)
    k, at = np.repeat(np.arange(N), len(tau)), np.tile(tau, N)
    x, u = phase.states_within(k, at), np.clip(phase.inputs_within(k, at), *part.phase.u_bounds)
    times = phase.times[k] + h[k] * at
    given = np.einsum("tj,kji->kti", basis, phase.stages.rates)
    missed = evaluated(part.functions.dynamics, phase, x, u, times, p).reshape(given.shape) - given
    of_cost = np.einsum("t,tj,kji,kti->k", weights, basis, phase.stages.costates, missed, optimize=True)
    if part.functions.stage_cost is not None:
        cost, stages, places = part.functions.stage_cost, phase.stages, phase.stages.times.ravel()
        fine = evaluated(cost, phase, x, u, times, p).reshape(N, -1) @ weights
        known = stages.states.reshape(len(places), -1), phase.inputs
        counted = evaluated(cost, phase, *known, places, p).reshape(N, -1) @ scheme.matrix[-1]
        of_cost = of_cost + phase.weight * (fine - counted)
    return Missed(h[:, None] * np.einsum("t,kti->ki", weights, np.abs(missed)), h * of_cost)


def _by_finer_steps(phase: PhaseSolution, scheme: MultipleShooting, p: Array) -> Missed:
    """The difference (N, nx) that half the steps, or a tighter tolerance, make at the end of every interval."""
    finer = replace(scheme, substeps=2 * scheme.substeps, tolerance=TIGHTER * scheme.tolerance)
    (ends, fine), (_, coarse) = (_shot(phase, one, p) for one in (finer, scheme))
    of_cost = phase.weight * (fine[:, 0] - coarse[:, 0]) + np.einsum("kji,ki->k", phase.stages.costates, ends)
    return Missed(np.abs(ends), of_cost)


def _shot(phase: PhaseSolution, scheme: MultipleShooting, p: Array) -> tuple[Array, Array]:
    """What the ends (N, nx) of intervals miss by a scheme, and their costs (N, 1)."""
    part, N = phase.part, phase.part.intervals
    layout = layout_of(part.phase, part.layout.nw, scheme)
    interval = interval_function(part.phase, part.functions, scheme, layout, len(p))
    times = phase.times[0] + phase.duration * times_of(layout.signals, part.mesh)
    w = signal_at(part.phase, times.ravel()).reshape(N, -1).T
    none = np.zeros((0, N))
    found = interval.map(N)(
        phase.states[:-1].T, none, phase.stages.inputs[:, 0].T, phase.states[1:].T, none,
        np.tile(p[:, None], (1, N)), phase.times[None, :-1], np.diff(phase.times)[None], w,
    )  # fmt: skip
    defects, cost = (np.asarray(value, dtype=float).T for value in found[:2])
    return defects, cost


def evaluated(function: Any, phase: PhaseSolution, x: Array, u: Array, t: Array, p: Array) -> Array:
    """Values (n, m) of a function of a phase at states (n, nx), inputs (n, nu) and times (n,)."""
    n = len(t)
    w = signal_at(phase.part.phase, t)
    values = np.asarray(function.map(n)(x.T, u.T, w.T, np.tile(p[:, None], (1, n)), t[None]), dtype=float)
    return values.reshape(-1, n).T
