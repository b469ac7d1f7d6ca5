"""Derivatives of a plan from its optimality conditions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from mpc.checks import Array, Flags
from mpc.plan import Plan, Status
from mpc.problem import MPCProblem
from mpc.rollout import Given, relative_violations
from mpc.sensitivities.changes import Changes, PlanModel
from mpc.sensitivities.linearised import Conditions, Linearised, Point
from mpc.sensitivities.plan_sensitivity import LocalProgram, PlanSensitivity, SensitivityStatus, null_directions
from mpc.tolerances import KKT, KKT_REPORTED, NEAR_OPTIMUM, PRIMAL, ROUNDED_SUM


def sensitivity_of(
    problem: MPCProblem, model: PlanModel, changes: Changes, plan: Plan, given: Given
) -> PlanSensitivity:
    """Derivatives of a plan of `problem` with the dynamics of `model`."""
    conditions = Conditions(problem, model, changes, given)
    if plan.status is not Status.SOLVED:
        return conditions.none(plan, SensitivityStatus.UNSOLVED)
    with np.errstate(over="ignore", invalid="ignore"):
        soft = problem.soft is not None
        slacks = relative_violations(problem, plan.states, problem.price_units) if soft else np.zeros(0)
        first = Point(np.array(plan.inputs), np.array(plan.states), slacks, None, np.zeros(0, dtype=bool))
        point = Linearised(conditions, first).with_multipliers()
        last = NEAR_OPTIMUM
        for _ in range(8):
            step = NewtonStep.at(Linearised(conditions, point))
            if step is None:
                return conditions.none(plan, SensitivityStatus.SINGULAR)
            size = step.size
            # rounding ends it sooner where the problem is badly conditioned
            if size <= PRIMAL or (last <= KKT_REPORTED and not size <= last):
                return _at_optimum(plan, step)
            if not size <= last:
                break
            after = step.after()
            last = size if (after.acting == point.acting).all() else NEAR_OPTIMUM  # other rows, other steps
            point = after
    return conditions.none(plan, SensitivityStatus.UNSOLVED)


def _at_optimum(plan: Plan, step: NewtonStep) -> PlanSensitivity:
    """Derivatives at an optimum, from the last step."""
    linear = step.linear
    at, nt = linear.conditions.columns, linear.conditions.nt
    rates = step.moves[:, :nt]
    U, X = (form[:, :, :nt] + form[:, :, linear.free] @ rates for form in (linear.U, linear.X))
    cost = linear.gradient[:nt] + linear.multipliers @ linear.rows[:, :nt]
    by_parameters = cost[at["p"]] + linear.cost_of_parameters
    idle = IdleRows.at(linear, rates)
    status = SensitivityStatus.SMOOTH
    if idle.weak.any():
        status = SensitivityStatus.ONE_SIDED
    parting = idle.dependent & ~idle.together
    if parting.any():
        status = SensitivityStatus.DEPENDENT
    pushing = np.flatnonzero(linear.worth(linear.multipliers) > KKT_REPORTED)
    keep = np.r_[0:nt, linear.free]
    inputs, states = (form[:, :, keep] for form in (linear.U, linear.X))
    held, weak = (linear.rows[rows][:, keep] for rows in (linear.point.acting, idle.weak))
    local = None if (parting & ~idle.weak).any() else LocalProgram(linear.H, linear.F, held, weak, inputs, states)
    return PlanSensitivity(
        plan=plan, status=status, cost_by_state=cost[at["x"]], cost_by_parameters=by_parameters,
        inputs_by_state=U[:, :, at["x"]], inputs_by_parameters=U[:, :, at["p"]],
        states_by_state=X[:, :, at["x"]], states_by_parameters=X[:, :, at["p"]],
        inputs_by_last_input=U[:, :, at["u_prev"]],
        active={linear.labels[i]: float(linear.multipliers[i]) for i in pushing},
        weakly_active=tuple(linear.labels[i] for i in np.flatnonzero(idle.weak)),
        dependent=tuple(linear.labels[i] for i in np.flatnonzero(idle.dependent)),
        margin=idle.margin(linear), local=local,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class IdleRows:
    """Rows (m,) that are met but do not push.

    Weak rows that only depend on each other are both: a direction has rates where its quadratic program has a solution
    (Ralph and Dempe, Mathematical Programming 70, 1995).
    """

    weak: Flags
    dependent: Flags
    together: Flags

    @classmethod
    def at(cls, linear: Linearised, rates: Array) -> IdleRows:
        """Idle rows at an optimum with rates (n, nt)."""
        met = linear.on_bound & linear.own & ~linear.point.acting & ~linear.idle_slacks
        acting = linear.rows[linear.point.acting][:, linear.free] * linear.scale
        basis = np.linalg.qr(acting.T)[0] if len(acting) else np.zeros((len(linear.scale), 0))
        rows = linear.rows[:, linear.free] * linear.scale
        length = np.linalg.norm(rows, axis=1)
        left = rows - rows @ basis @ basis.T
        size = np.linalg.norm(left, axis=1)
        alone = met & (size <= PRIMAL * length)
        together = np.zeros_like(met)
        for i in np.flatnonzero(alone):
            together[i] = _moves_along(linear, rates, {int(i): 1.0})
        apart = met & ~alone
        dependent = alone.copy()
        while (found := _vanishing_sum(left / np.where(size > 0, size, 1.0)[:, None], apart)) is not None:
            members = np.array(list(found))
            along = _moves_along(linear, rates, {i: part / size[i] for i, part in found.items()})
            members = members[:1] if along else members
            dependent[members] = True
            together[members] = along
            apart[members] = False
        return cls(met & ~alone, dependent, together)

    def margin(self, linear: Linearised) -> float:
        """Distance of the nearest row from beginning or ceasing to act [-]."""
        idle = self.weak | self.dependent
        acting = linear.point.acting
        worth = linear.worth(linear.multipliers)
        pushing = worth > KKT_REPORTED
        room = np.where(pushing, worth, -linear.values / linear.units)
        counts = pushing | (linear.own & ~(acting | idle))
        counts &= np.array([label.kind != "slack" for label in linear.labels], dtype=bool) | pushing | ~linear.on_bound
        if (idle & ~acting).any() and not counts.any():
            return 0.0
        return float(np.maximum(room[counts], 0.0).min(initial=np.inf))


def _vanishing_sum(unit: Array, weak: Flags) -> dict[int, float] | None:
    """Positive combination of weak rows that vanishes, or None.

    Where there is one the multipliers are not unique (Kyparisis, Mathematical Programming 32, 1985).
    """
    rows = np.flatnonzero(weak)
    if not len(rows):
        return None
    both = np.vstack([unit[rows].T, np.ones(len(rows))])
    parts, missed = nnls(both, np.append(np.zeros(len(both) - 1), 1.0), maxiter=30 * len(both))
    return {int(i): float(part) for i, part in zip(rows, parts) if part > 0} if missed <= PRIMAL else None


def _moves_along(linear: Linearised, rates: Array, parts: dict[int, float]) -> bool:
    """Whether a sum of rows stays on its bound under rates (n, nt)."""
    nt = linear.conditions.nt
    terms = [part * np.vstack([linear.rows[i, :nt], linear.rows[i, linear.free][:, None] * rates])
             for i, part in parts.items()]  # fmt: skip
    terms_of_all = np.concatenate(terms)
    return bool((np.abs(terms_of_all.sum(axis=0)) <= KKT * np.abs(terms_of_all).sum(axis=0)).all())


@dataclass(frozen=True, eq=False)
class NewtonStep:
    """Moves by θ = (x, p, u_prev) and, last, to the optimum."""

    linear: Linearised  # the conditions that it is a step on
    moves: Array  # (n, nt + 1): of the free inputs and slacks
    pushes: Array  # (number of acting rows, nt + 1): of their multipliers

    @classmethod
    def at(cls, linear: Linearised) -> NewtonStep | None:
        """Newton step at a point; None at saddles or dependent acting rows."""
        at, nt = linear.conditions.columns, linear.conditions.nt
        acting = np.flatnonzero(linear.point.acting)
        d = linear.scale
        rows = linear.rows[acting]
        G = rows[:, linear.free] * d
        length = np.linalg.norm(G, axis=1)
        length[length == 0] = 1.0
        G = G / length[:, None]
        H = linear.H * d * d[:, None]
        residual = linear.gradient[linear.free] + linear.multipliers @ linear.rows[:, linear.free] + linear.F_gap
        right = -np.column_stack([linear.F, residual]) * d[:, None]
        missed = rows[:, at["gap"]].ravel() + linear.values[acting]
        at_rows = -np.column_stack([rows[:, :nt], missed]) / length[:, None]
        if len(G) and (len(G) > len(d) or np.linalg.svd(G, compute_uv=False)[-1] <= PRIMAL):
            return None
        first = np.linalg.lstsq(G, at_rows, rcond=None)[0] if len(G) else np.zeros_like(right)
        Z = null_directions(G)
        if Z.shape[1]:
            reduced = Z.T @ H @ Z
            reduced = (reduced + reduced.T) / 2
            if not np.isfinite(reduced).all() or np.linalg.eigvalsh(reduced)[0] < ROUNDED_SUM:
                return None
            first = first + Z @ np.linalg.solve(reduced, Z.T @ (right - H @ first))
        pushes = np.linalg.lstsq(G.T, right - H @ first, rcond=None)[0] if len(G) else np.zeros((0, nt + 1))
        return cls(linear, first * d[:, None], pushes / length[:, None])

    @property
    def size(self) -> float:
        """Length of the step in sizes of inputs, states and slacks [-]."""
        linear = self.linear
        problem = linear.conditions.problem
        inputs, states = self._of_plan
        extent = np.where(problem.input_extent > 0, problem.input_extent, np.abs(inputs).max(initial=0.0))
        own = np.maximum(np.abs(linear.U[:, :, linear.conditions.columns["value"]]).max(axis=(0, 2)), extent)
        size = float(np.abs(inputs / np.where(own > 0, own, 1.0)).max(initial=0.0))
        size = max(size, float(np.abs(states / problem.state_extent).max()), np.abs(self._of_slacks).max(initial=0.0))
        return size if np.isfinite(size) else np.inf

    @property
    def _of_plan(self) -> tuple[Array, Array]:
        """Moves of inputs and states to the optimum."""
        linear, gap = self.linear, self.linear.conditions.columns["gap"]
        move = self.moves[:, -1]
        inputs, states = (form[:, :, linear.free] @ move + form[:, :, gap][:, :, 0] for form in (linear.U, linear.X))
        return inputs, states

    @property
    def _of_slacks(self) -> Array:
        """Moves of the slacks to the optimum."""
        at = self.linear.conditions.columns
        return self.moves[at["z"].stop - at["z"].start :, -1]

    def after(self) -> Point:
        """Point after the step, with its rows that act."""
        linear, point = self.linear, self.linear.point
        inputs, states = self._of_plan
        multipliers = np.zeros(len(linear.rows))
        multipliers[point.acting] = linear.multipliers[point.acting] + self.pushes[:, -1]
        at = linear.conditions.columns
        move = self.moves[:, -1]
        values = linear.values + linear.rows[:, at["gap"]].ravel() + linear.rows[:, linear.free] @ move
        # by more than it takes to act on: a row that is passed by as much as that would enter and leave for ever
        passed = (values > 2 * KKT_REPORTED * linear.units) & ~point.acting & linear.own
        acting = linear.acting(multipliers)
        enter(linear.rows[:, linear.free] * linear.scale, multipliers, acting, passed)
        slacks = point.slacks + self._of_slacks
        return Point(point.inputs + inputs, point.states + states, slacks, np.where(acting, multipliers, 0.0), acting)


def enter(rows: Array, multipliers: Array, acting: Flags, passed: Flags) -> None:
    """Let passed rows act, in place, exchanged for acting rows they depend on.

    That is the ratio test of the dual simplex method (Lemke, Naval Research Logistics Quarterly 1, 1954): the slope
    stays balanced, the multipliers stay >= 0 and the acting rows independent.
    """
    for i in np.flatnonzero(passed):
        kept = np.flatnonzero(acting)
        parts = np.linalg.lstsq(rows[kept].T, rows[i], rcond=None)[0]
        length = PRIMAL * np.linalg.norm(rows[i])
        if np.linalg.norm(rows[i] - parts @ rows[kept]) <= length:
            giving = parts * np.linalg.norm(rows[kept], axis=1) > length
            shares = multipliers[kept[giving]] / parts[giving]
            if not len(shares):  # the rows contradict each other
                continue
            multipliers[kept] -= shares.min() * parts
            multipliers[i] = shares.min()
            acting[kept[giving][shares.argmin()]] = False
        acting[i] = True
