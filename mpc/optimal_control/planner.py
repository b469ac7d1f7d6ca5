"""Plans by quadratic programs near an optimum, by an interior-point solver far from it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from mpc.budgets import ASIDE, PROGRAMS_TO_GO
from mpc.checks import Array
from mpc.exceptions import NotStabilisableError
from mpc.halfspaces import box_of
from mpc.linear_mpc import LinearMPC
from mpc.optimal_control.condensing import gains_along
from mpc.optimal_control.discrete_model import DiscreteModel
from mpc.optimal_control.loop_planner import LoopPlanner
from mpc.optimal_control.quadratic_phase import quadratic_columns, quadratic_parameters
from mpc.optimal_control.sqp import TINY, Sequential, Step, rounding_of_cost
from mpc.plan import Plan, Residuals, Status
from mpc.rollout import (
    Given,
    admissible,
    cost_of,
    deviations,
    disturbance,
    finite,
    for_each_state,
    relative_violations,
    spread_signals,
    violation_of,
)
from mpc.tolerances import COST_ROUNDING, FEASIBLE, KKT, OPTIMAL, VIOLATION_PRICE

LINEAR_LAW, SHIFTED, REAL_TIME = "linear law", "shifted plan", "real-time iteration"
CONVERGING, INTERIOR = "SQP", "Ipopt"


@dataclass(frozen=True, eq=False)
class _Path:
    """Path of states (N + 1, nx), inputs (N, nu), gains (N, nu, nx)."""

    states: Array
    inputs: Array
    gains: Array
    name: str

    def moved(self, step: Step) -> _Path:
        """Path after a step."""
        return replace(self, states=self.states + step.states, inputs=self.inputs + step.inputs, gains=step.gains)


@dataclass
class _Clock:
    """Time that is left of a sample, and what its longest program took."""

    limit: float
    began: float = field(default_factory=time.perf_counter)
    longest: float = 0.0
    last: float = field(default_factory=time.perf_counter)

    def program_ended(self) -> None:
        """Note how long a program took."""
        now = time.perf_counter()
        self.longest, self.last = max(self.longest, now - self.last), now

    @property
    def passed(self) -> float:
        """Since the sample began [s]."""
        return time.perf_counter() - self.began

    @property
    def up(self) -> bool:
        """Whether one more program would probably end too late."""
        return self.passed + self.longest > self.limit


@dataclass(frozen=True, eq=False)
class _Sample:
    """Statement of one sample: state, signals, price of what cannot be kept."""

    x: Array
    w: Array
    given: Given
    size: float  # of the cost
    dear: float
    clock: _Clock


@dataclass(frozen=True, eq=False)
class Planner:
    """Plans for one set of parameters p (np,).

    A sample takes so many `iterations`, quadratic programs, or where that is None as many as it needs. A first one
    begins at so many `starts`. No program is begun that would probably end later than `time_limit` [s].
    """

    law: LinearMPC
    model: DiscreteModel
    p: Array
    iterations: int | None
    most: int
    starts: int
    time_limit: float

    def __post_init__(self) -> None:
        _ = self.programs, self.gain  # built, and compiled, before a clock runs
        if np.isfinite(self.time_limit):
            _ = self.general

    @cached_property
    def general(self) -> LoopPlanner:
        """Planner of the same statement as a phase."""
        p = quadratic_parameters(self.law, self.p, self.law.soft or (1.0, 1.0))
        return LoopPlanner(self.model.loop(self.law, self.p), p, self.most, 1, self.time_limit)

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

    @property
    def _hard(self) -> bool:
        """Whether states have limits that must be kept."""
        return self.law.soft is None and len(self.law.state_rows[1]) + len(self.law.terminal_rows[1]) > 0

    def signals(self, stated: dict[str, Any]) -> Given:
        """Signals of a sample, checked."""
        return spread_signals(self.law, stated)

    def each(self, stated: dict[str, Any], n: int) -> list[Given]:
        """Signals of n states, common or one entry for each."""
        return for_each_state(self.law, stated, n)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "general"}

    def plan(self, x: Array, given: Given, before: Plan | None) -> Plan:
        """Plan from a state, begun at another or where it is best."""
        clock = _Clock(self.time_limit)
        w = disturbance(self.law, given)
        with np.errstate(over="ignore", invalid="ignore"):
            if before is None:
                first = self._linear_law(x, w, given)
                held = _held(first, given)
            else:
                first = held = _Path(before.states, before.inputs, self._gains, SHIFTED)
            size = max(min(cost_of(self.law, path.inputs, path.states, given) for path in (first, held)), TINY)
            sample = _Sample(x, w, given, size, VIOLATION_PRICE * size if self._hard else 0.0, clock)
            found, last, status = self._planned(sample, first)
            found = self._followed(x, found, w, given)
            if last is not None and last.relaxed and status in (Status.SOLVED, Status.FOLLOWED):
                over = relative_violations(self.law, found.states).max()
                status = Status.SOFTENED if over > FEASIBLE else status
            if clock.passed > self.time_limit:
                status = Status.LATE
            if found.name == REAL_TIME or status not in (Status.SOLVED, Status.SOFTENED):
                best, cost = self._best(x, found, first, w, given)
                if best is not found and status is not Status.LATE:
                    status = Status.REPLACED
                found = best
            else:
                cost = cost_of(self.law, found.inputs, found.states, given)
            residuals = Residuals(np.inf, np.inf, np.inf, np.inf)
            if last is not None and found.name not in (LINEAR_LAW, SHIFTED):
                residuals = Residuals(last.stationarity, last.defects, 0.0, 0.0)
            violation = violation_of(self.law, found.states)
        return Plan(found.inputs, found.states, cost, status, residuals, violation, clock.passed, found.name)

    def shifted(self, plan: Plan, given: Given) -> Plan:
        """Plan one sample later, with the linear law's last input."""
        error, effort = deviations(np.zeros_like(plan.states), np.zeros_like(plan.inputs), given)
        end = plan.states[-1]
        u = self._admissible(-effort[-1] - self.gain @ (end + error[-1]), plan.inputs[-1])
        after = finite(self.model.next(end, u, disturbance(self.law, given)[-1], self.p))
        return replace(plan, inputs=np.vstack([plan.inputs[1:], u]), states=np.vstack([plan.states[1:], after]))

    def _planned(self, sample: _Sample, first: _Path) -> tuple[_Path, Step | None, Status]:
        """Path, the last quadratic program of it, and its status."""
        follow = first.name == SHIFTED
        if follow and self.iterations is not None:
            return self._real_time(sample, first, self.iterations)
        at, last = self._contracted(sample, replace(first, name=CONVERGING))
        if sample.clock.up:
            return (first, None, Status.LATE) if last is None else (at, last, _status(last, Status.LATE))
        stayed = at.inputs is first.inputs
        enough = not self._law_does_better(sample, at) if follow else stayed
        if stayed and sample.size > TINY:  # it may be a saddle, to which no plan beside it comes back
            at, last = self._contracted(sample, self._aside(at))
        if _status(last) is Status.SOLVED and enough:
            return at, last, Status.SOLVED
        candidates = [*([] if last is None else [(at, last)]), *self._from_starts(sample, first)]
        if not candidates:
            return first, None, Status.REPLACED
        at, last = min(candidates, key=lambda one: self._rank(sample, *one))
        return at, last, _status(last)

    def _rank(self, sample: _Sample, at: _Path, last: Step) -> tuple[bool, float]:
        """Rank of a path: optima first, then by what it costs when it is followed."""
        followed = self._followed(sample.x, at, sample.w, sample.given)
        return _status(last) is not Status.SOLVED, self._total(sample, followed)

    def _real_time(self, sample: _Sample, first: _Path, iterations: int) -> tuple[_Path, Step | None, Status]:
        """Path after so many quadratic programs, the last of them, and its status."""
        at, last = replace(first, name=REAL_TIME), None
        for _ in range(iterations):
            if last is not None and sample.clock.up:
                return at, last, _status(last, Status.LATE)
            step = self._program(sample, at, relaxed=last is not None and last.relaxed)
            if step is None:
                return (first, None, Status.REPLACED) if last is None else (at, last, _status(last))
            at, last = at.moved(step), step
        return at, last, _status(last, Status.FOLLOWED)

    def _contracted(self, sample: _Sample, at: _Path) -> tuple[_Path, Step | None]:
        """Best path by quadratic programs with full steps, and the program there.

        They end at the optimum, or where so many more are to be expected that another solver will be sooner there.
        """
        best: tuple[_Path, Step | None] = at, None
        before: float | None = None
        while best[1] is None or not sample.clock.up:
            step = self._program(sample, at, relaxed=best[1] is not None and best[1].relaxed)
            if step is None:
                break
            left = _error(step)
            if best[1] is None or left < _error(best[1]):
                best = replace(at, gains=step.gains), step
            if left <= KKT or (before is not None and not _soon(left, before)):
                break
            at, before = at.moved(step), left
        return best

    def _program(self, sample: _Sample, at: _Path, *, relaxed: bool) -> Step | None:
        """Quadratic program at a path, if it has a solution."""
        step = self.programs.step(
            sample.x, at.states, at.inputs, sample.w, self.p, sample.given, sample.dear, relaxed=relaxed
        )
        sample.clock.program_ended()
        finite_step = step.solved and np.isfinite(step.inputs).all() and np.isfinite(step.states).all()
        return step if finite_step else None

    def _from_starts(self, sample: _Sample, first: _Path) -> Iterator[tuple[_Path, Step]]:
        """Paths that Ipopt comes to from the starts, with the quadratic program there; one where a plan leads to it."""
        dear = quadratic_parameters(self.law, self.p, (sample.dear, sample.dear))
        for path in self._starting_paths(sample, first):
            if sample.clock.up:
                return
            more = quadratic_columns(self.law, sample.x, path.states, self._aside(path).inputs, sample.given)
            general = self.general if self.law.soft is not None else replace(self.general, p=dear)
            shot = general.near(*more, sample.size)
            sample.clock.program_ended()
            if shot is None:
                continue
            states, inputs = shot[0][:, : self.law.nx].copy(), shot[1][:, : self.law.nu].copy()
            at, last = self._contracted(sample, replace(path, states=states, inputs=inputs, name=INTERIOR))
            if last is not None:
                yield at, last
            if path is first and first.name == SHIFTED and _status(last) is Status.SOLVED:
                return

    def _starting_paths(self, sample: _Sample, first: _Path) -> Iterator[_Path]:
        """Plan to follow; linear law; state held; straight way to the reference; inputs by chance."""
        if first.name == SHIFTED:
            yield first
        law = self._linear_law(sample.x, sample.w, sample.given) if first.name == SHIFTED else first
        yield law
        held = _held(law, sample.given)
        N, rng = self.law.horizon, np.random.default_rng(0)
        for number in range(1, self.starts):
            if number == 1:
                yield held
            elif number == 2:
                error, _ = deviations(np.zeros_like(held.states), held.inputs, sample.given)
                way = np.linspace(0, 1, N + 1)[:, None]
                yield replace(held, states=(1 - way) * held.states - way * error)
            else:
                pieces = rng.uniform(-1, 1, (1 + N // 5, self.law.nu)) * self.programs.input_size
                by_chance = replace(held, inputs=held.inputs + np.repeat(pieces, 5, axis=0)[:N], gains=0 * held.gains)
                yield self._followed(sample.x, by_chance, sample.w, sample.given)

    def _aside(self, path: _Path) -> _Path:
        """Path with inputs that break its symmetries, the same every time."""
        moves = np.random.default_rng(0).uniform(-ASIDE, ASIDE, path.inputs.shape)
        return replace(path, inputs=path.inputs + moves * self.programs.input_size)

    def _law_does_better(self, sample: _Sample, at: _Path) -> bool:
        """Whether the linear law, simulated, costs less than a plan."""
        law = self._total(sample, self._linear_law(sample.x, sample.w, sample.given))
        own = self._total(sample, at)
        return law < own - COST_ROUNDING * abs(own) - rounding_of_cost(self.law, sample.given)

    def _total(self, sample: _Sample, path: _Path) -> float:
        """Cost with violations at their price; infinite where it is no number."""
        cost, over = self._worth(path, sample.given)
        total = cost + sample.dear * over
        return total if np.isfinite(total) else np.inf

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
        over = relative_violations(self.law, path.states, self.law.price_units)
        return cost, float(over[over > FEASIBLE].sum())


def _held(path: _Path, given: Given) -> _Path:
    """Path that stays where another begins, inputs at their reference."""
    _, effort = deviations(path.states, np.zeros_like(path.inputs), given)
    return replace(path, states=np.tile(path.states[0], (len(path.states), 1)), inputs=-effort)


def _error(step: Step) -> float:
    """Larger of gaps and stationarity."""
    return max(step.defects, step.stationarity)


def _status(step: Step | None, otherwise: Status = Status.INACCURATE) -> Status:
    """SOLVED where the optimality conditions hold."""
    return Status.SOLVED if step is not None and _error(step) <= OPTIMAL else otherwise


def _soon(left: float, before: float) -> bool:
    """Whether errors that fall at this rate will be gone soon."""
    return left < before and np.log(KKT / left) / np.log(left / before) <= PROGRAMS_TO_GO


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
