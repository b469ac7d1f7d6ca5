"""Optimality conditions of a plan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mpc.checks import Array, Flags
from mpc.condensing import constraints_of, predict, soften
from mpc.feedback import block_lengths
from mpc.parametric_qp import Constraint, places
from mpc.plan import Plan
from mpc.problem import MPCProblem
from mpc.rollout import Given, relative_violations
from mpc.sensitivities.changes import Changes
from mpc.sensitivities.plan_sensitivity import PlanSensitivity, SensitivityStatus


class PlanModel(Protocol):
    """Derivatives of x⁺ = f(x, u, p) along a plan, p (np,)."""

    def first(self, states: Array, inputs: Array) -> tuple[Array, Array, Array, Array]:
        """Values f (N, nx), ∂f/∂x, ∂f/∂u and ∂f/∂p (N, nx, ·)."""
        ...

    def second(self, states: Array, inputs: Array, costates: Array) -> tuple[Array, Array]:
        """Hessians of Σ λ_i f_i by (x, u), and mixed derivatives with p."""
        ...


@dataclass(frozen=True, eq=False)
class Point:
    """Inputs (N, nu), states (N + 1, nx), slacks (N,), multipliers (m,) or None."""

    inputs: Array
    states: Array
    slacks: Array
    multipliers: Array | None
    acting: Flags

    @classmethod
    def from_plan(cls, problem: MPCProblem, plan: Plan) -> Point:
        """Point of a plan without multipliers."""
        slacks = np.zeros(0)
        if problem.soft is not None:
            slacks = relative_violations(problem, plan.states, problem.price_units)
        return cls(np.array(plan.inputs), np.array(plan.states), slacks, None, np.zeros(0, dtype=bool))


class Conditions:
    """Optimality conditions of a problem, to be linearised at points.

    Columns of every form are ξ = (x, p, u_prev, gap, value, z): what moves with θ = (x, p, u_prev), what closes the
    gaps of the dynamics, the value itself, and what moves with the free inputs.
    """

    def __init__(self, problem: MPCProblem, model: PlanModel, changes: Changes, given: Given) -> None:
        self.problem, self.model, self.changes, self.given = problem, model, changes, given
        last = problem.nu if problem.rate_limit is not None else 0
        self.columns = places({"x": problem.nx, "p": changes.parameters, "u_prev": last, "gap": 1, "value": 1,
                               "z": len(block_lengths(problem)) * problem.nu})  # fmt: skip
        self.nt = self.columns["gap"].start
        cross = changes.S
        self.stage_change = np.block([[changes.Q.transpose(2, 0, 1), cross.transpose(2, 0, 1)],
                                      [cross.transpose(2, 1, 0), changes.R.transpose(2, 0, 1)]])  # fmt: skip

    def forms(
        self, point: Point, model: tuple[Array, Array, Array], after: Array, feedback: Array | None
    ) -> tuple[Array, Array]:
        """Inputs (N, nu, ·) and states (N + 1, nx, ·) as functions of ξ."""
        A, B, F = model
        at = self.columns
        driven = np.zeros((len(A), self.problem.nx, at["z"].stop))
        driven[:, :, at["p"]] = F
        driven[:, :, at["gap"]] = (after - point.states[1:])[:, :, None]
        U, X = predict(self.problem, A, B, driven, at["z"].start, feedback)
        U[:, :, at["value"]] = point.inputs[:, :, None]
        X[:, :, at["value"]] = point.states[:, :, None]
        return U, X

    def rows(self, point: Point, U: Array, X: Array) -> tuple[Array, Array, list[Constraint]]:
        """Rows (m, ·) by ξ and slacks, values g <= 0 (m,), and labels."""
        problem, at = self.problem, self.columns
        rows, bounds, labels = constraints_of(problem, U, X, at)
        value = rows[:, at["value"]].ravel()
        if problem.rate_limit is not None:
            value = value + rows[:, at["u_prev"]] @ self.given["u_prev"]
        for kind, change in self.changes.bounds.items():
            of_kind = [i for i, label in enumerate(labels) if label.kind == kind]
            rows[of_kind, at["p"]] -= change[[labels[i].row for i in of_kind]]
        if problem.soft is None:
            return rows, value - bounds, labels
        rows, bounds, labels = soften(problem, rows, bounds, labels)
        value = np.concatenate([value, np.zeros(problem.horizon)]) + rows[:, at["z"].stop :] @ point.slacks
        for i, change in self.priced(labels):  # the price of a violation is counted in units that may change
            rows[i, at["p"]] -= point.slacks[labels[i].step - 1] * change
        return rows, value - bounds, labels

    def priced(self, labels: list[Constraint]) -> list[tuple[int, Array]]:
        """Softened rows with changing units, and their changes (np,)."""
        units = {kind: change for kind, change in self.changes.units.items() if change.any()}
        return [(i, units[label.kind][label.row]) for i, label in enumerate(labels) if label.kind in units]

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
