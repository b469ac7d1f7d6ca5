"""Solution of a nonlinear program, checked by its own derivatives."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ccdtools_ground.door import as_instance, as_share, brief
from mpc.budgets import USUAL_ITERATIONS
from mpc.checks import Array, as_count, as_floats, as_seconds
from mpc.exceptions import InputError
from mpc.optimal_control.descriptions import contradiction, violated
from mpc.optimal_control.interval import placed
from mpc.optimal_control.ipopt import WARM, Found, Settings, once
from mpc.optimal_control.notes import notes_of, undefined
from mpc.optimal_control.phase import Phase
from mpc.optimal_control.phase_solution import phase_solution
from mpc.optimal_control.planning import Clock
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.program import (
    NonlinearProgram,
    costs_of_scenarios,
    elastic,
    longer,
    rescaled,
    shaken,
    sized_as,
    unwound,
)
from mpc.optimal_control.solution import Ends, OptimalControlStatus, Solution, alike, merged
from mpc.optimal_control.starts import as_starts, promising, with_guess, without_limits
from mpc.optimal_control.transcription import build
from mpc.tolerances import BOTTOMLESS, COARSE_MESH, COST_ROUNDING, FAR_OPTIMUM, FEASIBLE, OPTIMAL, WELL_SIZED

SAID = {
    "Maximum_Iterations_Exceeded": OptimalControlStatus.STOPPED,
    "Maximum_WallTime_Exceeded": OptimalControlStatus.STOPPED,
    "Maximum_CpuTime_Exceeded": OptimalControlStatus.STOPPED,
    "User_Requested_Stop": OptimalControlStatus.STOPPED,  # by its clock
    "Infeasible_Problem_Detected": OptimalControlStatus.INFEASIBLE,
    "Restoration_Failed": OptimalControlStatus.INFEASIBLE,
    "Invalid_Number_Detected": OptimalControlStatus.UNDEFINED,
}
ENDLESS = "Diverging_Iterates"
LATE = "User_Requested_Stop"


def solve(program: NonlinearProgram | OptimalControlProblem | Phase, *, start: Solution | None = None,
          starts: Any = 1, p: ArrayLike | None = None, tolerance: float = 1e-8, max_iterations: int = USUAL_ITERATIONS,
          time_limit: float | None = None, options: dict[str, Any] | None = None) -> Solution:  # fmt: skip
    """Solve an optimal control problem.

    Parameters
    ----------
    program : NonlinearProgram, OptimalControlProblem or Phase
        What `build` made; a problem is built with its defaults.
    start : Solution, optional
        Where to start from, of any mesh of the same phases.
    starts : int or list
        Number of places to begin at, of which the best optimum is taken: the guess, or `start`, and places about the
        optimum without limits along the way, those that promise most after a few iterations. Or the places: each a
        Solution or, of one phase, (times, x, u) as `Phase(guess=…)`. `Solution.ends` and `advice` say where they led.
    p : (np,) array, optional
        Parameters to hold at these values, within their bounds: nothing is built anew. The program of the solution
        holds them, too.
    tolerance : float
        Of the solver, on scaled unknowns.
    max_iterations : int
        Stopped there, or by the time, the best feasible iterate is returned.
    time_limit : float, optional
        Of all that one solve takes [s].
    options : dict, optional
        For Ipopt, such as {"linear_solver": "mumps"}.

    Returns
    -------
    Solution
        With a status: only what passes a check of its own is called SOLVED.
    """
    return optima(program, start=start, starts=starts, p=p, tolerance=tolerance, max_iterations=max_iterations,
                  time_limit=time_limit, options=options)[0]  # fmt: skip


def optima(program: NonlinearProgram | OptimalControlProblem | Phase, *, start: Solution | None = None,
           starts: Any = 1, p: ArrayLike | None = None, **settled: Any) -> list[Solution]:  # fmt: skip
    """Solutions that differ, the best first; the arguments are those of `solve`."""
    given = build(program) if isinstance(program, OptimalControlProblem | Phase) else program
    expected = "what `build` returns, an OptimalControlProblem or a Phase"
    built: NonlinearProgram = as_instance("program", given, NonlinearProgram, expected)
    settings = as_settings(**settled)
    as_instance("start", start, (Solution, type(None)), "a Solution, or None")
    if p is not None:
        built = _held(built, p)
    places = as_starts(starts)
    if isinstance(places, list) and start is not None:
        raise InputError("start", "a solution beside a list of starts", "one of the two", "Put it into the list.")
    tries = _Tries(built, settings)
    if isinstance(places, list):
        for place in places:
            tries.begin_at(place if isinstance(place, Solution) else with_guess(built, place).guess)
    else:
        tries.begin_at(built.guess if start is None else start)
        tries.begin_about(tries.tried[0][1].v, places - 1)
    return tries.ranked()


class _Tries:
    """Solves of one program from several places, within one time limit."""

    def __init__(self, program: NonlinearProgram, settings: Settings) -> None:
        self.program = program
        self.settings = settings
        self.clock = Clock(settings.seconds)
        self.tried: list[tuple[Run, Found]] = []
        self.iterations = 0

    def begin_at(self, place: Solution | Array) -> None:
        """Solve from a solution or unknowns (n,), if there is time left."""
        if self.tried and self.clock.late:
            return
        warm = isinstance(place, Solution)
        guess, multipliers = _from_solution(self.program, place) if isinstance(place, Solution) else (place, None)
        sized = sized_as(self.program, place.program) if isinstance(place, Solution) else self.program
        run = Run(sized, self.settings, self.clock)
        found = run.solved(np.clip(guess, self.program.lower, self.program.upper), multipliers, warm=warm)
        if found.ended and not found.iterations and not warm:
            found = run.elsewhere(found)
        self.tried.append((run, found))

    def begin_about(self, v: Array, count: int) -> None:
        """Solve from so many places about unknowns (n,)."""
        free, run = without_limits(self.program), self.tried[0][0]
        if count and free is not self.program:
            v = once(free, v, None, run.left(warm=False)).v
        places, self.iterations = promising(self.program, v, count, self.settings, self.clock) if count else ([], 0)
        for place in places:
            self.begin_at(place)

    def ranked(self) -> list[Solution]:
        """Solutions, one for each optimum, the best first; without an optimum the best."""
        solved, unbounded = OptimalControlStatus.SOLVED, OptimalControlStatus.UNBOUNDED
        good = [pair for pair in self.tried if status_of(pair[1]) is solved]
        good.sort(key=lambda pair: pair[0].cost(pair[1]))
        solutions: list[Solution] = []
        ends = [Ends(unbounded if run.falls(found) else status, np.nan, 1) for run, found in self.tried
                if (status := status_of(found)) is not solved]  # fmt: skip
        for run, found in good:
            if not (solutions and alike(run.cost(found), solutions[-1].cost)):
                solutions.append(run.judged(found))
            ends.append(Ends(solutions[-1].status, solutions[-1].cost, 1))
        if not solutions:
            run, found = min(self.tried, key=_missed)
            solutions = [run.judged(found)]
        iterations = self.iterations + sum(run.iterations for run, _ in self.tried)
        told = merged(ends) if len(self.tried) > 1 else ()
        solutions = [replace(one, iterations=iterations, ends=told) for one in solutions]
        return sorted(solutions, key=lambda one: one.rank)


def _missed(tried: tuple[Run, Found]) -> tuple[float, float]:
    """Violation and cost of what is no optimum."""
    run, found = tried
    worst, cost = found.violations.max(initial=0.0), run.cost(found)
    return (worst if not worst <= FEASIBLE else 0.0), (cost if np.isfinite(cost) else np.inf)


def as_settings(tolerance: Any = 1e-8, max_iterations: Any = USUAL_ITERATIONS, time_limit: Any = None,
                options: Any = None) -> Settings:  # fmt: skip
    """Settings of a call, checked."""
    if options is not None and not (isinstance(options, dict) and all(isinstance(name, str) for name in options)):
        raise InputError("options", brief(repr(options)), "a dict of options of Ipopt")
    most, limit = as_count("max_iterations", max_iterations), as_seconds("time_limit", time_limit)
    return Settings(as_share("tolerance", tolerance), most, limit, dict(options or {}))


class Run:
    """Solver calls of one solve, within one time limit."""

    def __init__(self, program: NonlinearProgram, settings: Settings, clock: Clock) -> None:
        self.program = self.first = program
        self.settings = settings
        self.cost_size = abs(float(program.derivatives.values(program.guess)[0]))
        self.clock = clock
        self.iterations = 0

    def left(self, warm: bool) -> Settings:
        """Settings of the next call."""
        return replace(self.settings, seconds=self.clock.left,
                       options=(WARM if warm else {}) | self.settings.options)  # fmt: skip

    def solved(self, guess: Array, multipliers: dict[str, Array] | None, warm: bool) -> Found:
        """Solve, again where sizes were off, or told by bounds that are never met."""
        found = self._sized(guess, multipliers, warm)
        if warm or status_of(found) is not OptimalControlStatus.SOLVED:  # it begins with the sizes of a solution
            return found
        loose, kept = rescaled(self.program, found.v, centred=True, unbounded=True), self.program
        if np.abs(np.log(loose.scale / kept.scale)).max(initial=0.0) < np.log(WELL_SIZED):
            return found
        if self.clock.late:
            return replace(found, said=LATE)
        self.program = loose
        other, cost = self._sized(found.v, None, warm=False), self.cost(found)
        apart = abs(self.cost(other) - cost) > COST_ROUNDING * max(abs(cost), loose.cost_scale)
        if apart and status_of(other) is OptimalControlStatus.SOLVED:
            return other
        self.program = kept
        return replace(found, said=LATE) if other.said == LATE else found

    def _sized(self, guess: Array, multipliers: dict[str, Array] | None, warm: bool) -> Found:
        """Solve, again where the first sizes were off."""
        if warm:
            self.program = rescaled(self.program, guess, centred=True)
        kept: tuple[NonlinearProgram, Found] | None = None
        for _ in range(3):
            found = once(self.program, guess, multipliers, self.left(warm))
            self.iterations += found.iterations
            if kept is not None and found.said == LATE:
                return replace(kept[1], said=LATE)
            if kept is not None and status_of(found) is not OptimalControlStatus.SOLVED:
                self.program, found = kept  # sizes of what vanishes at the optimum were no better
                break
            if found.said == LATE or (not found.ended and status_of(found) is not OptimalControlStatus.SOLVED):
                break
            sized = rescaled(self.program, found.v, centred=True)
            ratio = np.concatenate([sized.scale / self.program.scale, [sized.cost_scale / self.program.cost_scale]])
            if np.abs(np.log(ratio)).max(initial=0.0) < np.log(WELL_SIZED):
                break
            if self.clock.late:
                return replace(found, said=LATE)
            missed = found.violations * self.program.row_scale / sized.row_scale
            honest = np.array_equal(sized.centre, self.program.centre) or missed.max(initial=0.0) <= FEASIBLE
            if status_of(found) is OptimalControlStatus.SOLVED and honest:
                kept = self.program, found
            self.program, guess, multipliers, warm = sized, found.v, found.multipliers, True
        return found

    def elsewhere(self, found: Found) -> Found:
        """Result from a moved guess, where the guess was stationary."""
        program = self.program
        # begun with a small barrier, which at full height would pull inputs back between their bounds
        other = self.solved(shaken(program), None, warm=True)
        f, then = (float(program.derivatives.values(one.v)[0]) for one in (found, other))
        gone = other.ended or other.said == ENDLESS
        if gone and then < f - COST_ROUNDING * max(program.cost_scale, abs(f)):
            return other
        self.program = program
        return found

    def judged(self, found: Found) -> Solution:
        """Solution from the solver's answer, its status confirmed."""
        status = status_of(found)
        endless = status is not OptimalControlStatus.UNDEFINED and self.falls(found)
        if status is OptimalControlStatus.SOLVED:
            found, endless = self._farthest(found)
        if endless:
            status = OptimalControlStatus.UNBOUNDED
        conflicts: tuple[str, ...] = ()
        if status is OptimalControlStatus.INFEASIBLE:
            found, status, conflicts = self._confirmed(found)
        if status is OptimalControlStatus.UNDEFINED:
            conflicts = undefined(self.program, found.v)
        elif not conflicts:
            conflicts = violated(self.program, found.v, found.violations, FEASIBLE)
        return self._packed(found, status, conflicts)

    def cost(self, found: Found) -> float:
        """Cost of a result."""
        return float(self.program.derivatives.values(found.v)[0])

    def falls(self, found: Found) -> bool:
        """Whether the cost fell without end."""
        first, last = (float(self.program.derivatives.values(v)[0]) for v in (self.program.guess, found.v))
        return last < -BOTTOMLESS * max(1.0, abs(first)) or (found.said == ENDLESS and last < first)

    def _farthest(self, found: Found) -> tuple[Found, bool]:
        """Optimum looked for farther still where it is very far, and whether the cost falls on."""
        first = self.first
        for _ in range(3):
            away = found.v - first.guess
            if np.abs(away / first.scale).max(initial=0.0) <= FAR_OPTIMUM:
                return found, False
            start = np.clip(first.guess + WELL_SIZED * away, first.lower, first.upper)
            sized = rescaled(self.program, start, centred=True)
            other, cost = once(sized, start, None, self.left(warm=True)), self.cost(found)
            self.iterations += other.iterations
            lower = self.cost(other) < cost - COST_ROUNDING * max(abs(cost), self.cost_size)
            if not lower or not (other.residuals.primal <= FEASIBLE or other.said == ENDLESS):
                return found, False
            if status_of(other) is not OptimalControlStatus.SOLVED:
                break
            self.program, found = sized, other
        return found, True

    def _confirmed(self, found: Found) -> tuple[Found, OptimalControlStatus, tuple[str, ...]]:
        """Verdict of infeasibility checked from several starts.

        Where one of them is feasible the problem is solved from there.
        """
        program = self.program
        least: Found | None = None
        first = np.clip(program.guess, program.lower, program.upper)
        near = found.v, first, shaken(program)
        for i, guess in enumerate((*near, *longer(program, first))):
            loose = elastic(program, guess)
            tried = once(loose, loose.guess, None, self.left(warm=False))
            self.iterations += tried.iterations
            v = tried.v[: len(guess)]
            g = np.asarray(program.derivatives.values(v)[1], dtype=float).ravel()
            missed = np.maximum.reduce([program.row_lower - g, g - program.row_upper, np.zeros(len(g))])
            tried = replace(tried, v=v, violations=missed / program.row_scale)
            if not np.isfinite(missed).all():
                continue
            if tried.violations.max(initial=0.0) <= FEASIBLE:
                again = self.solved(tried.v, None, warm=False)
                status = status_of(again)
                # over long intervals equations of a mesh hold where the dynamics do not
                if i >= len(near) and self._packed(again, status, ()).mesh_error > WELL_SIZED * COARSE_MESH:
                    self.program = program
                    continue
                if status is OptimalControlStatus.INFEASIBLE:  # it is not, at the start of this call
                    return tried, OptimalControlStatus.STOPPED, ()
                return again, status, ()
            if least is None or tried.violations.sum() < least.violations.sum():
                least = tried
            if SAID.get(tried.said) is OptimalControlStatus.STOPPED:
                return found, OptimalControlStatus.STOPPED, ()
        if least is None or not least.ended:
            return found, OptimalControlStatus.INACCURATE, ()
        on = least.multipliers
        named = contradiction(program, least.v, on["rows"], on["bounds"], least.violations, FEASIBLE)
        return replace(found, v=least.v, violations=least.violations), OptimalControlStatus.INFEASIBLE, named

    def _packed(self, found: Found, status: OptimalControlStatus, conflicts: tuple[str, ...]) -> Solution:
        """Solution with its trajectories."""
        program, multipliers = self.program, found.multipliers
        v = unwound(program, found.v)
        cost = float(program.derivatives.values(v)[0])
        p = v[program.parameters]
        weights = program.problem.weights
        if program.costs.stop > program.costs.start:
            weights = multipliers["rows"][: len(program.parts)]
        phases = tuple(
            phase_solution(part, v, p, clock, multipliers["rows"], float(weight))
            for part, clock, weight in zip(program.parts, program.times(v), weights)
        )  # fmt: skip
        notes = tuple(notes_of(program, v, status is OptimalControlStatus.SOLVED))
        return Solution(
            program=program, unknowns=v, cost=cost, cost_size=self.cost_size, p=p, phases=phases, status=status,
            residuals=found.residuals, conflicts=conflicts, notes=notes, multipliers=multipliers,
            iterations=self.iterations, solve_time=self.clock.taken, solver="ipopt",
            message=found.said,
        ).looked_between()  # fmt: skip


def _held(program: NonlinearProgram, p: ArrayLike) -> NonlinearProgram:
    """Program with both bounds of the parameters at one value."""
    value = np.atleast_1d(as_floats("p", p))
    low, high = program.problem.p_bounds
    if value.shape != low.shape or not ((low <= value) & (value <= high)).all():
        raise InputError("p", value, f"({len(low)},) within p_bounds")
    lower, upper = program.lower.copy(), program.upper.copy()
    lower[program.parameters] = upper[program.parameters] = value
    return replace(program, lower=lower, upper=upper)


def status_of(found: Found) -> OptimalControlStatus:
    """Status from the solver's word and the residuals."""
    feasible = found.residuals.primal <= FEASIBLE
    # its sizes may be those of a guess, by which small slopes are none, where the clock stopped the solver
    if feasible and found.residuals.worst <= OPTIMAL and found.said != LATE:
        return OptimalControlStatus.SOLVED
    return SAID.get(found.said, OptimalControlStatus.INACCURATE if feasible else OptimalControlStatus.INFEASIBLE)


def _from_solution(program: NonlinearProgram, start: Solution) -> tuple[Array, dict[str, Array] | None]:
    """Unknowns (n,) from a solution on any mesh; multipliers from the same."""
    fits = len(start.phases) == len(program.parts) and len(start.p) == program.problem.parameters
    sizes = [(one.states.shape[1], one.part.layout.nu) for one in start.phases]
    if not fits or sizes != [(part.layout.nx, part.layout.nu) for part in program.parts]:
        raise InputError("start", repr(start.program), f"a solution of the same phases: {program!r}")
    pairs = zip(start.program.parts, program.parts)
    alike = all(a.layout == b.layout and np.array_equal(a.mesh, b.mesh) for a, b in pairs)
    if alike and len(start.unknowns) == len(program.lower):
        return start.unknowns, start.multipliers
    v = program.guess.copy()
    v[program.parameters] = start.p
    for part, found in zip(program.parts, start.phases):
        v[part.first : part.last] = placed(part.layout, part.mesh, found.at_fractions)
        if part.duration >= 0:
            v[part.duration] = found.duration
    if program.costs.stop > program.costs.start:
        v[program.costs] = costs_of_scenarios(program, v)
    return v, None
