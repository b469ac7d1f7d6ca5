"""Jumps of a plant's right-hand side in x, u or w.

Derivatives say nothing of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array, Immutable
from ccdtools.plants.budgets import JUMP_LINES
from ccdtools.plants.casadi_arrays import Vectorised
from ccdtools.plants.casadi_operations import Operations
from ccdtools.plants.symbols import elements
from ccdtools.plants.tolerances import AT_POINT, JUMP_SIZES, JUMP_WIDTH, NO_JUMP
from ccdtools_ground.operations import JUMPS

DECIDES = {ca.OP_IF_ELSE_ZERO: (0,), ca.OP_COPYSIGN: (1,)}  # These inputs throw a switch; all of them in others.
GOES_ON = (ca.OP_FMOD, ca.OP_REMAINDER, ca.OP_COPYSIGN, ca.OP_IF_ELSE_ZERO)  # These vary between their switches.
SMOOTHER = "State the jump as something steep that is smooth, such as tanh(v / width) in place of sign(v)."


@dataclass(frozen=True, eq=False)
class Jump(Immutable):
    """Place at which a right-hand side jumps."""

    row: int  # of the right-hand side, the one that jumps most for its size
    names: tuple[str, ...]  # the operations that do
    # the place
    x: Array
    u: Array
    w: Array
    p: Array


class Switches:
    """Operations of f(x, u, w, p) that may jump in x, u or w.

    Parameters
    ----------
    f : casadi.Function
        (x, u, w, p) → column.

    Attributes
    ----------
    names : list of tuples of str
        Operations that each row depends on.
    """

    def __init__(self, f: ca.Function) -> None:
        self.f = f
        self.sizes = [f.numel_in(i) for i in range(4)]
        self.names: list[tuple[str, ...]] = [()] * f.numel_out(0)
        tape = Vectorised(f)
        if any(op in JUMPS for op, *_ in tape.instructions):
            arguments = [ca.SX.sym(name, n) for name, n in zip("xuwp", self.sizes)]
            positions = ca.SX(ca.vertcat(*self._read(tape, arguments)))
            self._positions = ca.Function("positions", arguments, [positions])

    def _read(self, tape: Vectorised, arguments: list[ca.SX]) -> list[ca.SX]:
        """Fill in `names`; expressions that change where a switch is thrown."""
        positions: list[ca.SX] = []

        def carried_out(op: int, *own: tuple[Any, bool, bool, set[str]]) -> tuple[Any, ...]:
            """(value, whether it depends on z, whether it is constant but for switches, by which) of an operation."""
            values, by_z, steps, names = zip(*own)
            value = ca.SX.unary(op, *values) if len(own) == 1 else ca.SX.binary(op, *values)
            deciding = DECIDES.get(op, range(len(own)))
            thrown = op in JUMPS and any(by_z[i] for i in deciding)
            if thrown and not all(steps[i] for i in deciding):
                positions.append(_position(op, values, value))
            own_name = {JUMPS[op]} if thrown else set[str]()
            return value, any(by_z), all(steps) or (thrown and op not in GOES_ON), own_name.union(*names)

        entries = [[(z, i < 3, False, set[str]()) for z in elements(column)] for i, column in enumerate(arguments)]
        operations: Operations = {op: partial(carried_out, op) for op, *_ in tape.instructions}
        (rows,) = tape.run(entries, operations, constant=lambda number: (ca.SX(number), False, True, set[str]()))
        self.names = [tuple(sorted(names)) for *_, names in rows]
        return positions

    def __bool__(self) -> bool:
        """Whether there is a switch at all."""
        return any(self.names)

    def within(self, boxes: Sequence[tuple[Array, Array]], design: tuple[Array, Array]) -> Jump | None:
        """Jump within bounds of x, u and w; None without one."""
        if not self:
            return None
        rng = np.random.default_rng(0)
        n = JUMP_LINES * len(JUMP_SIZES)
        if boxes:
            low, high = (np.concatenate([box[side] for box in boxes]) for side in (0, 1))
            ends = [rng.uniform(low, high, (n, len(low))) for _ in range(2)]
        else:
            size = np.repeat(JUMP_SIZES, JUMP_LINES)[:, None]
            ends = [size * rng.uniform(-1, 1, (n, sum(self.sizes[:3]))) for _ in range(2)]
        return self._between(ends[0], ends[1], rng.uniform(*design, (n, self.sizes[3])), JUMP_WIDTH)

    def at(self, z: Array, p: Array) -> Jump | None:
        """Jump at a point z = (x, u, w) and a design."""
        if not self:
            return None
        away = AT_POINT * np.maximum(np.abs(z), 1.0) * np.random.default_rng(0).uniform(-1, 1, (JUMP_LINES, len(z)))
        return self._between(z - away, z + away, np.tile(p, (JUMP_LINES, 1)), 1.0)

    def _between(self, start: Array, end: Array, p: Array, near: float) -> Jump | None:
        """Largest jump on lines (n, ·); None without one."""
        positions, f = Vectorised(self._positions), Vectorised(self.f)
        parts = np.cumsum(self.sizes[:3])[:-1]

        def at(function: Vectorised, t: Array) -> Array:
            """Function values (n, ·) at the shares `t` (n,) of the lines."""
            z = start + t[:, None] * (end - start)
            return np.asarray(function(*np.split(z, parts, axis=1), p))

        low, high = np.zeros(len(p)), np.ones(len(p))
        own = at(positions, low)
        thrown = (own != at(positions, high)).any(axis=1)
        if not thrown.any():
            return None
        for _ in range(60):  # until its ends are neighbours
            middle = 0.5 * (low + high)
            before = (at(positions, middle) == own).all(axis=1)
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        with np.errstate(all="ignore"):
            gap = np.abs(at(f, high) - at(f, low))
            around = np.abs(at(f, np.minimum(high + near, 1.0)) - at(f, np.maximum(low - near, 0.0)))
            largest = np.nanmax(np.abs(np.vstack([at(f, low), at(f, high)])), axis=0, initial=0.0)
            jumps = (gap > 0.5 * around) & (gap > NO_JUMP * largest) & thrown[:, None]
            jumps &= np.array([bool(names) for names in self.names])
            if not jumps.any():
                return None
            share = np.where(jumps, gap / largest, 0.0)
        run, row = np.unravel_index(int(np.argmax(share)), share.shape)
        place = start[run] + high[run] * (end[run] - start[run])
        x, u, w = np.split(place, parts)
        return Jump(int(row), self.names[row], x, u, w, p[run])


def _position(op: int, values: Any, value: Any) -> Any:
    """Number that changes only where a switch is thrown."""
    if op == ca.OP_FMOD or op == ca.OP_REMAINDER:
        return ca.floor((values[0] - value) / values[1] + 0.5)
    if op == ca.OP_COPYSIGN:
        return ca.sign(values[1])
    return values[0] != 0 if op == ca.OP_IF_ELSE_ZERO else value
