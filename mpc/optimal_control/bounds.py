"""Bounds as a user states them: numbers, None where there is none, one for all entries or one each."""

from __future__ import annotations

from typing import Any

import numpy as np

from mpc.checks import Array, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.functions import brief

Bounds = Any
INF = np.inf


def as_bounds(name: str, value: Any, size: int) -> tuple[Array, Array]:
    """Bounds (lower, upper), each (size,); infinite or None where there is none."""
    if value is None:
        return np.full(size, -INF), np.full(size, INF)
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise InputError(name, brief(repr(value)), "bounds (lower, upper)")
    sides = []
    for side, given, none in zip(("lower", "upper"), value, (-INF, INF)):
        entries = [none if entry is None else entry for entry in given] if isinstance(given, list | tuple) else given
        array = as_floats(f"{name}, {side}", none if entries is None else entries)
        if array.ndim == 0:
            array = np.full(size, float(array))
        if array.shape != (size,) or np.isnan(array).any():
            raise InputError(f"{name}, {side}", brief(repr(given)), f"a number, or {size} of them")
        sides.append(array)
    low, high = sides
    wrong = np.flatnonzero((low > high) | (low == INF) | (high == -INF))
    if len(wrong):
        i = int(wrong[0])
        raise InputError(
            name, f"[{low[i]:g}, {high[i]:g}] for entry {i + 1}", "lower ≤ upper, with a number between them"
        )
    return low, high


def as_parameter_bounds(value: Any) -> tuple[Array, Array]:
    """Bounds of the parameters, whose number they tell."""
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise InputError("p_bounds", brief(repr(value)), "bounds (lower, upper)")
    size = max(np.size(side) for side in value)
    return as_bounds("p_bounds", value, size)
