"""How much the dynamics are missed between the points of a mesh, and finer meshes where that is too much."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from mpc.checks import Array, as_count
from mpc.exceptions import InputError
from mpc.optimal_control.interval import runge_kutta
from mpc.optimal_control.problem import OptimalControlProblem, Phase, signal_at
from mpc.optimal_control.program import PhasePart
from mpc.optimal_control.schemes import Collocation, Scheme
from mpc.optimal_control.solution import OptimalControlStatus, PhaseSolution, Solution
from mpc.optimal_control.solving import solve
from mpc.optimal_control.transcription import build

QUADRATURE = 8  # Gauss points an interval at which the dynamics are compared
MOST_PARTS = 4  # that an interval is cut into at once
LEAST_INTERVAL = 1e-9  # of the phase


def mesh_errors(solution: Solution) -> tuple[Array, ...]:
    """What the dynamics miss over each interval, relative to the extent of each state, (N,) a phase.

    For collocation the integral of |dx/dt − f(x, u)| along the polynomials, with inputs that are cut at their bounds
    where they would cross them between the points; for shooting the difference that half the
    integration step makes. Zero for discrete dynamics.

    References
    ----------
    Betts, "Practical Methods for Optimal Control Using Nonlinear Programming", 3rd ed., SIAM 2020, section 4.7.
    """
    return tuple(
        _errors_of(part, phase, solution.p) for part, phase in zip(solution.program.parts, solution.phases)
    )  # fmt: skip


def _errors_of(part: PhasePart, phase: PhaseSolution, p: Array) -> Array:
    """The errors (N,) of a phase."""
    N = part.intervals
    if part.phase.discrete:
        return np.zeros(N)
    extent = np.abs(phase.states).max(axis=0)
    rates = np.abs(phase._rates).max(axis=(0, 1)) * phase.duration
    size = np.maximum(np.maximum(extent, 1e-12), np.minimum(rates, 1.0) * 1e-6)
    if isinstance(part.scheme, Collocation):
        missed = _by_residual(part, part.scheme, phase, p)
    else:
        missed = _by_half_steps(part, part.scheme.substeps, phase, p)
    return np.asarray((missed / size).max(axis=1))


def _by_residual(part: PhasePart, scheme: Collocation, phase: PhaseSolution, p: Array) -> Array:
    """∫ |dx/dt − f| over every interval, (N, nx)."""
    N = part.intervals
    tau, weights = np.polynomial.legendre.leggauss(max(QUADRATURE, 2 * scheme.stages))
    tau, weights = 0.5 * (tau + 1), 0.5 * weights
    h = np.diff(phase.times)
    basis = scheme.basis(tau)
    given = np.einsum("tj,kji->kti", basis, phase._rates)
    x = phase.states[:-1, None] + h[:, None, None] * np.einsum("tj,kji->kti", scheme.integrals(tau), phase._rates)
    u = np.clip(np.einsum("tj,kji->kti", basis, phase._stages[2]), *part.phase.u_bounds)
    times = phase.times[:-1, None] + h[:, None] * tau
    rates = evaluated(
        part,
        x.reshape(N * len(tau), -1),
        u.reshape(N * len(tau), -1),
        times.ravel(),
        p,
        signal_at(part.phase, times.ravel()),
    )
    missed = np.abs(given - rates.reshape(N, len(tau), -1))
    return np.asarray(h[:, None] * np.einsum("t,kti->ki", weights, missed))


def _by_half_steps(part: PhasePart, substeps: int, phase: PhaseSolution, p: Array) -> Array:
    """The difference (N, nx) that twice the Runge–Kutta steps make at the end of every interval."""
    steps = 2 * substeps
    h = np.diff(phase.times) / steps
    u = phase._stages[2][:, 0]
    z, t = phase.states[:-1].T, phase.times[:-1].copy()

    def rate(x: Array, at: Array, signal: Array) -> Array:
        return evaluated(part, x.T, u, at, p, signal).T

    for _ in range(steps):
        z = runge_kutta(rate, z, t, h, [signal_at(part.phase, at) for at in (t, t + h / 2, t + h)])
        t = t + h
    return np.abs(z.T - phase.states[1:])


def evaluated(part: PhasePart, x: Array, u: Array, t: Array, p: Array, w: Array) -> Array:
    """dx/dt (n, nx) at states (n, nx), inputs (n, nu), times (n,) and signals (n, nw)."""
    n = len(x)
    found = part.functions.dynamics.map(n)(x.T, u.T, w.T, np.tile(p[:, None], (1, n)), t[None])
    return np.asarray(found, dtype=float).reshape(part.layout.nx, n).T


def refine(problem: OptimalControlProblem | Phase, scheme: Scheme | None = None, *, intervals: Any = 10,
           tolerance: float = 1e-6, rounds: int = 10, **options: Any) -> Solution:  # fmt: skip
    """Solve on meshes that are made finer where the dynamics are missed, until they are met to a tolerance.

    Parameters
    ----------
    problem : OptimalControlProblem or Phase
    scheme : Collocation or MultipleShooting, optional
        `Radau(3)` by default.
    intervals : int, or one a phase
        Of the first mesh.
    tolerance : float
        Of `Solution.errors`.
    rounds : int
        Meshes at most.
    **options
        For `solve`.

    Returns
    -------
    Solution
        Of the last mesh; STOPPED if its errors are still larger.
    """
    if not 0 < float(tolerance) < 1:
        raise InputError("tolerance", tolerance, "a number between 0 and 1")
    began = time.perf_counter()
    program = build(problem, scheme, intervals)
    solution = solve(program, **options)
    iterations = solution.iterations
    if not solution.solved:
        return solution
    for _ in range(as_count("rounds", rounds) - 1):
        if all(error.max(initial=0.0) <= tolerance for error in solution.errors):
            break
        meshes = [_finer(part, error, tolerance) for part, error in zip(program.parts, solution.errors)]
        program = build(program.problem, program.parts[0].scheme, meshes=meshes)
        finer = solve(program, start=solution, **options)
        iterations += finer.iterations
        if not finer.solved:
            fresh = solve(program, **options)
            iterations += fresh.iterations
            finer = min(finer, fresh, key=lambda found: found.residuals.worst)
        if not finer.solved:
            return _ended(solution, "a finer mesh was not solved", iterations, began)
        solution = finer
    met = all(error.max(initial=0.0) <= tolerance for error in solution.errors)
    return _ended(solution, "" if met else "these were all the rounds", iterations, began)


def _ended(solution: Solution, reason: str, iterations: int, began: float) -> Solution:
    """The last solution, STOPPED for a reason, if there is one."""
    stopped = bool(reason) and solution.solved
    missed = f"; {reason}: the mesh misses the dynamics by {_worst(solution):.1e}"
    return replace(
        solution, iterations=iterations, solve_time=time.perf_counter() - began,
        status=OptimalControlStatus.STOPPED if stopped else solution.status,
        message=solution.message + missed * stopped,
    )  # fmt: skip


def _worst(solution: Solution) -> float:
    """The largest error of a mesh."""
    return max(float(error.max(initial=0.0)) for error in solution.errors)


def _finer(part: PhasePart, errors: Array, tolerance: float) -> Array:
    """A mesh whose intervals are cut into as many parts as their errors ask for."""
    order = part.scheme.stages + 1 if isinstance(part.scheme, Collocation) else 5
    asked = np.ceil((np.maximum(errors, tolerance) / (0.5 * tolerance)) ** (1 / order)).astype(int)
    steps = np.diff(part.mesh)
    parts = np.where((errors > tolerance) & (steps > LEAST_INTERVAL), np.clip(asked, 2, MOST_PARTS), 1)
    inner = [left + step * np.arange(n) / n for left, step, n in zip(part.mesh[:-1], steps, parts)]
    return np.append(np.concatenate(inner), 1.0)
