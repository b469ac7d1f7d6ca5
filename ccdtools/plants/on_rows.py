"""CasADi functions on rows of arrays, by CasADi's own machine.

It takes a nanosecond or two for an instruction and row; an array operation takes most of a microsecond however few rows
there are. Results differ by rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.plants.tolerances import KEPT_SIZES


def on_rows(function: ca.Function) -> Callable[..., Array]:
    """CasADi function of vectors, with one output, on rows of arrays.

    Returns
    -------
    callable
        Values (n, n_out) at arguments (n, n_i), or (n_i,) common to all rows.
    """

    @lru_cache(KEPT_SIZES)
    def for_rows(rows: int, common: tuple[int, ...]) -> ca.Function:
        """Function for so many rows, with some arguments common to all."""
        return function if rows == 1 else function.map(f"{function.name()}_{rows}", "serial", rows, list(common), [])

    def evaluated(*arguments: Array) -> Array:
        """Values of all rows."""
        rows = next(len(a) for a in arguments if a.ndim == 2)
        out = np.empty((rows, function.numel_out(0)))
        if not rows:
            return out
        made: Any = for_rows(rows, tuple(i for i, a in enumerate(arguments) if a.ndim == 1)).buffer()
        buffer, evaluate = made
        given = [np.ascontiguousarray(a, dtype=float) for a in arguments]  # held: the buffer has their addresses only
        for i, a in enumerate(given):
            if a.size:
                buffer.set_arg(i, memoryview(a))  # type: ignore[arg-type]
        buffer.set_res(0, memoryview(out))  # type: ignore[arg-type]
        evaluate()
        return out

    return evaluated


def as_rows(columns: Array) -> Array:
    """Rows (k, n) of numbers (n, k) in double precision; (k,) as they are."""
    return np.array(columns.T, dtype=float, order="C")
