"""Pieces of a program: equations of intervals, ends and links."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpc.checks import Array
from mpc.optimal_control.interval import Layout
from mpc.optimal_control.phase import PhaseFunctions
from mpc.tolerances import SPREAD_FLOOR, SPREAD_ROUNDING

Numbers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Clock:
    """Start and length of a phase, given or free."""

    start: float  # its start, less the free durations before it
    length: float  # its duration, where it is given
    free: Numbers  # (k,): unknowns that are free durations before it, and last its own if that is free
    own: bool  # whether its own is free

    def times(self, free: Any) -> tuple[Any, Any]:
        """Start and duration from the free durations (k,)."""
        before = free[: len(self.free) - self.own]
        length = free[len(self.free) - 1] if self.own else self.length
        return self.start + (ca.sum1(before) if before.numel() else 0), length


def piece_function(function: Callable[..., Any], scalar: bool, sizes: dict[str, int], data: int) -> ca.Function:
    """Function (z, data) → values from a function of named columns."""
    kind: Any = ca.SX if scalar else ca.MX
    z, given = kind.sym("z", sum(sizes.values())), kind.sym("data", data)
    cuts = np.cumsum([0, *sizes.values()])
    columns = {name: z[int(a) : int(b)] for name, a, b in zip(sizes, cuts[:-1], cuts[1:])}
    value = ca.densify(ca.vertcat(*(ca.vec(kind(part)) for part in function(**columns, data=given))))
    return ca.Function("piece", [z, given], [value], ["z", "data"], ["value"], {"cse": True})


def interval_piece(interval: ca.Function, layout: Layout, clock: Clock, parameters: int, discrete: bool) -> ca.Function:
    """Cost, defects and path values of an interval."""
    sizes = {
        "x": layout.nx, "v": layout.node_inputs, "own": layout.own, "x_next": layout.nx, "v_next": layout.node_inputs,
        "p": parameters, "free": len(clock.free),
    }  # fmt: skip

    def values(free: Any, p: Any, data: Any, **own: Any) -> list[Any]:
        start, length = clock.times(free)
        step = 1.0 if discrete else length * data[1]
        defects, cost, path = interval(*own.values(), p, start + length * data[0], step, data[2:])
        return [cost, defects, path]

    scalar = interval.is_a("SXFunction")
    return piece_function(values, scalar, sizes, 2 + layout.nw * len(layout.signals))


def end_piece(functions: PhaseFunctions, clock: Clock, nx: int, parameters: int) -> ca.Function:
    """Terminal cost and boundary values at a phase's ends."""

    def values(x0: Any, x: Any, p: Any, free: Any, data: Any) -> list[Any]:
        start, length = clock.times(free)
        found = []
        if functions.terminal_cost is not None:
            found.append(functions.terminal_cost(x, p, start + length))
        if functions.boundary is not None:
            found.append(functions.boundary(x0, x, start, start + length, p))
        return found

    sizes = {"x0": nx, "x": nx, "p": parameters, "free": len(clock.free)}
    return piece_function(values, _scalar(functions.terminal_cost, functions.boundary), sizes, 0)


def path_piece(functions: PhaseFunctions, clock: Clock, layout: Layout, parameters: int, fraction: float,
               kept: Numbers) -> ca.Function:  # fmt: skip
    """Path values at one end of a phase; data are the signal."""

    def values(x: Any, u: Any, p: Any, free: Any, data: Any) -> list[Any]:
        start, length = clock.times(free)
        given = u if u.numel() == layout.nu else ca.DM.zeros(layout.nu)
        assert functions.path is not None
        return [functions.path(x, given, data, p, start + fraction * length)[kept.tolist()]]

    held = layout.nu if fraction == 1 else layout.node_inputs
    sizes = {"x": layout.nx, "u": held, "p": parameters, "free": len(clock.free)}
    return piece_function(values, _scalar(functions.path), sizes, layout.nw)


def link_piece(link: ca.Function | None, clock: Clock, before: int, after: int, parameters: int) -> ca.Function:
    """Gap between a phase's first state and the last before it."""

    def values(end: Any, begin: Any, p: Any, free: Any, data: Any) -> list[Any]:
        return [(end if link is None else link(end, p, clock.times(free)[0])) - begin]

    sizes = {"end": before, "begin": after, "p": parameters, "free": len(clock.free)}
    return piece_function(values, _scalar(link), sizes, 0)


def parameter_piece(functions: tuple[ca.Function | None, ca.Function | None], parameters: int) -> ca.Function:
    """Cost and constraints of the parameters."""

    def values(p: Any, data: Any) -> list[Any]:
        return [function(p) for function in functions if function is not None]

    return piece_function(values, _scalar(*functions), {"p": parameters}, 0)


def _scalar(*functions: ca.Function | None) -> bool:
    """Whether all functions have scalar instructions."""
    return all(function is None or function.is_a("SXFunction") for function in functions)


def itself() -> ca.Function:
    """Number as a piece."""
    return piece_function(lambda z, data: [z], True, {"z": 1}, 0)


def mean_and_spread(weights: Array, spread: float) -> ca.Function:
    """Piece of the weighted mean plus `spread` standard deviations."""
    parts = ca.DM(weights / weights.sum())

    def value(z: Any, data: Any) -> list[Any]:
        mean = ca.dot(parts, z)
        variance = ca.dot(parts, (z - mean) ** 2)
        return [mean + spread * ca.sqrt(variance + SPREAD_ROUNDING * ca.dot(parts, z**2) + SPREAD_FLOOR)]

    return piece_function(value, True, {"z": len(weights)}, 0)


@dataclass(frozen=True, eq=False)
class Piece:
    """Function at M places, each value added to a row of [f; g]."""

    function: ca.Function  # (z (n,), data (d,)) → values (k,)
    unknowns: Numbers  # (n, M): which of all they are
    data: Array  # (d, M)
    rows: Numbers  # (k, M): where the values go: 0 is the cost f, 1 + i constraint i
    factors: Array  # (k,): that they are multiplied by

    @property
    def places(self) -> int:
        """Number M of places."""
        return int(self.unknowns.shape[1])

    @property
    def of_cost(self) -> NDArray[np.bool_]:
        """Whether each value (k,) is added to the cost."""
        return np.asarray(self.rows[:, 0] == 0)

    @cached_property
    def parts(self) -> dict[bool, ca.Function]:
        """Functions of the values in the cost, and of the others."""
        z, data = self.symbols
        value = self.function(z, data)
        found = {of_cost: value[listed(self.of_cost == of_cost)] for of_cost in (True, False)}
        return {key: ca.Function("part", [z, data], [part], {"cse": True}) for key, part in found.items()}

    @property
    def symbols(self) -> tuple[Any, Any]:
        """z and data, of the kind of the function."""
        kind: Any = ca.SX if self.function.is_a("SXFunction") else ca.MX
        return kind.sym("z", self.unknowns.shape[0]), kind.sym("data", self.data.shape[0])

    def mapped(self, function: ca.Function, *columns: Any) -> Sequence[Any]:
        """Results of a function of columns at all places."""
        found = function.map(self.places)(*columns) if self.places > 1 else function(*columns)
        return found if isinstance(found, list | tuple) else [found]

    def gathered(self, v: Any) -> Any:
        """Unknowns (n, M) of the piece."""
        return ca.reshape(v[self.unknowns.ravel(order="F").tolist()], *self.unknowns.shape)


def listed(chosen: NDArray[np.bool_]) -> list[int]:
    """Numbers of the chosen entries."""
    return [int(i) for i in np.flatnonzero(chosen)]
