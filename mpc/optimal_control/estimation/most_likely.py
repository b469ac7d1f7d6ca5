"""Most likely parameters and courses of experiments stated as one problem."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca

from mpc.budgets import GUESSED_STEPS
from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.optimal_control.estimation.curvature import beside, downhill
from mpc.optimal_control.estimation.information import Information, information
from mpc.optimal_control.estimation.marginal import Spread, observed, spread_of
from mpc.optimal_control.planning import Clock
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.refinement import refine
from mpc.optimal_control.solution import Solution
from mpc.tolerances import NEAR_OPTIMUM


def most_likely(problem: OptimalControlProblem, residual: ca.Function, p_size: Array, options: dict[str, Any],
                clock: Clock, measured: int | None) -> tuple[Solution, Information | None]:  # fmt: skip
    """Most likely solution, and what its data tell, sought in time.

    Beside a disturbance that of the parameters alone, by Newton's method: what the joint likelihood lacks enters as a
    cost of p. Where that curves downwards nothing is found.
    """
    solves = _Solves(residual, p_size, options, clock, measured)
    solution, known = solves.minimum(problem)
    if not (problem.phases[0].inputs and problem.parameters):
        return solution, known
    spread: Spread | None = None
    best = solution
    for _ in range(GUESSED_STEPS):
        if clock.late:
            return solution, None
        if known is None:
            break
        best, spread = solution, spread_of(solution, known, residual, spread)
        solution, known = solves.minimum(replace(problem, p_cost=spread), start=solution, starts=1)
        if known is not None and spread.convex and spread.moved(solution.p) < NEAR_OPTIMUM:
            return solution, observed(solution, known, spread)
    return best, None


class _Solves:
    """Solves within one time limit."""

    def __init__(self, residual: ca.Function, p_size: Array, options: dict[str, Any], clock: Clock,
                 measured: int | None) -> None:  # fmt: skip
        self.residual = residual
        self.p_size = p_size
        self.options = {"intervals": 1} | options
        self.clock = clock
        self.measured = measured

    def minimum(self, problem: OptimalControlProblem, **own: Any) -> tuple[Solution, Information | None]:
        """Solution that no direction leads down from, and what data tell."""
        solution = self._refined(problem, self.options | own)
        known, move = self._looked_at(solution)
        if move is None or self.clock.late:
            return solution, known if move is None else None
        anew = {name: value for name, value in self.options.items() if name != "start"}
        other = self._refined(beside(problem, solution, move), anew)
        solution = min(solution, other, key=lambda one: (not one.solved_on_mesh, one.cost))
        known, move = self._looked_at(solution)
        return solution, known if move is None else None

    def _looked_at(self, solution: Solution) -> tuple[Information | None, Array | None]:
        """What data tell of an optimum, and a move (n,) down from it."""
        if not solution.solved_on_mesh:
            return None, None
        known, reached = information(solution, self.residual, self.p_size, self.measured)
        return known, downhill(solution, reached)

    def _refined(self, problem: OptimalControlProblem, options: dict[str, Any]) -> Solution:
        """Solution on a mesh that is refined, in the time left."""
        try:
            return refine(problem, **options | {"time_limit": self.clock.left})
        except InputError as error:
            if error.argument != "guess":
                raise
            cure = "Give a `p_guess` with which the functions are finite, or states, as Experiment(guess=…)."
            raise InputError("p_guess", error.got, error.expected, cure) from error
