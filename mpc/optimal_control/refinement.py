"""Mesh refinement."""

from __future__ import annotations

import sys
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
from tqdm import tqdm

from ccdtools_ground.door import as_share, brief
from mpc.budgets import MESH_SAFETY, MESHES_WITHOUT_GAIN, MOST_PARTS
from mpc.checks import Array, Flags, as_count, as_seconds
from mpc.exceptions import InputError
from mpc.optimal_control.phase import Phase
from mpc.optimal_control.phase_solution import PhaseSolution
from mpc.optimal_control.planning import Clock
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.program import NonlinearProgram, shaken
from mpc.optimal_control.schemes import Collocation, Scheme
from mpc.optimal_control.solution import Ends, OptimalControlStatus, Solution, merged
from mpc.optimal_control.solving import optima, solve
from mpc.optimal_control.starts import as_starts
from mpc.optimal_control.transcription import build
from mpc.tolerances import (
    AT_BOUND,
    COARSE_MESH,
    COST_ROUNDING,
    JUMP_PLACE,
    JUMP_SHARE,
    JUMPED_LIMIT,
    LEAST_INTERVAL,
    LIMIT_PASSED,
    MESH_GAIN,
    SHARPER,
)

NO_TIME, NO_ROUNDS, FINER = "the time was up", "these were all the rounds", "on a finer mesh"
PASSING = (OptimalControlStatus.LIMITS_PASSED, OptimalControlStatus.STOPPED, OptimalControlStatus.INACCURATE)


def refine(problem: OptimalControlProblem | Phase, scheme: Scheme | None = None, *, intervals: Any = 10,
           tolerance: float = 1e-6, of: str = "dynamics", rounds: int = 15, starts: Any = 1,
           time_limit: float | None = None, progress: bool = False, **options: Any) -> Solution:  # fmt: skip
    """Solve on meshes refined until the dynamics are met.

    Intervals in which a limit is passed between the points are cut, too. Where that does not help, as a trajectory
    jumps over an obstacle, it is looked for anew, from a guess that is moved aside.

    Where an input jumps, or would by the Hamiltonian, intervals are cut to a tenth of the root of the tolerance: the
    cost feels the square of that, parameters the length itself.

    Parameters
    ----------
    problem : OptimalControlProblem or Phase
    scheme : Collocation or MultipleShooting, optional
        `Radau(3)` by default.
    intervals : int, or one a phase
        Of the first mesh.
    tolerance : float
    of : {"dynamics", "cost"}
        What the tolerance is of: `Solution.errors`, or the part of the cost by which `cost_error` estimates it to be
        off. Intervals are cut where either is missed; the other is met as SOLVED asks for.
    rounds : int
        Meshes at most, for each optimum.
    starts : int or list
        Places to begin at on the first mesh, see `solve`. Every optimum is refined that is not dearer than the best so
        far by more than its own estimated error; the best is returned.
    time_limit : float, optional
        Of all meshes together [s].
    progress : bool
        Show a progress bar: meshes, their intervals, and what they miss.
    **options
        For `solve`.

    Returns
    -------
    Solution
        SOLVED if its mesh meets the tolerance and limits are kept between the points. Else of the mesh that missed
        least, LIMITS_PASSED, COARSE or STOPPED: when rounds or time were up, or when twice in a row a finer mesh missed
        as much as the one before and no jump was looked for; `advice` says which, and what tolerance was reached.
        `cost_error` estimates the cost's error.
    """
    asked = as_share("tolerance", tolerance)
    if not isinstance(of, str) or of not in ("dynamics", "cost"):
        raise InputError("of", brief(repr(of)), "'dynamics' or 'cost'")
    clock, meshes = Clock(as_seconds("time_limit", time_limit)), as_count("rounds", rounds)
    with tqdm(total=meshes, desc="refining", disable=not progress, leave=False) as bar:
        run = _Rounds(options, asked, of, meshes - 1, clock, bar)
        program = build(problem, scheme, intervals)
        solution, reason, ends = run.best_of(program, starts)
        solution, reason = run.sharpened(solution, reason)
        for seed in range(3):  # each guess on a mesh twice as fine
            if not _jumps_over(solution) or clock.late:
                break
            halved = [np.sort(np.r_[part.mesh, (part.mesh[:-1] + part.mesh[1:]) / 2]) for part in program.parts]
            program = build(program.problem, scheme, meshes=halved)
            run.left = run.rounds
            moved = replace(program, guess=shaken(program, seed))
            other, ended = run.refined(run.solved(moved, None))
            if other.solved_on_mesh and (not solution.solved_on_mesh or run.missed(other) < run.missed(solution)):
                solution, reason = run.sharpened(other, ended)
        return _ended(replace(solution, ends=ends), reason, run)


class _Rounds:
    """Solves on finer and finer meshes."""

    def __init__(self, options: dict[str, Any], tolerance: float, of: str, left: int, clock: Clock, bar: Any) -> None:
        self.options = options
        self.tolerance = tolerance
        self.of_cost = of == "cost"
        self.dynamics = COARSE_MESH if self.of_cost else tolerance
        self.rounds = self.left = left
        self.clock = clock
        self.bar = bar
        self.iterations = [0]
        self.most = sys.maxsize

    def refined(self, solution: Solution) -> tuple[Solution, str]:
        """Best solution, and why it misses the tolerance, if so."""
        best, still = solution, 0
        while solution.solved_on_mesh and (meshes := self._meshes(solution)) is not None:
            if reason := self._over(still):
                return best, "" if self.missed(best) <= 1 else reason
            self.left -= 1
            program = build(solution.program.problem, solution.phases[0].part.scheme, meshes=meshes)
            if len(program.lower) > self.most:
                return best, "a mesh that meets it is too large"
            finer = self.solved(program, solution)
            if not finer.solved_on_mesh:
                return best, self._over(0) or f"{FINER} the problem is {finer.status.name}"
            through = finer.excess > max(JUMPED_LIMIT, MESH_GAIN * solution.excess)
            helped = self.missed(finer) <= max(MESH_GAIN * self.missed(solution), 1)
            lost = not any(map(np.any, self._jumps(solution)))  # a mesh that finds a jump may miss it by more at first
            still = 0 if helped else MESHES_WITHOUT_GAIN if through else still + lost
            solution = finer
            best = solution if self.missed(solution) <= max(self.missed(best), 1) else best
        return best, "" if self.missed(best) <= 1 else "intervals are as short as they may be"

    def best_of(self, program: NonlinearProgram, starts: Any) -> tuple[Solution, str, tuple[Ends, ...]]:
        """Best refined solution of several starts, and how they ended."""
        rounds = self.left
        if as_starts(starts) == 1:
            return *self.refined(self.solved(program, None)), ()
        first = optima(program, starts=starts, time_limit=self.clock.left, **self.options)
        self.iterations[0] += first[0].iterations
        best, reason = self.refined(first[0])
        ended = {(first[0].status, first[0].cost): best}
        for other in first[1:]:
            dearer = best.solved and other.cost - other.cost_error > best.cost
            if dearer or self.clock.late:
                continue
            self.left = rounds
            finer, missed = self.refined(other)
            ended[other.status, other.cost] = finer
            if finer.rank < best.rank:
                best, reason = finer, missed
        told = [(ended.get((one.status, one.cost), one), one.count) for one in first[0].ends]
        return best, reason, merged([Ends(one.status, one.cost, count) for one, count in told])

    def missed(self, solution: Solution) -> float:
        """Error of the dynamics, the cost or a limit, in tolerances [-]."""
        error = self.off(solution) / self.tolerance if self.of_cost else 0.0
        return max(error, solution.mesh_error / self.dynamics, solution.excess / LIMIT_PASSED)

    def _jumps(self, solution: Solution) -> list[Flags]:
        """Intervals of each phase that miss a jump.

        There inputs at a bound would save more than is tolerated. Amid others that would be another optimum, which no
        finer mesh leads to.
        """
        least = min(self.tolerance * _size_of_cost(solution), self._share(solution))
        each = [one.saved > least for one in solution.missed]
        return [saves & (np.convolve(saves, [1, 0, 1])[1:-1] == 0) for saves in each]

    def _share(self, solution: Solution) -> float:
        """Error of the cost that each interval may have."""
        allowed = self.tolerance * _size_of_cost(solution) if self.of_cost else solution.cost_tolerance
        fine = not self.of_cost and solution.cost_error <= allowed
        return np.inf if fine else allowed / sum(len(one.cost) for one in solution.missed)

    def off(self, solution: Solution) -> float:
        """Part of the cost by which it may be off [-]."""
        return solution.cost_error / _size_of_cost(solution)

    def _over(self, still: int) -> str:
        """Reason why there is no further round, or ""."""
        if self.clock.late:
            return NO_TIME
        if not self.left:
            return NO_ROUNDS
        said = f"{MESHES_WITHOUT_GAIN} times in a row a finer mesh missed as much as the one before"
        return said if still >= MESHES_WITHOUT_GAIN else ""

    def sharpened(self, solution: Solution, reason: str) -> tuple[Solution, str]:
        """Solution to a tighter solver tolerance where inputs reach bounds, if that leads to one.

        Along a singular arc it does not: the input begins to swing. Limits that are passed a little may then be kept,
        which weigh as little in the cost as intervals are short.
        """
        a_little = LIMIT_PASSED < solution.excess <= JUMPED_LIMIT and reason not in (NO_TIME, NO_ROUNDS)
        if not solution.solved_on_mesh or (reason and not a_little) or not _reach_bounds(solution):
            return solution, reason
        rounds = copy(self)
        rounds.options = self.options | {"tolerance": SHARPER * self.tolerance}
        rounds.left = self.rounds
        rounds.most = int(1.5 * len(solution.unknowns))
        sharp, missed = rounds.refined(rounds.solved(solution.program, solution))
        return (sharp, "") if sharp.solved_on_mesh and not missed else (solution, reason)

    def solved(self, program: NonlinearProgram, start: Solution | None) -> Solution:
        """Solution from `start`, else from the guess."""
        found = self._once(program, self.options if start is None else self.options | {"start": start})
        if not found.solved_on_mesh and start is not None and not self.clock.late:
            fresh = self._once(program, {name: value for name, value in self.options.items() if name != "start"})
            found = min(found, fresh, key=lambda one: (not one.solved_on_mesh, one.residuals.worst))
        if found.solved_on_mesh:
            intervals = sum(part.intervals for part in program.parts)
            self.bar.set_postfix_str(f"{intervals} intervals miss {found.mesh_error:.1e}")
        self.bar.update()
        return found

    def _once(self, program: NonlinearProgram, options: dict[str, Any]) -> Solution:
        """One solve in the time left."""
        found = solve(program, time_limit=self.clock.left, **options)
        self.iterations[0] += found.iterations
        return found

    def _meshes(self, solution: Solution) -> list[Array] | None:
        """Finer meshes; None where none are needed."""
        meshes, share = [], self._share(solution)
        each = zip(solution.phases, solution.missed, solution.path_excess, self._jumps(solution))
        for phase, missed, passed, jumps in each:
            errors = np.maximum(missed.cost / share, missed.dynamics / self.dynamics)  # in tolerances
            meshes.append(_finer_mesh(phase, errors, passed.intervals / LIMIT_PASSED, jumps, self.tolerance))
        same = all(len(mesh) == len(phase.times) for mesh, phase in zip(meshes, solution.phases))
        return None if same else meshes


def _size_of_cost(solution: Solution) -> float:
    """Size of the cost, beside which that of a cost that vanishes is rounding."""
    return max(abs(solution.cost), COST_ROUNDING * solution.program.cost_scale)


def _reach_bounds(solution: Solution) -> bool:
    """Whether inputs reach their bounds."""
    for phase in solution.phases:
        low, high = phase.part.phase.u_bounds
        room = AT_BOUND * np.where(np.isfinite(high - low), high - low, 0.0)
        inputs = phase.stages.inputs
        if inputs.size and ((inputs <= low + room) | (inputs >= high - room)).any():
            return True
    return False


def _jumps_over(solution: Solution) -> bool:
    """Whether limits are passed between points at the end."""
    return solution.status in PASSING and solution.excess > LIMIT_PASSED


def _ended(solution: Solution, reason: str, run: _Rounds) -> Solution:
    """Best solution, with a reason where tolerances are missed."""
    found = replace(solution, iterations=run.iterations[0], solve_time=run.clock.taken)
    if not solution.solved_on_mesh or run.missed(solution) <= 1:
        return found
    of_cost = (run.off(solution), run.tolerance, "misses the cost")
    of_limits = (solution.excess, LIMIT_PASSED, "passes limits between its points")
    each = ((solution.mesh_error, run.dynamics, "misses the dynamics"), of_limits, *([of_cost] if run.of_cost else []))
    worst, asked, what = max(each, key=lambda one: one[0] / one[1])
    missed = f"{reason}: the mesh {what} by {worst:.1e}"
    more = ", or for more rounds or time" if reason in (NO_TIME, NO_ROUNDS) else ""
    digit = 10.0 ** np.floor(np.log10(worst)) if np.isfinite(worst) else 1.0
    ask = f"Ask for {np.ceil(worst / digit) * digit:g}{more}." if asked == run.tolerance else "Take more intervals."
    if what == of_limits[2]:
        ask = "Keep a margin to them."
    if reason.startswith(FINER) or solution.excess > JUMPED_LIMIT:
        ask = "What holds here may hold at the points of the mesh alone: relax limits, or give a guess nearer to them."
    swinging = max(float(np.diff(one.part.mesh) @ _crossings(one)[1]) for one in solution.phases)
    if swinging > 0:
        ask += f" Inputs swing over {swinging:.0%} of the time, as along singular arcs: MultipleShooting() holds them."
    cure = f"This is the optimum on its mesh, but {missed} where {asked:.1e} was asked for. {ask}"
    status = solution.status if _jumps_over(solution) else OptimalControlStatus.STOPPED
    return replace(found, status=status, message=f"{solution.message}; {missed}", notes=(cure, *solution.notes))


def _finer_mesh(phase: PhaseSolution, errors: Array, excess: Array, jumps: Flags, tolerance: float) -> Array:
    """Mesh cut where errors and violations (N,) are above 1, or a jump is missed."""
    part = phase.part
    order = part.scheme.stages + 1 if isinstance(part.scheme, Collocation) else 5
    asked = np.clip((np.maximum(errors, 1.0) / MESH_SAFETY) ** (1 / order), 2, MOST_PARTS)
    steps = np.diff(part.mesh)
    parts = np.where(errors > 1, np.ceil(asked).astype(int), 1)
    long = steps > JUMP_PLACE * np.sqrt(tolerance)
    parts = np.where(excess > 1, np.maximum(parts, np.clip(np.ceil(np.cbrt(excess)), 2, MOST_PARTS)), parts).astype(int)
    crossing, swinging = _crossings(phase)
    parts[(jumps | crossing & ~swinging) & long] = MOST_PARTS  # where an input jumps
    parts[steps <= LEAST_INTERVAL] = 1
    if part.phase.discrete:
        return part.mesh
    inner = [left + step * np.arange(n) / n for left, step, n in zip(part.mesh[:-1], steps, parts)]
    return np.append(np.concatenate(inner), 1.0)


def _crossings(phase: PhaseSolution) -> tuple[Flags, Flags]:
    """Intervals (N,) in which an input crosses much of its range, and neighbours that do.

    There inputs swing back and forth, as along a singular arc, and there is no jump to find.
    """
    inputs = phase.stages.inputs
    if not inputs.size:
        return (np.zeros(len(inputs), dtype=bool),) * 2
    whole = np.ptp(inputs, axis=(0, 1))
    crossing = (np.ptp(inputs, axis=1) > JUMP_SHARE * np.where(whole > 0, whole, np.inf)).any(axis=1)
    return crossing, crossing & (np.convolve(crossing, [1, 0, 1])[1:-1] > 0)
