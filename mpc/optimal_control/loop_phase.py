"""Discrete program of a phase for a loop: what changes from sample to sample are bounds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array, Flags
from mpc.exceptions import InputError
from mpc.optimal_control.bounds import INF
from mpc.optimal_control.functions import wanted
from mpc.optimal_control.interval import first_guess
from mpc.optimal_control.phase import Phase, PhaseFunctions, signal_at
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.program import NonlinearProgram, places_of_violations, relaxable
from mpc.optimal_control.schemes import sampled
from mpc.optimal_control.transcription import build


@dataclass(frozen=True, eq=False)
class LoopPhase:
    """Phase with inputs held over each of N = `horizon` samples.

    The states of its program are (x, w, the input before), where w and the input before are asked for, and its
    parameters (p, t). Bounds of states, the terminal set and `rate_limit` are rows, which may be relaxed.
    """

    phase: Phase
    horizon: int
    p: Array
    rate_limit: Array | None
    sizes: Array | None = None  # (nx,): of states, where they are known

    @cached_property
    def functions(self) -> PhaseFunctions:
        """Functions of the phase, of (x, u, w, p, t, u_prev)."""
        return PhaseFunctions(self.phase, len(self.p), looped=True)

    @property
    def dt(self) -> float:
        """Sample time; 1 if discrete."""
        return 1.0 if self.phase.discrete else self.phase.duration[0] / self.horizon

    def asks(self, name: str) -> bool:
        """Whether any function asks for a column."""
        given = [getattr(self.phase, part) for part in ("dynamics", "stage_cost", "path", "terminal_cost", "boundary")]
        names = ("x", "u", "w", "p", "t", "u_prev", "x0", "t0")
        return any(name in wanted("phase", one, names) for one in given if one is not None)

    @cached_property
    def carries(self) -> bool:
        """Whether the state carries the input before."""
        return self.rate_limit is not None or self.asks("u_prev")

    @cached_property
    def timed(self) -> bool:
        """Whether anything depends on the time."""
        return self.asks("t") or self.asks("t0") or callable(self.phase.signal)

    def signal(self, t: float) -> Array:
        """Signal (N + 1, nw) that the phase states from a time on."""
        first = t if callable(self.phase.signal) else self.phase.start_time
        return signal_at(self.phase, first + self.dt * np.arange(self.horizon + 1))

    def step(self, x: Any, u: Any, w: Any, p: Any, t: Any, last: Any) -> tuple[Any, Any]:
        """Next state and cost of one sample."""
        f = self.functions
        if self.phase.discrete:
            return f.dynamics(x, u, w, p, t), f.cost_at(x, u, w, p, t, last)

        def rate(x: Any, t: Any) -> Any:
            return ca.vertcat(f.dynamics(x[:-1], u, w, p, t), f.cost_at(x[:-1], u, w, p, t, last))

        z = sampled(rate, self.dt)(ca.vertcat(x, 0), t)
        return z[:-1], z[-1]

    @cached_property
    def limited(self) -> Any:
        """States that have bounds."""
        return np.flatnonzero(np.isfinite(self.phase.x_bounds).any(axis=0))

    @cached_property
    def ending(self) -> Any:
        """States that have bounds of their own at the end."""
        return np.flatnonzero(np.isfinite(self.phase.end).any(axis=0) & np.not_equal(self.phase.end, self.phase.x_bounds)
                              .any(axis=0))  # fmt: skip

    @cached_property
    def program(self) -> NonlinearProgram:
        """Program for any state, signal, time and parameters; see `LoopPlanner`."""
        return relaxable(self._hard, self.may_give)

    @property
    def violations(self) -> int:
        """Place of the first violation among the unknowns, behind which their prices stand."""
        return len(self._hard.lower)

    @cached_property
    def given_rows(self) -> Any:
        """Row of every violation."""
        return np.concatenate(places_of_violations(self._hard, self.may_give))

    @cached_property
    def _hard(self) -> NonlinearProgram:
        """Program without violations."""
        parameters = np.append(self.p, self.phase.start_time)
        program = build(OptimalControlProblem(self._discrete, p_bounds=(parameters, parameters)))
        part, lower, upper = program.parts[0], program.lower.copy(), program.upper.copy()
        numbers, _ = part.coordinates
        states = part.first + np.flatnonzero(numbers < part.layout.nx)
        lower[states], upper[states] = -INF, INF
        row_lower, row_upper = program.row_lower.copy(), program.row_upper.copy()
        free = np.zeros(len(row_lower), dtype=bool)
        nx, nz = self.phase.states, part.layout.nx
        free[part.defects] = np.tile((np.arange(nz) >= nx) & (np.arange(nz) < nx + self.functions.nw), self.horizon)
        free[part.path.start : part.path.start + len(part.functions.path_names)] = ~self._of("u")  # of the first state
        row_lower[free], row_upper[free] = -INF, INF
        scale = program.scale.copy()
        if self.sizes is not None:
            own = numbers < nx
            scale[part.first + np.flatnonzero(own)] = self.sizes[numbers[own]]
        return replace(program, lower=lower, upper=upper, row_lower=row_lower, row_upper=row_upper, scale=scale)

    def _of(self, name: str) -> Flags:
        """Whether each path row depends on the inputs "u" or on the states "x"."""
        path, count = self._discrete_functions.path, len(self._discrete_functions.path_names)
        found = np.zeros(count, dtype=bool)
        if path is not None:
            rows, columns = path.jac_sparsity(0, 0 if name == "x" else 1).get_triplet()
            found[[row for row, column in zip(rows, columns) if name == "u" or column < self.phase.states]] = True
        return found

    @cached_property
    def may_give(self) -> Flags:
        """Rows that may be relaxed: those of states, not those of inputs alone."""
        program = self._hard
        found = np.zeros(len(program.row_lower), dtype=bool)
        for rows in program.rows:
            if rows.name in ("path", "boundary"):
                own = self._of("x") if rows.name == "path" else np.ones(len(rows.entries), dtype=bool)
                found[rows.first : rows.last] = np.tile(own, (rows.last - rows.first) // len(own))
        return found & (np.isfinite(program.row_lower) | np.isfinite(program.row_upper))

    @cached_property
    def _discrete_functions(self) -> PhaseFunctions:
        """Functions of the discrete phase."""
        return PhaseFunctions(self._discrete, len(self.p) + 1)

    @cached_property
    def _discrete(self) -> Phase:
        """Discrete phase of states (x, w, input before) and parameters (p, t)."""
        phase, f = self.phase, self.functions
        nx, nu, nw, N = phase.states, phase.inputs, f.nw, self.horizon
        limited, ending, limit = self.limited.tolist(), self.ending.tolist(), self.rate_limit

        def at(z: Any, u: Any, p: Any, t: Any) -> tuple[Any, ...]:
            """Columns (x, u, w, p, t, u_prev) of the phase."""
            return z[:nx], u, z[nx : nx + nw], p[:-1], p[-1] + self.dt * t, z[nx + nw :] if self.carries else 0 * u

        def dynamics(x: Any, u: Any, p: Any, t: Any) -> Any:
            return ca.vertcat(self.step(*at(x, u, p, t))[0], ca.DM.zeros(nw), *[u] * self.carries)

        def path(x: Any, u: Any, p: Any, t: Any) -> Any:
            change = [] if limit is None else [u - x[nx + nw :]]
            return ca.vertcat(f.path_at(*at(x, u, p, t)), x[limited], *change)

        def terminal_cost(x: Any, p: Any, t: Any) -> Any:
            return f.terminal_cost(x[:nx], x[nx : nx + nw], p[:-1], p[-1] + self.dt * t)

        def boundary(x0: Any, x: Any, t0: Any, t: Any, p: Any) -> Any:
            clock = p[-1] + self.dt * t0, p[-1] + self.dt * t
            stated = [] if f.boundary is None else [f.boundary(x0[:nx], x[:nx], x[nx : nx + nw], *clock, p[:-1])]
            return ca.vertcat(*stated, x[ending])

        names = [[f"rate of {name}" for name in phase.input_names], ["w"] * nw, list(phase.input_names) * self.carries]
        rates = (np.zeros(0), np.zeros(0)) if limit is None else (-limit, limit)
        path_bounds = tuple(np.concatenate([a, b[self.limited], c])
                            for a, b, c in zip(f.path_bounds, phase.x_bounds, rates))  # fmt: skip
        ends = tuple(np.concatenate([a, b[self.ending]]) for a, b in zip(f.boundary_bounds, phase.end))
        prices = np.pad(f.path_prices * self.dt, ((0, 0), (0, len(path_bounds[0]) - len(f.path_names))),
                        constant_values=INF)  # fmt: skip
        times = np.linspace(0, 1, N + 1)
        x, u = first_guess(phase)(times)
        more = [self.signal(phase.start_time), u][: 1 + self.carries]
        sizes = zip(phase.x_bounds, (-INF, INF), phase.u_bounds)
        return Phase(
            dynamics, nx + nw + nu * self.carries, nu, duration=N, discrete=True, guess=(times, np.hstack([x, *more]), u),
            stage_cost=None if phase.stage_cost is None else lambda x, u, p, t: self.step(*at(x, u, p, t))[1],
            terminal_cost=None if phase.terminal_cost is None else terminal_cost,
            path=path if len(path_bounds[0]) else None,
            path_bounds=path_bounds if len(path_bounds[0]) else (-INF, 0.0),
            path_prices=tuple(prices) if np.isfinite(prices).any() else None,
            path_names=[*f.path_names, *(phase.state_names[i] for i in limited), *(names[0] if limit is not None else [])],
            boundary=boundary if len(ends[0]) else None,
            boundary_bounds=ends if len(ends[0]) else (0.0, 0.0),
            boundary_names=[*f.boundary_names, *(f"end of {phase.state_names[i]}" for i in ending)],
            x_bounds=tuple(np.concatenate([of_x, np.full(nw, of_w), *[of_u] * self.carries]) for of_x, of_w, of_u in sizes),
            u_bounds=phase.u_bounds, input_names=phase.input_names,
            state_names=[*phase.state_names, *(f"w{i + 1}" for i in range(nw)),
                         *(f"{name} before" for name in names[2])],
        )  # fmt: skip


def as_loop_phase(phase: Phase, horizon: int | None, p: Array, rate_limit: Array | None) -> LoopPhase:
    """Loop of a phase, checked."""
    if phase.free_duration:
        raise InputError("duration", "one that is free", "a given duration, which moves along with the loop")
    if phase.samples is not None:
        raise InputError("samples", "samples of a phase", "none in a loop", "State references by a `signal`.")
    if not phase.inputs:
        raise InputError("inputs", "0 of them", "a phase with inputs")
    if phase.discrete and horizon not in (None, int(phase.duration[0])):
        raise InputError("horizon", horizon, f"{phase.duration[0]:g}, the steps of the phase, or None")
    if not phase.discrete and horizon is None:
        raise InputError("horizon", "nothing", "the samples N that the duration of the phase is divided into")
    return LoopPhase(phase, int(phase.duration[0]) if horizon is None else horizon, p, rate_limit)
