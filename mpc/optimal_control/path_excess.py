"""How far limits along the path are exceeded between the points at which a program keeps them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mpc.checks import Array
from mpc.optimal_control.mesh_errors import evaluated
from mpc.optimal_control.phase_solution import PhaseSolution
from mpc.optimal_control.program import NonlinearProgram
from mpc.optimal_control.schemes import Collocation
from mpc.optimal_control.unknowns import coordinates

LOOKS = 16  # places an interval, and again about the largest excess
LEAST_SIZE = 0.01  # of a limit, beside its size in the program


class Excess(NamedTuple):
    """The largest excess of each limit of a phase between the points: of its path, then of its bounded states.

    What passes a limit by the polynomial of an input alone, as where an input jumps, counts by the part of the time
    that it lasts at most: what inputs do is felt by its integral.

    Attributes
    ----------
    value, time : (m,) arrays
        In the limit's unit, and when.
    relative : (m,) array
        Beside how much the limit changes there over the extent of states and inputs.
    intervals : (N,) array
        The largest relative excess within every interval.
    names : tuple of str
    """

    value: Array
    time: Array
    relative: Array
    intervals: Array
    names: tuple[str, ...]


def path_excess(program: NonlinearProgram, v: Array, phases: tuple[PhaseSolution, ...], p: Array) -> tuple[Excess, ...]:
    """By how much limits are exceeded between the points of the mesh, and when, of the unknowns (n,) of a program.

    Zero where they never are; of discrete dynamics there is nothing between.
    """
    return tuple(_excess(phase, p, sizes) for phase, sizes in zip(phases, _sizes(program, v, phases)))


def _excess(phase: PhaseSolution, p: Array, sizes: Array) -> Excess:
    """That of a phase whose limits have sizes (m, N)."""
    m, N = sizes.shape
    bounded = _bounded(phase)
    names = (*phase.part.functions.path_names, *np.asarray(phase.part.phase.state_names)[bounded].tolist())
    if not m or phase.part.phase.discrete:
        return Excess(np.zeros(m), np.full(m, phase.times[0]), np.zeros(m), np.zeros(N), names)
    tau = (np.arange(LOOKS) + 0.5) / LOOKS
    beyond = _beyond(phase, p, np.repeat(np.arange(N), LOOKS), np.tile(tau, N)).reshape(m, N, LOOKS)
    relative = beyond.max(axis=2) / sizes
    worst = relative.argmax(axis=1)
    rows = np.arange(m)
    first = tau[beyond[rows, worst].argmax(axis=1)]
    near = np.clip(first[:, None] + np.linspace(-1, 1, LOOKS + 1) / LOOKS, 0, 1)
    k = np.repeat(worst, LOOKS + 1)
    closer = _beyond(phase, p, k, near.ravel()).reshape(m, m, LOOKS + 1)[rows, rows]
    at = closer.argmax(axis=1)
    value = np.maximum(closer[rows, at], 0.0)
    relative[rows, worst] = value / sizes[rows, worst]
    times = phase.times[worst] + np.diff(phase.times)[worst] * near[rows, at]
    return Excess(value, times, relative[rows, worst], np.maximum(relative, 0.0).max(axis=0), names)


def _bounded(phase: PhaseSolution) -> Any:
    """The states that have bounds."""
    low, high = phase.part.phase.x_bounds
    return np.flatnonzero(np.isfinite(low) | np.isfinite(high))


def _beyond(phase: PhaseSolution, p: Array, k: Any, tau: Array) -> Array:
    """How far each limit is exceeded at fractions (n,) of intervals k (n,), (m, n)."""
    part, scheme = phase.part, phase.part.scheme
    x, u = phase.states_within(k, tau), np.clip(phase.inputs_within(k, tau), *part.phase.u_bounds)
    own = _bounded(phase)
    low, high = (side[own, None] for side in part.phase.x_bounds)
    of_states = np.maximum(x.T[own] - high, low - x.T[own])
    path = part.functions.path
    if path is None:
        return of_states
    h = np.diff(phase.times)[k]
    times = phase.times[k] + h * tau
    low, high = (side[:, None] for side in part.functions.path_bounds)

    def of_path(inputs: Array) -> Array:
        values = evaluated(path, phase, x, inputs, times, p).T
        values = np.maximum(values - high, low - values)
        return np.where(np.isnan(values), np.inf, values)

    passed = of_path(u)
    if isinstance(scheme, Collocation):
        lines = np.stack([np.interp(tau, scheme.points, one) for one in np.eye(scheme.stages)], axis=1)
        between = of_path(np.einsum("nj,nji->ni", lines, phase.stages.inputs[k]))
        passed = np.maximum(np.minimum(passed, between), passed * h / phase.duration)
    return np.vstack([passed, of_states])


def _sizes(program: NonlinearProgram, v: Array, phases: tuple[PhaseSolution, ...]) -> list[Array]:
    """Sizes (m, N) of the limits of every phase: how much they change with the extents of states and inputs."""
    extents = np.zeros(len(v))
    found, paths = [], []
    for part, phase in zip(program.parts, phases):
        numbers, _ = coordinates(part.layout, part.mesh)
        of_all = np.concatenate([np.ptp(phase.states, axis=0), np.ptp(phase.inputs, axis=0)])
        extents[part.first : part.last] = of_all[numbers.astype(int)]
        own = _bounded(phase)
        scale = np.array([program.scale[part.first : part.last][numbers == i].max() for i in own])
        size = np.maximum(of_all[own], LEAST_SIZE * scale)
        found.append(np.tile(size.reshape(-1, 1), (1, part.intervals)))
        paths.append(0 if part.functions.path is None or part.phase.discrete else part.functions.path.numel_out(0))
    if not any(paths):
        return found
    steep = abs(program.derivatives.jacobian[1](v)[1].sparse().multiply(extents)).tocsr().max(axis=1).toarray().ravel()
    for k, (part, m) in enumerate(zip(program.parts, paths)):
        if not m:
            continue
        count = part.intervals * part.interval.numel_out(2)
        local, scale = (value[part.path][:count].reshape(part.intervals, -1, m) for value in (steep, program.row_scale))
        found[k] = np.vstack([np.maximum(local.min(axis=1), LEAST_SIZE * scale.min(axis=1)).T, found[k]])
    return found
