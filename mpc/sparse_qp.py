"""The QP with the states kept: sparse, for long horizons and many states."""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from mpc.candidates import Candidate, stagewise_candidate
from mpc.checks import Array
from mpc.feedback import stabilising_feedback
from mpc.plan import Plan, Residuals, Status
from mpc.problem import MPCProblem
from mpc.relaxation import inputs_conflict, regulated, saturated_regulator
from mpc.rollout import Given, admissible, cost_of, pushes, relative_violations, rollout, rollout_with_feedback
from mpc.stages import Staging
from mpc.tolerances import INTERIOR_POINT, KKT_REPORTED, NEGLIGIBLE, OSQP, OVERFLOW

_MOST_ITERATIONS = 20_000


class _Vectors(NamedTuple):
    """Linear cost and both sides of all rows, divided by a unit."""

    unit: float
    q: Array
    low: Array
    high: Array


class SparseSolver:
    """Solves one MPC problem in states and inputs from many states; safe to use from many threads.

    The solver is OSQP, an operator-splitting method (Stellato et al., Math. Prog. Comp. 12, 2020), or Clarabel. OSQP's
    answer is checked against the optimality conditions, and Clarabel asked where they do not hold. What neither solves
    goes to `solve_stagewise`, which prices violations.

    Parameters
    ----------
    problem : MPCProblem
        What to solve.
    parameters : tuple of str
        Signals that will be given.
    solver : str
        "osqp" or "clarabel".
    """

    def __init__(self, problem: MPCProblem, parameters: tuple[str, ...], solver: str):
        self.problem = problem
        self.solvers = tuple(dict.fromkeys((solver, "clarabel")))
        self.feedback = stabilising_feedback(problem)
        zeros = {name: np.zeros(rows * n) for name, (rows, n) in problem.signal_shapes.items() if name in parameters}
        self._staging = Staging(problem, problem.state_extent, zeros, problem.soft)
        self._H, self._K = _matrices(self._staging)
        self._workspace = threading.local()

    def __getstate__(self) -> dict[str, Any]:
        """The workspace of the solver is not copied: a copy sets up its own."""
        return {name: value for name, value in self.__dict__.items() if name != "_workspace"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._workspace = threading.local()

    def plan(self, x: Array, given: Given, start: float) -> Plan:
        """Plan from the state x; `start` is when the clock of its solve time began."""
        with np.errstate(over="ignore", invalid="ignore"):
            conflict = inputs_conflict(self.problem, given.get("u_prev"))
            if conflict or not np.abs(x / self.problem.state_extent).max() < OVERFLOW:
                return saturated_regulator(self.problem, x, start)
            found = self._solve(x, given)
            if found.status is not Status.SOLVED:
                inputs, states = regulated(self.problem, x, pushes(self.problem, given))
                typical = np.asarray(self.problem.R) * self._staging.input_size * self._staging.input_size[:, None]
                cost = float(np.trace(typical)) * self.problem.horizon
                if not self.problem.input_extent.all():  # only the state says how much inputs without limits cost
                    cost = max(cost, cost_of(self.problem, inputs, states, given))
                second = stagewise_candidate(self.problem, x, given, inputs, cost or 1.0)
                found = found if second is None else second
            return found.packed(self.problem, given, start)

    def _solve(self, x: Array, given: Given) -> Candidate:
        """The first candidate that meets the tolerance, or the last."""
        vectors = self._vectors(x, given)
        for solver in self.solvers:
            v, y = self._osqp(*vectors[1:]) if solver == "osqp" else self._clarabel(*vectors[1:])
            found = self._candidate(v, y, vectors, x, given, solver)
            if found.status is Status.SOLVED:
                break
        return found

    def _vectors(self, x: Array, given: Given) -> _Vectors:
        """The QP's vectors in a unit next to the size of the data: the tolerances of the solvers are absolute."""
        staging = self._staging
        if set(given) - {"u_prev"}:  # references and disturbances change more than the first state
            staging = Staging(self.problem, self.problem.state_extent, given, self.problem.soft)
        last = given.get("u_prev", np.zeros(self.problem.nu)) / staging.input_size
        first = np.concatenate([x / staging.state_size, last[: staging.memory]])
        q = np.concatenate([part for stage in staging.stages for part in (stage.gx, stage.gv)])
        equal = np.concatenate([first, *(stage.c for stage in staging.stages[:-1])])
        upper = np.concatenate([stage.d for stage in staging.stages])
        data = max(float(np.abs(part).max(initial=0.0)) for part in (equal, staging.x_ref, staging.u_ref))
        unit = float(10.0 ** np.ceil(np.log10(min(data, 1.0)))) if data > 1 / OVERFLOW else 1.0
        low = np.concatenate([equal, np.full(len(upper), -np.inf)])
        return _Vectors(unit, q / unit, low / unit, np.concatenate([equal, upper]) / unit)

    def _osqp(self, q: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """Variables and multipliers of OSQP, warm-started in this thread."""
        import osqp

        model = getattr(self._workspace, "model", None)
        if model is None:
            model = osqp.OSQP()
            model.setup(
                self._H, q, self._K, low, high, eps_abs=OSQP, eps_rel=OSQP, polishing=True, verbose=False,
                max_iter=_MOST_ITERATIONS, check_dualgap=False,
            )  # fmt: skip
            self._workspace.model = model
        else:
            model.update(q=q, l=low, u=high)
        result = model.solve(raise_error=False)
        return np.asarray(result.x, dtype=np.float64), np.asarray(result.y, dtype=np.float64)

    def _clarabel(self, q: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """Variables and multipliers of Clarabel."""
        import clarabel

        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = INTERIOR_POINT
        equal = int(np.isfinite(low).sum())
        cones = [clarabel.ZeroConeT(equal), clarabel.NonnegativeConeT(len(high) - equal)]
        solution = clarabel.DefaultSolver(self._H, q, self._K, high, cones, settings).solve()
        return np.array(solution.x), np.array(solution.z)

    def _residuals(self, v: Array, y: Array, q: Array, low: Array, high: Array) -> Residuals:
        """Relative KKT residuals on the scaled data."""
        Hv = self._H @ v + sparse.tril(self._H.T, -1) @ v
        Ky = self._K.T @ y
        Kv = self._K @ v
        equal = np.isfinite(low)
        force = max(*(float(np.linalg.norm(term)) for term in (Hv, q, Ky)), NEGLIGIBLE)
        size = np.maximum(np.abs(high), max(float(np.abs(v).max(initial=0.0)), NEGLIGIBLE))
        over = (Kv - high) / size
        stationarity = float(np.linalg.norm(Hv + q + Ky)) / force
        if self.feedback is None:
            stationarity = max(stationarity, self._reduced_gradient(Hv, q, Ky, y[equal]))
        y = np.where(equal, 0.0, y)
        cost = max(abs(float(v @ Hv)), abs(float(q @ v)), NEGLIGIBLE**2)
        gap = abs(float(y @ np.where(equal, 0.0, Kv - high))) / cost
        return Residuals(
            stationarity=stationarity,
            primal=float(np.max(np.where(equal, np.abs(over), over), initial=0.0)),
            dual=float(np.max(-y, initial=0.0)) / force,
            complementarity=max(float(np.linalg.norm(y * over)) / force, gap),
        )

    def _reduced_gradient(self, Hv: Array, q: Array, Ky: Array, y: Array) -> float:
        """Gradient by the inputs alone, with costates that leave none by the states, relative to its largest part.

        States of another size than the inputs would hide it in the gradient by all variables.
        """
        stages = self._staging.stages
        n = self._staging.n
        left = Hv + q + Ky
        costates = y.reshape(len(stages), n)
        change = np.zeros(n)
        gradient: list[Array] = []
        parts: list[Array] = []
        column = len(left)
        for k in reversed(range(len(stages))):
            inputs = slice(column - len(stages[k].gv), column)
            states = slice(inputs.start - n, inputs.start)
            column = states.start
            if k + 1 < len(stages):
                B = stages[k].B
                gradient.append(left[inputs] - B.T @ change)
                parts.append(np.abs(Hv[inputs]) + np.abs(q[inputs]) + np.abs(B).T @ np.abs(costates[k + 1] + change))
                change = stages[k].A.T @ change
            change = change - left[states]
        largest = max(float(np.linalg.norm(np.concatenate(parts))), NEGLIGIBLE)
        return float(np.linalg.norm(np.concatenate(gradient))) / largest

    def _candidate(self, v: Array, y: Array, vectors: _Vectors, x: Array, given: Given, solver: str) -> Candidate:
        """What the minimiser means for the plant; INACCURATE where it fails a check, as do the states it leads to."""
        name = {"osqp": "OSQP", "clarabel": "Clarabel"}[solver]
        residuals = self._residuals(v, y, *vectors[1:])
        if not np.isfinite(v).all():
            inputs, states = regulated(self.problem, x, pushes(self.problem, given))
            return Candidate(inputs, states, Status.INACCURATE, residuals, name)
        inputs, states, missed = self._trajectory(v * vectors.unit, x, given)
        if residuals.worst <= KKT_REPORTED:
            residuals = self._residuals(self._with_states(v, states / vectors.unit), y, *vectors[1:])
        over = relative_violations(self.problem, states).max() if self.problem.soft is None else 0.0
        accurate = residuals.worst <= KKT_REPORTED and max(missed, over) <= KKT_REPORTED
        return Candidate(inputs, states, Status.SOLVED if accurate else Status.INACCURATE, residuals, name)

    def _with_states(self, v: Array, states: Array) -> Array:
        """The variables with these states (N + 1, nx) in place of those the solver found."""
        moved = v.copy()
        column = 0
        for stage, state in zip(self._staging.stages, states / self._staging.state_size):
            moved[column : column + self.problem.nx] = state
            column += len(stage.gx) + len(stage.gv)
        return moved

    def _trajectory(self, v: Array, x: Array, given: Given) -> tuple[Array, Array, float]:
        """Inputs within U, the states they lead to, and how far the minimiser missed U, relative to it."""
        states = []
        variables = []
        column = 0
        for stage in self._staging.stages:
            states.append(v[column : column + len(stage.gx)])
            variables.append(v[column + len(stage.gx) : column + len(stage.gx) + len(stage.gv)])
            column += len(stage.gx) + len(stage.gv)
        inputs, predicted = self._staging.plan(states, variables, x)
        if self.feedback is not None:
            starts = np.flatnonzero(~self._staging.held)
            deviations = inputs[starts] + np.einsum("bij,bj->bi", self.feedback, predicted[starts])
            return rollout_with_feedback(self.problem, x, deviations, self.feedback, given)
        within = admissible(self.problem, inputs, given)
        missed = float(np.abs((within - inputs) / self._staging.input_size).max())
        return within, rollout(self.problem, x, within, given), missed


def _matrices(staging: Staging) -> tuple[Any, Any]:
    """Upper triangle of the Hessian, and the rows: first state, dynamics, constraints."""
    stages = staging.stages
    n = staging.n
    H = sparse.triu(sparse.block_diag([block for stage in stages for block in (stage.Hx, stage.Hv)])).tocsc()
    widths = [len(stage.gx) + len(stage.gv) for stage in stages]
    starts = np.cumsum([0, *widths])
    equal = sparse.lil_matrix((n * len(stages), int(starts[-1])))
    for k, stage in enumerate(stages):
        column = int(starts[k])
        equal[n * k : n * (k + 1), column : column + n] = np.eye(n)
        if k + 1 < len(stages):
            equal[n * (k + 1) : n * (k + 2), column : column + widths[k]] = -np.hstack([stage.A, stage.B])
    rows = sparse.block_diag([np.hstack([stage.D, stage.C]) for stage in stages])
    return H, sparse.vstack([equal, rows]).tocsc()
