"""Plans by sequential quadratic programs, with substitutes where these fail."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mpc.checks import Array
from mpc.exceptions import NotStabilisableError
from mpc.halfspaces import box_of
from mpc.linear_mpc import LinearMPC
from mpc.optimal_control.condensing import gains_along
from mpc.optimal_control.discrete_model import DiscreteModel
from mpc.optimal_control.sqp import TINY, Sequential, Step
from mpc.plan import Plan, Residuals, Status
from mpc.rollout import Given, admissible, cost_of, deviations, disturbance, finite, relative_violations, violation_of
from mpc.tolerances import COST_DIGITS, FEASIBLE, KKT, MERIT_DECREASE, OPTIMAL, VIOLATION_PRICE

LINEAR_LAW, SHIFTED, REAL_TIME, CONVERGING = "linear law", "shifted plan", "real-time iteration", "SQP"


@dataclass(frozen=True, eq=False)
class _Path:
    """Path of states (N + 1, nx), inputs (N, nu), gains (N, nu, nx)."""

    states: Array
    inputs: Array
    gains: Array
    name: str

    def moved(self, step: Step, part: float = 1.0) -> _Path:
        """Path after a part of a step."""
        return replace(
            self, states=self.states + part * step.states, inputs=self.inputs + part * step.inputs, gains=step.gains
        )


@dataclass(frozen=True, eq=False)
class Planner:
    """Plans for one set of parameters p (np,).

    A sample takes so many `iterations`, quadratic programs, or where that is None as many as it needs, `most` at most;
    none is begun that would probably end later than `time_limit` [s].
    """

    law: LinearMPC
    model: DiscreteModel
    p: Array
    iterations: int | None
    most: int
    time_limit: float

    def __post_init__(self) -> None:
        _ = self.programs, self.gain  # built, and compiled, before a clock runs

    @cached_property
    def programs(self) -> Sequential:
        """Quadratic programs along plans."""
        return Sequential(self.law, self.model)

    @cached_property
    def gain(self) -> Array:
        """Gain (nu, nx) of the linear law."""
        return gain_at_rest(self.law)

    @property
    def _gains(self) -> Array:
        """Gains (N, nu, nx) of the linear law along a plan."""
        return np.tile(self.gain, (self.law.horizon, 1, 1))

    @cached_property
    def _limits(self) -> tuple[Array, Array, Array] | None:
        """Least and largest input and its largest change, if U is a box."""
        box = box_of(*self.law.input_rows)
        rate = np.full(self.law.nu, np.inf) if self.law.rate_limit is None else self.law.rate_limit
        return None if box is None else (*box, rate)

    def plan(self, x: Array, given: Given, before: Plan | None) -> Plan:
        """Plan from a state, begun at another or the linear law's."""
        began = time.perf_counter()
        w = disturbance(self.law, given)
        with np.errstate(over="ignore", invalid="ignore"):
            if before is None:
                first = self._linear_law(x, w, given)
            else:
                first = _Path(before.states, before.inputs, self._gains, SHIFTED)
            found, last, status = self._iterated(x, first, w, given, began, follow=before is not None)
            found = self._followed(x, found, w, given)
            if last is not None and last.relaxed and status in (Status.SOLVED, Status.FOLLOWED):
                over = relative_violations(self.law, found.states).max()
                status = Status.SOFTENED if over > FEASIBLE else status
            if time.perf_counter() - began > self.time_limit:
                status = Status.LATE
            if found.name == REAL_TIME or status not in (Status.SOLVED, Status.SOFTENED):
                best, cost = self._best(x, found, first, w, given)
                if best is not found and status is not Status.LATE:
                    status = Status.REPLACED
                found = best
            else:
                cost = cost_of(self.law, found.inputs, found.states, given)
            residuals = Residuals(np.inf, np.inf, np.inf, np.inf)
            if last is not None and found.name in (REAL_TIME, CONVERGING):
                residuals = Residuals(last.stationarity, last.defects, 0.0, 0.0)
            violation = violation_of(self.law, found.states)
        duration = time.perf_counter() - began
        return Plan(found.inputs, found.states, cost, status, residuals, violation, duration, found.name)

    def shifted(self, plan: Plan, given: Given) -> Plan:
        """Plan one sample later, with the linear law's last input."""
        error, effort = deviations(np.zeros_like(plan.states), np.zeros_like(plan.inputs), given)
        end = plan.states[-1]
        u = self._admissible(-effort[-1] - self.gain @ (end + error[-1]), plan.inputs[-1])
        after = finite(self.model.next(end, u, disturbance(self.law, given)[-1], self.p))
        return replace(plan, inputs=np.vstack([plan.inputs[1:], u]), states=np.vstack([plan.states[1:], after]))

    def _iterated(
        self, x: Array, first: _Path, w: Array, given: Given, began: float, *, follow: bool
    ) -> tuple[_Path, Step | None, Status]:
        """Path by quadratic programs, the last of them, and its status."""
        real_time = follow and self.iterations is not None
        at = replace(first, name=CONVERGING if self.iterations is None else REAL_TIME)
        hard = self.law.soft is None and len(self.law.state_rows[1]) + len(self.law.terminal_rows[1]) > 0
        dear = VIOLATION_PRICE * max(cost_of(self.law, at.inputs, at.states, given), TINY) if hard else 0.0
        last: Step | None = None
        status = Status.FOLLOWED if real_time else Status.INACCURATE
        relaxed = False
        gap_price = limit_price = 0.0
        longest, now = 0.0, time.perf_counter()
        costates: Array | None = None
        for count in range(self.iterations or 1 if real_time else self.most):
            if last is not None and now - began + longest > self.time_limit:
                return at, last, Status.LATE
            step = self.programs.step(
                x, at.states, at.inputs, w, self.p, given, dear, relaxed=relaxed,
                costates=costates if count >= 6 else None,  # then the curvature of the model counts
            )  # fmt: skip
            if not (step.solved and np.isfinite(step.inputs).all() and np.isfinite(step.states).all()):
                return (first, None, Status.REPLACED) if last is None else (at, last, Status.INACCURATE)
            last = step
            if not real_time:
                if max(step.defects, step.stationarity) <= KKT:
                    break
                relaxed = step.relaxed  # from now on all violations have their price: one problem to converge on
                of_gap, of_limit, costates = self.programs.prices(step, at.states, at.inputs, given)
                gap_price, limit_price = max(gap_price, of_gap), max(limit_price, of_limit)
                charged = (dear, dear) if relaxed else (limit_price, 0.0)
                then = self._after(step, x, at, w, given, gap_price, charged)
                if then is None:
                    break
                at = then
            else:
                at = at.moved(step)
            longest, now = max(longest, time.perf_counter() - now), time.perf_counter()
        assert last is not None
        if max(last.defects, last.stationarity) <= OPTIMAL:
            status = Status.SOLVED
        return at, last, status

    def _after(self, step: Step, x: Array, at: _Path, w: Array, given: Given, gap_price: float,
               charged: tuple[float, float]) -> _Path | None:  # fmt: skip
        """Path after a step that lowers the merit, or None."""

        def merit(path: _Path) -> float:
            return self.programs.merit(x, path.states, path.inputs, w, self.p, given, gap_price, charged)

        now = merit(at)
        promised = now - self.programs.priced_cost(at.states + step.states, at.inputs + step.inputs, given, charged)
        for part in 0.5 ** np.arange(11):
            enough = now - MERIT_DECREASE * part * max(promised, 0.0) + COST_DIGITS * abs(now)
            planned = at.moved(step, part)
            if merit(planned) <= enough:  # not so of what is no number
                return planned
            followed = self._followed(x, planned, w, given)
            if merit(followed) <= enough:
                return followed
        return None

    def _linear_law(self, x: Array, w: Array, given: Given) -> _Path:
        """Path of the model under the linear law."""
        states, inputs = np.zeros((self.law.horizon + 1, self.law.nx)), np.zeros((self.law.horizon, self.law.nu))
        error, effort = deviations(states, inputs, given)
        return self._followed(x, _Path(-error, -effort, self._gains, LINEAR_LAW), w, given)

    def _followed(self, x: Array, path: _Path, w: Array, given: Given) -> _Path:
        """Path on the model itself from x, within input limits; finite."""
        N = self.law.horizon
        last = given.get("u_prev", np.zeros(self.law.nu))
        if self._limits is not None:
            states, inputs = self.model.followed(x, last, path.states, path.inputs, path.gains, self._limits, w, self.p)
        else:
            states, inputs = np.empty((N + 1, self.law.nx)), np.empty((N, self.law.nu))
            states[0] = x
            for k in range(N):
                wanted = path.inputs[k] - path.gains[k] @ (states[k] - path.states[k])
                inputs[k] = self._admissible(wanted, inputs[k - 1] if k else last)
                states[k + 1] = finite(self.model.next(states[k], inputs[k], w[k], self.p))
        return replace(path, states=finite(states), inputs=finite(inputs))

    def _admissible(self, wanted: Array, last: Array) -> Array:
        """Admissible input nearest to `wanted`, after `last`."""
        if self._limits is None:
            return np.asarray(admissible(self.law, wanted[None], {"u_prev": last})[0])
        low, high, rate = self._limits
        return np.clip(np.clip(wanted, low, high), last - rate, last + rate)

    def _best(self, x: Array, found: _Path, first: _Path, w: Array, given: Given) -> tuple[_Path, float]:
        """Cheapest of found path, start and linear law, and its cost.

        A real-time iteration is replaced only by one that costs far less: it may pay now for what comes.
        """
        paths = [found, first if first.name == LINEAR_LAW else self._followed(x, first, w, given)]
        if found.name != REAL_TIME:  # far from rest the gains at rest may do harm
            paths.append(self._followed(x, replace(first, gains=np.zeros_like(first.gains)), w, given))
        worth = [self._worth(path, given) for path in paths]
        if first.name != LINEAR_LAW and not np.isfinite(worth[1]).all():
            paths.append(self._linear_law(x, w, given))
            worth.append(self._worth(paths[-1], given))
        price = VIOLATION_PRICE * max((cost for cost, _ in worth[1:] if np.isfinite(cost)), default=1.0)
        total = [cost + price * over if np.isfinite([cost, over]).all() else np.inf for cost, over in worth]
        total[0] /= 2.0 if found.name == REAL_TIME else 1.0
        best = int(np.argmin(total))
        return paths[best], worth[best][0]

    def _worth(self, path: _Path, given: Given) -> tuple[float, float]:
        """Cost of a path and the sum of its hard violations."""
        cost = cost_of(self.law, path.inputs, path.states, given)
        if self.law.soft is not None:
            return cost, 0.0
        return cost, float(relative_violations(self.law, path.states, self.law.price_units).sum())


def gain_at_rest(law: LinearMPC) -> Array:
    """Gain (nu, nx) of the regulator, else of the horizon's first step.

    Vehicles that cannot move sideways are such: at rest their linearisation cannot be stabilised.
    """
    try:
        return law.gain
    except NotStabilisableError:
        A, B = (np.tile(matrix, (law.horizon, 1, 1)) for matrix in (law.A, law.B))
        weights = (np.array(weight, order="C") for weight in (law.Q, law.R, law.cross, law.P))
        gains, _ = gains_along(A, B, *weights)
        return np.asarray(gains[0])
