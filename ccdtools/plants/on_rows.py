"""CasADi functions on rows of arrays.

An array operation takes most of a microsecond however few rows there are, CasADi's machine a nanosecond or two for an
instruction and row. Results differ by rounding. In place, two to three times as fast as by operations that return new
arrays, they are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, lru_cache, partial
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.plants.casadi_arrays import Operations, Tape, numpy_operations
from ccdtools.plants.tolerances import KEPT_SIZES

IN_PLACE: Operations = {
    ca.OP_ADD: np.add, ca.OP_SUB: np.subtract, ca.OP_MUL: np.multiply, ca.OP_DIV: np.divide, ca.OP_NEG: np.negative,
    ca.OP_SQ: np.square, ca.OP_TWICE: lambda a, out: np.add(a, a, out),
    ca.OP_INV: lambda a, out: np.divide(1.0, a, out),
}  # fmt: skip


class Native:
    """CasADi function of vectors on rows of arrays.

    Parameters
    ----------
    function : casadi.Function
        One output; dense vectors in and out.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._for_rows = lru_cache(KEPT_SIZES)(partial(_for_rows, function))

    def __call__(self, *arguments: Array) -> Array:
        """Values (n, n_out) at arguments (n, n_i), or (n_i,) common to all rows."""
        rows = next(len(a) for a in arguments if a.ndim == 2)
        out = np.empty((rows, self._function.numel_out(0)))
        if not rows:
            return out
        common = tuple(i for i, a in enumerate(arguments) if a.ndim == 1)
        made: Any = self._for_rows(rows, common).buffer()
        buffer, evaluate = made
        given = [np.ascontiguousarray(a, dtype=float) for a in arguments]  # held: the buffer has their addresses only
        for i, a in enumerate(given):
            if a.size:
                buffer.set_arg(i, memoryview(a))  # type: ignore[arg-type]
        buffer.set_res(0, memoryview(out))  # type: ignore[arg-type]
        evaluate()
        return out


class InPlace:
    """Instructions of a function, carried out in place.

    Parameters
    ----------
    tape : Tape
        Of a function with one output; dense vectors in and out.
    arguments : sequence of (n_i, n) or (n_i,) arrays
        A row for every entry, or one number for all of the n runs. They are looked up at every `run`.

    Attributes
    ----------
    out : (n_out, n) array
        Values of the last run.
    """

    def __init__(self, tape: Tape, arguments: Sequence[Array]) -> None:
        runs = next(a.shape[1] for a in arguments if a.ndim == 2)
        self.out = np.empty((tape.function.numel_out(0), runs))
        room = np.empty((tape.function.sz_w(), runs))
        value: list[Any] = [0.0] * len(room)
        self._calls: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        for op, inputs, outputs, number in tape.instructions:
            if op == ca.OP_INPUT:
                value[outputs[0]] = arguments[inputs[0]][inputs[1]]
            elif op == ca.OP_CONST:
                value[outputs[0]] = number
            elif op == ca.OP_OUTPUT:
                self._calls.append((np.copyto, (self.out[outputs[1]], value[inputs[0]])))
            else:
                operands = [value[i] for i in inputs]
                value[outputs[0]] = room[outputs[0]]
                self._calls.append((_into_room(op), (*operands, room[outputs[0]])))

    def run(self) -> None:
        """Carry out the instructions."""
        with np.errstate(all="ignore"):
            for call, operands in self._calls:
                call(*operands)


def _for_rows(function: ca.Function, rows: int, common: tuple[int, ...]) -> ca.Function:
    """Function for `rows` rows, with some arguments `common` to all."""
    return function if rows == 1 else function.map(f"{function.name()}_{rows}", "serial", rows, list(common), [])


def as_rows(columns: Array) -> Array:
    """Rows (k, n) of numbers (n, k) in double precision; (k,) as they are."""
    return np.array(columns.T, dtype=float, order="C")


@cache
def _into_room(op: int) -> Callable[..., Any]:
    """(operands, out) → an operation that writes to `out`."""
    if op in IN_PLACE:
        return IN_PLACE[op]
    plain = numpy_operations()[op]
    return plain if isinstance(plain, np.ufunc) else lambda *operands: np.copyto(operands[-1], plain(*operands[:-1]))
