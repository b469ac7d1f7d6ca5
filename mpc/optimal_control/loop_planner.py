"""Plans of a phase from sample to sample, each confirmed by the program's own conditions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice
from typing import Any

import numpy as np

from ccdtools_ground.door import as_number
from mpc.checks import Array, as_array, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.discrete_model import DiscreteModel
from mpc.optimal_control.functions import compiled
from mpc.optimal_control.interval import first_guess
from mpc.optimal_control.ipopt import Settings, once, solver_of
from mpc.optimal_control.local_statement import Local
from mpc.optimal_control.loop_phase import LoopPhase
from mpc.optimal_control.loop_results import RANKS, Tried, better
from mpc.optimal_control.paths import CONVERGING, Path, contracted, programs, while_newton
from mpc.optimal_control.phase_stages import PhaseStages
from mpc.optimal_control.planning import (
    SHIFTED,
    Clock,
    Trajectory,
    aside,
    beginnings,
    shifted,
    told_of_inputs,
    until_most_agree,
)
from mpc.optimal_control.program import NonlinearProgram, rescaled
from mpc.optimal_control.solving import LATE, Run, as_settings
from mpc.optimal_control.sqp import Step, carried, next_step
from mpc.plan import Plan, Residuals, Status
from mpc.rollout import Given, finite, no_faster
from mpc.tolerances import (
    BOTTOMLESS,
    COST_ROUNDING,
    FEASIBLE,
    KKT,
    NEGLIGIBLE,
    SOLVERS,
    VIOLATION_PRICE as PRICE,
    WELL_SIZED,
)

ASKED = {"u_prev": "the input applied a sample ago (nu,)", "t": "the time at which the sample is taken"}


@dataclass(frozen=True, eq=False)
class LoopPlanner:
    """Plans of a phase for parameters p (np,), by Ipopt.

    They begin at the plan before, or at so many `starts`. Where hard limits of states cannot be kept, their violations
    get a price, and the plan is SOFTENED.
    """

    loop: LoopPhase
    p: Array
    most: int
    starts: int
    time_limit: float

    def built(self, *settings: Settings) -> LoopPlanner:
        """Itself, with the solvers of settings made before a clock runs."""
        for own in settings:
            solver_of(self.loop.program, own)
        return self

    def with_parameters(self, p: Array) -> LoopPlanner:
        """Planner for other parameters, nothing of which is built anew."""
        other = replace(self, p=p)
        other.__dict__.update(model=self.model, stages=self.stages, _guess=self._guess)
        return other

    @property
    def settings(self) -> Settings:
        """Settings of every call of the solver."""
        # it would move bounds by a part of their distance from the origin
        return replace(as_settings(1e-8, self.most, self.time_limit, {"bound_relax_factor": 0.0}), best=False)

    @property
    def to_begin(self) -> Settings:
        """Settings of starts for programs."""
        return replace(self.settings, tolerance=SOLVERS)

    @cached_property
    def model(self) -> DiscreteModel:
        """Next state of (x, u, w) and parameters (p, t)."""
        loop = self.loop
        sizes = {"x": loop.phase.states, "u": loop.phase.inputs, "w": loop.nw, "p": len(self.p) + 1}
        step = compiled("dynamics", lambda x, u, w, p: loop.step(x, u, w, p[:-1], p[-1], 0 * u)[0], sizes)
        return DiscreteModel(step, loop.horizon)

    @cached_property
    def stages(self) -> PhaseStages:
        """Statement along plans."""
        return PhaseStages(self.loop)

    def signals(self, stated: dict[str, Any]) -> Given:
        """Checked signals of a sample."""
        loop, N, nw, nu = self.loop, self.loop.horizon, self.loop.functions.nw, self.loop.phase.inputs
        known = {"w": nw > 0, "u_prev": loop.carries, "t": loop.timed, "time": loop.timed}
        given = {name: value for name, value in stated.items() if value is not None}
        if "time" in given and loop.timed:  # the number of the sample
            given["t"] = loop.phase.start_time + loop.dt * as_number("time", given["time"])
        strange = next((name for name in given if not known.get(name)), None)
        if strange is not None:
            names = ", ".join(name for name, there in known.items() if there)
            raise InputError(strange, "a signal", f"{names or 'none'}: nothing in the phase depends on {strange}")
        missing = next((name for name in ASKED if known[name] and name not in given), None)
        if missing is not None:
            raise InputError(missing, "nothing", ASKED[missing], f"The phase depends on it: pass {missing}=….")
        t = as_number("t", given.get("t", loop.phase.start_time))
        if "w" not in given:
            w = loop.signal(t)
        else:  # held over each sample
            w = np.atleast_1d(as_floats("w", given["w"]))
            if w.shape not in ((nw,), (N, nw), (N + 1, nw)):
                rows = f"({N + 1}, {nw}), a row for each sample and the end, or ({nw},), held"
                raise InputError("w", f"shape {w.shape}", rows)
            w = np.tile(w, (N + 1, 1)) if w.ndim == 1 else w
            w = as_array("w", np.vstack([w, w[-1:]]) if len(w) == N else w, (N + 1, nw))
            w = np.hstack([w, w])[:, : loop.nw]
        u_prev = as_array("u_prev", given.get("u_prev", np.zeros(nu)), (nu,))
        return {"t": np.array([t]), "u_prev": u_prev, "w": w}

    def each(self, stated: dict[str, Any], n: int) -> list[Given]:
        """Signals of n states, common or one entry for each."""
        own = {"u_prev": (n, self.loop.phase.inputs), "t": (n,), "w": (n, None, self.loop.functions.nw)}
        given = {name: as_floats(name, v) for name, v in stated.items() if v is not None and name in own}
        rows = {name: as_array(name, v, own[name]) for name, v in given.items() if v.ndim == len(own[name])}
        return [self.signals(stated | {name: row[i] for name, row in rows.items()}) for i in range(n)]

    def plan(self, x: Array, given: Given, before: Plan | None) -> Plan:
        """Plan from a state, begun at another or at several places."""
        clock = Clock(self.time_limit)
        with np.errstate(over="ignore", invalid="ignore"):  # inputs by chance may lead far away
            found = None if before is None else self._followed(x, given, before, clock)
            if found is None or before is None or not self._sure(x, given, found, before):
                found = better(found, self._planned(x, given, before, clock))
        return clock.stamped(told_of_inputs(found, self.loop.phase.u_bounds, self.loop.rate_limit, given))

    def _followed(self, x: Array, given: Given, before: Plan, clock: Clock) -> Plan | None:
        """Plan that quadratic programs lead to, or None."""
        own, late = carried(before, self.stages.rows), before.status is Status.LATE
        first, stated = Path(before.states, before.inputs, multipliers=own), partial(self._local, x, given)
        if own is None and not late:
            return None
        for times in (PRICE,) if before.status is Status.SOFTENED else (1.0, PRICE):
            path = contracted(while_newton(programs(first, stated, clock, times=times)), self.most)
            if path is None or path.last is None:
                return None
            if not path.error <= KKT or path.last.falls:
                return self._reached(path, stated) if clock.stopped else None
            found, first = self._optimum(path.last), path.moved
            if path.last.local.passed[1] <= KKT:  # else the price may be too low
                break
        return found

    def _sure(self, x: Array, given: Given, found: Plan, before: Plan) -> bool:
        """Whether no other plan is looked for."""
        if found.status is not Status.SOFTENED or before.status is Status.SOFTENED:
            return True
        if self._local(x, given, found.states, found.inputs).passed_beside_told <= FEASIBLE:
            return True
        # from elsewhere limits may be kept, which was looked at as they began to be passed, if there was time
        then = partial(self._local, before.states[0], given)
        return before.status is Status.LATE and then(before.states, before.inputs).passed[1] > FEASIBLE

    def _reached(self, path: Path, stated: Callable[[Array, Array], Local]) -> Plan | None:
        """Plan after the last program in time, None without numbers."""
        states, inputs = path.moved.states, path.moved.inputs
        local, on = stated(states, inputs), path.last.multipliers if path.last else None
        if on is None or not np.isfinite(local.cost()):
            return None
        residuals, nx = Residuals(path.error, local.defects, 0.0, 0.0), self.loop.phase.states
        return Plan(np.clip(inputs, *self.loop.phase.u_bounds), states[:, :nx].copy(), local.cost(), Status.LATE,
                    residuals, local.passed[0], 0.0, CONVERGING, on.costates[:, :nx].copy(), on.pushes)  # fmt: skip

    def _local(self, x: Array, given: Given, states: Array, inputs: Array) -> Local:
        """Statement at a plan of a sample."""
        along = self.loop.states_with(states, inputs, given)
        first = np.concatenate([x, along[0, len(x) :]])
        return self.stages.at(first, along, inputs, np.append(self.p, given["t"]), given["w"])

    def _optimum(self, step: Step) -> Plan:
        """Plan of a step that moves it no more."""
        local, nx, bounds = step.local, self.loop.phase.states, self.loop.phase.u_bounds
        over, relative = local.passed
        status = Status.SOLVED if relative <= FEASIBLE else Status.SOFTENED
        residuals, on = Residuals(step.stationarity, step.defects, 0.0, 0.0), step.multipliers
        hessian = None if self.loop.timed or self.loop.functions.nw else step.hessian  # signals may change it
        return Plan(np.clip(local.inputs, *bounds), local.states[:, :nx].copy(), local.cost(), status, residuals,
                    over, 0.0, CONVERGING, on.costates[:, :nx].copy(), on.pushes, hessian)  # fmt: skip

    def _with_multipliers(self, plan: Plan, step: Step | None) -> Plan:
        """Optimum with the multipliers of a program about it, which confirms it."""
        if step is None:
            return plan
        still = min(step.error, step.size) <= KKT**0.5 or step.saved <= FEASIBLE  # where costs are flat it moves
        status = plan.status if still or plan.status is Status.SOFTENED else Status.INACCURATE
        on = step.multipliers
        nx = self.loop.phase.states
        return replace(plan, status=status, costates=on.costates[:, :nx].copy(), pushes=on.pushes)

    def _planned(self, x: Array, given: Given, before: Plan | None, clock: Clock) -> Plan:
        """Plan, the best of what was tried."""
        needed, expected = self._expected(x, given)
        program = self._sample(x, given)
        programs = self._sized(program, needed)
        run = Run(program, self.settings, clock)
        tried: list[Tried] = []
        solved = partial(self._solved, run, local=partial(self._local, x, given))
        if before is not None:
            v = self._unknowns(program, before.states, self._aside(before.inputs, program), given)
            tried.append(solved(program, v, PRICE**2))
        if not tried or not (tried[0].sure or clock.up):
            for i, sized in enumerate(programs):
                if i and clock.up:
                    break
                tried += self._from_starts(partial(solved, sized), sized, x, given, clock)
                best = min(tried, key=lambda one: one.rank)
                for v in (best.found.v, self._unknowns(sized, *next(self._guesses(x, given, sized)), given)):
                    if best.status in RANKS[2:] and not clock.late:
                        tried.append(solved(sized, v, PRICE**2))
                        best = min(tried, key=lambda one: one.rank)
                if best.status in RANKS[:2] and not best.cost > expected:
                    break
        best = min(tried, key=lambda one: one.rank)
        if best.status in RANKS[2:] and self._endless(x, given, run, tried, best, clock):
            cure = "Bound states and inputs, or price them."
            raise InputError("stage_cost", "a cost that falls without end", "costs with a lower bound", cure)
        plan = self._packed(best, run.program, x, given, before)
        if plan.status not in RANKS[:2]:
            late = clock.stopped or any(one.found.said == LATE for one in tried)
            return replace(plan, status=Status.LATE) if late else plan
        plan = self._with_multipliers(plan, best.step)
        # limits that are small beside the way are kept to their own sizes by programs
        sure = plan.status is Status.SOLVED or clock.late
        nearer = None if sure else self._followed(x, given, plan, clock)
        return nearer if nearer and self._sure(x, given, nearer, plan) else plan

    def _endless(self, x: Array, given: Given, run: Run, tried: list[Tried], best: Tried, clock: Clock) -> bool:
        """Whether the cost falls without end."""
        free_x, free_u = (not np.isfinite([*at]).all() for at in (self.loop.phase.x_bounds, self.loop.phase.u_bounds))
        if (free_x or free_u) and any(run.falls(one.found) for one in tried):
            return True
        if not free_u or clock.late:
            return False
        costs = []
        for far in NEGLIGIBLE ** -np.arange(5.0):
            states, inputs = self._led_to(x, far * self._trajectory(best.found.v)[1], given)
            at = self._local(x, given, finite(states), inputs)
            costs.append(at.cost() if at.passed[1] <= FEASIBLE else np.nan)
        falls = -np.diff(costs)
        return bool(falls[0] > FEASIBLE * abs(costs[0]) and (falls[1:] >= falls[:-1] / 2).all())

    def near(self, x: Array, given: Given, states: Array, inputs: Array, cost: float,
             clock: Clock) -> tuple[Array, Array] | None:  # fmt: skip
        """States and inputs that the solver comes to, None where gaps are left.

        They begin at others, unless these are no numbers.
        """
        if not (np.isfinite(states).all() and np.isfinite(inputs).all()):
            return None
        program = replace(self._sample(x, given), cost_scale=cost)
        settings = replace(self.to_begin, seconds=clock.left)
        found = once(program, self._unknowns(program, states, inputs, given), None, settings)
        return None if found.residuals.primal > 1 / WELL_SIZED else self._trajectory(found.v)

    def shifted(self, plan: Plan, given: Given) -> Plan:
        """Plan one sample later, with the last input held."""
        u = plan.inputs[-1]
        later = self.stages.rows.later
        return shifted(plan, u, self._next(plan.states[-1], u, given, self.loop.horizon - 1), later)

    def _next(self, x: Array, u: Array, given: Given, k: int) -> Array:
        """Next state after step k of a sample, finite."""
        t = given["t"] + k * self.loop.dt
        return finite(self.model.next(x, u, given["w"][k], np.concatenate([self.p, t])))

    def _solved(self, run: Run, program: NonlinearProgram, v: Array, price: float, *,
                local: Callable[[Array, Array], Local]) -> Tried:  # fmt: skip
        """Result from unknowns, with limits of states at a price.

        The price is in sizes of cost and rows; at 0 they are hard.
        """
        first, rows = self.loop.violations, self.loop.given_rows
        sized = rescaled(program, v)
        lower, upper, scale = sized.lower.copy(), sized.upper.copy(), sized.scale.copy()
        own, prices = slice(first, first + len(rows)), slice(first + len(rows), None)
        lower[prices] = upper[prices] = price * sized.cost_scale / sized.row_scale[rows]
        upper[own], scale[own] = np.inf if price else 0.0, sized.row_scale[rows] / PRICE
        run.program = replace(sized, lower=lower, upper=upper, scale=scale)
        found = run.solved(np.clip(v, lower, upper), None, warm=False)
        at = local(*self._trajectory(found.v))
        over, relative = at.passed
        return Tried(found, at.cost(), over, float(np.maximum(relative, at.defects)), at)

    def _trajectory(self, v: Array) -> Trajectory:
        """States (N + 1, nx) and inputs (N, nu) of unknowns."""
        nodes, own, _, _ = self.loop.program.parts[0].unknowns(v)
        return finite(nodes[: self.loop.phase.states].T.copy()), own.T.copy()

    def _aside(self, inputs: Array, program: NonlinearProgram) -> Array:
        """Inputs (N, nu) that break symmetries, within their bounds."""
        return np.clip(aside(inputs, self._input_sizes(program)), *self.loop.phase.u_bounds)

    def _input_sizes(self, program: NonlinearProgram) -> Array:
        """Sizes (nu,) of inputs."""
        part = program.parts[0]
        return np.asarray(program.scale[part.first + part.layout.nx :][: self.loop.phase.inputs])

    def _guesses(self, x: Array, given: Given, program: NonlinearProgram) -> Iterator[Trajectory]:
        """States and inputs of the starts: the phase's guess, else the state held; straight to its end; by chance."""
        phase, N, rng = self.loop.phase, self.loop.horizon, np.random.default_rng(0)
        states, inputs = self._guess
        size, middle = self._input_sizes(self.loop.program), np.clip(inputs[0], *phase.u_bounds)
        box = np.maximum(phase.u_bounds[0], middle - size), np.minimum(phase.u_bounds[1], middle + size)
        first = states if phase.guess is not None else np.tile(x, (N + 1, 1)), self._aside(inputs, program)
        return islice(beginnings(first, x, states[-1], lambda u: self._led_to(x, u, given), rng, box), self.starts)

    def _led_to(self, x: Array, inputs: Array, given: Given) -> Trajectory:
        """States (N + 1, nx) that inputs lead to, finite, and these."""
        states = np.tile(x, (len(inputs) + 1, 1))
        for k, u in enumerate(inputs):
            states[k + 1] = self._next(states[k], u, given, k)
        return states, inputs

    def _sample(self, x: Array, given: Given) -> NonlinearProgram:
        """Program of one sample."""
        program, nx, nw = self.loop.program, self.loop.phase.states, self.loop.nw
        part, lower, upper = program.parts[0], program.lower.copy(), program.upper.copy()
        signal = part.first + nx + part.layout.column * np.arange(self.loop.horizon + 1)[:, None] + np.arange(nw)
        first = np.concatenate([x, given["w"][0], given["u_prev"][: part.layout.nx - nx - nw]])
        for bounds in (lower, upper):
            bounds[signal] = given["w"]
            bounds[part.first : part.first + len(first)] = first
            bounds[program.parameters] = np.concatenate([self.p, given["t"]])
        return replace(program, lower=lower, upper=upper, guess=np.clip(program.guess, lower, upper))

    def _from_starts(self, solved: Callable[[Array, float], Tried], program: NonlinearProgram, x: Array, given: Given,
                     clock: Clock) -> Iterator[Tried]:  # fmt: skip
        """Results from starts, until most agree."""
        guesses = (self._unknowns(program, *guess, given) for guess in self._guesses(x, given, program))
        own = (solved(v, 0.0) for i, v in enumerate(guesses) if not (i and clock.up))
        return until_most_agree(own, self.starts, lambda one: one.sure)

    @cached_property
    def _guess(self) -> Trajectory:
        """States and inputs of the phase's guess."""
        states, inputs = first_guess(self.loop.phase)(np.linspace(0, 1, self.loop.horizon + 1))
        return states, inputs[:-1]

    def _expected(self, x: Array, given: Given) -> tuple[Array, float]:
        """Inputs (nu,) that the first program from the state held needs, and twice what its plan would cost.

        Needed is also an input that would cost as much as staying, by the program's curvature. Where limits cannot be
        kept there, it is the program without them, of which no cost is expected. Infinite where nothing is known.
        """
        inputs, states = self._guess[1], np.tile(x, (self.loop.horizon + 1, 1))
        held = self._local(x, given, states, inputs)
        for one in (held, replace(held, room=np.full(len(held.room), np.inf))):
            step = next_step(one, PRICE * one.force, times=PRICE)
            if step is not None and not step.relaxed and np.isfinite(step.inputs).all():
                alike = np.sqrt(2 * abs(held.cost())) * step.program.unit.reshape(inputs.shape)
                needed = np.maximum(np.abs(inputs + step.inputs).max(axis=0), alike.min(axis=0))
                cost = self._local(x, given, states + step.states[:, : len(x)], inputs + step.inputs).cost()
                expected = cost + max(abs(cost), COST_ROUNDING * held.cost_size)
                return np.asarray(needed), expected if one is held and np.isfinite(expected) else np.inf
        return np.full(inputs.shape[1], np.inf), np.inf

    def _sized(self, program: NonlinearProgram, needed: Array) -> list[NonlinearProgram]:
        """Itself, and one of the sizes that are needed, first where bounds of all inputs are loose."""
        told = self._input_sizes(program)
        size = np.where(told > WELL_SIZED * needed, np.maximum(needed, NEGLIGIBLE * told), told)
        if (size == told).all():
            return [program]
        sized = replace(program, scale=self.loop.scale(program, (-size, size)))
        loose = (needed > 0) & (NEGLIGIBLE**0.5 * told > needed)
        return [sized, program] if loose.all() else [program, sized]

    def _unknowns(self, program: NonlinearProgram, states: Array, inputs: Array, given: Given) -> Array:
        """Unknowns of a plan, without violations."""
        v, part = program.guess.copy(), program.parts[0]
        z = self.loop.states_with(states, inputs, given)
        v[part.first : part.last] = np.concatenate([np.hstack([z[:-1], inputs]).ravel(), z[-1]])
        most = BOTTOMLESS * program.scale  # where a model escapes the solver would end the process
        return np.clip(np.clip(v, -most, most), program.lower, program.upper)

    def _packed(self, best: Tried, program: NonlinearProgram, x: Array, given: Given, before: Plan | None) -> Plan:
        """Plan of a result, or the best that was reached instead."""
        states, inputs = self._trajectory(best.found.v)
        found = Plan(inputs, states, best.cost, best.status, best.found.residuals, best.violation, 0.0, "Ipopt")
        if found.status is not Status.REPLACED:
            return found
        name, other = ("guess", self._guess[1]) if before is None else (SHIFTED, before.inputs)
        plans = []
        for plan in (replace(found, inputs=other, solver=name), replace(found, status=Status.INACCURATE)):
            inputs = plan.inputs
            if self.loop.rate_limit is not None:
                inputs = no_faster(inputs, given["u_prev"], self.loop.rate_limit, np.zeros(len(inputs), dtype=bool))
            states, _ = self._led_to(x, inputs, given)
            at = self._local(x, given, finite(states), inputs)
            cost, (violation, passed) = at.cost(), at.passed
            total = cost + PRICE * program.cost_scale * passed
            simulated = replace(plan, inputs=inputs, states=finite(states), cost=cost, violation=violation)
            plans.append((total if np.isfinite(total) else np.inf, simulated))
        return min(plans, key=lambda one: one[0])[1]
