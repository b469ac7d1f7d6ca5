"""Admissible intervals of a single input at many states.

Everything is vectorised over the states, in units in which a violation of one is "the extent of the set away".
"""

from __future__ import annotations

import numpy as np

from invariant_sets.tolerances import ROUNDING

Array = np.ndarray


def nearest_inputs(
    slope: Array, room: Array, lower: float | Array, upper: float | Array, wanted: Array
) -> tuple[Array, Array]:
    """Inputs (k,) nearest to `wanted` (k,) with slope·v <= room, lower <= v <= upper, and their worst violations.

    Where no input meets all rows, the one with the least violation, and nearest to the wanted one among those; a
    negative violation is inside.

    Parameters
    ----------
    slope, room : (k, m) arrays
        Rows at each state; finite.
    lower, upper : float or (k,) array
        Bounds of the input.
    wanted : (k,) array
        Proposed inputs.
    """
    low, high = _interval(slope, room, lower, upper)
    empty = np.flatnonzero(low > high)
    if len(empty):
        level = np.zeros((len(room), 1))
        ends = (np.broadcast_to(end, len(room))[empty] for end in (lower, upper))
        level[empty, 0] = _least_level(slope[empty], room[empty], *ends)
        low, high = _interval(slope, room + level, lower, upper)
    middle = np.clip((low + high) / 2, lower, upper)
    crossed = low > high
    low = np.where(crossed, middle, low)
    high = np.where(crossed, middle, high)
    v = np.clip(np.clip(wanted, low, high), lower, upper)
    return v, (slope * v[:, None] - room).max(axis=1, initial=-np.inf)


def _interval(slope: Array, room: Array, lower: float | Array, upper: float | Array) -> tuple[Array, Array]:
    """Ends of {v : slope v <= room}, lower above upper if empty."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        bound = room / slope
    high = np.where(slope > ROUNDING, bound, np.inf).min(axis=1, initial=np.inf)
    low = np.where(slope < -ROUNDING, bound, -np.inf).max(axis=1, initial=-np.inf)
    return np.maximum(low, lower), np.minimum(high, upper)


def _least_level(slope: Array, room: Array, lower: Array, upper: Array) -> Array:
    """Least violation of the moving rows by some input, by bisection."""
    moving = np.where(np.abs(slope) > ROUNDING, slope * ((lower + upper) / 2)[:, None] - room, -np.inf)
    top: Array = np.maximum(moving.max(axis=1, initial=0.0), 0.0)
    bottom = np.zeros(len(top))
    for _ in range(110):  # from the largest double that is used down to rounding
        middle = (bottom + top) / 2
        low, high = _interval(slope, room + middle[:, None], lower, upper)
        top = np.where(low <= high, middle, top)
        bottom = np.where(low <= high, bottom, middle)
    return top
