"""Optimality conditions of a plan, linearised at one point."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import nnls

from mpc.checks import Array, Flags
from mpc.condensing import constraints_of, number_of_slacks, predict, row_units
from mpc.feedback import block_lengths, feedback_along
from mpc.parametric_qp import places
from mpc.plan import Plan
from mpc.problem import MPCProblem
from mpc.rollout import Given, deviations
from mpc.sensitivities.changes import SOFTENED, Changes, PlanModel
from mpc.sensitivities.plan_sensitivity import PlanSensitivity, SensitivityStatus
from mpc.tolerances import KKT_REPORTED


@dataclass(frozen=True, eq=False)
class Point:
    """Inputs (N, nu), states (N + 1, nx), slacks (N,), multipliers (m,) or None."""

    inputs: Array
    states: Array
    slacks: Array
    multipliers: Array | None
    acting: Flags


class Conditions:
    """Optimality conditions of a problem, to be linearised at points.

    Columns of every form are ξ = (x, p, u_prev, gap, value, z, s): what moves with θ = (x, p, u_prev), what closes the
    gaps of the dynamics, the value itself, and what moves with the free inputs and slacks.
    """

    def __init__(self, problem: MPCProblem, model: PlanModel, changes: Changes, given: Given) -> None:
        self.problem, self.model, self.changes, self.given = problem, model, changes, given
        last = problem.nu if problem.rate_limit is not None else 0
        free = len(block_lengths(problem)) * problem.nu
        self.columns = places({"x": problem.nx, "p": changes.parameters, "u_prev": last, "gap": 1, "value": 1,
                               "z": free, "s": number_of_slacks(problem)})  # fmt: skip
        self.nt = self.columns["gap"].start
        self.free = slice(self.columns["z"].start, self.columns["s"].stop)
        cross = changes.S
        self.stage_change = np.block([[changes.Q.transpose(2, 0, 1), cross.transpose(2, 0, 1)],
                                      [cross.transpose(2, 1, 0), changes.R.transpose(2, 0, 1)]])  # fmt: skip

    def none(self, plan: Plan, status: SensitivityStatus) -> PlanSensitivity:
        """Sensitivity with NaN in place of each derivative."""
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


class Linearised:
    """Optimality conditions at one point."""

    def __init__(self, conditions: Conditions, point: Point) -> None:
        self.conditions, self.point = conditions, point
        self.free = conditions.free  # columns of z and the slacks
        problem, at, given = conditions.problem, conditions.columns, conditions.given
        nx, N = problem.nx, problem.horizon
        after, A, B, F = conditions.model.first(point.states[:-1], point.inputs)
        driven = np.zeros((N, nx, conditions.free.stop))
        driven[:, :, at["p"]] = F
        driven[:, :, at["gap"]] = (after - point.states[1:])[:, :, None]
        self.feedback = feedback_along(problem, A, B)
        self.U, self.X = predict(problem, A, B, driven, at["z"].start, self.feedback)
        self.U[:, :, at["value"]] = point.inputs[:, :, None]
        self.X[:, :, at["value"]] = point.states[:, :, None]
        priced = self._hold_limits()
        error, effort = deviations(point.states, point.inputs, given)
        steps = np.hstack([error[:-1], effort])
        self.slope = 2 * steps @ problem.stage_weight
        self.end_slope = 2 * problem.P @ error[-1]
        forms = np.concatenate([self.X[:-1], self.U], axis=1)
        linear, quadratic = problem.soft or (0.0, 0.0)
        self.gradient = np.einsum("ki,kij->j", self.slope, forms) + self.end_slope @ self.X[-1]
        self.gradient[at["s"]] = linear + 2 * quadratic * point.slacks
        mixed = 2 * np.einsum("pij,kj->kip", conditions.stage_change, steps)
        end_mixed = 2 * np.einsum("ijp,j->ip", conditions.changes.P, error[-1])
        self.cost_of_parameters = 0.5 * (np.einsum("ki,kip->p", steps, mixed) + error[-1] @ end_mixed)
        about = conditions.changes.reference
        self.cost_of_parameters -= self.slope.sum(axis=0) @ about + self.end_slope @ about[:nx]
        mixed = mixed - 2 * problem.stage_weight @ about
        end_mixed = end_mixed - 2 * problem.P @ about[:nx]
        curvature = np.broadcast_to(2 * problem.stage_weight, (N, nx + problem.nu, nx + problem.nu))
        self.curvature = self._hessian(forms, curvature)[:, conditions.free]  # of the cost alone
        diagonal = self.curvature.diagonal()
        self.scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        if point.multipliers is not None:
            costates = self._costates(A, B)
            of_model, mixed_of_model = conditions.model.second(point.states[:-1], point.inputs, costates)
            curvature = curvature + of_model
            mixed = mixed + mixed_of_model
        whole = self._hessian(forms, curvature)
        of_end = self.X[-1][:, conditions.free].T @ end_mixed
        whole[:, at["p"]] += np.einsum("kia,kip->ap", forms[:, :, conditions.free], mixed) + of_end
        for i, k, change in priced:  # what a slack is worth changes with the unit that it is counted in
            whole[at["s"].start - at["z"].start + k, at["p"]] -= self.multipliers[i] * change
        self.H = whole[:, conditions.free]
        self.F = whole[:, : conditions.nt]
        self.F_gap = whole[:, at["gap"]].ravel()

    def _hold_limits(self) -> list[tuple[int, int, Array]]:
        """Set what the limits are here; return row, slack and price of each violation whose unit changes."""
        conditions, point = self.conditions, self.point
        problem, at, given = conditions.problem, conditions.columns, conditions.given
        self.rows, bounds, self.labels = constraints_of(problem, self.U, self.X, at)
        last = given.get("u_prev", np.zeros(0))
        value = self.rows[:, at["value"]].ravel() + self.rows[:, at["u_prev"]] @ last
        self.values = value + self.rows[:, at["s"]] @ point.slacks - bounds  # g <= 0
        for i, (kind, _, row) in enumerate(self.labels):
            if kind in conditions.changes.bounds:
                self.rows[i, at["p"]] -= conditions.changes.bounds[kind][row]
        # the price of a violation is counted in units that may change
        prices = {kind: change for kind, change in conditions.changes.units.items() if change.any()}
        priced = [(i, step - 1, prices[kind][row]) for i, (kind, step, row) in enumerate(self.labels) if kind in prices]
        for i, k, change in priced:
            self.rows[i, at["p"]] -= point.slacks[k] * change
        self.units = row_units(problem, self.labels)
        self.on_bound = self.values >= -KKT_REPORTED * self.units  # rows that hold with equality
        near = {self.labels[i].step for i in np.flatnonzero(self.on_bound) if self.labels[i].kind in SOFTENED}
        idle = [label.kind == "slack" and label.step not in near for label in self.labels]
        self.idle_slacks = np.array(idle, dtype=bool)  # of steps that keep their limits
        held = np.concatenate([np.arange(length) > 0 for length in block_lengths(problem)])
        own = [label.kind != "input" or not held[label.step] for label in self.labels]
        self.own = np.array(own, dtype=bool)  # of a held input, the limits at its first step
        self.multipliers = np.zeros(len(self.rows)) if point.multipliers is None else point.multipliers
        return priced

    def _hessian(self, forms: Array, curvature: Array) -> Array:
        """Lagrangian Hessian (n, ·) by (z, slacks) and ξ."""
        problem, slacks = self.conditions.problem, self.conditions.columns["s"]
        weighted = (curvature @ forms).reshape(-1, forms.shape[-1])
        H: Array = forms[:, :, self.free].reshape(len(weighted), -1).T @ weighted
        H += self.X[-1][:, self.free].T @ (2 * problem.P @ self.X[-1])
        if problem.soft is not None:
            H[slacks.start - self.free.start :, slacks] = 2 * problem.soft[1] * np.eye(problem.horizon)
        return H

    def _costates(self, A: Array, B: Array) -> Array:
        """Costates λ (N, nx) of each next state.

        Along the feedback, where there is one, they do not lose their digits to an unstable model: at an optimum the
        slope by the inputs, which it adds, is zero.
        """
        problem = self.conditions.problem
        nx, sets = problem.nx, problem.limits.sets
        on_states, on_inputs = np.zeros((problem.horizon + 1, nx)), np.zeros((problem.horizon, problem.nu))
        both = np.vstack([np.eye(problem.nu), -np.eye(problem.nu)])
        for i in np.flatnonzero(self.multipliers):
            kind, step, row = self.labels[i]
            if kind == "rate":
                on_inputs[step] += self.multipliers[i] * both[row]
                if step:
                    on_inputs[step - 1] -= self.multipliers[i] * both[row]
            elif kind in sets:
                pushed = on_inputs if kind == "input" else on_states
                pushed[step] += self.multipliers[i] * sets[kind][0][row]
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

    def with_multipliers(self) -> Point:
        """The point with multipliers >= 0 that best balance the gradient."""
        met = np.flatnonzero(self.on_bound & self.own)
        multipliers = np.zeros(len(self.rows))
        scaled = self.rows[met][:, self.free] * self.scale
        length = np.linalg.norm(scaled, axis=1)
        met, scaled, length = met[length > 0], scaled[length > 0], length[length > 0]
        if len(met):
            unit = scaled / length[:, None]
            multipliers[met] = nnls(unit.T, -self.gradient[self.free] * self.scale, maxiter=30 * len(met))[0] / length
        return replace(self.point, multipliers=multipliers, acting=self.acting(multipliers))

    def worth(self, multipliers: Array) -> Array:
        """Violation (m,) of each row if inactive, in its unit [-]."""
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

    def acting(self, multipliers: Array) -> Flags:
        """Whether each row (m,) pushes, or is an unpushed slack at zero."""
        pushing = self.worth(multipliers) > KKT_REPORTED
        return np.asarray(pushing | self.idle_slacks)
