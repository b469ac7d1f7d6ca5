"""Unknowns of a phase: their places on a mesh, bounds, guesses and sizes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mpc.checks import Array
from mpc.optimal_control.bounds import middle
from mpc.optimal_control.functions import slopes_of
from mpc.optimal_control.phase import Phase, PhaseFunctions, evaluated, interpolated
from mpc.optimal_control.schemes import MultipleShooting, Scheme
from mpc.tolerances import LEAST_MOVE

Trajectory = Callable[[Array], Sequence[Array]]


@dataclass(frozen=True)
class Layout:
    """Unknowns of an interval: its first node's, then its own."""

    nx: int
    nu: int
    nw: int
    node_inputs: int  # inputs at a node, shared by both its neighbours: nu or 0
    inner: tuple[float, ...]  # points of the interval, as fractions, with unknown states of their own
    held: tuple[float, ...]  # points with inputs of their own
    points: tuple[float, ...]  # where states and inputs are known, and limits along the path are kept
    signals: tuple[float, ...]  # where the signal is needed

    @property
    def node(self) -> int:
        """Unknowns of a node."""
        return self.nx + self.node_inputs

    @property
    def own(self) -> int:
        """Unknowns of an interval besides those of its nodes."""
        return len(self.inner) * self.nx + len(self.held) * self.nu

    @property
    def column(self) -> int:
        """Unknowns of an interval and its first node."""
        return self.node + self.own


def layout_of(phase: Phase, nw: int, scheme: Scheme) -> Layout:
    """Unknowns of an interval of a phase under a scheme."""
    sizes = (phase.states, phase.inputs, nw)
    if phase.discrete:
        return Layout(*sizes, 0, (), (0.0,), (0.0,), (0.0,))
    if isinstance(scheme, MultipleShooting):
        halves = 2 * scheme.substeps if scheme.integrator == "rk4" else 2
        return Layout(*sizes, 0, (), (0.0,), (0.0,), tuple(i / halves for i in range(halves + 1)))
    inner = tuple(c for c in scheme.points if 0 < c < 1)
    shared = phase.inputs if scheme.continuous_inputs else 0
    return Layout(*sizes, shared, inner, inner if shared else scheme.points, scheme.points, scheme.points)


def at_points(layout: Layout, x: Any, v: Any, own: Any, x_next: Any, v_next: Any) -> tuple[list[Any], list[Any]]:
    """States and inputs at every point of an interval."""
    states, inputs, used = [], [], 0
    for c in layout.points:
        if c in layout.inner:
            states.append(own[used : used + layout.nx])
            used += layout.nx
        else:
            states.append(x if c == 0 else x_next)
        if c in layout.held:
            inputs.append(own[used : used + layout.nu])
            used += layout.nu
        else:
            inputs.append(v if c == 0 else v_next)
    return states, inputs


def times_of(points: Sequence[float], mesh: Array) -> Array:
    """Fractions (N, points) of a phase for a mesh (N + 1,)."""
    return np.asarray(mesh[:-1, None] + np.diff(mesh)[:, None] * np.asarray(points))


def placed(layout: Layout, mesh: Array, trajectory: Trajectory) -> Array:
    """Unknowns (n,) from a trajectory: fractions (k,) → (k, nx) and (k, nu)."""
    x, u = trajectory(mesh)
    nodes = np.hstack([x, u[:, : layout.node_inputs]])
    own = [np.zeros((len(mesh) - 1, 0))]
    for c in sorted({*layout.inner, *layout.held}):
        x, u = trajectory(mesh[:-1] + c * np.diff(mesh))
        own += [x] * (c in layout.inner) + [u] * (c in layout.held)
    return np.concatenate([np.hstack([nodes[:-1], *own]).ravel(), nodes[-1]])


def coordinates(layout: Layout, mesh: Array) -> tuple[Any, Array]:
    """Coordinates (n,) of a phase's unknowns, states before inputs, and fractions."""
    width = layout.nx + layout.nu

    def numbers(at: Array) -> list[Array]:
        return np.split(np.tile(np.arange(width), (len(at), 1)), [layout.nx], axis=1)

    def fractions(at: Array) -> list[Array]:
        return np.split(np.tile(np.reshape(at, (-1, 1)), (1, width)), [layout.nx], axis=1)

    return placed(layout, mesh, numbers).astype(int), placed(layout, mesh, fractions)


def sized(lower: Array, upper: Array, guess: Array) -> tuple[Array, Array]:
    """Sizes of unknowns, by bounds, else by guesses (n,) or (k, n), and where they are counted from.

    An unknown is as large as its values, at most as a hundred times what they are apart; NaN where neither bounds nor
    guesses tell.
    """
    guess, bounded = np.atleast_2d(guess), np.isfinite(lower) & np.isfinite(upper)
    low, high = (np.where(bounded, *pair) for pair in ((lower, guess.min(axis=0)), (upper, guess.max(axis=0))))
    known = [np.where(np.isfinite(side), side, guess[0]) for side in (lower, upper)]
    apart = np.ptp(np.vstack([guess, *known]), axis=0)
    size = np.maximum(np.abs(low), np.abs(high))
    size = np.where(apart > 0, np.minimum(size, apart / LEAST_MOVE), size)
    size = np.where(size > 0, size, np.where(bounded, 1.0, np.nan))
    return size, counted_from(low, high, np.nan_to_num(size))


def counted_from(low: Any, high: Any, size: Any) -> Any:
    """Place nearest to 0 from which no value between two is larger than their size."""
    middle, room = (low + high) / 2, np.maximum(size - (high - low) / 2, 0.0)
    return np.clip(0.0, middle - room, middle + room)


def first_duration(phase: Phase) -> float:
    """First guess of the duration."""
    low, high = phase.duration
    if phase.duration_guess is not None:
        return float(np.clip(phase.duration_guess, low, high))
    return float(np.sqrt(low * high)) if np.isfinite(high) else max(1.0, 2 * low)


def first_guess(phase: Phase) -> Trajectory:
    """First guess of a phase: the user's, else a straight line."""
    if phase.guess is not None:
        times, x, u = phase.guess
        return lambda at: (interpolated(at, times, x), interpolated(at, times, u))
    first, last = middle(*phase.start), middle(*phase.end)
    first, last = np.where(np.isnan(first), last, first), np.where(np.isnan(last), first, last)
    near_zero = np.clip(0.0, *phase.x_bounds)
    x = np.where(np.isnan([first, last]), near_zero, [first, last])
    u = np.clip(np.zeros(phase.inputs), *phase.u_bounds)
    return lambda at: (interpolated(at, np.array([0.0, 1.0]), x), np.tile(u, (len(at), 1)))


def phase_unknowns(phase: Phase, functions: PhaseFunctions, parameters: Array, layout: Layout,
                   mesh: Array) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
    """Bounds, guess and sizes of the unknowns (n,) of a phase, and where they are counted from."""
    trajectory = first_guess(phase)
    x, u = trajectory(mesh)
    known = [np.where(np.isfinite(side), side, x[0]) for side in (*phase.start, *phase.end)]
    (x_low, x_high), (u_low, u_high) = phase.x_bounds, phase.u_bounds
    of_states, of_inputs = sized(x_low, x_high, np.vstack([x, *known])), sized(u_low, u_high, u)
    sizes, centre = (np.concatenate(pair) for pair in zip(of_states, of_inputs))
    if np.isnan(sizes).any():
        sizes = _sizes(phase, functions, parameters, mesh, x, u, sizes)
    numbers, _ = coordinates(layout, mesh)
    lower, upper = (np.concatenate(sides)[numbers] for sides in ((x_low, u_low), (x_high, u_high)))
    first, last = slice(layout.nx), slice(len(lower) - layout.node, len(lower) - layout.node_inputs)
    for place, (low, high) in ((first, phase.start), (last, phase.end)):
        lower[place] = np.maximum(lower[place], low)
        upper[place] = np.minimum(upper[place], high)
    return lower, upper, np.clip(placed(layout, mesh, trajectory), lower, upper), sizes[numbers], centre[numbers]


def _sizes(phase: Phase, functions: PhaseFunctions, parameters: Array, mesh: Array, x: Array, u: Array,
           sizes: Array) -> Array:  # fmt: skip
    """Sizes (nx + nu,) of states and inputs, some of them told, NaN the others.

    An unknown is as large as a state of known size needs it, to move by that over the phase or as fast as the rest
    of its dynamics makes it; failing that, a state is as large as it moves over the phase. Where the dynamics are flat
    at the guess, that is asked again beside it, by the sizes that are known.
    """
    times, dynamics = phase.start_time + first_duration(phase) * mesh, slopes_of(functions.dynamics)

    def steepness(aside: Array) -> Array:
        """Largest slopes (nx, nx + nu) of the dynamics, per phase, beside the guess."""
        slopes = evaluated(dynamics, phase, x + aside[: phase.states], u + aside[phase.states :], times, parameters)
        steep = np.abs(slopes).max(axis=0).reshape(-1, phase.states).T
        return np.where(np.isfinite(steep), steep, 0.0) * (1.0 if phase.discrete else first_duration(phase))

    told = np.isfinite(sizes)
    sizes, steep = np.where(told, sizes, 1.0), steepness(np.zeros(len(sizes)))
    for _ in range(2 * len(sizes)):
        if told.all():
            break
        with np.errstate(divide="ignore"):
            moves = np.maximum(sizes[: phase.states], (steep * (sizes * told)).max(axis=1))
            needed = np.where(told[: phase.states, None], moves[:, None] / steep, np.inf).min(axis=0)
        found = np.logical_not(told) & np.isfinite(needed)
        if not found.any():
            needed = np.zeros(len(sizes))
            needed[: phase.states] = (steep * (sizes * told)).max(axis=1)
            found = np.logical_not(told) & (needed > 0)
        sizes, told = np.where(found, needed, sizes), told | found
        if not found.any():
            before, steep = steep, steepness(sizes * told)
            if np.array_equal(before, steep):  # nothing is left to ask
                break
    return sizes
