"""How much a solution misses the dynamics between the points of its mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpc.checks import Array
from mpc.optimal_control.interval import interval_function, runge_kutta
from mpc.optimal_control.phase import signal_at
from mpc.optimal_control.phase_solution import PhaseSolution
from mpc.optimal_control.program import PhasePart
from mpc.optimal_control.schemes import Collocation, MultipleShooting

QUADRATURE = 8  # Gauss points an interval at which the dynamics are compared
TIGHTER = 0.01  # tolerance of CVODES that its result is compared with, beside its own
STILL = 1e-6  # extent of a state, beside what its rate would make of it over the phase, that is rounding


def mesh_errors(phase: PhaseSolution, p: Array) -> Array:
    """What a phase misses of the dynamics over each interval, relative to the extent of each state, (N,).

    For collocation the integral of |dx/dt − f(x, u)| along the polynomials, with inputs that are cut at their bounds
    where they would cross them between the points; for shooting the difference that half the integration step makes,
    or with CVODES a hundredth of its tolerance.
    Zero for discrete dynamics; infinite where the dynamics are not finite between the points.

    References
    ----------
    Betts, "Practical Methods for Optimal Control Using Nonlinear Programming", 3rd ed., SIAM 2020, section 4.7.
    """
    scheme = phase.part.scheme
    if phase.part.phase.discrete:
        return np.zeros(phase.part.intervals)
    moved = np.abs(phase.stages.rates).max(axis=(0, 1)) * phase.duration
    size = np.maximum(np.abs(phase.states).max(axis=0), STILL * moved)
    if isinstance(scheme, Collocation):
        missed = _by_residual(phase, scheme, p)
    elif scheme.integrator == "cvodes":
        missed = _by_tighter_steps(phase, replace(scheme, tolerance=TIGHTER * scheme.tolerance), p)
    else:
        missed = _by_half_steps(phase, scheme.substeps, p)
    relative = missed / np.where(size > 0, size, 1.0)
    return np.asarray(np.where(np.isfinite(relative), relative, np.inf).max(axis=1))


def _by_residual(phase: PhaseSolution, scheme: Collocation, p: Array) -> Array:
    """∫ |dx/dt − f| over every interval, (N, nx)."""
    part, N = phase.part, phase.part.intervals
    tau, weights = np.polynomial.legendre.leggauss(max(QUADRATURE, 2 * scheme.stages))
    tau, weights = 0.5 * (tau + 1), 0.5 * weights
    h = np.diff(phase.times)
    basis = scheme.basis(tau)
    given = np.einsum("tj,kji->kti", basis, phase.stages.rates)
    x = phase.states[:-1, None] + h[:, None, None] * np.einsum("tj,kji->kti", scheme.integrals(tau), phase.stages.rates)
    u = np.clip(np.einsum("tj,kji->kti", basis, phase.stages.inputs), *part.phase.u_bounds)
    times = phase.times[:-1, None] + h[:, None] * tau
    states, inputs = (value.reshape(N * len(tau), -1) for value in (x, u))
    rates = evaluated(part, states, inputs, times.ravel(), p, signal_at(part.phase, times.ravel()))
    missed = np.abs(given - rates.reshape(N, len(tau), -1))
    return np.asarray(h[:, None] * np.einsum("t,kti->ki", weights, missed))


def _by_half_steps(phase: PhaseSolution, substeps: int, p: Array) -> Array:
    """The difference (N, nx) that twice the Runge–Kutta steps make at the end of every interval."""
    part, steps = phase.part, 2 * substeps
    h = np.diff(phase.times) / steps
    u = phase.stages.inputs[:, 0]
    z, t = phase.states[:-1].T, phase.times[:-1].copy()

    def rate(x: Array, at: Array, signal: Array) -> Array:
        return evaluated(part, x.T, u, at, p, signal).T

    for _ in range(steps):
        z = runge_kutta(rate, z, t, h, [signal_at(part.phase, at) for at in (t, t + h / 2, t + h)])
        t = t + h
    return np.abs(z.T - phase.states[1:])


def _by_tighter_steps(phase: PhaseSolution, scheme: MultipleShooting, p: Array) -> Array:
    """The difference (N, nx) of an integration by this scheme at the end of every interval."""
    part, N = phase.part, phase.part.intervals
    interval = interval_function(part.phase, part.functions, scheme, part.layout, len(p))
    times = phase.times[:-1, None] + np.diff(phase.times)[:, None] * np.asarray(part.layout.signals)
    w = signal_at(part.phase, times.ravel()).reshape(N, -1).T
    none = np.zeros((0, N))
    found = interval.map(N)(
        phase.states[:-1].T, none, phase.stages.inputs[:, 0].T, phase.states[1:].T, none,
        np.tile(p[:, None], (1, N)), phase.times[None, :-1], np.diff(phase.times)[None], w,
    )  # fmt: skip
    return np.abs(np.asarray(found[0], dtype=float)).T


def evaluated(part: PhasePart, x: Array, u: Array, t: Array, p: Array, w: Array) -> Array:
    """dx/dt (n, nx) at states (n, nx), inputs (n, nu), times (n,) and signals (n, nw)."""
    n = len(x)
    found = part.functions.dynamics.map(n)(x.T, u.T, w.T, np.tile(p[:, None], (1, n)), t[None])
    return np.asarray(found, dtype=float).reshape(part.layout.nx, n).T
