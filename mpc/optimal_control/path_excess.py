"""How far the path limits of a phase are exceeded between the points at which a program keeps them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpc.checks import Array
from mpc.optimal_control.phase import signal_at
from mpc.optimal_control.phase_solution import PhaseSolution

LOOKS = 8  # places an interval


class Excess(NamedTuple):
    """The largest excess of one path limit, and when."""

    value: Array
    time: Array


def path_excess(phase: PhaseSolution, p: Array) -> Excess:
    """By how much each value of the path function is beyond its bounds between the points of the mesh, (m,), and when.

    Zero where it never is; of discrete dynamics there is nothing between.
    """
    path = phase.part.functions.path
    count = 0 if path is None else path.numel_out(0)
    if path is None or phase.part.phase.discrete:
        return Excess(np.zeros(count), np.full(count, phase.times[0]))
    inside = (np.arange(LOOKS) + 0.5) / LOOKS
    times = (phase.times[:-1, None] + np.diff(phase.times)[:, None] * inside).ravel()
    low, high = phase.part.functions.path_bounds
    u = np.clip(phase.u(times), *phase.part.phase.u_bounds)
    w = signal_at(phase.part.phase, times)
    given = np.tile(np.asarray(p)[:, None], (1, len(times)))
    values = np.asarray(path.map(len(times))(phase.x(times).T, u.T, w.T, given, times[None]), dtype=float)
    beyond = np.maximum(values - high[:, None], low[:, None] - values)
    worst = beyond.argmax(axis=1)
    return Excess(np.maximum(beyond[np.arange(count), worst], 0.0), times[worst])
