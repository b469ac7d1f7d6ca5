"""Plans of a phase from sample to sample, each confirmed by the program's own conditions."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from mpc.budgets import ASIDE
from mpc.checks import Array, as_array, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.bounds import as_number
from mpc.optimal_control.discrete_model import DiscreteModel
from mpc.optimal_control.functions import compiled
from mpc.optimal_control.interval import first_guess
from mpc.optimal_control.ipopt import Found
from mpc.optimal_control.loop_phase import LoopPhase
from mpc.optimal_control.program import NonlinearProgram, rescaled
from mpc.optimal_control.solution import OptimalControlStatus
from mpc.optimal_control.solving import Run, as_settings, status_of
from mpc.plan import Plan, Residuals, Status
from mpc.rollout import Given, finite
from mpc.tolerances import FEASIBLE, VIOLATION_PRICE

RANKS = (Status.SOLVED, Status.SOFTENED, Status.INACCURATE, Status.REPLACED)
ASKED = {"u_prev": "the input applied a sample ago (nu,)", "t": "the time at which the sample is taken"}


@dataclass(frozen=True, eq=False)
class LoopPlanner:
    """Plans of a phase for parameters p (np,), by Ipopt from the plan before or from so many `starts`.

    Where hard limits of states cannot be kept, their violations get a price, and the plan is SOFTENED.
    """

    loop: LoopPhase
    p: Array
    most: int
    starts: int
    time_limit: float

    def __post_init__(self) -> None:
        _ = self.loop.program

    @cached_property
    def model(self) -> DiscreteModel:
        """Next state of (x, u, w) and parameters (p, t)."""
        loop = self.loop
        sizes = {"x": loop.phase.states, "u": loop.phase.inputs, "w": loop.functions.nw, "p": len(self.p) + 1}
        step = compiled("dynamics", lambda x, u, w, p: loop.step(x, u, w, p[:-1], p[-1], 0 * u)[0], sizes)
        return DiscreteModel(step, loop.horizon)

    def signals(self, stated: dict[str, Any]) -> Given:
        """Signals of a sample: w (N + 1, nw), t and u_prev, checked."""
        loop, rows, nw, nu = self.loop, self.loop.horizon + 1, self.loop.functions.nw, self.loop.phase.inputs
        known = {"w": nw > 0, "u_prev": loop.carries, "t": loop.timed}
        given = {name: value for name, value in stated.items() if value is not None}
        strange = next((name for name in given if not known.get(name)), None)
        if strange is not None:
            names = ", ".join(name for name, there in known.items() if there)
            raise InputError(strange, "a signal", f"{names or 'none'}: nothing in the phase depends on {strange}")
        missing = next((name for name in ASKED if known[name] and name not in given), None)
        if missing is not None:
            raise InputError(missing, "nothing", ASKED[missing], f"The phase depends on it: pass {missing}=….")
        t = as_number("t", given.get("t", loop.phase.start_time), "a finite number", lambda _: True)
        w = as_floats("w", given.get("w", loop.signal(t)))
        return {
            "t": np.array([t]), "u_prev": as_array("u_prev", given.get("u_prev", np.zeros(nu)), (nu,)),
            "w": as_array("w", np.tile(w, (rows, 1)) if w.ndim <= 1 else w, (rows, nw)),
        }  # fmt: skip

    def each(self, stated: dict[str, Any], n: int) -> list[Given]:
        """Signals of n states, common or one entry for each."""
        more = {"u_prev": 2, "t": 1, "w": 3}
        rows = [name for name, value in stated.items() if value is not None and np.ndim(value) == more.get(name)]
        short = next((name for name in rows if len(stated[name]) != n), None)
        if short is not None:
            raise InputError(short, f"{len(stated[short])} of them", f"{n}, one for each state")
        return [self.signals(stated | {name: stated[name][i] for name in rows}) for i in range(n)]

    def plan(self, x: Array, given: Given, before: Plan | None) -> Plan:
        """Plan from a state, begun at another or at several places."""
        program = self._sample(x, given)
        run = Run(program, as_settings(1e-8, self.most, self.time_limit, None))
        tried: list[Found] = []
        if before is not None:
            tried.append(self._solved(run, program, (before.states, before.inputs), given, warm=True))
        if not tried or self._status(program, tried[0]) is not Status.SOLVED:
            for guess in self._guesses(x, given):
                if not run.late:
                    tried.append(self._solved(run, program, guess, given, warm=False))
        found = min(tried, key=lambda one: self._rank(program, one))
        status = self._status(program, found)
        if status is Status.SOFTENED and not run.late:  # its price may be too low
            run.program = self._priced(program, VIOLATION_PRICE * run.program.cost_scale)
            dearer = run.solved(np.clip(found.v, run.program.lower, run.program.upper), None, warm=True)
            if self._rank(program, dearer) < self._rank(program, found):
                found, status = dearer, self._status(program, dearer)
        if status is Status.REPLACED and any(run.falls(one) for one in tried):
            cure = "Bound states and inputs, or price them."
            raise InputError("stage_cost", "a cost that falls without end", "costs with a lower bound", cure)
        return self._packed(program, found, Status.LATE if run.late else status, run, before)

    def shifted(self, plan: Plan, given: Given) -> Plan:
        """Plan one sample later, with the last input held."""
        last = self._next(plan.states[-1], plan.inputs[-1], given, self.loop.horizon - 1)
        return replace(plan, inputs=np.vstack([plan.inputs[1:], plan.inputs[-1]]),
                       states=np.vstack([plan.states[1:], last]))  # fmt: skip

    def _solved(self, run: Run, program: NonlinearProgram, guess: tuple[Array, Array], given: Given, *,
                warm: bool) -> Found:  # fmt: skip
        """Result from states and inputs, with limits of states at a price."""
        v = self._unknowns(program, *guess, given)
        run.program = self._priced(program, rescaled(program, v).cost_scale)
        return run.solved(v, None, warm=warm)

    def _guesses(self, x: Array, given: Given) -> Iterator[tuple[Array, Array]]:
        """Guess of the phase or the state held; the model under these inputs; under inputs by chance."""
        phase, N, rng = self.loop.phase, self.loop.horizon, np.random.default_rng(0)
        states, inputs = first_guess(phase)(np.linspace(0, 1, N + 1))
        part = self.loop.program.parts[0]
        size = self.loop.program.scale[part.first + part.layout.nx :][: phase.inputs]
        low, high = np.maximum(phase.u_bounds[0], -size), np.minimum(phase.u_bounds[1], size)
        aside = np.clip(inputs[:-1] + rng.uniform(-ASIDE, ASIDE, (N, phase.inputs)) * size, *phase.u_bounds)
        yield states if phase.guess is not None else np.tile(x, (N + 1, 1)), aside
        for number in range(1, self.starts):
            if number > 1:
                pieces = rng.uniform(low, high, (1 + N // 5, phase.inputs))
                aside = np.repeat(pieces, 5, axis=0)[:N]
            states = np.tile(x, (N + 1, 1))
            for k in range(N):
                states[k + 1] = self._next(states[k], aside[k], given, k)
            yield states, aside

    def _next(self, x: Array, u: Array, given: Given, k: int) -> Array:
        """Next state after step k of a sample, finite."""
        t = given["t"] + k * self.loop.dt
        return finite(self.model.next(x, u, given["w"][k], np.concatenate([self.p, t])))

    def _sample(self, x: Array, given: Given) -> NonlinearProgram:
        """Program of one sample."""
        program, nx, nw = self.loop.program, self.loop.phase.states, self.loop.functions.nw
        part, lower, upper = program.parts[0], program.lower.copy(), program.upper.copy()
        nodes = part.first + part.layout.column * np.arange(self.loop.horizon + 1)[:, None]
        last = given["u_prev"] if self.loop.carries else []
        known = {part.first: np.concatenate([x, given["w"][0], last]), program.parameters.start: [*self.p, *given["t"]]}
        for bounds in (lower, upper):
            bounds[nodes + nx + np.arange(nw)] = given["w"]
            for first, value in known.items():
                bounds[first : first + len(value)] = value
        return replace(program, lower=lower, upper=upper, guess=np.clip(program.guess, lower, upper))

    def _unknowns(self, program: NonlinearProgram, states: Array, inputs: Array, given: Given) -> Array:
        """Unknowns of a plan, without violations."""
        v, part = program.guess.copy(), program.parts[0]
        last = [np.vstack([given["u_prev"], inputs])] * self.loop.carries
        z = np.hstack([states, given["w"], *last])
        v[part.first : part.last] = np.concatenate([np.hstack([z[:-1], inputs]).ravel(), z[-1]])
        return np.clip(v, program.lower, program.upper)

    def _rank(self, program: NonlinearProgram, found: Found) -> tuple[int, float]:
        """Rank of a result: optima by their cost, softened ones and others by their violation."""
        status = self._status(program, found)
        cost = float(program.derivatives.values(found.v)[0])
        worth = cost if status is Status.SOLVED else self._violation(program, found.v) + found.residuals.primal
        return RANKS.index(status), worth if np.isfinite(worth) else np.inf

    def _status(self, program: NonlinearProgram, found: Found) -> Status:
        """Status of a result: an optimum only where its own conditions hold, and all limits."""
        within = self._violation(program, found.v) <= FEASIBLE
        if status_of(found) is OptimalControlStatus.SOLVED:
            return Status.SOLVED if within else Status.SOFTENED
        return Status.INACCURATE if within and found.residuals.primal <= FEASIBLE else Status.REPLACED

    def _priced(self, program: NonlinearProgram, cost: float) -> NonlinearProgram:
        """Program in which limits of states may be violated at a price."""
        lower, upper, first = program.lower.copy(), program.upper.copy(), self.loop.violations
        upper[first:-1] = np.inf
        lower[-1] = upper[-1] = VIOLATION_PRICE * cost
        return replace(program, lower=lower, upper=upper)

    def _violation(self, program: NonlinearProgram, v: Array) -> float:
        """Largest violation of a limit of states, in sizes of its row."""
        held = np.concatenate([v[: self.loop.violations], np.zeros(len(v) - self.loop.violations)])
        g = np.asarray(program.derivatives.values(held)[1], dtype=float).ravel()
        over = np.maximum(g - program.row_upper, program.row_lower - g) / program.row_scale
        return float(over[self.loop.may_give].max(initial=0.0))

    def _packed(self, program: NonlinearProgram, found: Found, status: Status, run: Run, before: Plan | None) -> Plan:
        """Plan of a result, or what stands in for it."""
        part, nx, name = program.parts[0], self.loop.phase.states, "Ipopt"
        nodes, own, _, _ = part.unknowns(found.v)
        states, inputs = nodes[:nx].T.copy(), own.T.copy()
        if before is not None and status in (Status.REPLACED, Status.LATE) and not found.residuals.primal <= FEASIBLE:
            states, inputs, name = before.states, before.inputs, "shifted plan"
        cost = float(program.derivatives.values(found.v)[0]) if name == "Ipopt" else np.nan
        took = time.perf_counter() - run.began
        return Plan(inputs, finite(states), cost, status, found.residuals, self._violation(program, found.v), took, name)
