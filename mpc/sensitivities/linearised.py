"""Optimality conditions of a plan, linearised at one point."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import nnls

from mpc.checks import Array, Flags
from mpc.condensing import row_units
from mpc.feedback import block_lengths, feedback_along
from mpc.sensitivities.changes import SOFTENED
from mpc.sensitivities.conditions import Conditions, Point
from mpc.tolerances import ACTIVE, WEAKLY_ACTIVE


class Linearised:
    """Optimality conditions at one point."""

    def __init__(self, conditions: Conditions, point: Point) -> None:
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
        self.slope = 2 * steps @ problem.stage_weight
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
        curvature = np.broadcast_to(2 * problem.stage_weight, (N, nx + problem.nu, nx + problem.nu))
        self.curvature = self._hessian(forms, curvature, slacks)[:, -n:]  # of the cost alone
        diagonal = self.curvature.diagonal()
        self.scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        if point.multipliers is not None:
            costates = self._costates(A, B)
            of_model, mixed_of_model = conditions.model.second(point.states[:-1], point.inputs, costates)
            curvature = curvature + of_model
            mixed = mixed + mixed_of_model
        whole = self._hessian(forms, curvature, slacks)
        free = slice(at["z"].start, at["z"].stop)
        drawn = np.einsum("kia,kip->ap", forms[:, :, free], mixed) + self.X[-1][:, free].T @ end_mixed
        whole[: free.stop - free.start, at["p"]] += drawn
        if slacks:  # what a slack is worth changes with the unit that it is counted in
            for i, change in conditions.priced(self.labels):
                whole[free.stop - free.start + self.labels[i].step - 1, at["p"]] -= self.multipliers[i] * change
        self.H = whole[:, -n:]
        self.F = whole[:, : conditions.nt]
        self.F_gap = whole[:, at["gap"]].ravel()

    @property
    def free(self) -> slice:
        """Columns of z and the slacks."""
        return slice(self.conditions.columns["z"].start, self.width)

    def _mixed(self, steps: Array, end: Array) -> tuple[Array, Array]:
        """Derivatives of cost slopes by p, (N, nx + nu, np) and (nx, np)."""
        conditions = self.conditions
        return (
            2 * np.einsum("pij,kj->kip", conditions.stage_change, steps),
            2 * np.einsum("ijp,j->ip", conditions.changes.P, end),
        )

    def _hessian(self, forms: Array, curvature: Array, slacks: int) -> Array:
        """Lagrangian Hessian (n, ·) by (z, slacks) and (ξ, slacks)."""
        problem, at = self.conditions.problem, self.conditions.columns
        free = slice(at["z"].start, at["z"].stop)
        weighted = (curvature @ forms).reshape(-1, forms.shape[-1])
        H: Array = forms[:, :, free].reshape(len(weighted), -1).T @ weighted + self.X[-1][:, free].T @ (
            2 * problem.P @ self.X[-1]
        )
        if problem.soft is None:
            return H
        whole = np.zeros((len(H) + slacks, H.shape[1] + slacks))
        whole[: len(H), : H.shape[1]] = H
        whole[len(H) :, H.shape[1] :] = 2 * problem.soft[1] * np.eye(slacks)
        return whole

    def _pushes(self) -> tuple[Array, Array]:
        """Slopes by states (N + 1, nx) and inputs (N, nu) from limits."""
        problem = self.conditions.problem
        on_states = np.zeros((problem.horizon + 1, problem.nx))
        on_inputs = np.zeros((problem.horizon, problem.nu))
        both = np.vstack([np.eye(problem.nu), -np.eye(problem.nu)])
        sets = problem.limits.sets
        for i in np.flatnonzero(self.multipliers):
            kind, step, row = self.labels[i]
            if kind == "rate":
                on_inputs[step] += self.multipliers[i] * both[row]
                if step:
                    on_inputs[step - 1] -= self.multipliers[i] * both[row]
            elif kind in sets:
                pushed = on_inputs if kind == "input" else on_states
                pushed[step] += self.multipliers[i] * sets[kind][0][row]
        return on_states, on_inputs

    def _costates(self, A: Array, B: Array) -> Array:
        """Costates λ (N, nx) of each next state.

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

    def with_multipliers(self, point: Point) -> Point:
        """Point with multipliers >= 0 that best balance the gradient."""
        met = np.flatnonzero((self.values >= -ACTIVE * self.units) & self.own)
        multipliers = np.zeros(len(self.rows))
        scaled = self.rows[met][:, self.free] * self.scale
        length = np.linalg.norm(scaled, axis=1)
        met, scaled, length = met[length > 0], scaled[length > 0], length[length > 0]
        if len(met):
            unit = scaled / length[:, None]
            multipliers[met] = nnls(unit.T, -self.gradient[self.free] * self.scale, maxiter=30 * len(met))[0] / length
        return Point(point.inputs, point.states, point.slacks, multipliers, self.acting(multipliers))

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
        pushing = self.worth(multipliers) > WEAKLY_ACTIVE
        near = {
            label.step
            for label, value, unit in zip(self.labels, self.values, self.units)
            if label.kind in SOFTENED and value >= -ACTIVE * unit
        }
        idle = [label.kind == "slack" and label.step not in near for label in self.labels]
        return np.asarray(pushing | np.array(idle, dtype=bool))

    @property
    def on_bound(self) -> Flags:
        """Whether each row (m,) holds with equality, up to tolerance."""
        return np.asarray(self.values >= -WEAKLY_ACTIVE * self.units)
