"""Bounds, guess and sizes of the unknowns of a phase."""

from __future__ import annotations

import casadi as ca
import numpy as np

from mpc.checks import Array
from mpc.optimal_control.interval import Layout
from mpc.optimal_control.phase import Phase, PhaseFunctions, signal_at
from mpc.optimal_control.unknowns import between, first_duration, first_guess, placed, size_of


def phase_unknowns(phase: Phase, functions: PhaseFunctions, parameters: Array, layout: Layout,
                   mesh: Array) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Lower and upper bounds, guess and sizes of the unknowns (n,) of a phase, with parameters (np,) to begin with."""
    trajectory = first_guess(phase)
    x, u = trajectory(mesh)
    known = [np.where(np.isfinite(side), side, 0.0) for side in (*phase.start, *phase.end)]
    (x_low, x_high), (u_low, u_high) = phase.x_bounds, phase.u_bounds
    inputs, states = size_of(u_low, u_high, u), size_of(x_low, x_high, np.vstack([x, *known]))
    told = [
        (np.isfinite(low) & np.isfinite(high)) | (np.abs(values).max(axis=0, initial=0.0) > 0)
        for low, high, values in ((x_low, x_high, np.vstack([x, *known])), (u_low, u_high, u))
    ]
    if not (told[0].all() and told[1].all()):
        guess = np.concatenate([states, inputs]), np.concatenate(told)
        states, inputs = np.split(_sizes(phase, functions, parameters, mesh, x, u, *guess), [phase.states])
    sizes = states, inputs
    lower, upper, size = (
        placed(layout, mesh, between(np.zeros(1), side[0][None], side[1][None]))
        for side in (*zip(phase.x_bounds, phase.u_bounds), sizes)
    )
    first, last = slice(layout.nx), slice(len(lower) - layout.node, len(lower) - layout.node_inputs)
    for place, (low, high) in ((first, phase.start), (last, phase.end)):
        lower[place] = np.maximum(lower[place], low)
        upper[place] = np.minimum(upper[place], high)
    return lower, upper, np.clip(placed(layout, mesh, trajectory), lower, upper), size


def _sizes(phase: Phase, functions: PhaseFunctions, parameters: Array, mesh: Array, x: Array, u: Array, sizes: Array,
           told: Array) -> Array:  # fmt: skip
    """Sizes (nx + nu,) of states and inputs, some of them told: the others by how the dynamics join them.

    An unknown is as large as a state of known size needs it, to move by that over the phase or as fast as the rest
    of its dynamics makes it; failing that, a state is as large as it moves over the phase.
    """
    n = len(mesh)
    times = phase.start_time + first_duration(phase) * mesh
    p = np.tile(parameters[:, None], (1, n))
    w = signal_at(phase, phase.start_time + phase.duration[0] * mesh)
    columns = [ca.MX.sym(name, functions.dynamics.numel_in(i)) for i, name in enumerate("xuwpt")]
    both = ca.jacobian(functions.dynamics(*columns), ca.vertcat(*columns[:2]))
    slopes = ca.Function("slopes", columns, [ca.vec(ca.densify(both))]).map(n)(x.T, u.T, w.T, p, times[None])
    steep = np.abs(np.asarray(slopes, dtype=float)).max(axis=1).reshape(-1, phase.states).T
    steep = np.where(np.isfinite(steep), steep, 0.0) * (1.0 if phase.discrete else first_duration(phase))
    sizes, told = np.where(told, sizes, 1.0), told.copy()
    for _ in range(len(sizes)):
        with np.errstate(divide="ignore"):
            moves = np.maximum(sizes[: phase.states], (steep * (sizes * told)).max(axis=1))
            needed = np.where(told[: phase.states, None], moves[:, None] / steep, np.inf).min(axis=0)
        found = np.logical_not(told) & np.isfinite(needed)
        if not found.any():
            needed = np.zeros(len(sizes))
            needed[: phase.states] = (steep * (sizes * told)).max(axis=1)
            found = np.logical_not(told) & (needed > 0)
        sizes, told = np.where(found, needed, sizes), told | found
    return sizes
