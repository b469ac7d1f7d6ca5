"""Finer meshes where the dynamics are missed."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from mpc.checks import Array, as_count
from mpc.exceptions import InputError
from mpc.optimal_control.phase import Phase
from mpc.optimal_control.phase_solution import PhaseSolution
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.schemes import Collocation, Scheme
from mpc.optimal_control.solution import OptimalControlStatus, Solution
from mpc.optimal_control.solving import solve
from mpc.optimal_control.transcription import build

SAFETY = 0.05  # part of the tolerance that new intervals aim at
MOST_PARTS = 6  # that an interval is cut into at once
JUMP = 0.5  # of an input's range, crossed within one interval
LEAST_INTERVAL = 1e-9  # of the phase


def refine(problem: OptimalControlProblem | Phase, scheme: Scheme | None = None, *, intervals: Any = 10,
           tolerance: float = 1e-6, rounds: int = 10, **options: Any) -> Solution:  # fmt: skip
    """Solve on meshes that are made finer where the dynamics are missed, until they are met to a tolerance.

    Where an input jumps, intervals are cut to the root of the tolerance, which the cost feels as the tolerance.

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
        meshes = [_finer(phase, error, tolerance) for phase, error in zip(solution.phases, solution.errors)]
        if all(len(mesh) == len(phase.times) for mesh, phase in zip(meshes, solution.phases)):
            break
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


def _finer(phase: PhaseSolution, errors: Array, tolerance: float) -> Array:
    """A mesh whose intervals are cut into as many parts as their errors ask for, and where an input jumps."""
    part = phase.part
    order = part.scheme.stages + 1 if isinstance(part.scheme, Collocation) else 5
    asked = np.ceil((np.maximum(errors, tolerance) / (SAFETY * tolerance)) ** (1 / order)).astype(int)
    steps = np.diff(part.mesh)
    parts = np.where(errors > tolerance, np.clip(asked, 2, MOST_PARTS), 1)
    parts[_jumps(phase) & (steps > np.sqrt(tolerance))] = MOST_PARTS
    parts[steps <= LEAST_INTERVAL] = 1
    if part.phase.discrete:
        return part.mesh
    inner = [left + step * np.arange(n) / n for left, step, n in zip(part.mesh[:-1], steps, parts)]
    return np.append(np.concatenate(inner), 1.0)


def _jumps(phase: PhaseSolution) -> Array:
    """Intervals (N,) within which an input crosses most of its range: the jump's own place is known no better.

    Not where it crosses back and forth in neighbours, as inputs do along a singular arc: there is no jump to find.
    """
    inputs = phase.stages.inputs
    if not inputs.size:
        return np.zeros(len(inputs), dtype=bool)
    whole = np.ptp(inputs, axis=(0, 1))
    crossing = (np.ptp(inputs, axis=1) > JUMP * np.where(whole > 0, whole, np.inf)).any(axis=1)
    beside = np.convolve(crossing, [1, 0, 1], mode="same") > 0
    return np.asarray(crossing & ~beside)
