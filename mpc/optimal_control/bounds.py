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
    value = _as_pair(name, value)
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
    value = _as_pair("p_bounds", value)
    size = max(np.size(side) for side in value)
    return as_bounds("p_bounds", value, size)


def _as_pair(name: str, value: Any) -> Any:
    """Two sides of bounds."""
    given = tuple(value) if isinstance(value, np.ndarray) else value
    if not isinstance(given, list | tuple) or len(given) != 2:
        cure = "Each is a number or has one for every entry: pairs of every entry are ([lower, …], [upper, …])."
        raise InputError(name, brief(repr(value)), "bounds (lower, upper)", cure)
    return given


def as_end(name: str, value: Any, within: tuple[Array, Array]) -> tuple[Array, Array]:
    """Bounds of the states at an end, within those of the phase."""
    low, high = within
    size = len(low)
    if value is None:
        return low, high
    if isinstance(value, tuple) and len(value) == 2:
        if size == 2 and all(entry is None or np.ndim(entry) == 0 for entry in value) and value[0] != value[1]:
            cure = f"Write {list(value)} for the values, ([{value[0]}] * 2, [{value[1]}] * 2) for bounds."
            raise InputError(name, f"{value} for two states", "a list of values, or a tuple of bounds", cure)
        own = as_bounds(name, value, size)
    else:
        try:
            given = as_floats(name, [np.nan if entry is None else entry for entry in np.atleast_1d(value).tolist()])
        except TypeError:
            given = as_floats(name, value)
        if given.shape != (size,):
            raise InputError(
                name, f"shape {given.shape}", f"({size},), one number a state, or bounds as a tuple"
            )
        if np.isinf(given).any():
            raise InputError(name, given, "finite numbers; None where a state is free")
        own = np.where(np.isnan(given), -INF, given), np.where(np.isnan(given), INF, given)
    both = np.maximum(low, own[0]), np.minimum(high, own[1])
    cross = np.flatnonzero(both[0] > both[1])
    if len(cross):
        i = int(cross[0])
        got = f"[{own[0][i]:g}, {own[1][i]:g}] for state {i + 1}"
        raise InputError(name, got, f"a value within x_bounds [{low[i]:g}, {high[i]:g}]")
    return both


def as_duration(value: Any, discrete: bool) -> tuple[float, float]:
    """Least and largest duration."""
    raw = as_floats("duration", value)
    if raw.ndim == 0:
        raw = np.array([raw, raw])
    if raw.shape != (2,) or not np.isfinite(raw[0]) or not 0 < raw[0] <= raw[1]:
        cure = "A duration that may come to nothing has no mesh: bound it from below." if raw.size == 2 else ""
        raise InputError("duration", brief(repr(value)), "a number > 0, or bounds 0 < lower ≤ upper", cure)
    if discrete and (raw[0] != raw[1] or raw[0] % 1):
        raise InputError("duration", brief(repr(value)), "a whole number of steps, for discrete dynamics")
    return float(raw[0]), float(raw[1])
