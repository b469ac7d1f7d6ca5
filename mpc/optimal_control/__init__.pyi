from mpc.optimal_control.nonlinear_mpc import NonlinearMPC as NonlinearMPC
from mpc.optimal_control.offset_free import OffsetFreeNonlinearMPC as OffsetFreeNonlinearMPC
from mpc.optimal_control.phase import Phase as Phase
from mpc.optimal_control.phase_solution import PhaseSolution as PhaseSolution
from mpc.optimal_control.problem import OptimalControlProblem as OptimalControlProblem
from mpc.optimal_control.program import NonlinearProgram as NonlinearProgram
from mpc.optimal_control.refinement import refine as refine
from mpc.optimal_control.schemes import (
    Collocation as Collocation,
    HermiteSimpson as HermiteSimpson,
    MultipleShooting as MultipleShooting,
    Radau as Radau,
    Trapezoidal as Trapezoidal,
    sampled as sampled,
)
from mpc.optimal_control.solution import OptimalControlStatus as OptimalControlStatus, Solution as Solution
from mpc.optimal_control.solution_sensitivity import (
    PhaseSensitivity as PhaseSensitivity,
    SolutionSensitivity as SolutionSensitivity,
)
from mpc.optimal_control.solving import solve as solve
from mpc.optimal_control.transcription import build as build
from mpc.optimal_control.whole_inputs import (
    Rounded as Rounded,
    round_inputs as round_inputs,
    sum_up_rounding as sum_up_rounding,
)
