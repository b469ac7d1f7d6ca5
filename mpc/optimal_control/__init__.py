"""Optimal control with CasADi: state a problem once, transcribe it, solve it, and check what was found."""

from mpc.optimal_control.nlp import NonlinearProgram, build
from mpc.optimal_control.problem import OptimalControlProblem, Phase
from mpc.optimal_control.refinement import refine
from mpc.optimal_control.schemes import Collocation, HermiteSimpson, MultipleShooting, Radau, Trapezoidal
from mpc.optimal_control.solution import OptimalControlStatus, PhaseSolution, Solution
from mpc.optimal_control.solving import solve

__all__ = [
    "Collocation",
    "HermiteSimpson",
    "MultipleShooting",
    "NonlinearProgram",
    "OptimalControlProblem",
    "OptimalControlStatus",
    "Phase",
    "PhaseSolution",
    "Radau",
    "Solution",
    "Trapezoidal",
    "build",
    "refine",
    "solve",
]
