"""A plan before it is packed, and the one that is found stage by stage."""

from __future__ import annotations

import time
from dataclasses import dataclass

from mpc.checks import Array
from mpc.plan import Plan, Residuals, Status
from mpc.problem import MPCProblem
from mpc.rollout import Given, admissible, cost_of, relative_violations, violation_of
from mpc.stages import Staging
from mpc.stagewise import solve_stagewise
from mpc.tolerances import FEASIBLE, RELAXATION_SHARES


@dataclass(frozen=True, eq=False)
class Candidate:
    """A plan before it is packed: inputs, states, status, residuals and the solver that found it."""

    inputs: Array
    states: Array
    status: Status
    residuals: Residuals
    solver: str

    def packed(self, problem: MPCProblem, given: Given, start: float) -> Plan:
        """The plan, with cost and violation of these inputs and states; its clock began at `start`."""
        cost = cost_of(problem, self.inputs, self.states, given)
        violation = violation_of(problem, self.states)
        duration = time.perf_counter() - start
        return Plan(self.inputs, self.states, cost, self.status, self.residuals, violation, duration, self.solver)


def stagewise_candidate(
    problem: MPCProblem, x: Array, given: Given, inputs: Array, typical_cost: float
) -> Candidate | None:
    """The plan of `solve_stagewise` from a first guess of the inputs; None if the iteration did not converge.

    Hard state constraints become squared violations, weighed against the typical cost; where all of them hold, the
    problem was feasible.
    """
    hard = problem.soft is None and len(problem.state_rows[1]) + len(problem.terminal_rows[1]) > 0
    shares = (RELAXATION_SHARES[0], RELAXATION_SHARES[-1]) if hard else (1.0,)
    for share in shares:  # a weight too stiff to solve is followed by a lower one
        staging = Staging(problem, x, given, (0.0, typical_cost / share) if hard else problem.soft)
        found = solve_stagewise(staging.stages, staging.start, staging.first_guess(inputs))
        if found.converged:
            break
    else:
        return None
    inputs, states = staging.plan(found.states, found.variables, x)
    inputs = admissible(problem, inputs, given)  # changes what rounding has left undetermined
    violated = problem.soft is None and relative_violations(problem, states).max() > FEASIBLE
    status = Status.SOFTENED if violated else Status.SOLVED
    residuals = Residuals(found.step, found.violation, 0.0, 0.0)
    return Candidate(inputs, states, status, residuals, "stagewise")
