"""Sparse QP with the states kept."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from mpc.checks import Array
from mpc.dense_qp import clarabel_solution
from mpc.feedback import stabilising_feedback
from mpc.plan import Plan, Residuals, Status
from mpc.problem import MPCProblem
from mpc.rollout import Given, admissible, pushes, relative_violations, rollout, rollout_with_feedback
from mpc.solving import (
    CondensedSolver,
    inputs_conflict,
    plan_of,
    regulated,
    saturated_regulator,
    stagewise_candidate,
    timed,
)
from mpc.stages import StagewiseQP
from mpc.tolerances import KKT, KKT_REPORTED, NEGLIGIBLE, OVERFLOW, RUNAWAY, SOLVERS


class SparseSolver:
    """Solver of one MPC problem with the states kept; safe for threads.

    The solver is OSQP, an operator-splitting method (Stellato et al., Math. Prog. Comp. 12, 2020), or Clarabel. OSQP's
    answer is checked against the optimality conditions, and Clarabel asked where they do not hold. What neither solves
    is solved condensed, or, where that has too many variables, goes to `solve_stagewise`, which prices violations.
    `parameters` are the signals that will be given, `solver` is "osqp" or "clarabel".
    """

    def __init__(self, problem: MPCProblem, parameters: tuple[str, ...], solver: str):
        self.problem = problem
        self.solvers = tuple(dict.fromkeys((solver, "clarabel")))
        self.feedback = stabilising_feedback(problem)
        zeros = {name: np.zeros(rows * n) for name, (rows, n) in problem.signal_shapes.items() if name in parameters}
        self._stagewise = StagewiseQP(problem, problem.state_size, zeros, problem.soft)
        stages = self._stagewise.stages
        ends = np.cumsum([len(part) for stage in stages for part in (stage.gx, stage.gv)])
        self._places = np.split(np.arange(ends[-1]), ends[:-1])  # of state and variables of every stage
        self._states = np.array(self._places[::2])
        self._inputs = np.concatenate([place[: stage.nu] for place, stage in zip(self._places[1::2], stages)])
        self._H, self._K = self._matrices()
        self._whole_H = (self._H + sparse.triu(self._H, 1).T).tocsr()
        self._K_T = self._K.T.tocsr()
        self._equal = self._states.size
        dynamics, self._limits = self._K[: self._equal], self._K[self._equal :].tocsr()
        self._limits_T = self._limits.T.tocsr()
        self._costates = splu(dynamics[:, self._states.ravel()].T.tocsc())
        self._driven = dynamics[:, self._inputs].T.tocsr()
        self._driven_sizes = abs(self._driven)
        self._weight = float(np.abs(self._whole_H.diagonal()[self._inputs]).max(initial=0.0))
        radius = float(np.abs(np.linalg.eigvals(problem.A)).max())
        # costates keep the digits that `_doubt` needs
        self._remembers = problem.horizon * np.log(max(radius, 1.0)) < np.log(RUNAWAY)
        self._parameters = parameters
        self._workspace = threading.local()

    def first_inputs(self, states: Array, given: Sequence[Given]) -> Array:
        """First inputs (n, nu) of the plans from states (n, nx)."""
        return np.array([self.plan(*each, time.perf_counter()).inputs[0] for each in zip(states, given)])

    def plan(self, x: Array, given: Given, start: float) -> Plan:
        """Plan from the state x; its clock began at `start`."""
        with np.errstate(over="ignore", invalid="ignore"):
            conflict = inputs_conflict(self.problem, given.get("u_prev"))
            if conflict or not np.abs(x / self.problem.state_extent).max() < OVERFLOW:
                return saturated_regulator(self.problem, x, start)
            found = self._solve(x, given)
            if found.status is not Status.SOLVED:
                if self.problem.horizon * self.problem.nu <= 100:  # as fast as stage by stage
                    plan = self._condensed.plan(x, given, start)
                    if plan.status is not Status.INACCURATE:
                        return plan
                inputs, _ = regulated(self.problem, x, pushes(self.problem, given))
                typical = np.asarray(self.problem.R) * self._stagewise.input_size * self._stagewise.input_size[:, None]
                cost = float(np.trace(typical)) * self.problem.horizon
                second = stagewise_candidate(self.problem, x, given, inputs, cost or 1.0)
                found = found if second is None else second
            return timed(found, start)

    @cached_property
    def _condensed(self) -> CondensedSolver:
        """Solver of the problem in the inputs alone."""
        return CondensedSolver(self.problem, self._parameters)

    def _solve(self, x: Array, given: Given) -> Plan:
        """First candidate that meets the tolerance, or the last."""
        q, low, high = self._vectors(x, given)
        for solver in self.solvers:
            if solver == "osqp":
                v, y = self._osqp(q, low, high)
            else:  # what is small beside the sets would be solved to fewer digits
                data = float(np.abs(low[: self._equal]).max(initial=0.0))
                unit = data if data > 1 / OVERFLOW else 1.0
                v, y, _ = clarabel_solution(self._H, q, self._K, high, unit, self._equal)
            found = self._candidate(v, self._residuals(v, y, q, low, high), x, given, solver)
            if found.status is Status.SOLVED:
                cost = None if self.problem.S is None else found.cost / self._stagewise.cost
                if self._doubt(v, y, q, high, found.states, cost) <= KKT_REPORTED:
                    break
                found = replace(found, status=Status.INACCURATE)
        return found

    def _vectors(self, x: Array, given: Given) -> tuple[Array, Array, Array]:
        """Linear cost and the two sides of all rows."""
        stagewise = self._stagewise
        if set(given) - {"u_prev"}:  # references and disturbances change more than the first state
            stagewise = StagewiseQP(self.problem, stagewise.state_size, given, stagewise.price, stagewise.input_size)
        last = given.get("u_prev", np.zeros(self.problem.nu)) / stagewise.input_size
        first = np.concatenate([x / stagewise.state_size, last[: stagewise.memory]])
        q = np.concatenate([part for stage in stagewise.stages for part in (stage.gx, stage.gv)])
        equal = np.concatenate([first, *(stage.c for stage in stagewise.stages[:-1])])
        upper = np.concatenate([stage.d for stage in stagewise.stages])
        return q, np.concatenate([equal, np.full(len(upper), -np.inf)]), np.concatenate([equal, upper])

    def _osqp(self, q: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """Variables and multipliers of OSQP, warm-started in this thread."""
        import osqp

        model = getattr(self._workspace, "model", None)
        if model is None:
            model = osqp.OSQP()
            model.setup(
                self._H, q, self._K, low, high, eps_abs=KKT, eps_rel=KKT, polishing=True, verbose=False,
                max_iter=20_000, check_dualgap=False,
            )  # fmt: skip
            self._workspace.model = model
        else:
            model.update(q=q, l=low, u=high)
        result = model.solve(raise_error=False)
        return np.asarray(result.x, dtype=np.float64), np.asarray(result.y, dtype=np.float64)

    def _residuals(self, v: Array, y: Array, q: Array, low: Array, high: Array) -> Residuals:
        """Relative KKT residuals on the scaled data."""
        Hv = self._whole_H @ v
        Ky = self._K_T @ y
        Kv = self._K @ v
        equal = np.isfinite(low)
        force = max(*(float(np.linalg.norm(term)) for term in (Hv, q, Ky)), NEGLIGIBLE)
        size = np.maximum(np.abs(high), max(float(np.abs(v).max(initial=0.0)), NEGLIGIBLE))
        over = (Kv - high) / size
        y = np.where(equal, 0.0, y)
        return Residuals(
            stationarity=float(np.linalg.norm(Hv + q + Ky)) / force,
            primal=float(np.max(np.where(equal, np.abs(over), over), initial=0.0)),
            dual=float(np.max(-y, initial=0.0)) / force,
            complementarity=float(np.linalg.norm(y * over)) / force,
        )

    def _candidate(self, v: Array, residuals: Residuals, x: Array, given: Given, solver: str) -> Plan:
        """Plan of the minimiser; INACCURATE where it fails a check."""
        name = {"osqp": "OSQP", "clarabel": "Clarabel"}[solver]
        if not np.isfinite(v).all():
            inputs, states = regulated(self.problem, x, pushes(self.problem, given))
            return plan_of(self.problem, given, inputs, states, Status.INACCURATE, residuals, name)
        inputs, states, missed = self._trajectory(v, x, given)
        over = relative_violations(self.problem, states).max() if self.problem.soft is None else 0.0
        accurate = residuals.worst <= KKT_REPORTED and max(missed, over) <= KKT_REPORTED
        status = Status.SOLVED if accurate else Status.INACCURATE
        return plan_of(self.problem, given, inputs, states, status, residuals, name)

    def _trajectory(self, v: Array, x: Array, given: Given) -> tuple[Array, Array, float]:
        """Inputs within U, their states, and the relative miss of U."""
        parts = [v[place] for place in self._places]
        inputs, predicted = self._stagewise.plan(parts[::2], parts[1::2], x)
        if self.feedback is not None:
            starts = np.flatnonzero(~self._stagewise.held)
            deviations = inputs[starts] + np.einsum("bij,bj->bi", self.feedback, predicted[starts])
            found = rollout_with_feedback(self.problem, x[None], deviations[None], self.feedback, [given])
            return found[0][0], found[1][0], float(found[2][0])
        within = admissible(self.problem, inputs, given)
        missed = float(np.abs((within - inputs) / self._stagewise.input_size).max())
        return within, rollout(self.problem, x, within, given), missed

    def _matrices(self) -> tuple[Any, Any]:
        """Upper triangle of the Hessian, and rows of dynamics and constraints."""
        stages = self._stagewise.stages
        blocks: list[Array] = []
        for stage in stages:
            joint = stage.Hc.any()  # else the zeros would be stored
            blocks += [np.block([[stage.Hx, stage.Hc], [stage.Hc.T, stage.Hv]])] if joint else [stage.Hx, stage.Hv]
        H = sparse.triu(sparse.block_diag(blocks)).tocsc()
        equal = sparse.lil_matrix((self._states.size, H.shape[0]))
        rows = np.arange(self._states.size).reshape(self._states.shape)
        for k, stage in enumerate(stages):
            equal[rows[k], self._states[k]] = 1.0
            if k + 1 < len(stages):
                places = np.concatenate(self._places[2 * k : 2 * k + 2])
                equal[np.ix_(rows[k + 1], places)] = -np.hstack([stage.A, stage.B])
        limits = sparse.block_diag([np.hstack([stage.D, stage.C]) for stage in stages])
        return H, sparse.vstack([equal, limits]).tocsc()

    def _doubt(self, v: Array, y: Array, q: Array, high: Array, states: Array, own_cost: float | None) -> float:
        """Largest relative error of the gradient by the inputs and of the duality gap, with `states` (N + 1, nx).

        In the residuals of all variables those of another size would hide it. With a cross weight the parts may cancel
        to a cost that is small beside them: then what both can have lost, by convexity, is also set against the cost
        itself, `own_cost`, in the units of H.
        """
        v = v.copy()
        v[self._states[:, : states.shape[1]]] = states / self._stagewise.state_size
        y = y[self._equal :]
        Hv = self._whole_H @ v
        pushed = self._limits_T @ y
        unit = float(np.abs(v).max(initial=0.0))
        left, largest = self._gradient(Hv, q, pushed, unit) if self._remembers else (np.zeros(1), 0.0)
        gradient = float(np.linalg.norm(left)) / largest if largest > 0 else 0.0
        least = SOLVERS / KKT_REPORTED * self._weight * unit**2  # that the solver knows of
        cost = max(abs(float(v @ Hv)), abs(float(q @ v)), least)
        gap = abs(float(y @ (high[self._equal :] - self._limits @ v)))
        doubt = max(gradient, gap / cost if cost > 0 else 0.0)
        if own_cost is None or max(own_cost, least) <= 0:
            return doubt
        return max(doubt, (float(np.abs(left).sum()) * unit + gap) / max(own_cost, least))

    def _gradient(self, Hv: Array, q: Array, pushed: Array, unit: float) -> tuple[Array, float]:
        """Gradient by the inputs alone, and its largest part's size."""
        force = Hv + q + pushed
        costates = self._costates.solve(force[self._states.ravel()])
        left = force[self._inputs] - self._driven @ costates
        parts = [Hv[self._inputs], q[self._inputs], pushed[self._inputs], self._driven_sizes @ np.abs(costates)]
        return left, max(NEGLIGIBLE * self._weight * unit, *(float(np.linalg.norm(part)) for part in parts))
