"""Plans from the condensed QP, else relaxed, stage by stage, or of the saturated regulator."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import numpy as np
from scipy.linalg import block_diag

from mpc.checks import Array, Flags
from mpc.condensing import condense, number_of_slacks, row_units
from mpc.dense_qp import DenseQP, QPResult
from mpc.exceptions import NotStabilisableError
from mpc.feedback import block_lengths, stabilising_feedback
from mpc.halfspaces import box_of, is_empty
from mpc.plan import Plan, Residuals, Status
from mpc.problem import MPCProblem
from mpc.rollout import (
    Given,
    admissible,
    cost_of,
    finite,
    pushes,
    relative_violations,
    rollout,
    rollout_with_feedback,
    simulated,
    violation_of,
)
from mpc.stages import StagewiseQP
from mpc.stagewise import solve_stagewise
from mpc.tolerances import (
    FEASIBLE,
    GROWTH,
    KKT,
    KKT_REPORTED,
    NEAR_CIRCLE,
    OVERFLOW,
    PRIMAL,
    RELAXATION_MARGIN,
    RELAXATION_SHARES,
    RELAXATION_WIDER,
    ROUNDED_SUM,
    RUNAWAY,
)


@dataclass(frozen=True, eq=False)
class Program:
    """Solution of the QP, and what is known of it.

    status : SOFTENED where the QP was relaxed; far : inputs (N, nu) of the regulator where its states run away.
    """

    result: QPResult
    status: Status
    far: Array | None = None


def plan_of(
    problem: MPCProblem, given: Given, inputs: Array, states: Array, status: Status, residuals: Residuals, solver: str
) -> Plan:
    """Plan with its cost and violation, its time yet to be told."""
    cost, violation = cost_of(problem, inputs, states, given), violation_of(problem, states)
    return Plan(inputs, states, cost, status, residuals, violation, 0.0, solver)


def timed(plan: Plan, start: float) -> Plan:
    """Plan with the time since its clock began at `start`."""
    return replace(plan, solve_time=time.perf_counter() - start)


def stagewise_candidate(problem: MPCProblem, x: Array, given: Given, inputs: Array, typical_cost: float) -> Plan | None:
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
    return plan_of(problem, given, inputs, states, status, residuals, "stagewise")


class CondensedSolver:
    """Solver of one MPC problem from many states; safe for threads."""

    def __init__(self, problem: MPCProblem, parameters: tuple[str, ...]):
        self.problem = problem
        self.qp = condense(problem, parameters)
        self.units = row_units(problem, self.qp.labels)
        self.soft = np.array([label.kind in ("state", "terminal") for label in self.qp.labels], dtype=bool)
        self.feedback = stabilising_feedback(problem)
        self.unstable = float(np.abs(np.linalg.eigvals(problem.A)).max()) > 1 + NEAR_CIRCLE
        # of a long unstable horizon the second form is the stagewise one
        self.dense = DenseQP(self.qp.H, self.qp.G, self.units, second=self.feedback is None)
        moves = self.qp.nz - number_of_slacks(problem)
        self._scale = 1 / np.sqrt(np.diag(self.qp.H)[:moves])
        self._H = self.qp.H[:moves, :moves] * self._scale * self._scale[:, None]
        self._inverse = np.linalg.inv(self._H)
        self._extent = np.where(problem.input_extent > 0, problem.input_extent, np.inf)

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

    def first_inputs(self, states: Array, given: Sequence[Given]) -> Array:
        """First inputs (n, nu) of the plans from states (n, nx).

        Where no limit acts on the minimiser it is a linear law, evaluated for all states at once.
        """
        qp = self.qp
        moves = len(self._scale)
        with np.errstate(over="ignore", invalid="ignore"):
            theta = np.array([self.theta(*each) for each in zip(states, given)])
            q = theta @ qp.F.T + qp.f
            b = qp.w + theta @ qp.S.T
            force = q[:, :moves] * self._scale
            v = -force @ self._inverse
            z = v * self._scale
            found = np.linalg.norm(v @ self._H + force, axis=1) <= KKT * np.linalg.norm(force, axis=1)
            found &= (z @ qp.G[:, :moves].T <= b).all(axis=1)
            u = z @ qp.Lz[: qp.nu, :moves].T + theta @ qp.Lt[: qp.nu].T + qp.l[: qp.nu]
            limited = {i: self._program(states[i], given[i], q[i], b[i]) for i in np.flatnonzero(~found).tolist()}
            solved = {i: program for i, program in limited.items() if program is not None and program.far is None}
            if solved:
                own = [given[i] for i in solved]
                inputs, _, found[[*solved]] = self._trajectories([*solved.values()], states[[*solved]], own)
                u[[*solved]] = inputs[:, 0]
        for i in np.flatnonzero(~found).tolist():
            u[i] = self.plan(states[i], given[i], time.perf_counter()).inputs[0]
        return np.asarray(u)

    def plan(self, x: Array, given: Given, start: float) -> Plan:
        """Plan from the state x; its clock began at `start`."""
        theta = self.theta(x, given)
        with np.errstate(over="ignore", invalid="ignore"):
            q, b = self.qp.at(theta)
            program = self._program(x, given, q, b)
            found = None if program is None else self._best(program, x, given, q)
            if found is None or not np.isfinite(found.inputs).all():
                return saturated_regulator(self.problem, x, start)
            return timed(found, start)

    def _best(self, program: Program, x: Array, given: Given, q: Array) -> Plan:
        """Plan of a program's solution, INACCURATE where it fails a check.

        What does is solved stage by stage for an unstable plant, and so is what has to be relaxed while the states run
        away: there the dense QP would lose the digits of the inputs.
        """
        stage_by_stage = partial(stagewise_candidate, self.problem, x, given, typical_cost=self._typical_cost(q))
        away = None if program.far is None else stage_by_stage(program.far)
        if away is not None:
            return away
        result, status = program.result, program.status
        inputs, states, accurate = (found[0] for found in self._trajectories([program], x[None], [given]))
        if not accurate:
            inputs = admissible(self.problem, inputs, given)
            states = rollout(self.problem, x, inputs, given)
            status = Status.INACCURATE
        first = plan_of(self.problem, given, inputs, states, status, result.residuals, result.solver)
        if accurate or program.far is not None or not self.unstable:
            return first
        return stage_by_stage(inputs) or first

    def _program(self, x: Array, given: Given, q: Array, b: Array) -> Program | None:
        """Solution, relaxed if need be.

        There is none where input constraints contradict or data overflow.
        """
        if not max(np.abs(q).max(), (-b).max(initial=0.0)) < OVERFLOW:  # a bound that says nothing may be larger
            return None
        # without limits of states there is nothing to relax, so the word needs a second one
        result = self.dense.solve(q, b, confirm_infeasible=not self.soft.any())
        if not result.infeasible:
            return Program(result, Status.SOLVED)
        if inputs_conflict(self.problem, given.get("u_prev")):
            return None
        relaxed = self._relaxed(q, b) or (result, Status.SOFTENED)
        return Program(*relaxed, self._far_inputs(x, pushes(self.problem, given)))

    def _relaxed(self, q: Array, b: Array) -> tuple[QPResult, Status] | None:
        """Solution with least relaxed state constraints, SOLVED where none needed it; None without one.

        Whether the problem is infeasible is decided here, by the violation that is left when it is made least: what the
        QP solver said before is only the reason to ask.
        """
        least = self._least_violation(q, b)
        if least is None:
            return None
        relaxed, point = least
        for margin in RELAXATION_WIDER:  # the least relaxation is feasible by a hair's breadth
            wider = relaxed + margin * self.units * (relaxed > b)
            result = self.dense.solve(q, wider, confirm_infeasible=margin == RELAXATION_WIDER[-1])
            if not result.infeasible:
                break
        else:
            result = replace(result, z=point)
        infeasible = (relaxed - b > FEASIBLE * self.units).any()
        return result, Status.SOFTENED if infeasible else Status.SOLVED

    def _least_violation(self, q: Array, b: Array) -> tuple[Array, Array] | None:
        """Right-hand side relaxed by least squares of violations, and a point z within; None where hard rows conflict.

        Only rows of state and terminal constraints are relaxed; input, rate and slack rows are kept (Kerrigan and
        Maciejowski, *Soft constraints and exact penalty functions in MPC*, 2000, in two stages instead of one penalty).
        """
        qp, units = self.qp, self.units
        soft = self.soft
        if not soft.any():
            return None
        typical = self._typical_cost(q)
        columns = self._slack_columns
        tries: list[tuple[float, dict[str, float]]] = [(share, {}) for share in RELAXATION_SHARES]
        # many rows that are violated together differ by a small part of their slacks alone, which magnifies residuals
        for share, settings in [(RELAXATION_SHARES[0], {"sing_tol": ROUNDED_SUM}), *tries]:
            share = share / typical
            linear = np.concatenate([share * q, np.zeros(columns.shape[1])])
            result = self._elastic(share, **settings).solve(linear, b, confirm_infeasible=not settings)
            if result.residuals.worst <= (PRIMAL if settings else KKT) or (result.infeasible and not settings):
                break
        if result.infeasible or not np.isfinite(result.z).all():
            return None
        slack = np.maximum(-columns @ result.z[qp.nz :], 0.0)
        room = RELAXATION_MARGIN * np.maximum(units, slack)
        relaxed: Array = np.where(soft, b + np.where(slack > 2 * room, slack, 0.0) + room, b)
        # what the first stage left violated by rounding is tolerated too
        z = result.z[: qp.nz]
        return relaxed + np.where(soft, np.maximum(qp.G @ z - relaxed, 0.0), 0.0), z

    @cached_property
    def _slack_columns(self) -> Array:
        """Columns (m, steps) of each step's relative violation."""
        steps = np.array([label.step for label in self.qp.labels])
        columns = np.zeros((self.qp.m, int(steps[self.soft].max())))
        columns[self.soft, steps[self.soft] - 1] = -self.units[self.soft]
        return columns

    @cached_property
    def _elastic(self) -> Callable[..., DenseQP]:
        """Share of the cost → QP with squared violations."""

        def elastic(share: float, **settings: float) -> DenseQP:
            """QP of one share."""
            H = block_diag(share * self.qp.H, np.eye(self._slack_columns.shape[1]))
            G = np.hstack([self.qp.G, self._slack_columns])
            return DenseQP(H, G, self.units, second=self.dense.second, settings=settings)

        return lru_cache(len(RELAXATION_SHARES))(elastic)

    def _typical_cost(self, q: Array) -> float:
        """Cost of the unconstrained optimum within input bounds, at least one row unit's.

        A wide bound plays no part in it, and next to the origin, where nothing is wanted, violations still count.
        """
        curvature, bounded, least = self._sizes_of_cost
        return max(float(np.minimum(bounded, q**2 / curvature).sum()), least) or 1.0

    @cached_property
    def _sizes_of_cost(self) -> tuple[Array, Array, float]:
        """Curvatures, costs of input bounds, and of a row's unit."""
        curvature = np.diag(self.qp.H)
        size = np.full(self.qp.nz, np.inf)
        moves = len(self._scale)
        size[:moves] = np.tile(self._extent, moves // len(self._extent))
        moved = ((self.qp.G[self.soft] / self.units[self.soft, None]) ** 2 / curvature).sum(axis=1).max(initial=0.0)
        return curvature, size**2 * curvature, float(1 / moved) if moved > 0.0 else 0.0

    def _trajectories(
        self, programs: Sequence[Program], x: Array, given: Sequence[Given]
    ) -> tuple[Array, Array, Flags]:
        """Inputs, states, and whether their checks hold (n,)."""
        problem, qp = self.problem, self.qp
        accurate = np.array([program.result.residuals.worst <= KKT_REPORTED for program in programs])
        z = np.array([program.result.z for program in programs])
        z[~np.isfinite(z)] = 0.0
        if self.feedback is None:
            theta = np.array([self.theta(*each) for each in zip(x, given)])
            inputs = z @ qp.Lz.T + theta @ qp.Lt.T + qp.l
            states = z @ qp.Xz.T + theta @ qp.Xt.T + qp.x
            return inputs.reshape(len(z), -1, problem.nu), states.reshape(len(z), -1, problem.nx), accurate
        deviations = z[:, : len(self._scale)].reshape(len(z), -1, problem.nu)
        inputs, states, missed = rollout_with_feedback(problem, x, deviations, self.feedback, given)
        accurate &= (missed <= KKT_REPORTED) & (self._pull(self.feedback, states) <= RUNAWAY)
        if problem.soft is None:
            relaxed = np.array([program.status is Status.SOFTENED for program in programs])
            accurate &= relaxed | (relative_violations(problem, states).max(axis=1) <= KKT_REPORTED)
        return inputs, states, accurate

    def _far_inputs(self, x: Array, push: Array) -> Array | None:
        """Regulator's inputs where its states run away, otherwise None."""
        if self.feedback is None:
            return None
        by_state, by_pushes, of_inputs = self._most_pull
        most = by_state @ np.abs(x) + by_pushes @ (np.abs(push).max(axis=0) + of_inputs)
        if (most <= RUNAWAY).all():  # whatever the inputs are
            return None
        inputs, states = regulated(self.problem, x, push)
        return inputs if self._pull(self.feedback, states[None])[0] > RUNAWAY else None

    @cached_property
    def _most_pull(self) -> tuple[Array, Array, Array]:
        """Bounds on `_pull` by state and pushes; inputs' pushes."""
        assert self.feedback is not None
        problem = self.problem
        box = box_of(*problem.input_rows)
        gains = np.repeat(np.abs(self.feedback), block_lengths(problem), axis=0) / self._extent[:, None]
        power = np.eye(problem.nx)
        pushed = np.zeros_like(power)
        by_state = by_pushes = np.zeros(problem.B.T.shape)
        for gain in gains:
            by_state = np.maximum(by_state, gain @ np.abs(power))
            by_pushes = np.maximum(by_pushes, gain @ pushed)
            pushed = pushed + np.abs(power)
            power = problem.A @ power
        largest = np.full(problem.nu, np.inf) if box is None else np.abs(box).max(axis=0)
        return by_state, by_pushes, np.abs(problem.B) @ largest

    def _pull(self, feedback: Array, states: Array) -> Array:
        """Largest Kx (n,) in sizes of inputs.

        By so much u = v - Kx is less exact than v.
        """
        starts = np.cumsum([0, *block_lengths(self.problem)])[:-1]
        pull = np.abs(np.einsum("bij,nbj->nbi", feedback, states[:, starts])) / self._extent
        return np.asarray(pull.max(axis=(1, 2)))


def inputs_conflict(problem: MPCProblem, last_input: Array | None) -> bool:
    """Whether no input in U keeps the rate limit.

    U is convex and not empty, so an input that is in U may stay where it is.
    """
    if problem.rate_limit is None or last_input is None:
        return False
    H, h = problem.input_rows
    both = np.vstack([np.eye(problem.nu), -np.eye(problem.nu)])
    near = np.concatenate([last_input + problem.rate_limit, problem.rate_limit - last_input])
    return is_empty(np.vstack([H, both]), np.concatenate([h, near]))


def saturated_regulator(problem: MPCProblem, x: Array, start: float) -> Plan:
    """Plan of the saturated regulator."""
    inputs, states = regulated(problem, x, np.zeros((problem.horizon, problem.nx)))
    unknown = Residuals(np.inf, np.inf, np.inf, np.inf)
    violation = violation_of(problem, states)
    return timed(Plan(inputs, states, np.inf, Status.INFEASIBLE, unknown, violation, 0.0, "LQR"), start)


def regulated(problem: MPCProblem, x: Array, push: Array) -> tuple[Array, Array]:
    """Inputs and states under the saturated regulator, or zero inputs."""
    try:
        gain = problem.gain
    except NotStabilisableError:
        gain = np.zeros((problem.nu, problem.nx))

    def law(_: int, state: Array) -> Array:
        """Saturated input."""
        return problem.nearest_inputs(finite(-state @ gain.T))

    with np.errstate(over="ignore", invalid="ignore"):
        inputs, states = simulated(problem, x[None], push, law)
    return inputs[0], states[0]
