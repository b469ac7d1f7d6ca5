"""How far the path limits of a phase are exceeded between the points at which a program keeps them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpc.checks import Array
from mpc.optimal_control.phase import signal_at
from mpc.optimal_control.phase_solution import PhaseSolution
from mpc.optimal_control.program import NonlinearProgram

LOOKS = 8  # places an interval


class Excess(NamedTuple):
    """The largest excess of each path limit, (m,), and when."""

    value: Array
    time: Array


def path_excess(phase: PhaseSolution, p: Array) -> Excess:
    """By how much each value of the path function is beyond its bounds between the points of the mesh, and when.

    Zero where it never is; of discrete dynamics there is nothing between.
    """
    times, beyond = _beyond(phase, p)
    flat = beyond.reshape(len(beyond), times.size)
    worst = flat.argmax(axis=1)
    return Excess(np.maximum(flat[np.arange(len(flat)), worst], 0.0), times.ravel()[worst])


def intervals_passed(program: NonlinearProgram, k: int, phase: PhaseSolution, p: Array) -> Array:
    """The largest excess of a path limit within every interval of phase k, in its size, (N,)."""
    sizes = path_sizes(program, k)
    if not len(sizes):
        return np.zeros(phase.part.intervals)
    _, beyond = _beyond(phase, p)
    return np.asarray((np.maximum(beyond, 0.0) / sizes[:, None, None]).max(axis=(0, 2)))


def path_sizes(program: NonlinearProgram, k: int) -> Array:
    """Sizes (m,) of the path limits of phase k; none where it has none."""
    path = program.problem.functions[k].path
    rows = next((one for one in program.rows if (one.name, one.phase) == ("path", k) and one.last > one.first), None)
    if path is None or rows is None:
        return np.zeros(0)
    return np.asarray(program.row_scale[rows.first : rows.first + path.numel_out(0)])


def _beyond(phase: PhaseSolution, p: Array) -> tuple[Array, Array]:
    """Times (N, `LOOKS`) between the points, and how far each value is beyond its bounds there, (m, N, `LOOKS`)."""
    inside = (np.arange(LOOKS) + 0.5) / LOOKS
    times = phase.times[:-1, None] + np.diff(phase.times)[:, None] * inside
    path = phase.part.functions.path
    if path is None or phase.part.phase.discrete:
        return times, np.zeros((0 if path is None else path.numel_out(0), *times.shape))
    low, high = phase.part.functions.path_bounds
    at = times.ravel()
    u = np.clip(phase.u(at), *phase.part.phase.u_bounds)
    given = np.tile(np.asarray(p)[:, None], (1, len(at)))
    w = signal_at(phase.part.phase, at)
    values = np.asarray(path.map(len(at))(phase.x(at).T, u.T, w.T, given, at[None]), dtype=float)
    beyond = np.maximum(values - high[:, None], low[:, None] - values)
    return times, np.nan_to_num(beyond).reshape(-1, *times.shape)
