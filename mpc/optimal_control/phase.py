"""One phase of an optimal control problem."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools_ground.algebraic import check_index
from ccdtools_ground.door import as_number
from mpc.checks import Array, as_array, as_count, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.bounds import (
    INF,
    Bounds,
    as_bounds,
    as_duration,
    as_end,
    as_guess,
    as_names,
    as_prices,
    as_samples,
    check_within,
)
from mpc.optimal_control.functions import Statement, brief, compiled, slopes_of, symbols_of, wanted

LIMITED = ("path", "boundary")  # functions whose values have bounds and names


@dataclass(frozen=True, eq=False)
class Phase:
    """One stretch of time with its own dynamics, costs and limits.

    Every function is stated in CasADi and named arguments: any of the state `x`, the input `u`, the given signal `w`,
    the parameters `p` and the time `t`. In `NonlinearMPC(phase)` stage cost and path know the input before, `u_prev`;
    with `algebraic` equations they and the dynamics know the algebraic variables `z`.

    Parameters
    ----------
    dynamics : function
        dx/dt (nx, 1), or the next state if `discrete`.
    states, inputs : int
        nx and nu.
    stage_cost : function, optional
        Scalar; integrated over time, or summed if `discrete`.
    terminal_cost : function of x, w, p, t, optional
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
        Values that are kept within `path_bounds`, at all points of the mesh: ≤ 0 by default. Those of an input count
        where it acts: at the end of a phase in time, but not at the last state of a `discrete` one.
    path_bounds : (lower, upper)
    path_prices : (linear, quadratic), optional
        Makes path limits soft: a violation e costs linear · e + quadratic · e², integrated over time, or summed over
        all points if `discrete`. Each is a number ≥ 0 or one for every value, None where a limit is hard; not both 0.
    boundary : function of x0, x, w, t0, t, p, optional
        Of both ends of the phase; values that are kept within `boundary_bounds`: = 0 by default.
    boundary_bounds : (lower, upper)
    signal : function of t, or (n, nw) array, optional
        The given signal w of a phase whose duration is given: a Python function of times (n,) that returns (n, nw); or
        values at equal distances from its start to its end, linear between them.
    guess : (times, x, u), optional
        Where to start from: states (n, nx) and inputs (n, nu) at n rising times, as fractions of the duration.
    duration_guess : float, optional
        Where to start from when the duration is free.
    discrete : bool
    state_names, input_names : sequence of str, optional
        With units, for messages and figures.
    path_names, boundary_names : sequence of str, optional
        What conflicts and advice call each value of `path` and `boundary`: "path 1", … by default.
    samples : (times (n,), values (n, m)), optional
        Rising times from the phase's start [s] that become points of the mesh, and what is known there: y.
    sample_cost : function of x, w, p, t, y, optional
        Scalar; summed over the samples.
    algebraic : function, optional
        g (nz, 1), kept at 0 by z; of index 1, which is that ∂g/∂z is regular.
    algebraics : int
        nz. Without `algebraic`, so many of the last inputs are z, and of the last path limits their equations.
    z_guess : (nz,) array or number
        Where z starts from.

    Raises
    ------
    InputError
        If a function has another signature, other free symbols or another shape; bounds cross; numbers are not finite.
        Functions of p, and of a signal that is a function, are tried when the problem is stated.
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
    path_prices: Any = None
    boundary: Statement | None = None
    boundary_bounds: Bounds = (0.0, 0.0)
    signal: Callable[[Array], ArrayLike] | ArrayLike | None = None
    guess: Any = None
    duration_guess: float | None = None
    discrete: bool = False
    state_names: Sequence[str] = ()
    input_names: Sequence[str] = ()
    path_names: Sequence[str] = ()
    boundary_names: Sequence[str] = ()
    samples: Any = None
    sample_cost: Statement | None = None
    algebraic: Statement | None = None
    algebraics: int = 0
    z_guess: Any = 0.0

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "states", as_count("states", self.states))
        set_(self, "inputs", as_count("inputs", self.inputs, least=0))
        set_(self, "algebraics", as_count("algebraics", self.algebraics) if self.algebraic or self.algebraics else 0)
        guess = as_floats("z_guess", self.z_guess)
        guess = np.full(self.algebraics, guess) if guess.ndim == 0 else guess
        set_(self, "z_guess", as_array("z_guess", guess, (self.algebraics,)))
        for name, size in (("x_bounds", self.states), ("u_bounds", self.inputs)):
            set_(self, name, as_bounds(name, getattr(self, name), size))
        for name in ("start", "end"):
            set_(self, name, as_end(name, getattr(self, name), self.x_bounds))
        set_(self, "duration", as_duration(self.duration, bool(self.discrete)))
        set_(self, "start_time", as_number("start_time", self.start_time))
        for name, letter, size in (("state_names", "x", self.states), ("input_names", "u", self.inputs)):
            set_(self, name, as_names(name, getattr(self, name), letter, size))
        if self.duration_guess is not None:
            check_within("duration_guess", as_number("duration_guess", self.duration_guess), "duration", self.duration)
        if self.signal is not None and not callable(self.signal):
            signal = as_floats("signal", self.signal)
            if signal.ndim != 2 or len(signal) < 2:
                raise InputError("signal", f"shape {signal.shape}", "(n, nw), n ≥ 2, or a function of time")
            set_(self, "signal", as_array("signal", signal, (None, None)))
        if self.signal is not None and self.duration[0] != self.duration[1]:
            cure = "State what is known over time as an expression of t in the dynamics."
            raise InputError("signal", "a duration that is free", "a given duration", cure)
        if self.guess is not None:
            set_(self, "guess", as_guess(self.guess, self.states, self.inputs))
        set_(self, "samples", as_samples(self.samples, self.sample_cost, self.duration, bool(self.discrete)))
        self._try_functions()

    def _try_functions(self) -> None:
        """Raise for functions that cannot be meant."""
        width = 0 if self.signal is None or callable(self.signal) else int(np.shape(self.signal)[1])
        for name, (sizes, rows) in _columns(self, width, 0, looped=True).items():
            given = getattr(self, name)
            stated = given is not None or name == "dynamics"
            asked = wanted(name, given, tuple(sizes)) if stated else ()
            if "p" in asked or ("w" in asked and callable(self.signal)):
                continue
            function = compiled(name, given, sizes, rows) if stated else None
            if name == "algebraic" and function is not None:
                _check_index(self, function)
            if name in LIMITED:
                _, names = _with_limits(self, name, function)
            if name == "path":
                as_prices(self.path_prices, len(names))
                if self.algebraic is None and self.algebraics > min(len(names), self.inputs):
                    raise InputError("algebraics", self.algebraics, "0 without `algebraic`, their equations")

    @property
    def bounded(self) -> Any:
        """States that have bounds."""
        return np.flatnonzero(np.isfinite(self.x_bounds).any(axis=0))

    @property
    def held(self) -> bool:
        """Whether an input that is held acts until the end."""
        return not self.discrete

    @property
    def free_duration(self) -> bool:
        """Whether the duration is unknown."""
        return bool(self.duration[0] < self.duration[1])


class PhaseFunctions:
    """Functions of a phase as `casadi.Function` with common arguments.

    Attributes
    ----------
    dynamics, stage_cost, path : (x, u, w, p, t) → value, or None
        Costs and limits of a loop of (x, u, w, p, t, u_prev).
    terminal_cost : (x, w, p, t) → scalar, or None
    sample_cost : (x, w, p, t, y) → scalar, or None
    algebraic : (x, u, w, p, t, z) → value, or None
        With it dynamics, costs and limits are of z, too.
    boundary : (x0, x, w, t0, t, p) → value, or None
    path_bounds, boundary_bounds : (lower, upper)
        Arrays, one entry a value.
    path_prices : (2, values) array
        Linear and quadratic prices of violations; infinite where a limit is hard.
    path_names, boundary_names : tuple of str
    """

    def __init__(self, phase: Phase, parameters: int, *, looped: bool = False) -> None:
        self.nw = signal_at(phase, np.array([phase.start_time])).shape[1]
        made: dict[str, Any] = {
            name: None if getattr(phase, name) is None else compiled(name, getattr(phase, name), sizes, rows)
            for name, (sizes, rows) in _columns(phase, self.nw, parameters, looped=looped).items()
        }
        self.dynamics, self.stage_cost, self.path, self.terminal_cost, *others = made.values()
        self.boundary, self.sample_cost, self.algebraic = others
        if self.algebraic is not None:
            _check_index(phase, self.algebraic)
        self.path_bounds, self.path_names = _with_limits(phase, "path", self.path)
        self.boundary_bounds, self.boundary_names = _with_limits(phase, "boundary", self.boundary)
        self.path_prices = as_prices(phase.path_prices, len(self.path_names))

    @cached_property
    def path_slopes(self) -> ca.Function:
        """Derivatives of the path values by states and inputs."""
        return slopes_of(self.path)

    @cached_property
    def price(self) -> ca.Function:
        """Price of violations at columns (x, u, w, p, t)."""
        return self._priced(set(range(self.path_prices.shape[1])))

    @cached_property
    def price_of_inputs(self) -> ca.Function:
        """Price of violations of inputs alone."""
        of_states = [] if self.path is None else self.path.jac_sparsity(0, 0).row()
        return self._priced(set(range(self.path_prices.shape[1])).difference(of_states))

    def _priced(self, entries: set[int]) -> ca.Function:
        at, total = self.dynamics.mx_in(), ca.MX(0)
        value = self.path_at(*at)
        for side, sign in zip(self.path_bounds, (1.0, -1.0)):
            for i in entries.intersection(np.flatnonzero(np.isfinite([*self.path_prices, side]).all(axis=0)).tolist()):
                over = sign * (side[i] - value[i])
                linear, quadratic = self.path_prices[:, i]
                total += (over > 0) * (linear * over + quadratic * over**2)  # NaN where the value is
        return ca.Function("price", at, [total])

    @cached_property
    def priced(self) -> PhaseFunctions:
        """Functions with it in the stage cost."""
        found, at = copy(self), self.dynamics.mx_in()
        found.stage_cost = ca.Function("stage_cost", at, [self.cost_at(*at) + self.price(*at)])
        return found

    def cost_at(self, *at: Any) -> Any:
        """Stage cost at columns (x, u, w, p, t); 0 without one."""
        return 0 if self.stage_cost is None else self.stage_cost(*at)

    def path_at(self, *at: Any) -> Any:
        """Path values at columns (x, u, w, p, t); none without limits."""
        return type(at[0])(0, 1) if self.path is None else self.path(*at)


def _columns(
    phase: Phase, width: int, parameters: int, *, looped: bool
) -> dict[str, tuple[dict[str, int], int | None]]:
    """Columns and lengths of each function's arguments, and its value's length."""
    running = {"x": phase.states, "u": phase.inputs, "w": width, "p": parameters, "t": 1}
    running |= {} if phase.algebraic is None else {"z": phase.algebraics}
    moving = running | ({"u_prev": phase.inputs} if looped else {})
    at_end = {"x": phase.states, "w": width, "p": parameters, "t": 1}
    ends = {"x0": phase.states, "x": phase.states, "w": width, "t0": 1, "t": 1, "p": parameters}
    known = 0 if phase.samples is None else phase.samples[1].shape[1]
    at_samples = {"x": phase.states, "w": width, "p": parameters, "t": 1, "y": known}
    return {
        "dynamics": (running, phase.states), "stage_cost": (moving, 1), "path": (moving, None),
        "terminal_cost": (at_end, 1), "boundary": (ends, None), "sample_cost": (at_samples, 1),
        "algebraic": (running, None),
    }  # fmt: skip


def _check_index(phase: Phase, algebraic: ca.Function) -> None:
    """Raise an `InputError` unless the algebraic equations are of index 1."""
    columns = symbols_of(algebraic)
    check_index(algebraic(*columns.values()), columns["z"], phase.z_guess)


def _with_limits(phase: Phase, name: str, function: ca.Function | None) -> tuple[tuple[Array, Array], tuple[str, ...]]:
    """Bounds and names of a function's values, empty without limits."""
    if function is None:
        usual = repr(Phase.__dataclass_fields__[f"{name}_bounds"].default)
        for own, stated in ((f"{name}_bounds", repr(getattr(phase, f"{name}_bounds")) != usual),
                            (f"{name}_names", len(getattr(phase, f"{name}_names")) > 0)):  # fmt: skip
            if stated:
                got = brief(repr(getattr(phase, own)))
                raise InputError(own, got, f"a function `{name}`, whose values they are of")
        return (np.zeros(0), np.zeros(0)), ()
    size = function.numel_out(0)
    given = {"w"} if phase.free_duration else {"w", "t", "t0"}
    tied = {row for i, of in enumerate(function.name_in()) if of not in given
            for row in function.jac_sparsity(0, i).row()}  # fmt: skip
    idle = next((i for i in range(size) if i not in tied), None)
    if idle is not None:
        got = f"value {idle + 1}, which depends on no state, input or parameter"
        raise InputError(name, got, "limits of what can be chosen")
    bounds = as_bounds(f"{name}_bounds", getattr(phase, f"{name}_bounds"), size)
    return bounds, as_names(f"{name}_names", getattr(phase, f"{name}_names"), f"{name} ", size)


def signal_at(phase: Phase, times: Array) -> Array:
    """Values (n, nw) of a phase's given signal at times (n,)."""
    if phase.signal is None:
        return np.zeros((len(times), 0))
    if callable(phase.signal):
        try:
            given = phase.signal(times)
        except Exception as error:  # the function is the user's: whatever it raises is told with what is expected
            reason = brief(" ".join(f"{type(error).__name__}: {error}".split()))
            raise InputError("signal", f"one that stops with {reason}", "a function of times (n,)") from error
        return as_array("signal", given, (len(times), None))
    table = np.asarray(phase.signal)
    grid = phase.start_time + phase.duration[0] * np.linspace(0, 1, len(table))
    return interpolated(times, grid, table)


def interpolated(at: Array, times: Array, table: Array) -> Array:
    """Rows (..., m) of a table (n, m) at times (...), linear between."""
    columns = [np.interp(at, times, column) for column in table.T]
    return np.stack(columns, axis=-1) if columns else np.zeros((*np.shape(at), 0))


def signal_along(phase: Phase, fractions: Array) -> Array:
    """Values (N, points · nw) of a phase's given signal at fractions (N, points) of it."""
    times = phase.start_time + phase.duration[0] * fractions
    return signal_at(phase, times.ravel()).reshape(len(fractions), -1)


def evaluated(function: ca.Function, phase: Phase, x: Array, u: Array, t: Array, p: Array) -> Array:
    """Values (n, m) of a function of x, u, w, p, t at states (n, nx), inputs (n, nu) and times (n,)."""
    return np.asarray(function(x.T, u.T, signal_at(phase, t).T, p, t[None]), dtype=float).T
