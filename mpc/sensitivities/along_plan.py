"""The derivatives of a plan: Newton steps to the optimum itself, then those of its optimality conditions."""

from __future__ import annotations

import numpy as np

from mpc.plan import Plan, Status
from mpc.problem import MPCProblem
from mpc.rollout import Given
from mpc.sensitivities.changes import Changes
from mpc.sensitivities.conditions import Conditions, PlanModel, Point
from mpc.sensitivities.idle_rows import IdleRows
from mpc.sensitivities.linearised import Linearised
from mpc.sensitivities.newton_step import NewtonStep
from mpc.sensitivities.plan_sensitivity import LocalProgram, PlanSensitivity, SensitivityStatus
from mpc.tolerances import ACTIVE, NEAR_OPTIMUM, NEWTON, WEAKLY_ACTIVE

STEPS = 8  # of Newton's method at most


def sensitivity_of(
    problem: MPCProblem, model: PlanModel, changes: Changes, plan: Plan, given: Given
) -> PlanSensitivity:
    """Derivatives of a plan of `problem`, whose dynamics are those of `model`, under the signals `given`."""
    conditions = Conditions(problem, model, changes, given)
    if plan.status is not Status.SOLVED:
        return conditions.none(plan, SensitivityStatus.UNSOLVED)
    with np.errstate(over="ignore", invalid="ignore"):
        point = Point.of(problem, plan)
        point = Linearised(conditions, point).with_multipliers(point)
        last = NEAR_OPTIMUM
        for _ in range(STEPS):
            step = NewtonStep.of(Linearised(conditions, point), point)
            if step is None:
                return conditions.none(plan, SensitivityStatus.SINGULAR)
            size = step.size
            # rounding ends it sooner where the problem is badly conditioned
            if size <= NEWTON or (last <= ACTIVE and not size <= last):
                return _at_optimum(plan, step)
            if not size <= last:
                break
            last = size
            point = step.after()
    return conditions.none(plan, SensitivityStatus.UNSOLVED)


def _at_optimum(plan: Plan, step: NewtonStep) -> PlanSensitivity:
    """The derivatives at an optimum, from the step that no longer moves it."""
    linear, point = step.linear, step.point
    at, nt = linear.conditions.columns, linear.conditions.nt
    rates = step.moves[:, :nt]
    n = at["z"].stop - at["z"].start
    U, X = (form[:, :, :nt] + form[:, :, at["z"]] @ rates[:n] for form in (linear.U, linear.X))
    cost = linear.gradient[:nt] + linear.multipliers @ linear.rows[:, :nt]
    by_parameters = cost[at["p"]] + linear.cost_of_parameters
    idle = IdleRows.of(linear, point, rates)
    status = SensitivityStatus.SMOOTH
    if idle.weak.any():
        status = SensitivityStatus.ONE_SIDED
    parting = idle.dependent & ~idle.together
    if parting.any():
        status = SensitivityStatus.DEPENDENT
    pushing = np.flatnonzero(linear.worth(linear.multipliers) > WEAKLY_ACTIVE)
    keep = np.r_[0:nt, at["z"].start : linear.width]
    inputs, states = (
        np.concatenate([form[:, :, np.r_[0:nt, at["z"]]], np.zeros((*form.shape[:2], len(point.slacks)))], axis=2)
        for form in (linear.U, linear.X)
    )
    held, weak = (linear.rows[rows][:, keep] for rows in (point.acting, idle.weak))
    local = None if (parting & ~idle.weak).any() else LocalProgram(linear.H, linear.F, held, weak, inputs, states)
    return PlanSensitivity(
        plan=plan, status=status, cost_by_state=cost[at["x"]], cost_by_parameters=by_parameters,
        inputs_by_state=U[:, :, at["x"]], inputs_by_parameters=U[:, :, at["p"]],
        states_by_state=X[:, :, at["x"]], states_by_parameters=X[:, :, at["p"]],
        inputs_by_last_input=U[:, :, at["u_prev"]],
        active={linear.labels[i]: float(linear.multipliers[i]) for i in pushing},
        weakly_active=tuple(linear.labels[i] for i in np.flatnonzero(idle.weak)),
        dependent=tuple(linear.labels[i] for i in np.flatnonzero(idle.dependent)),
        margin=idle.margin(linear, point), local=local,
    )  # fmt: skip
