"""Derivatives of an optimal plan and its cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ccdtools_ground.outcome import Outcome
from mpc.checks import Array, as_array
from mpc.dense_qp import DenseQP
from mpc.parametric_qp import Constraint
from mpc.plan import Plan
from mpc.tolerances import KKT_REPORTED


class SensitivityStatus(Outcome):
    """Validity of derivatives; the value is the advice."""

    SMOOTH = "The active set is the same nearby: the derivatives hold on every side, as far as `margin`."
    ONE_SIDED = (
        "Constraints are weakly active, see `weakly_active`: derivatives of inputs and states are those of the side on "
        "which they do not act. Ask `along` for any other direction. Those of the cost hold on every side."
    )
    DEPENDENT = (
        "Active constraints depend on each other and do not move together, see `dependent`: on some side the problem "
        "has no solution, or another rate; the derivatives hold one set of independent ones. Drop a constraint, or "
        "make the state constraints soft."
    )
    SINGULAR = (
        "The first-order conditions hold, but their derivatives are singular: it is no strict optimum (the Hessian of "
        "the Lagrangian is not positive definite along the active constraints), or active constraints of a trajectory "
        "depend on each other. There are no derivatives. Give every input a cost, or start from another plan."
    )
    UNSOLVED = "The plan is no optimum of the problem as posed, so there are no derivatives: see `plan.status`."


class Rates(NamedTuple):
    """One-sided rates of cost, inputs (N, nu) and states (N + 1, nx)."""

    cost: float
    inputs: Array
    states: Array


@dataclass(frozen=True, eq=False)
class LocalProgram:
    """QP of the rates of change, in ξ = (θ, z), θ = (x, p, u_prev)."""

    H: Array  # (n, n): Hessian of the Lagrangian by z
    F: Array  # (n, nt): its mixed derivatives by z and θ
    # rows that keep acting, and those that may begin or cease to
    held: Array  # (·, nt + n)
    weak: Array  # (·, nt + n)
    inputs: Array  # (N, nu, nt + n)
    states: Array  # (N + 1, nx, nt + n)

    def rate(self, theta: Array) -> Array | None:
        """Rate (n,) of z along θ (nt,); None without a solution."""
        nt = len(theta)
        held, at = self.held[:, nt:], self.held[:, :nt] @ theta
        d = 1 / np.sqrt(np.abs(np.diag(self.H)))
        first = -np.linalg.lstsq(held * d, at, rcond=None)[0] * d if len(at) else np.zeros(len(d))
        free = null_directions(held * d) * d[:, None]
        if not free.shape[1]:
            return first
        bounds = -(self.weak[:, :nt] @ theta + self.weak[:, nt:] @ first)
        H = free.T @ self.H @ free
        slope = free.T @ (self.H @ first + self.F @ theta)
        found = DenseQP((H + H.T) / 2, self.weak[:, nt:] @ free).solve(slope, bounds, confirm_infeasible=True)
        solved = not found.infeasible and found.residuals.worst <= KKT_REPORTED
        return first + free @ found.z if solved else None


@dataclass(frozen=True, eq=False, repr=False)
class PlanSensitivity:
    """Optimal plan with derivatives by x (nx,), p (np,) and u_prev (nu,).

    They are those of the optimality conditions at the active constraints (Fiacco, *Introduction to Sensitivity and
    Stability Analysis in Nonlinear Programming*, 1983), of the plan after Newton steps on these; NaN where there are
    none, see `status`.

    Attributes
    ----------
    plan : Plan
    status : SensitivityStatus
        With advice.
    cost_by_state, cost_by_parameters : (nx,) and (np,) arrays
        ∂J*/∂x and ∂J*/∂p, terminal cost included.
    inputs_by_state, inputs_by_parameters : (N, nu, nx) and (N, nu, np) arrays
    states_by_state, states_by_parameters : (N + 1, nx, nx) and (N + 1, nx, np) arrays
    inputs_by_last_input : (N, nu, nu) array
        Where there is a rate limit; else (N, nu, 0).
    active : dict of Constraint to float
        The constraints that act, with their multipliers: by how much J* falls when the bound is moved out by one.
    weakly_active : tuple of Constraint
        Met without a multiplier, or so nearly that rounding decides.
    dependent : tuple of Constraint
        Met, and a combination of others that are (LICQ fails).
    margin : float
        What the nearest constraint is from beginning or ceasing to act, in units of its bound [-]: beyond about this
        change the derivatives are others.
    """

    plan: Plan
    status: SensitivityStatus
    cost_by_state: Array
    cost_by_parameters: Array
    inputs_by_state: Array
    inputs_by_parameters: Array
    states_by_state: Array
    states_by_parameters: Array
    inputs_by_last_input: Array
    active: dict[Constraint, float]
    weakly_active: tuple[Constraint, ...]
    dependent: tuple[Constraint, ...]
    margin: float
    local: LocalProgram | None

    def __repr__(self) -> str:
        sizes = f"N={len(self.plan.inputs)}, {self.cost_by_parameters.size} parameters, {len(self.active)} active"
        return f"PlanSensitivity({sizes}, status={self.status.name}, margin={self.margin:.2g})"

    @property
    def smooth(self) -> bool:
        """Whether the derivatives hold on every side."""
        return self.status is SensitivityStatus.SMOOTH

    @property
    def regular(self) -> bool:
        """Whether the active constraints are independent (LICQ)."""
        return not self.dependent and self.status is not SensitivityStatus.UNSOLVED

    @property
    def input_by_state(self) -> Array:
        """Gain ∂u_0/∂x (nu, nx)."""
        return np.asarray(self.inputs_by_state[0])

    @property
    def input_by_parameters(self) -> Array:
        """Derivative ∂u_0/∂p (nu, np)."""
        return np.asarray(self.inputs_by_parameters[0])

    def along(
        self, dx: ArrayLike | None = None, dp: ArrayLike | None = None, du_prev: ArrayLike | None = None
    ) -> Rates:
        """One-sided rates along dx (nx,), dp (np,) and du_prev (nu,).

        At weakly active constraints they are not linear in the direction: a quadratic program says which of them begin
        to act (Jittorntrum, Mathematical Programming Study 21, 1984). NaN where that has no solution: the way
        leads out, or dependent constraints push otherwise there; or where acting constraints are dependent, or the plan
        is no optimum.
        """
        nx, nu = self.cost_by_state.size, self.plan.inputs.shape[1]
        count, last = self.cost_by_parameters.size, self.inputs_by_last_input.shape[-1]
        parts = [
            np.zeros(n) if value is None else as_array(name, value, (n,))
            for name, value, n in (("dx", dx, nx), ("dp", dp, count), ("du_prev", du_prev, last))
        ]
        theta = np.concatenate(parts)
        rate = None if self.local is None else self.local.rate(theta)
        if self.local is None or rate is None:
            N = len(self.plan.inputs)
            return Rates(np.nan, np.full((N, nu), np.nan), np.full((N + 1, nx), np.nan))
        move = np.concatenate([theta, rate])
        cost = float(self.cost_by_state @ parts[0] + self.cost_by_parameters @ parts[1])
        for label, multiplier in self.active.items():
            if label.kind == "rate" and label.step == 0:
                cost += float(parts[2][label.row % last]) * (-multiplier if label.row < last else multiplier)
        return Rates(cost, self.local.inputs @ move, self.local.states @ move)


def null_directions(rows: Array) -> Array:
    """Orthonormal basis (n, ·) of the null space of rows (m, n)."""
    m, n = rows.shape
    return np.asarray(np.linalg.qr(rows.T, mode="complete")[0][:, m:]) if m else np.eye(n)
