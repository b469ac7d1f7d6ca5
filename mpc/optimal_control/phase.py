"""One phase of an optimal control problem, as it is stated and as functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array, as_count, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.bounds import INF, Bounds, as_bounds
from mpc.optimal_control.functions import Statement, brief, compiled


@dataclass(frozen=True, eq=False)
class Phase:
    """One stretch of time with its own dynamics, costs and limits.

    Every function is stated in CasADi and named arguments: any of the state `x`, the input `u`, the given signal `w`,
    the parameters `p` and the time `t`.

    Parameters
    ----------
    dynamics : function
        dx/dt (nx, 1), or the next state if `discrete`.
    states, inputs : int
        nx and nu.
    stage_cost : function, optional
        Scalar; integrated over time, or summed if `discrete`.
    terminal_cost : function of x, p, t, optional
        Scalar, at the end.
    start, end : (nx,) array, or bounds (lower, upper) as a tuple; optional
        Of the states there; None or NaN where an entry is free.
    duration : float, or bounds (lower, upper)
        Of the phase [s]; a number of steps, whole, if `discrete`.
    start_time : float
        Of the first phase, or of a scenario [s].
    x_bounds, u_bounds : (lower, upper), optional
        Each a number or one for every entry; infinite where there is none.
    path : function, optional
        Values that are kept within `path_bounds`, at all points of the mesh: ≤ 0 by default.
    path_bounds : (lower, upper)
    boundary : function of x0, x, t0, t, p, optional
        Of both ends of the phase; values that are kept within `boundary_bounds`: = 0 by default.
    boundary_bounds : (lower, upper)
    signal : function of t, or (n, nw) array, optional
        The given signal w: a Python function of times (n,) that returns (n, nw), for a phase whose times are given; or
        values at equal distances from its start to its end, linear between them.
    guess : (times, x, u), optional
        Where to start from: states (n, nx) and inputs (n, nu) at n rising times, as fractions of the duration.
    duration_guess : float, optional
        Where to start from when the duration is free.
    discrete : bool
    state_names, input_names : sequence of str, optional
        With units, for messages and figures.

    Raises
    ------
    InputError
        If a function has another signature, other free symbols or another shape; bounds cross; numbers are not finite.
    """

    dynamics: Statement
    states: int
    inputs: int
    stage_cost: Statement | None = None
    terminal_cost: Statement | None = None
    start: Bounds = None
    end: Bounds = None
    duration: Any = 1.0
    start_time: float = 0.0
    x_bounds: Bounds = (-INF, INF)
    u_bounds: Bounds = (-INF, INF)
    path: Statement | None = None
    path_bounds: Bounds = (-INF, 0.0)
    boundary: Statement | None = None
    boundary_bounds: Bounds = (0.0, 0.0)
    signal: Callable[[Array], ArrayLike] | ArrayLike | None = None
    guess: Any = None
    duration_guess: float | None = None
    discrete: bool = False
    state_names: Sequence[str] = ()
    input_names: Sequence[str] = ()

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "states", as_count("states", self.states))
        inputs = 0 if self.inputs == 0 and not isinstance(self.inputs, bool) else as_count("inputs", self.inputs)
        set_(self, "inputs", inputs)
        for name, size in (("x_bounds", self.states), ("u_bounds", self.inputs)):
            set_(self, name, as_bounds(name, getattr(self, name), size))
        for name in ("start", "end"):
            set_(self, name, self._at_an_end(name, getattr(self, name)))
        set_(self, "duration", self._as_duration())
        time = as_floats("start_time", self.start_time)
        if time.ndim or not np.isfinite(time):
            raise InputError("start_time", brief(repr(self.start_time)), "a finite number")
        set_(self, "start_time", float(time))
        for name, letter, size in (("state_names", "x", self.states), ("input_names", "u", self.inputs)):
            if isinstance(getattr(self, name), str):
                raise InputError(name, brief(repr(getattr(self, name))), f"a list of {size} names")
            names = tuple(getattr(self, name)) or tuple(f"{letter}{i + 1}" for i in range(size))
            if len(names) != size or not all(isinstance(entry, str) for entry in names):
                raise InputError(name, f"{len(names)} names", f"{size}, one each")
            set_(self, name, names)
        if self.duration_guess is not None:
            number = as_floats("duration_guess", self.duration_guess)
            if number.ndim or not np.isfinite(number) or not number > 0:
                raise InputError("duration_guess", brief(repr(self.duration_guess)), "a number > 0")
        if self.signal is not None and not callable(self.signal):
            signal = as_floats("signal", self.signal)
            if signal.ndim != 2 or len(signal) < 2 or not np.isfinite(signal).all():
                raise InputError("signal", f"shape {signal.shape}", "(n, nw), finite, n ≥ 2, or a function of time")
            set_(self, "signal", signal)
        if self.signal is not None and self.duration[0] != self.duration[1]:
            cure = "State what is known over time as an expression of t in the dynamics."
            raise InputError("signal", "a duration that is free", "a given duration", cure)

    def _at_an_end(self, name: str, value: Any) -> tuple[Array, Array]:
        """Bounds of the states at an end, within those of the phase."""
        low, high = self.x_bounds
        if value is None:
            return low, high
        if isinstance(value, tuple) and len(value) == 2:
            own = as_bounds(name, value, self.states)
        else:
            try:
                given = as_floats(name, [np.nan if entry is None else entry for entry in np.atleast_1d(value).tolist()])
            except TypeError:
                given = as_floats(name, value)
            if given.shape != (self.states,):
                raise InputError(
                    name, f"shape {given.shape}", f"({self.states},), one number a state, or bounds as a tuple"
                )
            if np.isinf(given).any():
                raise InputError(name, given, "finite numbers; None where a state is free")
            own = np.where(np.isnan(given), -INF, given), np.where(np.isnan(given), INF, given)
        both = np.maximum(low, own[0]), np.minimum(high, own[1])
        cross = np.flatnonzero(both[0] > both[1])
        if len(cross):
            i = int(cross[0])
            got = f"[{own[0][i]:g}, {own[1][i]:g}] for state {i + 1}"
            raise InputError(name, got, f"a value within x_bounds [{low[i]:g}, {high[i]:g}]")
        return both

    def _as_duration(self) -> tuple[float, float]:
        """Least and largest duration."""
        raw = as_floats("duration", self.duration)
        if raw.ndim == 0:
            raw = np.array([raw, raw])
        if raw.shape != (2,) or not np.isfinite(raw[0]) or not 0 < raw[0] <= raw[1]:
            cure = "A duration that may come to nothing has no mesh: bound it from below." if raw.size == 2 else ""
            raise InputError("duration", brief(repr(self.duration)), "a number > 0, or bounds 0 < lower ≤ upper", cure)
        if self.discrete and (raw[0] != raw[1] or raw[0] % 1):
            raise InputError("duration", brief(repr(self.duration)), "a whole number of steps, for discrete dynamics")
        return float(raw[0]), float(raw[1])

    @property
    def free_duration(self) -> bool:
        """Whether the duration is to be found."""
        return self.duration[0] < self.duration[1]


class PhaseFunctions:
    """The functions of a phase as `casadi.Function`, all with the same arguments.

    Attributes
    ----------
    dynamics, stage_cost, path : (x, u, w, p, t) → value, or None
    terminal_cost : (x, p, t) → scalar, or None
    boundary : (x0, x, t0, t, p) → value, or None
    """

    def __init__(self, phase: Phase, parameters: int) -> None:
        self.nw = _width(phase)
        running = {"x": phase.states, "u": phase.inputs, "w": self.nw, "p": parameters, "t": 1}
        at_end = {"x": phase.states, "p": parameters, "t": 1}
        ends = {"x0": phase.states, "x": phase.states, "t0": 1, "t": 1, "p": parameters}
        self.dynamics = compiled("dynamics", phase.dynamics, running, phase.states)
        self.stage_cost = _optional("stage_cost", phase.stage_cost, running, 1)
        self.path = _optional("path", phase.path, running, None)
        self.terminal_cost = _optional("terminal_cost", phase.terminal_cost, at_end, 1)
        self.boundary = _optional("boundary", phase.boundary, ends, None)
        self.path_bounds = _of_values("path_bounds", phase.path_bounds, self.path)
        self.boundary_bounds = _of_values("boundary_bounds", phase.boundary_bounds, self.boundary)


def _optional(name: str, given: Any, sizes: dict[str, int], rows: int | None) -> ca.Function | None:
    """A function, where there is one."""
    return None if given is None else compiled(name, given, sizes, rows)


def _of_values(name: str, bounds: Any, function: ca.Function | None) -> tuple[Array, Array]:
    """Bounds for every value of a function; none for none."""
    return as_bounds(name, bounds, 0 if function is None else function.numel_out(0))


def _width(phase: Phase) -> int:
    """Entries of the given signal."""
    if phase.signal is None:
        return 0
    if not callable(phase.signal):
        return int(np.shape(phase.signal)[1])
    return signal_at(phase, np.array([phase.start_time])).shape[1]


def signal_at(phase: Phase, times: Array) -> Array:
    """Values (n, nw) of the given signal of a phase at times (n,)."""
    if phase.signal is None:
        return np.zeros((len(times), 0))
    if callable(phase.signal):
        try:
            given = phase.signal(times)
        except Exception as error:  # the function is the user's: whatever it raises is told with what is expected
            reason = brief(" ".join(f"{type(error).__name__}: {error}".split()))
            raise InputError("signal", f"one that stops with {reason}", "a function of times (n,)") from error
        values = as_floats("signal", given)
        if values.ndim != 2 or len(values) != len(times) or not np.isfinite(values).all():
            raise InputError(
                "signal", f"values of shape {values.shape} at {len(times)} times", f"({len(times)}, nw), finite"
            )
        return values
    table = np.asarray(phase.signal)
    grid = phase.start_time + phase.duration[0] * np.linspace(0, 1, len(table))
    return np.stack([np.interp(times, grid, column) for column in table.T], axis=1)
