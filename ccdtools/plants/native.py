"""CasADi functions on the rows of NumPy arrays by CasADi's own machine: for few rows, where array operations are slow.

An array operation takes most of a microsecond however few rows there are, CasADi's machine a nanosecond or two for an
instruction and row. Results differ by rounding.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array

FEW = 192  # rows up to which CasADi's machine is the faster one; they are even at 200 to 300
KEPT = 16  # numbers of rows that a function is held ready for


class Native:
    """A CasADi function of vectors on rows of arrays.

    Parameters
    ----------
    function : casadi.Function
        One output; dense vectors in and out.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._for_rows: dict[tuple[int, tuple[int, ...]], ca.Function] = {}

    def __call__(self, *arguments: Array) -> Array:
        """Values (n, n_out) at arguments (n, n_i); those of shape (n_i,) are common to all rows."""
        rows = next(len(a) for a in arguments if a.ndim == 2)
        out = np.empty((rows, self._function.numel_out(0)))
        if not rows:
            return out
        common = tuple(i for i, a in enumerate(arguments) if a.ndim == 1)
        made: Any = self._mapped(rows, common).buffer()
        buffer, evaluate = made
        given = [np.ascontiguousarray(a, dtype=float) for a in arguments]  # held: the buffer has their addresses only
        for i, a in enumerate(given):
            if a.size:
                buffer.set_arg(i, memoryview(a))  # type: ignore[arg-type]
        buffer.set_res(0, memoryview(out))  # type: ignore[arg-type]
        evaluate()
        return out

    def _mapped(self, rows: int, common: tuple[int, ...]) -> ca.Function:
        """The function for so many rows, some of whose arguments are common to all."""
        if rows == 1:
            return self._function
        made = self._for_rows.get((rows, common))
        if made is None:
            name = f"{self._function.name()}_{rows}"
            made = self._function.map(name, "serial", rows, list(common), [])
            for oldest in list(self._for_rows)[: max(0, len(self._for_rows) - KEPT + 1)]:
                self._for_rows.pop(oldest, None)  # another thread may have been faster
            self._for_rows[rows, common] = made
        return made
