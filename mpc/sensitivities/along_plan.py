"""The optimality conditions of a plan, differentiated: Newton steps to the optimum itself, then its derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import nnls

from mpc.checks import Array
from mpc.condensing import constraints_of, row_units, soften
from mpc.feedback import block_lengths, feedback_along
from mpc.parametric_qp import Constraint
from mpc.plan import Plan, Status
from mpc.problem import MPCProblem
from mpc.rollout import Given, relative_violations
from mpc.sensitivities.changes import Changes
from mpc.sensitivities.plan_sensitivity import LocalProgram, PlanSensitivity, SensitivityStatus, null_directions
from mpc.tolerances import ACTIVE, BALANCED, DEFINITE, INDEPENDENT, NEAR_OPTIMUM, NEWTON, TOGETHER, WEAKLY_ACTIVE

Mask = NDArray[np.bool_]

STEPS = 8  # of Newton's method at most
SOFTENED = ("state", "terminal")  # kinds of constraints that a slack may relax


class PlanModel(Protocol):
    """Derivatives of x⁺ = f(x, u, p) along a plan, p (np,)."""

    def first(self, states: Array, inputs: Array) -> tuple[Array, Array, Array, Array]:
        """f (N, nx), ∂f/∂x (N, nx, nx), ∂f/∂u (N, nx, nu), ∂f/∂p (N, nx, np) at states and inputs of N steps."""
        ...

    def second(self, states: Array, inputs: Array, costates: Array) -> tuple[Array, Array]:
        """Of Σ λ_i f_i with costates λ (N, nx): Hessians by (x, u) and mixed with p, (N, nx + nu, nx + nu | np)."""
        ...


def sensitivity_of(
    problem: MPCProblem, model: PlanModel, changes: Changes, plan: Plan, given: Given
) -> PlanSensitivity:
    """Derivatives of a plan of `problem`, whose dynamics are those of `model`, under the signals `given`."""
    conditions = _Conditions(problem, model, changes, given)
    if plan.status is not Status.SOLVED:
        return conditions.none(plan, SensitivityStatus.UNSOLVED)
    point = _Point.of(problem, plan)
    with np.errstate(over="ignore", invalid="ignore"):
        linear = conditions.at(point)
        point = linear.with_multipliers(point)
        last = NEAR_OPTIMUM
        for _ in range(STEPS):
            linear = conditions.at(point)
            solved = linear.solved(point)
            if solved is None:
                return conditions.none(plan, SensitivityStatus.SINGULAR)
            size = linear.size_of(solved)
            # rounding ends it sooner where the problem is badly conditioned
            if size <= NEWTON or (last <= ACTIVE and not size <= last):
                return linear.sensitivity(plan, point, solved)
            if not size <= last:
                break
            last = size
            point = linear.moved(point, solved)
    return conditions.none(plan, SensitivityStatus.UNSOLVED)


@dataclass(frozen=True, eq=False)
class _Point:
    """Inputs (N, nu), states (N + 1, nx), slacks (N,) of soft limits, multipliers (m,) if known, which rows act."""

    inputs: Array
    states: Array
    slacks: Array
    multipliers: Array | None
    acting: Mask

    @classmethod
    def of(cls, problem: MPCProblem, plan: Plan) -> _Point:
        """A plan, whose multipliers are not known."""
        slacks = np.zeros(0)
        if problem.soft is not None:
            slacks = relative_violations(problem, plan.states, problem.price_units)
        return cls(np.array(plan.inputs), np.array(plan.states), slacks, None, np.zeros(0, dtype=bool))


class _Conditions:
    """The optimality conditions of a problem, to be linearised at points.

    Columns of every form are ξ = (x, p, u_prev, gap, value, z): what moves with θ = (x, p, u_prev), what closes the
    gaps of the dynamics, the value itself, and what moves with the free inputs.
    """

    def __init__(self, problem: MPCProblem, model: PlanModel, changes: Changes, given: Given) -> None:
        self.problem, self.model, self.changes, self.given = problem, model, changes, given
        last = problem.nu if problem.rate_limit is not None else 0
        ends = np.cumsum([0, problem.nx, changes.parameters, last, 1, 1, len(block_lengths(problem)) * problem.nu])
        names = ("x", "p", "u_prev", "gap", "value", "z")
        self.columns = {name: slice(int(a), int(b)) for name, a, b in zip(names, ends[:-1], ends[1:])}
        self.nt = int(ends[3])
        self.stage = np.block([[problem.Q, np.zeros((problem.nx, problem.nu))],
                               [np.zeros((problem.nu, problem.nx)), problem.R]])  # fmt: skip
        if problem.S is not None:
            self.stage[: problem.nx, problem.nx :] = problem.S
            self.stage[problem.nx :, : problem.nx] = problem.S.T
        cross = changes.S
        self.stage_change = np.block([[changes.Q.transpose(2, 0, 1), cross.transpose(2, 0, 1)],
                                      [cross.transpose(2, 1, 0), changes.R.transpose(2, 0, 1)]])  # fmt: skip

    def at(self, point: _Point) -> _Linearised:
        """Everything about one point."""
        return _Linearised(self, point)

    def forms(
        self, point: _Point, model: tuple[Array, Array, Array], after: Array, feedback: Array | None
    ) -> tuple[Array, Array]:
        """Inputs (N, nu, ·) and states (N + 1, nx, ·) as they move with ξ."""
        A, B, F = model
        problem, at = self.problem, self.columns
        N, width = problem.horizon, at["z"].stop
        U, X = np.zeros((N, problem.nu, width)), np.zeros((N + 1, problem.nx, width))
        X[0, :, at["x"]] = np.eye(problem.nx)
        first = 0
        for b, length in enumerate(block_lengths(problem)):
            column = at["z"].start + b * problem.nu
            form = np.zeros((problem.nu, width))
            form[:, column : column + problem.nu] = np.eye(problem.nu)
            if feedback is not None:
                form -= feedback[b] @ X[first]
            for k in range(first, first + length):
                U[k] = form
                X[k + 1] = A[k] @ X[k] + B[k] @ form
                X[k + 1, :, at["p"]] += F[k]
                X[k + 1, :, at["gap"]] += (after[k] - point.states[k + 1])[:, None]
            first += length
        U[:, :, at["value"]] = point.inputs[:, :, None]
        X[:, :, at["value"]] = point.states[:, :, None]
        return U, X

    def rows(self, point: _Point, U: Array, X: Array) -> tuple[Array, Array, list[Constraint]]:
        """Rows (m, ·) of ξ and the slacks, their values g <= 0 (m,) at the point, and their labels."""
        problem, at = self.problem, self.columns
        rows, bounds, labels = constraints_of(problem, U, X, at)
        value = rows[:, at["value"]].ravel()
        if problem.rate_limit is not None:
            value = value + rows[:, at["u_prev"]] @ self.given["u_prev"]
        kinds = [(label.kind, label.row) for label in labels]
        moved = {kind: change for kind, change in self.changes.bounds.items() if change.any()}
        for i, (kind, row) in enumerate(kinds):
            if kind in moved:
                rows[i, at["p"]] -= moved[kind][row]
        if problem.soft is None:
            return rows, value - bounds, labels
        rows, bounds, labels, _, _ = soften(problem, rows, bounds, labels, np.zeros((0, 0)))
        value = np.concatenate([value, np.zeros(problem.horizon)]) + rows[:, at["z"].stop :] @ point.slacks
        units = problem.price_units
        sets = {"state": problem.state_rows[1], "terminal": problem.terminal_rows[1]}
        for i, (kind, row) in enumerate(kinds):  # a price is counted in units of the bound
            if kind in moved and kind in sets and units[kind][row] == abs(sets[kind][row]):
                change = np.sign(sets[kind][row]) * moved[kind][row]
                rows[i, at["p"]] -= point.slacks[labels[i].step - 1] * change
        return rows, value - bounds, labels

    def none(self, plan: Plan, status: SensitivityStatus) -> PlanSensitivity:
        """What there is to say where there are no derivatives."""
        N, nx, nu, count = self.problem.horizon, self.problem.nx, self.problem.nu, self.changes.parameters
        last = self.columns["u_prev"].stop - self.columns["u_prev"].start
        shapes = {
            "cost_by_state": (nx,), "cost_by_parameters": (count,), "inputs_by_state": (N, nu, nx),
            "inputs_by_parameters": (N, nu, count), "states_by_state": (N + 1, nx, nx),
            "states_by_parameters": (N + 1, nx, count), "inputs_by_last_input": (N, nu, last),
        }  # fmt: skip
        unknown = {name: np.full(shape, np.nan) for name, shape in shapes.items()}
        return PlanSensitivity(
            plan=plan, status=status, **unknown, active={}, weakly_active=(), dependent=(), margin=np.nan, local=None
        )


class _Linearised:
    """The optimality conditions at one point."""

    def __init__(self, conditions: _Conditions, point: _Point) -> None:
        self.conditions = conditions
        problem, at = conditions.problem, conditions.columns
        nx, N = problem.nx, problem.horizon
        after, A, B, F = conditions.model.first(point.states[:-1], point.inputs)
        self.feedback = feedback_along(problem, A, B)
        self.U, self.X = conditions.forms(point, (A, B, F), after, self.feedback)
        rows, self.values, self.labels = conditions.rows(point, self.U, self.X)
        self.rows = rows
        self.units = row_units(problem, self.labels)
        held = np.concatenate([np.arange(length) > 0 for length in block_lengths(problem)])
        own = [label.kind != "input" or not held[label.step] for label in self.labels]
        self.own = np.array(own, dtype=bool)  # of a held input, the limits at its first step
        self.multipliers = np.zeros(len(rows)) if point.multipliers is None else point.multipliers
        given = conditions.given
        error = point.states - given["x_ref"].reshape(N + 1, -1) if "x_ref" in given else point.states
        effort = point.inputs - given["u_ref"].reshape(N, -1) if "u_ref" in given else point.inputs
        steps = np.hstack([error[:-1], effort])
        self.slope = 2 * steps @ conditions.stage
        self.end_slope = 2 * problem.P @ error[-1]
        forms = np.concatenate([self.X[:-1], self.U], axis=1)
        slacks = len(point.slacks)
        n = at["z"].stop - at["z"].start + slacks
        self.width = at["z"].stop + slacks
        gradient = np.einsum("ki,kij->j", self.slope, forms) + self.end_slope @ self.X[-1]
        self.gradient = np.concatenate([gradient, np.zeros(slacks)])
        if problem.soft is not None:
            linear, quadratic = problem.soft
            self.gradient[at["z"].stop :] = linear + 2 * quadratic * point.slacks
        mixed, end_mixed = self._mixed(steps, error[-1])
        self.cost_of_parameters = 0.5 * (np.einsum("ki,kip->p", steps, mixed) + error[-1] @ end_mixed)
        curvature = np.broadcast_to(2 * conditions.stage, (N, nx + problem.nu, nx + problem.nu))
        self.curvature = self._hessian(forms, curvature, slacks)[:, -n:]  # of the cost alone
        diagonal = self.curvature.diagonal()
        self.scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        self.balanced = False
        if point.multipliers is not None:
            costates = self._costates(A, B)
            lost = self.feedback is not None and problem.blocks is not None  # the digits of the costates
            self.balanced = lost or self._imbalance(B, costates) <= BALANCED
            of_model, mixed_of_model = conditions.model.second(point.states[:-1], point.inputs, costates)
            curvature = curvature + of_model
            mixed = mixed + mixed_of_model
        whole = self._hessian(forms, curvature, slacks)
        free = slice(at["z"].start, at["z"].stop)
        drawn = np.einsum("kia,kip->ap", forms[:, :, free], mixed) + self.X[-1][:, free].T @ end_mixed
        whole[: free.stop - free.start, at["p"]] += drawn
        self.H = whole[:, -n:]
        self.F = whole[:, : conditions.nt]
        self.F_gap = whole[:, at["gap"]].ravel()

    @property
    def free(self) -> slice:
        """Columns of z and the slacks."""
        return slice(self.conditions.columns["z"].start, self.width)

    def _mixed(self, steps: Array, end: Array) -> tuple[Array, Array]:
        """How the slopes of the cost change with p, (N, nx + nu, np) and (nx, np)."""
        conditions = self.conditions
        return (
            2 * np.einsum("pij,kj->kip", conditions.stage_change, steps),
            2 * np.einsum("ijp,j->ip", conditions.changes.P, end),
        )

    def _hessian(self, forms: Array, curvature: Array, slacks: int) -> Array:
        """Second derivatives (n, ·) of the Lagrangian by (z, slacks) and by (ξ, slacks)."""
        problem, at = self.conditions.problem, self.conditions.columns
        free = slice(at["z"].start, at["z"].stop)
        weighted = (curvature @ forms).reshape(-1, forms.shape[-1])
        H = forms[:, :, free].reshape(len(weighted), -1).T @ weighted + self.X[-1][:, free].T @ (
            2 * problem.P @ self.X[-1]
        )
        if problem.soft is None:
            return H
        whole = np.zeros((len(H) + slacks, H.shape[1] + slacks))
        whole[: len(H), : H.shape[1]] = H
        whole[len(H) :, H.shape[1] :] = 2 * problem.soft[1] * np.eye(slacks)
        return whole

    def _pushes(self) -> tuple[Array, Array]:
        """What the multipliers of limits add to the slopes by states (N + 1, nx) and inputs (N, nu)."""
        problem = self.conditions.problem
        on_states = np.zeros((problem.horizon + 1, problem.nx))
        on_inputs = np.zeros((problem.horizon, problem.nu))
        both = np.vstack([np.eye(problem.nu), -np.eye(problem.nu)])
        sets = {"state": problem.state_rows[0], "terminal": problem.terminal_rows[0], "input": problem.input_rows[0]}
        for i in np.flatnonzero(self.multipliers):
            kind, step, row = self.labels[i]
            if kind == "rate":
                on_inputs[step] += self.multipliers[i] * both[row]
                if step:
                    on_inputs[step - 1] -= self.multipliers[i] * both[row]
            elif kind in sets:
                pushed = on_inputs if kind == "input" else on_states
                pushed[step] += self.multipliers[i] * sets[kind][row]
        return on_states, on_inputs

    def _costates(self, A: Array, B: Array) -> Array:
        """λ (N, nx): what the cost from each next state on changes by with that state.

        Along the feedback, where there is one, they do not lose their digits to an unstable model: at an optimum the
        slope by the inputs, which it adds, is zero.
        """
        problem = self.conditions.problem
        nx = problem.nx
        on_states, on_inputs = self._pushes()
        costates = np.empty((problem.horizon, nx))
        closing = self.feedback if problem.blocks is None else None
        now = self.end_slope + on_states[-1]
        for k in reversed(range(problem.horizon)):
            costates[k] = now
            by_input = self.slope[k, nx:] + on_inputs[k] + B[k].T @ now
            now = self.slope[k, :nx] + on_states[k] + A[k].T @ now
            if closing is not None:
                now = now - closing[k].T @ by_input
        return costates

    def _imbalance(self, B: Array, costates: Array) -> float:
        """Slope of the Lagrangian by the inputs, beside the largest of its parts [-]."""
        nx = self.conditions.problem.nx
        parts = (self.slope[:, nx:], self._pushes()[1], np.einsum("kxu,kx->ku", B, costates))
        starts = np.cumsum([0, *block_lengths(self.conditions.problem)])[:-1]
        left = np.add.reduceat(sum(parts), starts, axis=0)
        largest = max(float(np.abs(part).max(initial=0.0)) for part in parts)
        return float(np.abs(left).max()) / largest if largest > 0 else 0.0

    def with_multipliers(self, point: _Point) -> _Point:
        """The point with multipliers >= 0 of the rows that are met, which balance the gradient best."""
        met = np.flatnonzero((self.values >= -ACTIVE * self.units) & self.own)
        multipliers = np.zeros(len(self.rows))
        scaled = self.rows[met][:, self.free] * self.scale
        length = np.linalg.norm(scaled, axis=1)
        met, scaled, length = met[length > 0], scaled[length > 0], length[length > 0]
        if len(met):
            unit = scaled / length[:, None]
            multipliers[met] = nnls(unit.T, -self.gradient[self.free] * self.scale, maxiter=30 * len(met))[0] / length
        return _Point(point.inputs, point.states, point.slacks, multipliers, self._acting(multipliers))

    def _worth(self, multipliers: Array) -> Array:
        """How far (m,) each row would be passed if it alone did not act, in its unit [-]; of linear models exactly."""
        pushing = np.flatnonzero(multipliers > 0)
        d = self.scale
        G = self.rows[pushing][:, self.free] * d
        H = self.curvature * d * d[:, None]
        try:
            soft = G @ cho_solve(cho_factor(H), G.T)
        except np.linalg.LinAlgError:  # a model that is not linear may leave an input free of cost
            soft = G @ np.linalg.lstsq(H, G.T, rcond=None)[0]
        size = np.sqrt(np.diag(soft))
        size[size == 0] = 1.0
        stiffness = np.diag(np.linalg.pinv(soft / size / size[:, None], hermitian=True)) / size**2
        worth = np.zeros(len(multipliers))
        worth[pushing] = multipliers[pushing] / np.where(stiffness > 0, stiffness, np.inf) / self.units[pushing]
        return worth

    def _acting(self, multipliers: Array) -> Mask:
        """Rows (m,) that push, and those of slacks at zero that nothing pushes, (m,) bool."""
        pushing = self._worth(multipliers) > WEAKLY_ACTIVE
        near = {
            label.step
            for label, value, unit in zip(self.labels, self.values, self.units)
            if label.kind in SOFTENED and value >= -ACTIVE * unit
        }
        idle = [label.kind == "slack" and label.step not in near for label in self.labels]
        return pushing | np.array(idle, dtype=bool)

    def solved(self, point: _Point) -> tuple[Array, Array] | None:
        """Moves of (z, slacks) and of the acting multipliers, by θ and (last column) to the optimum; None at a saddle.

        The acting rows are independent: of dependent ones a basic solution has multipliers on a part only.
        """
        at, nt = self.conditions.columns, self.conditions.nt
        acting = np.flatnonzero(point.acting)
        d = self.scale
        rows = self.rows[acting]
        G = rows[:, self.free] * d
        length = np.linalg.norm(G, axis=1)
        length[length == 0] = 1.0
        G = G / length[:, None]
        H = self.H * d * d[:, None]
        residual = self.gradient[self.free] + self.multipliers @ self.rows[:, self.free] + self.F_gap
        right = -np.column_stack([self.F, residual]) * d[:, None]
        missed = rows[:, at["gap"]].ravel() + self.values[acting]
        at_rows = -np.column_stack([rows[:, :nt], missed]) / length[:, None]
        first = np.linalg.lstsq(G, at_rows, rcond=None)[0] if len(G) else np.zeros_like(right)
        Z = null_directions(G)
        if Z.shape[1]:
            reduced = Z.T @ H @ Z
            reduced = (reduced + reduced.T) / 2
            if not np.isfinite(reduced).all() or np.linalg.eigvalsh(reduced)[0] < DEFINITE:
                return None
            first = first + Z @ np.linalg.solve(reduced, Z.T @ (right - H @ first))
        pushes = np.linalg.lstsq(G.T, right - H @ first, rcond=None)[0] if len(G) else np.zeros((0, nt + 1))
        return first * d[:, None], pushes / length[:, None]

    def size_of(self, solved: tuple[Array, Array]) -> float:
        """How far a Newton step goes, in sizes of inputs and states [-]."""
        problem = self.conditions.problem
        inputs, states = self._steps(solved)
        extent = np.where(problem.input_extent > 0, problem.input_extent, np.abs(inputs).max(initial=0.0))
        own = np.maximum(np.abs(self.U[:, :, self.conditions.columns["value"]]).max(axis=(0, 2)), extent)
        size = float(np.abs(inputs / np.where(own > 0, own, 1.0)).max(initial=0.0))
        size = max(size, float(np.abs(states / problem.state_extent).max()))
        return size if np.isfinite(size) else np.inf

    def _steps(self, solved: tuple[Array, Array]) -> tuple[Array, Array]:
        """Moves of inputs and states of a Newton step."""
        at = self.conditions.columns
        move = solved[0][: at["z"].stop - at["z"].start, -1]
        inputs, states = (form[:, :, at["z"]] @ move + form[:, :, at["gap"]][:, :, 0] for form in (self.U, self.X))
        return inputs, states

    def moved(self, point: _Point, solved: tuple[Array, Array]) -> _Point:
        """The point after a Newton step; rows that it would pass act from then on, those that would pull do not."""
        inputs, states = self._steps(solved)
        multipliers = np.zeros(len(self.rows))
        multipliers[point.acting] = self.multipliers[point.acting] + solved[1][:, -1]
        at = self.conditions.columns
        move = solved[0][:, -1]
        values = self.values + self.rows[:, at["gap"]].ravel() + self.rows[:, self.free] @ move
        passed = (values > ACTIVE * self.units) & ~point.acting & self.own
        acting = self._acting(multipliers) | passed
        slacks = point.slacks + move[at["z"].stop - at["z"].start :]
        return _Point(point.inputs + inputs, point.states + states, slacks, np.where(acting, multipliers, 0.0), acting)

    def sensitivity(self, plan: Plan, point: _Point, solved: tuple[Array, Array]) -> PlanSensitivity:
        """The derivatives at an optimum."""
        at, nt = self.conditions.columns, self.conditions.nt
        rates = solved[0][:, :nt]
        n = at["z"].stop - at["z"].start
        U, X = (form[:, :, :nt] + form[:, :, at["z"]] @ rates[:n] for form in (self.U, self.X))
        cost = self.gradient[:nt] + self.multipliers @ self.rows[:, :nt]
        by_parameters = cost[at["p"]] + self.cost_of_parameters
        weak, dependent, together = self._idle(point, rates)
        status = SensitivityStatus.SMOOTH
        if weak.any():
            status = SensitivityStatus.ONE_SIDED
        if (dependent & ~together).any():
            status = SensitivityStatus.DEPENDENT
        pushing = np.flatnonzero(self._worth(self.multipliers) > WEAKLY_ACTIVE)
        keep = np.r_[0:nt, at["z"].start : self.width]
        inputs, states = (
            np.concatenate([form[:, :, np.r_[0:nt, at["z"]]], np.zeros((*form.shape[:2], len(point.slacks)))], axis=2)
            for form in (self.U, self.X)
        )
        local = LocalProgram(self.H, self.F, self.rows[point.acting][:, keep], self.rows[weak][:, keep], inputs, states)
        return PlanSensitivity(
            plan=plan, status=status, cost_by_state=cost[at["x"]], cost_by_parameters=by_parameters,
            inputs_by_state=U[:, :, at["x"]], inputs_by_parameters=U[:, :, at["p"]],
            states_by_state=X[:, :, at["x"]], states_by_parameters=X[:, :, at["p"]],
            inputs_by_last_input=U[:, :, at["u_prev"]],
            active={self.labels[i]: float(self.multipliers[i]) for i in pushing}, weakly_active=self._named(weak),
            dependent=self._named(dependent), margin=self._margin(point, weak | dependent), local=local,
        )  # fmt: skip

    def _named(self, rows: Mask) -> tuple[Constraint, ...]:
        """Labels of rows."""
        return tuple(self.labels[i] for i in np.flatnonzero(rows))

    @property
    def _on_bound(self) -> Mask:
        """Rows (m,) that hold with equality."""
        return np.asarray(np.abs(self.values) <= WEAKLY_ACTIVE * self.units)

    def _idle(self, point: _Point, rates: Array) -> tuple[Mask, Mask, Mask]:
        """Rows (m,) that are met but do not push: weak ones, dependent ones, and which of these move along anyway."""
        nt = self.conditions.nt
        met = self._on_bound & self.own & ~point.acting
        acting = self.rows[point.acting][:, self.free] * self.scale
        basis = np.linalg.qr(acting.T)[0] if len(acting) else np.zeros((len(self.scale), 0))
        touched = {self.labels[i].step for i in np.flatnonzero(self._on_bound) if self.labels[i].kind in SOFTENED}
        met &= np.array([label.kind != "slack" or label.step in touched for label in self.labels], dtype=bool)
        dependent, together = np.zeros_like(met), np.zeros_like(met)
        for i in np.flatnonzero(met):
            row = self.rows[i, self.free] * self.scale
            length = float(np.linalg.norm(row))
            left = float(np.linalg.norm(row - basis @ (basis.T @ row)))
            if left > INDEPENDENT * length:
                continue
            dependent[i] = True
            parts = self.rows[i, self.free][:, None] * rates
            rate = self.rows[i, :nt] + parts.sum(axis=0)
            size = np.abs(self.rows[i, :nt]) + np.abs(parts).sum(axis=0)
            together[i] = bool((np.abs(rate) <= TOGETHER * size).all())
        return met & ~dependent, dependent, together

    def _margin(self, point: _Point, idle: Mask) -> float:
        """How far the nearest row is from beginning or ceasing to act, in its unit [-]."""
        worth = self._worth(self.multipliers)
        pushing = worth > WEAKLY_ACTIVE
        room = np.where(pushing, worth, -self.values / self.units)
        counts = pushing | ~(point.acting | idle)
        counts &= np.array([label.kind != "slack" for label in self.labels], dtype=bool) | pushing
        if (idle & ~point.acting).any() and not counts.any():
            return 0.0
        return float(np.maximum(room[counts], 0.0).min(initial=np.inf))
