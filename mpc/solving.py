"""Plans from the condensed QP, else stage by stage."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from mpc.checks import Array
from mpc.condensing import condense, row_units
from mpc.dense_qp import DenseQP, QPResult
from mpc.feedback import block_lengths, stabilising_feedback
from mpc.plan import Plan, Residuals, Status
from mpc.problem import MPCProblem
from mpc.relaxation import inputs_conflict, regulated, relax, saturated_regulator, typical_cost
from mpc.rollout import (
    Given,
    admissible,
    cost_of,
    pushes,
    relative_violations,
    rollout,
    rollout_with_feedback,
    violation_of,
)
from mpc.stages import StagewiseQP
from mpc.stagewise import solve_stagewise
from mpc.tolerances import FEASIBLE, GROWTH, KKT_REPORTED, OVERFLOW, RELAXATION_SHARES, RUNAWAY, UNIT_CIRCLE


@dataclass(frozen=True, eq=False)
class Candidate:
    """Inputs, states, status, residuals and solver of a plan."""

    inputs: Array
    states: Array
    status: Status
    residuals: Residuals
    solver: str

    def packed(self, problem: MPCProblem, given: Given, start: float) -> Plan:
        """Plan with cost and violation; its clock began at `start`."""
        cost = cost_of(problem, self.inputs, self.states, given)
        violation = violation_of(problem, self.states)
        duration = time.perf_counter() - start
        return Plan(self.inputs, self.states, cost, self.status, self.residuals, violation, duration, self.solver)


def stagewise_candidate(
    problem: MPCProblem, x: Array, given: Given, inputs: Array, typical_cost: float
) -> Candidate | None:
    """Plan of `solve_stagewise` from first inputs; None if not converged.

    Hard state constraints become squared violations, weighed against the typical cost; where all of them hold, the
    problem was feasible.
    """
    hard = problem.soft is None and len(problem.state_rows[1]) + len(problem.terminal_rows[1]) > 0
    shares = (RELAXATION_SHARES[0], RELAXATION_SHARES[-1]) if hard else (1.0,)
    for share in shares:  # a weight too stiff to solve is followed by a lower one
        stagewise = StagewiseQP(problem, x, given, (0.0, typical_cost / share) if hard else problem.soft)
        found = solve_stagewise(stagewise.stages, stagewise.start, stagewise.first_guess(inputs))
        if found.converged:
            break
    else:
        return None
    inputs, states = stagewise.plan(found.states, found.variables, x)
    inputs = admissible(problem, inputs, given)  # changes what rounding has left undetermined
    violated = problem.soft is None and relative_violations(problem, states).max() > FEASIBLE
    status = Status.SOFTENED if violated else Status.SOLVED
    residuals = Residuals(found.step, found.violation, 0.0, 0.0)
    return Candidate(inputs, states, status, residuals, "stagewise")


class CondensedSolver:
    """Solver of one MPC problem from many states; safe for threads."""

    def __init__(self, problem: MPCProblem, parameters: tuple[str, ...]):
        self.problem = problem
        self.qp = condense(problem, parameters)
        self.units = row_units(problem, self.qp.labels)
        self.feedback = stabilising_feedback(problem)
        self.unstable = float(np.abs(np.linalg.eigvals(problem.A)).max()) > 1 + UNIT_CIRCLE
        # of a long unstable horizon the second form is the stagewise one, see `_in_another_form`
        self.dense = DenseQP(self.qp.H, self.qp.G, self.units, second=self.feedback is None)

    def theta(self, x: Array, given: Given) -> Array:
        """Parameter of the QP."""
        return np.concatenate([x if name == "x" else given[name] for name, _ in self.qp.parameters])

    def runaway(self, x: Array, given: Given) -> Array | None:
        """States of a relaxed plan that runs away, otherwise None."""
        if self.feedback is None:
            return None
        plan = self.plan(x, given, time.perf_counter())
        away = plan.status is Status.SOFTENED and relative_violations(self.problem, plan.states).max() > GROWTH
        return plan.states if away else None

    def plan(self, x: Array, given: Given, start: float) -> Plan:
        """Plan from the state x; its clock began at `start`."""
        theta = self.theta(x, given)
        with np.errstate(over="ignore", invalid="ignore"):
            q, b = self.qp.at(theta)
            if not max(np.abs(q).max(), (-b).max(initial=0.0)) < OVERFLOW:  # a bound that says nothing may be larger
                return saturated_regulator(self.problem, x, start)
            found = self._solve(x, theta, given, q, b)
            if found is None or not np.isfinite(found.inputs).all():
                return saturated_regulator(self.problem, x, start)
            return found.packed(self.problem, given, start)

    def _solve(self, x: Array, theta: Array, given: Given, q: Array, b: Array) -> Candidate | None:
        """Best candidate; None where input constraints contradict."""
        result = self.dense.solve(q, b)
        if not result.infeasible:
            first = self._candidate(result, Status.SOLVED, x, theta, given)
            return first if first.status is Status.SOLVED else self._in_another_form(first, x, given, q)
        if inputs_conflict(self.problem, given.get("u_prev")):
            return None
        inputs, states = regulated(self.problem, x, pushes(self.problem, given))
        away = self._runs_away(states)  # then the dense QP would lose the digits of the inputs
        far = self._stage_by_stage(inputs, x, given, q) if away else None
        if far is not None:
            return far
        relaxed = relax(self.problem, self.qp, self.dense, q, b)
        result, status = (result, Status.SOFTENED) if relaxed is None else (relaxed.result, relaxed.status)
        first = self._candidate(result, status, x, theta, given)
        return first if away or first.status is status else self._in_another_form(first, x, given, q)

    def _candidate(self, result: QPResult, status: Status, x: Array, theta: Array, given: Given) -> Candidate:
        """Candidate of the QP's minimiser; INACCURATE where it fails a check."""
        accurate = result.residuals.worst <= KKT_REPORTED
        if self.feedback is not None and np.isfinite(result.z).all():
            deviations = result.z[: self.feedback.shape[0] * self.problem.nu].reshape(-1, self.problem.nu)
            inputs, states, missed = rollout_with_feedback(self.problem, x, deviations, self.feedback, given)
            accurate = accurate and missed <= KKT_REPORTED and not self._runs_away(states)
            if status is Status.SOLVED and self.problem.soft is None:
                accurate = accurate and relative_violations(self.problem, states).max() <= KKT_REPORTED
        else:
            inputs = self.qp.inputs(result.z, theta)
            states = self.qp.states(result.z, theta)
        if not accurate:
            inputs = admissible(self.problem, inputs, given)
            states = rollout(self.problem, x, inputs, given)
        return Candidate(inputs, states, status if accurate else Status.INACCURATE, result.residuals, result.solver)

    def _runs_away(self, states: Array) -> bool:
        """Whether v - Kx keeps too few digits of the inputs."""
        if self.feedback is None:
            return False
        starts = np.cumsum([0, *block_lengths(self.problem)])[:-1]
        feedback = np.abs(np.einsum("bij,bj->bi", self.feedback, states[starts]))
        extent = np.where(self.problem.input_extent > 0, self.problem.input_extent, np.inf)
        return bool((feedback / extent).max() > RUNAWAY)

    def _in_another_form(self, first: Candidate, x: Array, given: Given, q: Array) -> Candidate:
        """Plan found stage by stage for an unstable plant, else `first`."""
        second = self._stage_by_stage(first.inputs, x, given, q) if self.unstable else None
        return first if second is None else second

    def _stage_by_stage(self, inputs: Array, x: Array, given: Given, q: Array) -> Candidate | None:
        """Plan found stage by stage, or None."""
        typical = typical_cost(self.qp, self.units, self.problem.input_extent, q)
        return stagewise_candidate(self.problem, x, given, inputs, typical)
