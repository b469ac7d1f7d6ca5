"""Finer meshes where the dynamics are missed."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np

from mpc.checks import Array, as_count
from mpc.exceptions import InputError
from mpc.optimal_control.path_excess import intervals_passed
from mpc.optimal_control.phase import Phase
from mpc.optimal_control.phase_solution import PhaseSolution
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.program import NonlinearProgram
from mpc.optimal_control.schemes import Collocation, Scheme
from mpc.optimal_control.solution import OptimalControlStatus, Solution
from mpc.optimal_control.solving import solve
from mpc.optimal_control.transcription import build

SAFETY = 0.05  # part of the tolerance that new intervals aim at
MOST_PARTS = 6  # that an interval is cut into at once
PINNED = 0.1  # of the root of the tolerance, to which the place of a jump is known
SHARPNESS = 1e-3  # tolerance of the last solves where inputs may jump: short intervals weigh little in the cost
GROWTH = 1.5  # of the program, by those last solves
AT_BOUND = 1e-6  # of an input's range
JUMP = 0.5  # of an input's range, crossed within one interval
LEAST_INTERVAL = 1e-9  # of the phase


def refine(problem: OptimalControlProblem | Phase, scheme: Scheme | None = None, *, intervals: Any = 10,
           tolerance: float = 1e-6, rounds: int = 10, **options: Any) -> Solution:  # fmt: skip
    """Solve on meshes that are made finer where the dynamics are missed, until they are met to a tolerance.

    Intervals in which a path limit is passed between the points are halved, too, in as many rounds as there are.

    Where an input jumps, intervals are cut to a tenth of the root of the tolerance: the cost feels the square of that,
    parameters the length itself.

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
    began, left = time.perf_counter(), as_count("rounds", rounds) - 1
    program = build(problem, scheme, intervals)
    solution = solve(program, **options)
    if not solution.solved:
        return solution
    rounds_of = _Rounds(options, tolerance, left, solution.iterations)
    solution, reason = rounds_of.refined(solution)
    if not reason and "tolerance" not in options and _reach_bounds(solution):
        sharp = _Rounds(options | {"tolerance": SHARPNESS * tolerance}, tolerance, rounds_of.left, rounds_of.iterations)
        finer = sharp.sharpened(solution)
        return _ended(solution if finer is None else finer, "", sharp.iterations, began)
    return _ended(solution, reason, rounds_of.iterations, began)


class _Rounds:
    """Solves on finer and finer meshes, each from the one before."""

    def __init__(self, options: dict[str, Any], tolerance: float, left: int, iterations: int) -> None:
        self.options = {name: value for name, value in options.items() if name != "start"}
        self.tolerance = tolerance
        self.left = left
        self.iterations = iterations
        self.most = sys.maxsize

    def refined(self, solution: Solution) -> tuple[Solution, str]:
        """The last solution, and why it is not the one that was asked for, if it is not."""
        while (meshes := self._meshes(solution)) is not None:
            if not self.left:
                met = _met(solution, self.tolerance)
                return solution, "" if met else "these were all the rounds"
            self.left -= 1
            program = build(solution.program.problem, solution.phases[0].part.scheme, meshes=meshes)
            if program.v.numel() > self.most:
                return solution, "a mesh that meets them is too large"
            finer = self._solved(program, solution)
            if not finer.solved:
                return solution, "a finer mesh was not solved"
            solution = finer
        met = _met(solution, self.tolerance)
        return solution, "" if met else "intervals are as short as they may be"

    def sharpened(self, solution: Solution) -> Solution | None:
        """The solution to a tighter tolerance of the solver, if a mesh of much the same size does for that.

        Along a singular arc it does not: the input begins to swing.
        """
        self.most = int(GROWTH * len(solution.unknowns))
        sharp = self._solved(solution.program, solution)
        if not sharp.solved:
            return None
        sharp, reason = self.refined(sharp)
        return None if reason else sharp

    def _solved(self, program: NonlinearProgram, start: Solution) -> Solution:
        """From the solution of another mesh; if that fails, from the guess."""
        found = solve(program, start=start, **self.options)
        self.iterations += found.iterations
        if found.solved:
            return found
        fresh = solve(program, **self.options)
        self.iterations += fresh.iterations
        return min(found, fresh, key=lambda one: (not one.solved, one.residuals.worst))

    def _meshes(self, solution: Solution) -> list[Array] | None:
        """Finer meshes; None where none is asked for."""
        meshes = []
        for k, (phase, error) in enumerate(zip(solution.phases, solution.errors)):
            passed = intervals_passed(solution.program, k, phase, solution.p) > self.tolerance
            meshes.append(_finer(phase, error, passed, self.tolerance))
        same = all(len(mesh) == len(phase.times) for mesh, phase in zip(meshes, solution.phases))
        return None if same else meshes


def _reach_bounds(solution: Solution) -> bool:
    """Whether inputs reach their bounds, between which they may jump."""
    for phase in solution.phases:
        low, high = phase.part.phase.u_bounds
        room = AT_BOUND * np.where(np.isfinite(high - low), high - low, 0.0)
        if phase.inputs.size and ((phase.inputs <= low + room) | (phase.inputs >= high - room)).any():
            return True
    return False


def _ended(solution: Solution, reason: str, iterations: int, began: float) -> Solution:
    """The last solution, STOPPED for a reason, if there is one."""
    stopped = bool(reason) and solution.solved
    missed = f"; {reason}: the mesh misses the dynamics by {_worst(solution):.1e}"
    return replace(
        solution, iterations=iterations, solve_time=time.perf_counter() - began,
        status=OptimalControlStatus.STOPPED if stopped else solution.status,
        message=solution.message + missed * stopped,
    )  # fmt: skip


def _met(solution: Solution, tolerance: float) -> bool:
    """Whether the dynamics are met."""
    return all(error.max(initial=0.0) <= tolerance for error in solution.errors)


def _worst(solution: Solution) -> float:
    """The largest error of a mesh."""
    return max(float(error.max(initial=0.0)) for error in solution.errors)


def _finer(phase: PhaseSolution, errors: Array, passed: Any, tolerance: float) -> Array:
    """A mesh whose intervals are cut into as many parts as their errors ask for, and where an input jumps.

    Intervals in which a path limit is passed are halved, as long as they are longer than the place of a jump.
    """
    part = phase.part
    order = part.scheme.stages + 1 if isinstance(part.scheme, Collocation) else 5
    asked = np.ceil((np.maximum(errors, tolerance) / (SAFETY * tolerance)) ** (1 / order)).astype(int)
    steps = np.diff(part.mesh)
    parts = np.where(errors > tolerance, np.clip(asked, 2, MOST_PARTS), 1)
    long = steps > PINNED * np.sqrt(tolerance)
    parts[passed & long] = np.maximum(parts, 2)[passed & long]
    parts[_jumps(phase) & long] = MOST_PARTS
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
