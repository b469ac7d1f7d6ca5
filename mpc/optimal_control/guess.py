"""Where a phase starts from, as a user states it."""

from __future__ import annotations

from typing import Any

import numpy as np

from mpc.checks import Array, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.functions import brief

RISING = "rising fractions of the duration, from 0 to 1"


def as_guess(value: Any, states: int, inputs: int) -> tuple[Array, Array, Array]:
    """Times (n,) as fractions of the duration, states (n, nx) and inputs (n, nu)."""
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise InputError("guess", brief(repr(value)), "(times, x, u)")
    times, x, u = (as_floats("guess", part) for part in value)
    n = len(np.atleast_1d(times))
    if states == 1 and x.shape == (n,):
        x = x[:, None]
    if inputs == 1 and u.shape == (n,):
        u = u[:, None]
    shapes = ((n,), (n, states), (n, inputs))
    finite = all(np.isfinite(part).all() for part in (times, x, u))
    if (times.shape, x.shape, u.shape) != shapes or not finite:
        got = f"shapes {times.shape}, {x.shape}, {u.shape}" if finite else "numbers that are not finite"
        raise InputError(
            "guess", got, f"(n,) fractions, (n, {states}) states and (n, {inputs}) inputs, finite"
        )
    if not n or (np.diff(times) < 0).any():
        raise InputError("guess", "times that fall" if n else "no times", RISING)
    if times[0] < 0 or times[-1] > 1:
        raise InputError("guess", f"times from {times[0]:g} to {times[-1]:g}", RISING, "Divide them by the duration.")
    return times, x, u
