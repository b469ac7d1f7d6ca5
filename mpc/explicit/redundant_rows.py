"""Rows of a parametric QP that the others imply: each is left out only where multipliers prove it."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import daqp
import numpy as np

from mpc.checks import Array
from mpc.explicit.scaled_qp import ScaledQP
from mpc.tolerances import REDUNDANT

Ints = np.ndarray[Any, np.dtype[np.int64]]

_ITERATIONS = 3  # steps of a linear program that are waited for, in numbers of its rows and columns


class NeededRows(NamedTuple):
    """Rows of M that the others are not known to imply, and whether all rows were looked at."""

    rows: Ints
    finished: bool


def irredundant_rows(qp: ScaledQP, deadline: float = np.inf) -> NeededRows:
    """Rows of M without those that the others imply, also where they touch the set.

    A row is kept in doubt, and when it was not looked at before the deadline, `time.perf_counter()` [s].
    """
    J, h = qp.joint
    kept = np.ones(len(J), dtype=bool)
    finished = True
    for i in reversed(range(len(qp.M))):
        finished = time.perf_counter() <= deadline
        if not finished:
            break
        kept[i] = False
        kept[i] = not is_implied(J[i], float(h[i]), J[kept], h[kept])
    return NeededRows(np.flatnonzero(kept[: len(qp.M)]), finished)


def is_implied(row: Array, bound: float, J: Array, h: Array) -> bool:
    """Whether multipliers y >= 0 prove row x <= bound for all Jx <= h: row = y'J and y'h <= bound, to rounding."""
    # the point that lies farthest across the row, within one unit of it
    normals = np.ascontiguousarray(np.vstack([J, row]))
    bounds = np.append(h, bound + 1.0)
    most = _ITERATIONS * sum(normals.shape)
    point, _, flag, info = daqp.solve(
        None, np.ascontiguousarray(-row), normals, bounds, np.full(len(bounds), -1e30), iter_limit=most
    )
    if flag != 1 or not row @ point <= bound + REDUNDANT:
        return False
    y = np.maximum(info["lam"][:-1], 0.0)
    return _proves(y, row, bound, J, h, point) or _proves(_refined(y, row, J), row, bound, J, h, point)


def _refined(y: Array, row: Array, J: Array) -> Array:
    """Multipliers of the same rows that combine them to `row` as exactly as these can."""
    active = np.flatnonzero(y)
    refined = np.zeros(len(y))
    refined[active] = np.maximum(np.linalg.lstsq(J[active].T, row, rcond=None)[0], 0.0)
    return refined


def _proves(y: Array, row: Array, bound: float, J: Array, h: Array, point: Array) -> bool:
    """Whether y'J is the row, over points of the size of this one, and y'h its bound."""
    missed = np.abs(row - y @ J) @ (1.0 + np.abs(point))
    return bool(y @ h + missed <= bound + REDUNDANT)
