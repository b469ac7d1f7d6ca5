"""One call of Ipopt, checked by the program's own derivatives."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ccdtools_ground.door import brief
from mpc.budgets import USUAL_ITERATIONS
from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.optimal_control.planning import Clock
from mpc.optimal_control.program import SizedProgram
from mpc.plan import Residuals
from mpc.tolerances import BOTTOMLESS, FEASIBLE

ONE_AT_A_TIME = threading.RLock()  # A solver of CasADi has one memory for calls from all threads.
ENDED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")

# Options for a start that is nearly the optimum, with or without its multipliers
WARM: dict[str, Any] = {
    "mu_init": 1e-5, "bound_mult_init_method": "mu-based", "bound_push": 1e-6, "bound_frac": 1e-6,
    "slack_bound_push": 1e-6, "slack_bound_frac": 1e-6,
}  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """Settings of one call."""

    tolerance: float
    iterations: int  # at most
    seconds: float  # at most; infinite where there is no limit
    options: dict[str, Any]  # for Ipopt
    best: bool = True  # whether the best iterate is kept if the solver is stopped, else the last one

    @property
    def watched(self) -> bool:
        """Whether iterates are looked at."""
        return bool(np.isfinite(self.seconds)) or (self.best and self.iterations < USUAL_ITERATIONS)


@dataclass(frozen=True)
class Found:
    """Result of one call, in the units of the problem."""

    v: Array
    multipliers: dict[str, Array]
    residuals: Residuals
    violations: Array
    iterations: int
    said: str

    @property
    def ended(self) -> bool:
        """Whether the solver says that it is done."""
        return self.said in ENDED


def once(program: SizedProgram, guess: Array, multipliers: dict[str, Array] | None, settings: Settings) -> Found:
    """Solve with the program's present sizes."""
    began = time.perf_counter()
    size, about, of_cost, kept = program.scale, program.centre, program.cost_scale, program.limited
    of_rows, rows_about = program.row_scale[kept], program.row_centre[kept]
    x0, lbx, ubx = ((side - about) / size for side in (guess, program.lower, program.upper))
    lbg, ubg = ((side[kept] - rows_about) / of_rows for side in (program.row_lower, program.row_upper))
    p = np.concatenate([size, about, [of_cost], of_rows, rows_about])
    given: dict[str, Any] = {"x0": x0, "lbx": lbx, "ubx": ubx, "lbg": lbg, "ubg": ubg, "p": p}
    if multipliers is not None:
        given |= {
            "lam_g0": multipliers["rows"][kept] * of_rows / of_cost,
            "lam_x0": multipliers["bounds"] * size / of_cost,
        }
    with ONE_AT_A_TIME:
        solver, watch = solver_of(program, settings)
        if watch is not None:
            watch.begin(given, settings.best, Clock(settings.seconds, began))
        result = solver(**given)
        stats = solver.stats()
        best, iterate = ((np.inf, np.inf), given["x0"]) if watch is None else (watch.rank, watch.z)
    z, pushes, on_bounds = (np.asarray(result[name], dtype=float).ravel() for name in ("x", "lam_g", "lam_x"))
    on_rows = np.zeros(len(program.row_scale))
    on_rows[kept] = pushes
    said = str(stats["return_status"])
    if said == "Invalid_Option":
        raise InputError("options", brief(repr(settings.options)), "options that this Ipopt accepts")
    residuals, violations = _checked(program, z, on_rows, on_bounds, given)
    rank = _rank(float(violations.max(initial=0.0)), float(result["f"]))
    if said not in ENDED and best < rank:
        z = iterate
        residuals, violations = _checked(program, z, on_rows, on_bounds, given)
    back = {"rows": on_rows / program.row_scale * of_cost, "bounds": on_bounds / size * of_cost}
    v = np.clip(about + z * size, program.lower, program.upper)
    return Found(v, back, residuals, violations, int(stats["iter_count"]), said)


def solver_of(program: SizedProgram, settings: Settings) -> tuple[Any, BestIterate | None]:
    """Ipopt on scaled unknowns and rows, made once per options."""
    limits: dict[str, Any] = {"tol": settings.tolerance, "max_iter": settings.iterations}
    # QAMD, number 6, is for rows that are nearly full: parameters and durations reach every interval of every scenario
    given = {"print_level": 0, "sb": "yes", "diverging_iterates_tol": BOTTOMLESS, "mumps_pivot_order": 6}
    ipopt = given | limits | settings.options
    made = program.derivatives.solvers
    key = repr((sorted(ipopt.items()), settings.watched)), program.limited.tobytes()
    if key in made:
        return made[key]  # type: ignore[no-any-return]
    statement, functions = program.derivatives.scaled(program.limited)
    watch = BestIterate(len(program.lower), len(program.limited)) if settings.watched else None
    plain = {"print_time": False, "show_eval_warnings": False, "calc_lam_p": False, "inputs_check": False}
    own: dict[str, Any] = {"ipopt": ipopt} | ({} if watch is None else {"iteration_callback": watch}) | plain
    try:
        solver = ca.nlpsol("solver", "ipopt", statement, own | functions)
    except RuntimeError as error:
        if not settings.options:
            raise
        reason = str(error).strip().splitlines()[-1]
        raise InputError("options", brief(repr(settings.options)), "options that Ipopt knows", reason) from error
    made[key] = solver, watch
    return solver, watch


class BestIterate(ca.Callback):
    """Callback that keeps the cheapest feasible iterate, else the least infeasible, in time."""

    def __init__(self, unknowns: int, rows: int) -> None:
        ca.Callback.__init__(self)
        self._sizes = {"x": unknowns, "f": 1, "g": rows, "lam_x": unknowns, "lam_g": rows}
        self._sizes["lam_p"] = 2 * (unknowns + rows) + 1
        self.construct("best", {})

    def begin(self, given: dict[str, Any], best: bool, clock: Clock) -> None:
        """Forget what was kept."""
        self.rank, self.z, self._first = (np.inf, np.inf), given["x0"], True
        self._sides, self._best, self._clock = (given["lbg"], given["ubg"]), best, clock

    def get_n_in(self) -> int:
        """Number of arguments, for CasADi."""
        return int(ca.nlpsol_n_out())

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Sparsity of an argument, for CasADi."""
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)])

    def eval(self, arg: Any) -> list[int]:
        """Look at one iterate; 1 where no more is to follow."""
        if self._first:  # what was before is no iteration
            self._first, self._clock = False, Clock(self._clock.limit, self._clock.began)
        if not self._best:
            return [int(self._clock.up)]
        f, g = float(arg[1]), np.asarray(arg[2], dtype=float).ravel()
        rank = _rank(np.maximum(self._sides[0] - g, g - self._sides[1]).max(initial=0.0), f)
        if rank < self.rank:
            self.rank, self.z = rank, np.asarray(arg[0], dtype=float).ravel()
        return [int(self._clock.up)]


def _rank(violation: float, f: float) -> tuple[float, float]:
    """Rank by violation, then cost; infinite where not finite."""
    if not (np.isfinite(violation) and np.isfinite(f)):
        return np.inf, np.inf
    return (0.0, f) if violation <= FEASIBLE else (violation, f)


def _checked(program: SizedProgram, z: Array, on_rows: Array, on_bounds: Array,
             given: dict[str, Any]) -> tuple[Residuals, Array]:  # fmt: skip
    """Scaled residuals of the optimality conditions, and row violations (m,)."""
    v = program.centre + z * program.scale
    values = program.derivatives.stationarity(v, on_rows / program.row_scale * program.cost_scale)
    rows, gradient, of_cost = (np.asarray(value, dtype=float).ravel() for value in values)
    rows = rows / program.row_scale
    gradient, of_cost = (value * program.scale / program.cost_scale for value in (gradient, of_cost))
    size = max(1.0, float(np.abs(of_cost).max(initial=0.0)), float(np.abs(on_rows).max(initial=0.0)))
    low, high = program.row_lower / program.row_scale, program.row_upper / program.row_scale
    violations = np.maximum.reduce([low - rows, rows - high, np.zeros(len(rows))])
    outside = np.maximum.reduce([given["lbx"] - z, z - given["ubx"], np.zeros(len(z))])
    of_bounds = _complementarity(z, on_bounds, given["lbx"], given["ubx"])
    of_rows = _complementarity(rows, on_rows, low, high)
    return Residuals(
        float(np.abs(gradient + on_bounds).max(initial=0.0)) / size,
        float(max(violations.max(initial=0.0), outside.max(initial=0.0))),
        0.0,
        max(of_bounds, of_rows) / size,
    ), violations


def _complementarity(value: Array, multiplier: Array, low: Array, high: Array) -> float:
    """Largest product of multiplier and distance, at most 1."""
    room = np.where(multiplier > 0, high - value, value - low)
    free = low < high
    product = np.abs(multiplier) * np.minimum(np.maximum(room, 0.0), 1.0)
    return float(product[free].max(initial=0.0))
