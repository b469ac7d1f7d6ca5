"""The optional arguments of a solve, checked and spread over the horizon."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array, as_array, as_floats
from mpc.exceptions import InputError
from mpc.problem import MPCProblem


def spread_signals(problem: MPCProblem, signals: dict[str, ArrayLike | None]) -> dict[str, Array]:
    """Each given signal as one flat array; a single row is held over the horizon.

    Raises
    ------
    InputError
        An unknown name, a wrong shape, NaN, or a signal the controller was not built for.
    """
    shapes = problem.signal_shapes
    given: dict[str, Array] = {}
    for name, value in signals.items():
        if value is None:
            continue
        if name == "w" and name not in shapes:
            raise InputError("w", "a disturbance", "none", "The controller has no disturbance matrix E.")
        if name not in shapes:
            raise InputError(name, f"unknown signal {name!r}", f"some of {sorted(shapes)}")
        rows, n = shapes[name]
        array = as_floats(name, value)
        given[name] = as_array(name, np.tile(array, (rows, 1)) if array.ndim <= 1 else array, (rows, n)).ravel()
    if problem.rate_limit is not None and "u_prev" not in given:
        raise InputError("u_prev", "nothing", "the last input", "The controller has a rate limit: pass u_prev.")
    if problem.rate_limit is None and "u_prev" in given:
        raise InputError("u_prev", "a last input", "none", "The controller has no rate limit: leave u_prev out.")
    return given


def for_each_state(problem: MPCProblem, signals: dict[str, Any], n: int) -> list[dict[str, Array]]:
    """The signals of n solves, the same for all but those that come with one entry for each."""
    each = {
        name: as_array(name, value, (n, *((problem.nu,) if name == "u_prev" else problem.signal_shapes[name])))
        for name, value in signals.items()
        if name in problem.signal_shapes and value is not None
        and as_floats(name, value).ndim == (2 if name == "u_prev" else 3)
    }  # fmt: skip
    if not each:
        return [spread_signals(problem, signals)] * n
    return [spread_signals(problem, signals | {name: rows[i] for name, rows in each.items()}) for i in range(n)]
