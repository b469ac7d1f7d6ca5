"""The optional arguments of a solve, checked and spread over the horizon."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array, as_array, as_floats
from mpc.exceptions import InputError

if TYPE_CHECKING:
    from mpc.linear_mpc import LinearMPC


def spread_signals(mpc: LinearMPC, signals: dict[str, ArrayLike | None]) -> dict[str, Array]:
    """Each given signal as one flat array; a single row is held over the horizon.

    Raises
    ------
    InputError
        An unknown name, a wrong shape, NaN, or a signal the controller was not built for.
    """
    N, nw = mpc.horizon, 0 if mpc.E is None else mpc.E.shape[1]
    shapes = {"u_prev": (1, mpc.nu), "x_ref": (N + 1, mpc.nx), "u_ref": (N, mpc.nu), "w": (N, nw)}
    given: dict[str, Array] = {}
    for name, value in signals.items():
        if value is None:
            continue
        if name not in shapes:
            raise InputError(f"unknown signal {name!r}, expected some of {sorted(shapes)}.")
        if name == "w" and nw == 0:
            raise InputError("w was given, but the controller has no disturbance matrix E.")
        rows, n = shapes[name]
        array = as_floats(name, value)
        given[name] = as_array(name, np.tile(array, (rows, 1)) if array.ndim <= 1 else array, (rows, n)).ravel()
    if (mpc.rate_limit is not None) != ("u_prev" in given):
        got, cure = ("not given", "pass") if mpc.rate_limit is not None else ("given", "leave out")
        raise InputError(f"u_prev was {got}: {cure} it, it belongs to a controller with a rate_limit.")
    return given


def for_each_state(mpc: LinearMPC, signals: dict[str, Any], n: int) -> list[dict[str, Array]]:
    """The signals of n solves: the same for all, but for last inputs of shape (n, nu), one for each."""
    last = signals.get("u_prev")
    if last is None or as_floats("u_prev", last).ndim != 2:
        return [spread_signals(mpc, signals)] * n
    return [spread_signals(mpc, signals | {"u_prev": row}) for row in as_array("u_prev", last, (n, mpc.nu))]
