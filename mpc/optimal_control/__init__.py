"""Optimal control with CasADi: state a problem once, transcribe it, solve it, and check what was found."""

from mpc.optimal_control.nonlinear_mpc import NonlinearMPC
from mpc.optimal_control.offset_free import OffsetFreeNonlinearMPC
from mpc.optimal_control.phase import Phase
from mpc.optimal_control.phase_solution import PhaseSolution
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.program import NonlinearProgram
from mpc.optimal_control.refinement import refine
from mpc.optimal_control.sampled import sampled
from mpc.optimal_control.schemes import Collocation, HermiteSimpson, MultipleShooting, Radau, Trapezoidal
from mpc.optimal_control.solution import OptimalControlStatus, Solution
from mpc.optimal_control.solution_sensitivity import PhaseSensitivity, SolutionSensitivity
from mpc.optimal_control.solving import solve
from mpc.optimal_control.transcription import build

__all__ = [
    "Collocation",
    "HermiteSimpson",
    "MultipleShooting",
    "NonlinearMPC",
    "NonlinearProgram",
    "OffsetFreeNonlinearMPC",
    "OptimalControlProblem",
    "OptimalControlStatus",
    "Phase",
    "PhaseSensitivity",
    "PhaseSolution",
    "Radau",
    "Solution",
    "SolutionSensitivity",
    "Trapezoidal",
    "build",
    "refine",
    "sampled",
    "solve",
]
