"""Discrete program of a phase for a loop: what changes from sample to sample are bounds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array, Flags, Immutable
from mpc.exceptions import InputError
from mpc.optimal_control.algebraic import eliminated
from mpc.optimal_control.bounds import INF
from mpc.optimal_control.functions import wanted
from mpc.optimal_control.interval import first_guess, phase_unknowns
from mpc.optimal_control.phase import Phase, PhaseFunctions, signal_at
from mpc.optimal_control.problem import OptimalControlProblem
from mpc.optimal_control.program import NonlinearProgram, PhasePart, places_of_violations, relaxable
from mpc.optimal_control.schemes import sampled
from mpc.optimal_control.transcription import build
from mpc.rollout import Given
from mpc.tolerances import WELL_SIZED


@dataclass(frozen=True, eq=False)
class LoopPhase(Immutable):
    """Phase with inputs held over each of N = `horizon` samples.

    The states of its program are (x, w, the input before), where w and the input before are asked for, and its
    parameters (p, t); of a phase in time, w stands twice: at both ends of a sample. Bounds of states, the terminal set
    and `rate_limit` are rows, which may be relaxed.
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

    @property
    def nw(self) -> int:
        """Number of signals of a sample, in time of both ends."""
        return int(self.functions.nw) * (1 if self.phase.discrete else 2)

    @cached_property
    def carries(self) -> bool:
        """Whether the state carries the input before."""
        return self.rate_limit is not None or self.asks("u_prev")

    @cached_property
    def timed(self) -> bool:
        """Whether anything depends on the time."""
        return self.asks("t") or self.asks("t0") or callable(self.phase.signal)

    def signal(self, t: float) -> Array:
        """Stated signal (N + 1, ·) of every sample from a time on."""
        first = t if callable(self.phase.signal) else self.phase.start_time
        w = signal_at(self.phase, np.asarray(first + self.dt * np.arange(self.horizon + 1)))
        return np.hstack([w, np.vstack([w[1:], w[-1:]])])[:, : self.nw]

    def step(self, x: Any, u: Any, w: Any, p: Any, t: Any, last: Any) -> tuple[Any, Any]:
        """Next state and cost of one sample, along which w is linear."""
        f, nx = self.functions, self.phase.states
        if self.phase.discrete:
            return f.dynamics(x, u, w, p, t), f.cost_at(x, u, w, p, t, last)

        w, end = ca.vertsplit(ca.vec(w), [0, f.nw, self.nw])

        def rate(x: Any, t: Any) -> Any:
            at = x[:nx], u, x[nx + 1 :], p, t
            return ca.vertcat(f.dynamics(*at), f.cost_at(*at, last), (end - w) / self.dt)

        z = sampled(rate, self.dt)(ca.vertcat(x, 0, w), t)
        return z[:nx], z[nx]

    def states_with(self, states: Array, inputs: Array, given: Given) -> Array:
        """States (N + 1, nx + nw + nu) of a plan with its signals."""
        before = [np.vstack([given["u_prev"], inputs])] * self.carries
        return np.hstack([states, given["w"], *before])

    @cached_property
    def ending(self) -> Any:
        """States that have bounds of their own at the end."""
        end, usual = np.array(self.phase.end), np.array(self.phase.x_bounds)
        return np.flatnonzero((np.isfinite(end) & (end != usual)).any(axis=0))

    @cached_property
    def program(self) -> NonlinearProgram:
        """Program for any state, signal, time and parameters; see `LoopPlanner`."""
        return relaxable(self._hard, self.may_give)

    @property
    def violations(self) -> int:
        """Place of the first violation; their prices stand behind them."""
        return len(self._hard.lower)

    @cached_property
    def given_rows(self) -> Any:
        """Row of every violation."""
        return np.concatenate(places_of_violations(self._hard, self.may_give))

    @cached_property
    def _hard(self) -> NonlinearProgram:
        """Program without violations, whose bounds of states are rows."""
        parameters = np.append(self.p, self.phase.start_time)
        program = build(OptimalControlProblem(self._discrete, p_bounds=(parameters, parameters)))
        part, nx, nw = program.parts[0], self.phase.states, self.nw
        numbers, _ = part.coordinates
        states, known = part.first + np.flatnonzero(numbers < part.layout.nx), part.first + np.flatnonzero(numbers < nx)
        lower, upper, scale = program.lower.copy(), program.upper.copy(), program.scale.copy()
        lower[states], upper[states] = -INF, INF
        if self.sizes is None:
            scale = self.scale(program, self.phase.u_bounds)
        else:
            scale[known] = self.sizes[numbers[known - part.first]]
        free = np.zeros(len(program.row_lower), dtype=bool)
        of_signal = np.arange(part.layout.nx)
        free[part.defects] = np.tile((of_signal >= nx) & (of_signal < nx + nw), self.horizon)
        free[part.path][: len(part.functions.path_names)] = ~self.counting(part)[0]
        row_lower, row_upper = np.where(free, -INF, program.row_lower), np.where(free, INF, program.row_upper)
        return replace(program, lower=lower, upper=upper, row_lower=row_lower, row_upper=row_upper, scale=scale)

    def scale(self, program: NonlinearProgram, u_bounds: tuple[Array, Array]) -> Array:
        """Sizes of unknowns (n,), without bounds that nothing reaches."""
        part, found = program.parts[0], program.scale.copy()
        guess = None if self.phase.guess is None else part.phase.guess
        loose = replace(part.phase, x_bounds=(-INF, INF), u_bounds=u_bounds, start=None, end=None, guess=guess)
        parameters, own = program.lower[program.parameters], found[part.first : part.last]
        moved = phase_unknowns(loose, part.functions, parameters, part.layout, part.mesh)[3]
        own[:] = np.where(own > WELL_SIZED * moved, moved, own)
        return found

    def of(self, part: PhasePart, name: str) -> Flags:
        """Whether each path row depends on "u" or "x"."""
        path, found = part.functions.path, np.zeros(len(part.functions.path_names), dtype=bool)
        if path is not None:
            rows, columns = path.jac_sparsity(0, 0 if name == "x" else 1).get_triplet()
            found[[row for row, column in zip(rows, columns) if name == "u" or column < self.phase.states]] = True
        return found

    def counting(self, part: PhasePart) -> Flags:
        """Whether each path row counts at each state (N + 1, r)."""
        of_inputs = self.of(part, "u")
        along = [np.ones_like(of_inputs)] * (self.horizon - 1)
        return np.vstack([of_inputs, *along, ~of_inputs | part.phase.held])  # the first state is given

    @cached_property
    def may_give(self) -> Flags:
        """Rows that may be relaxed: not those of inputs alone, nor those that have a price."""
        program, part = self._hard, self._hard.parts[0]
        own = self.of(part, "x") & np.isinf(part.functions.path_prices[0])
        found = np.ones(len(program.row_lower), dtype=bool)
        along = np.append(np.tile(own, self.horizon), own[self.counting(part)[-1]])
        found[part.defects] = False
        found[part.path.start :][: len(along)] = along
        return found & (np.isfinite(program.row_lower) | np.isfinite(program.row_upper))

    @cached_property
    def _discrete(self) -> Phase:
        """Discrete phase of states (x, w, input before) and parameters (p, t)."""
        phase, nw, N, last = self.phase, self.nw, self.horizon, [1] * self.carries
        times = np.linspace(0, 1, N + 1)
        x, u = first_guess(phase)(times)
        sides = zip(phase.x_bounds, (-INF, INF), phase.u_bounds)
        before = [f"{name} before" for _ in last for name in phase.input_names]
        return (Phase if phase.discrete else _Sampled)(
            self._dynamics, phase.states + nw + len(before), phase.inputs, duration=N, discrete=True,
            guess=(times, np.hstack([x, self.signal(phase.start_time), *[u for _ in last]]), u),
            x_bounds=tuple(np.concatenate([a, np.full(nw, b), *[c for _ in last]]) for a, b, c in sides),
            u_bounds=phase.u_bounds, input_names=phase.input_names,
            state_names=[*phase.state_names, *(f"w{i + 1}" for i in range(nw)), *before],
            stage_cost=None if phase.stage_cost is None else (
                lambda x, u, p, t: self.step(*self._at(x, u, p, t, along=True))[1]
            ),
            terminal_cost=None if phase.terminal_cost is None else self._terminal_cost,
            **self._along_the_way(), **self._at_the_end(),
        )  # fmt: skip

    def _at(self, x: Any, u: Any, p: Any, t: Any, *, along: bool = False) -> tuple[Any, ...]:
        """Columns (x, u, w, p, t, u_prev) at a sample, or along it."""
        nx, end = self.phase.states, self.phase.states + self.nw
        w = x[nx:end] if along else x[nx : nx + self.functions.nw]
        return x[:nx], u, w, p[:-1], p[-1] + self.dt * t, x[end:] if self.carries else 0 * u

    def _dynamics(self, x: Any, u: Any, p: Any, t: Any) -> Any:
        """Next state; the signal's rows are left free."""
        return ca.vertcat(self.step(*self._at(x, u, p, t, along=True))[0], ca.DM.zeros(self.nw), *[u] * self.carries)

    def _terminal_cost(self, x: Any, p: Any, t: Any) -> Any:
        """Cost of the last state."""
        x, _, *columns = self._at(x, 0, p, t)
        return self.functions.terminal_cost(x, *columns[:3])

    def _along_the_way(self) -> dict[str, Any]:
        """Path limits, bounds of states, and changes of inputs."""
        phase, f, limit, own = self.phase, self.functions, self.rate_limit, self.phase.bounded.tolist()
        rates = [] if limit is None else [limit]

        def path(x: Any, u: Any, p: Any, t: Any) -> Any:
            at = self._at(x, u, p, t)
            return ca.vertcat(f.path_at(*at), *(x[i] for i in own), *(u - at[-1] for _ in rates))

        sides = zip(f.path_bounds, phase.x_bounds, (-1.0, 1.0))
        bounds = [np.concatenate([a, b[own], *(sign * limit for limit in rates)]) for a, b, sign in sides]
        hard = np.full((2, len(bounds[0]) - len(f.path_names)), INF)
        prices = np.hstack([f.path_prices * self.dt, hard])
        names = [*f.path_names, *(phase.state_names[i] for i in own),
                 *(f"rate of {name}" for _ in rates for name in phase.input_names)]  # fmt: skip
        stated = {"path": path, "path_bounds": tuple(bounds), "path_names": names, "path_prices": tuple(prices)}
        return stated if names else {}

    def _at_the_end(self) -> dict[str, Any]:
        """Conditions at the end and bounds of the last state."""
        f, own = self.functions, self.ending.tolist()

        def boundary(x0: Any, x: Any, t0: Any, t: Any, p: Any) -> Any:
            (first, *_), (last, _, w, known, end, _) = self._at(x0, 0, p, t0), self._at(x, 0, p, t)
            stated = [] if f.boundary is None else [f.boundary(first, last, w, p[-1] + self.dt * t0, end, known)]
            return ca.vertcat(*stated, *(x[i] for i in own))

        bounds = tuple(np.concatenate([a, b[self.ending]]) for a, b in zip(f.boundary_bounds, self.phase.end))
        names = [*f.boundary_names, *(f"end of {self.phase.state_names[i]}" for i in own)]
        return {"boundary": boundary, "boundary_bounds": bounds, "boundary_names": names} if names else {}


class _Sampled(Phase):
    """Samples of a phase in time: the last input acts until the end."""

    held = True


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
    if phase.algebraic is not None:
        phase = eliminated(phase, len(p), looped=True)
    return LoopPhase(phase, int(phase.duration[0]) if horizon is None else horizon, p, rate_limit)
