"""Solve a nonlinear program, and check what the solver says with the program's own derivatives."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array, as_count, as_floats, as_seconds
from mpc.exceptions import InputError
from mpc.optimal_control.phase import Phase
from mpc.optimal_control.phase_solution import phase_solution
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.program import NonlinearProgram, describe_row, rescaled
from mpc.optimal_control.solution import OptimalControlStatus, Solution
from mpc.optimal_control.transcription import build
from mpc.optimal_control.unknowns import placed
from mpc.plan import Residuals

FEASIBLE = 1e-6  # violation, in scaled rows, of what passes for feasible
OPTIMAL = 1e-5  # residual of the optimality conditions, scaled by the size of multipliers
ACTIVE = 1e-7  # distance from a bound, in scaled unknowns, at which it may have a multiplier
RESCALINGS = 3  # solves at most, each with sizes as the one before found them
WELL_SIZED = 10.0  # ratio of sizes that is good enough
WARM = {
    "mu_init": 1e-5, "bound_mult_init_method": "mu-based", "bound_push": 1e-6, "bound_frac": 1e-6,
    "slack_bound_push": 1e-6, "slack_bound_frac": 1e-6,
}  # fmt: skip
SHOWN = 5  # conflicts that are named
LIMITS = ("Maximum_Iterations_Exceeded", "Maximum_WallTime_Exceeded", "Maximum_CpuTime_Exceeded", "User_Requested_Stop")
IMPOSSIBLE = ("Infeasible_Problem_Detected", "Restoration_Failed")


def solve(program: NonlinearProgram | OptimalControlProblem | Phase, *, start: Solution | None = None,
          p: ArrayLike | None = None, tolerance: float = 1e-8, max_iterations: int = 3000,
          time_limit: float | None = None, options: dict[str, Any] | None = None) -> Solution:  # fmt: skip
    """Solve an optimal control problem.

    Parameters
    ----------
    program : NonlinearProgram, OptimalControlProblem or Phase
        What `build` made; a problem is built with its defaults.
    start : Solution, optional
        Where to start from, of any mesh of the same phases.
    p : (np,) array, optional
        Parameters to hold at these values, within their bounds: nothing is built anew.
    tolerance : float
        Of the solver, on scaled unknowns.
    max_iterations : int
    time_limit : float, optional
        [s].
    options : dict, optional
        For Ipopt, such as {"linear_solver": "mumps"}.

    Returns
    -------
    Solution
        With a status: only what passes a check of its own is called SOLVED.
    """
    if isinstance(program, OptimalControlProblem | Phase):
        program = build(program)
    if not isinstance(program, NonlinearProgram):
        raise InputError("program", type(program).__name__, "what `build` returns, an OptimalControlProblem or a Phase")
    as_count("max_iterations", max_iterations)
    seconds = as_seconds("time_limit", time_limit)
    lower, upper = program.lower.copy(), program.upper.copy()
    if p is not None:
        _hold(program, p, lower, upper)
    began = time.perf_counter()
    guess = np.clip(program.guess if start is None else unknowns_from(program, start), lower, upper)
    own = (WARM if start is not None else {}) | dict(options or {})
    same = (
        start is not None
        and len(start.multipliers["rows"]) == len(program.row_lower)
        and len(start.unknowns) == len(guess)
    )
    first = start.multipliers if same and start is not None else None
    iterations = 0
    if start is not None:
        program = rescaled(program, guess)
    for _ in range(RESCALINGS):
        found = _once(program, guess, first, lower, upper, (tolerance, max_iterations, seconds, own))
        iterations += found.iterations
        sized = rescaled(program, found.v)
        ratio = np.concatenate([sized.scale / program.scale, [sized.cost_scale / program.cost_scale]])
        off = float(np.abs(np.log(ratio)).max(initial=0.0))
        if off < np.log(WELL_SIZED) or not found.ended:
            break
        program, guess, first, own = sized, found.v, found.multipliers, WARM | dict(options or {})
    seconds = time.perf_counter() - began
    return _solution(program, replace(found, iterations=iterations), seconds)


@dataclass(frozen=True)
class _Found:
    """What one call of the solver gave, in the units of the problem."""

    v: Array
    multipliers: dict[str, Array]
    residuals: Residuals
    violations: Array
    iterations: int
    said: str

    @property
    def ended(self) -> bool:
        """Whether the solver says that it is done."""
        return self.said in ("Solve_Succeeded", "Solved_To_Acceptable_Level")


def _once(program: NonlinearProgram, guess: Array, multipliers: dict[str, Array] | None, lower: Array, upper: Array,
          settings: tuple[float, int, float, dict[str, Any]]) -> _Found:  # fmt: skip
    """Solve with the sizes that the program has now."""
    tolerance, most, seconds, own = settings
    limits = {"tol": tolerance, "max_iter": most} | ({"max_wall_time": seconds} if np.isfinite(seconds) else {})
    solver = _solver(program, limits | own)
    size, of_cost = program.scale, program.cost_scale
    given: dict[str, Any] = {"x0": guess / size, "lbx": lower / size, "ubx": upper / size,
             "lbg": program.row_lower / program.row_scale, "ubg": program.row_upper / program.row_scale,
             "p": np.concatenate([size, [of_cost], program.row_scale])}  # fmt: skip
    if multipliers is not None:
        given |= {
            "lam_g0": multipliers["rows"] * program.row_scale / of_cost,
            "lam_x0": multipliers["bounds"] * size / of_cost,
        }
    result = solver(**given)
    stats = solver.stats()
    z, on_rows, on_bounds = (np.asarray(result[name], dtype=float).ravel() for name in ("x", "lam_g", "lam_x"))
    residuals, violations = _checked(program, z, on_rows, on_bounds, given)
    back = {"rows": on_rows / program.row_scale * of_cost, "bounds": on_bounds / size * of_cost}
    v = np.clip(z * size, lower, upper)
    return _Found(v, back, residuals, violations, int(stats["iter_count"]), str(stats["return_status"]))


def _solution(program: NonlinearProgram, found: _Found, elapsed: float) -> Solution:
    """The solution that the solver's answer stands for."""
    v, multipliers = found.v, found.multipliers
    cost = float(program.derivatives.values(v)[0])
    p = v[program.parameters]
    weights = program.problem.weights
    if program.problem.risk == "worst" and len(program.parts) > 1:
        rows = next(rows for rows in program.rows if rows.name == "cost of a scenario")
        weights = multipliers["rows"][rows.first : rows.last]
    phases = tuple(
        phase_solution(part, v, p, clock, multipliers["rows"], float(weight))
        for part, clock, weight in zip(program.parts, program.times(v), weights)
    )  # fmt: skip
    worst = np.argsort(-found.violations)[:SHOWN]
    conflicts = tuple(describe_row(program, int(i), v) for i in worst if found.violations[i] > FEASIBLE)
    status = _status(found.said, found.residuals)
    return Solution(
        program=program, unknowns=v, cost=cost, p=p, phases=phases, status=status, residuals=found.residuals,
        conflicts=conflicts, multipliers=multipliers, iterations=found.iterations, solve_time=elapsed, solver="ipopt",
        message=found.said,
    )  # fmt: skip


def _hold(program: NonlinearProgram, p: ArrayLike, lower: Array, upper: Array) -> None:
    """Set bounds of the parameters to one value."""
    value = as_floats("p", p)
    low, high = program.problem.p_bounds
    if value.shape != low.shape or not ((low <= value) & (value <= high)).all():
        raise InputError("p", value, f"({len(low)},) within p_bounds")
    lower[program.parameters] = upper[program.parameters] = value


def _solver(program: NonlinearProgram, options: dict[str, Any]) -> Any:
    """Ipopt on scaled unknowns and rows; made once for each choice of options, whatever the sizes."""
    made = program.derivatives.solvers
    key = repr(sorted(options.items()))
    if key not in made:
        statement, functions = program.derivatives.scaled
        ipopt = {"print_level": 0, "sb": "yes"} | options
        quiet = {"print_time": False, "show_eval_warnings": False}
        settings: dict[str, Any] = {"ipopt": ipopt, "calc_lam_p": False} | quiet
        made[key] = ca.nlpsol("solver", "ipopt", statement, settings | functions)
    return made[key]


def _checked(program: NonlinearProgram, z: Array, on_rows: Array, on_bounds: Array,
             given: dict[str, Any]) -> tuple[Residuals, Array]:  # fmt: skip
    """Residuals of the optimality conditions, and violations of the rows (m,), in scaled unknowns and rows."""
    values = program.derivatives.stationarity(z * program.scale, on_rows / program.row_scale * program.cost_scale)
    rows, gradient, of_cost = (np.asarray(value, dtype=float).ravel() for value in values)
    rows = rows / program.row_scale
    gradient, of_cost = (value * program.scale / program.cost_scale for value in (gradient, of_cost))
    size = max(1.0, float(np.abs(of_cost).max(initial=0.0)), float(np.abs(on_rows).max(initial=0.0)))
    violations = np.maximum.reduce([given["lbg"] - rows, rows - given["ubg"], np.zeros(len(rows))])
    outside = np.maximum.reduce([given["lbx"] - z, z - given["ubx"], np.zeros(len(z))])
    of_bounds = _complementarity(z, on_bounds, given["lbx"], given["ubx"])
    of_rows = _complementarity(rows, on_rows, given["lbg"], given["ubg"])
    return Residuals(
        float(np.abs(gradient + on_bounds).max(initial=0.0)) / size,
        float(max(violations.max(initial=0.0), outside.max(initial=0.0))),
        0.0,
        max(of_bounds, of_rows) / size,
    ), violations


def _complementarity(value: Array, multiplier: Array, low: Array, high: Array) -> float:
    """The largest product of a multiplier and the distance from the bound of its sign, which counts as 1 at most."""
    room = np.where(multiplier > 0, high - value, value - low)
    free = low < high
    product = np.abs(multiplier) * np.minimum(np.maximum(room, 0.0), 1.0)
    return float(product[free].max(initial=0.0))


def _status(said: str, residuals: Residuals) -> OptimalControlStatus:
    """What a solver's word and the residuals come to."""
    if residuals.worst <= OPTIMAL and residuals.primal <= FEASIBLE:
        return OptimalControlStatus.SOLVED
    if said in LIMITS:
        return OptimalControlStatus.STOPPED
    if said in IMPOSSIBLE or residuals.primal > FEASIBLE:
        return OptimalControlStatus.INFEASIBLE
    return OptimalControlStatus.INACCURATE


def unknowns_from(program: NonlinearProgram, start: Solution) -> Array:
    """Unknowns (n,) of a program, of a solution of the same phases on any mesh."""
    fits = len(start.phases) == len(program.parts) and len(start.p) == program.problem.parameters
    if not fits or any(a.states.shape[1] != b.layout.nx for a, b in zip(start.phases, program.parts)):
        raise InputError("start", repr(start.program), f"a solution of the same phases: {program!r}")
    if len(start.unknowns) == len(program.lower) and _alike(start.program, program):
        return start.unknowns
    v = program.guess.copy()
    v[program.parameters] = start.p
    for part, found in zip(program.parts, start.phases):
        v[part.first : part.last] = placed(part.layout, part.mesh, found.at_fractions)
        if part.duration >= 0:
            v[part.duration] = found.duration
    return v


def _alike(a: NonlinearProgram, b: NonlinearProgram) -> bool:
    """Whether two programs have the same unknowns."""
    return all(x.layout == y.layout and np.array_equal(x.mesh, y.mesh) for x, y in zip(a.parts, b.parts))
