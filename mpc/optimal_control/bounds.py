"""Bounds, names and guesses as a user states them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ccdtools_ground import door
from ccdtools_ground.door import brief
from mpc.checks import Array, as_array, as_floats
from mpc.exceptions import InputError
from mpc.tolerances import ROUNDED_SUM

Bounds = Any
INF = np.inf
RISING = "rising fractions of the duration, from 0 to 1"


def as_bounds(name: str, value: Any, size: int | None, *, crossing: bool = False) -> tuple[Array, Array]:
    """Bounds (lower, upper), each (size,).

    Infinite where None or, apart, beyond 1e19; without a size they tell it.
    """
    if value is None:
        return np.full(size or 0, -INF), np.full(size or 0, INF)
    value = tuple(value) if isinstance(value, np.ndarray) else value
    if not isinstance(value, list | tuple) or len(value) != 2:
        cure = "Each is a number or has one for every entry: pairs of every entry are ([lower, …], [upper, …])."
        raise InputError(name, brief(repr(value)), "bounds (lower, upper)", cure)
    size = max(np.size(side) for side in value) if size is None else size
    sides = []
    for side, given, none in zip(("lower", "upper"), value, (-INF, INF)):
        entries = [none if entry is None else entry for entry in given] if isinstance(given, list | tuple) else given
        array = as_floats(f"{name}, {side}", none if entries is None else entries)
        if array.ndim == 0:
            array = np.full(size, float(array))
        if array.shape != (size,) or np.isnan(array).any():
            raise InputError(f"{name}, {side}", brief(repr(given)), f"a number, or {size} of them")
        sides.append(array)
    apart = sides[0] != sides[1]  # as Ipopt has it
    low, high = (np.where(apart & (np.abs(one) >= 1e19), np.copysign(INF, one), one) for one in sides)
    wrong = np.flatnonzero(((low > high) | (low == INF) | (high == -INF)) & (not crossing))
    if len(wrong):
        i = int(wrong[0])
        raise InputError(
            name, f"[{low[i]:g}, {high[i]:g}] for entry {i + 1}", "lower ≤ upper, with a number between them"
        )
    return low, high


def as_prices(value: Any, size: int) -> Array:
    """Linear and quadratic prices (2, size) of violations; infinite where None."""
    if value is not None and not size:
        raise InputError("path_prices", brief(repr(value)), "a function `path`, whose violations they are of")
    expected = f"(linear, quadratic), each a number ≥ 0 or {size} of them, both None where hard, not both 0"
    try:
        given = np.stack(as_bounds("path_prices", value, size, crossing=True))
    except InputError as error:
        raise InputError("path_prices", error.got, expected) from None
    hard = np.isinf(given)
    if (given[~hard] < 0).any() or (given == 0).all(axis=0).any() or (hard[0] != hard[1]).any():
        raise InputError("path_prices", brief(repr(value)), expected)
    return np.where(hard, INF, given)


def check_within(name: str, value: Any, limits: str, within: tuple[Any, Any]) -> None:
    """Raise where numbers are beyond their limits, by more than rounding."""
    low, high = within
    if (np.maximum(low - value, value - high) > ROUNDED_SUM * np.abs(value)).any():
        raise InputError(name, value, f"one within {limits}, {low} to {high}")


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
            raise InputError(name, f"shape {given.shape}", f"({size},), one number a state, or bounds as a tuple")
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
    pair = isinstance(value, tuple | list) and len(value) == 2 and value[1] is None
    raw = as_floats("duration", (value[0], INF) if pair else value)
    if raw.ndim == 0:
        raw = np.array([raw, raw])
    if raw.shape != (2,) or not np.isfinite(raw[0]) or not 0 < raw[0] <= raw[1]:
        cure = "A duration that may come to nothing has no mesh: bound it from below." if raw.size == 2 else ""
        raise InputError("duration", brief(repr(value)), "a number > 0, or bounds 0 < lower ≤ upper", cure)
    if discrete and (raw[0] != raw[1] or raw[0] % 1):
        raise InputError("duration", brief(repr(value)), "a whole number of steps, for discrete dynamics")
    return float(raw[0]), float(raw[1])


def as_names(name: str, value: Any, usual: str, size: int) -> tuple[str, ...]:
    """Names, `size` of them; by default `usual` and a number."""
    names = door.as_names(name, tuple(value) if isinstance(value, list) else value, size, usual)
    if len(set(names)) < size:
        double = next(entry for entry in names if names.count(entry) > 1)
        raise InputError(name, f"{double!r} twice", "names that differ")
    return names


def middle(low: Array, high: Array) -> Array:
    """Middle (n,) of bounds; NaN without two."""
    with np.errstate(invalid="ignore"):
        found = 0.5 * (low + high)
    return np.where(np.isfinite(found), found, np.nan)


def as_guess(value: Any, states: int, inputs: int) -> tuple[Array, Array, Array]:
    """Times (n,) as fractions of the duration, states (n, nx) and inputs (n, nu)."""
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise InputError("guess", brief(repr(value)), "(times, x, u)")
    times = as_array("guess", value[0], (None,))
    n = len(times)
    given = ((as_floats("guess", part), size) for part, size in zip(value[1:], (states, inputs)))
    x, u = (as_array("guess", part[:, None] if part.shape == (n,) and size == 1 else part, (n, size))
            for part, size in given)  # fmt: skip
    if not n or (np.diff(times) < 0).any():
        raise InputError("guess", "times that fall" if n else "no times", RISING)
    if times[0] < 0 or times[-1] > 1:
        raise InputError("guess", f"times from {times[0]:g} to {times[-1]:g}", RISING, "Divide them by the duration.")
    return times, x, u


def as_samples(value: Any, cost: Any, duration: tuple[float, float], discrete: bool) -> tuple[Array, Array] | None:
    """Rising times (n,) within a given duration, and values (n, m) known there; None without their cost."""
    if (value is None) != (cost is None):
        raise InputError(
            "samples", f"{'no ' * (value is None)}samples{' without' * (cost is None)} sample_cost", "both"
        )
    if value is None:
        return None
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise InputError("samples", brief(repr(value)), "(times, values)")
    times = as_array("samples", value[0], ("n",))
    values = as_array("samples", value[1], (len(times), None))
    if duration[0] != duration[1]:
        raise InputError("samples", "a duration that is free", "a given duration")
    if (np.diff(times) <= 0).any() or times[0] < 0 or times[-1] > duration[0] or (discrete and (times % 1).any()):
        expected = f"rising times within 0 and {duration[0]:g}" + (", whole steps" if discrete else "")
        raise InputError("samples", brief(str(times)), expected)
    return times, values
