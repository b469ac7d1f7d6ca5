"""The unknowns of a phase in one vector: node, interval, node, …, node; their sizes, and where they start from."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mpc.checks import Array
from mpc.optimal_control.interval import Layout
from mpc.optimal_control.phase import Phase

Trajectory = Callable[[Array], tuple[Array, Array]]


def placed(layout: Layout, mesh: Array, trajectory: Trajectory) -> Array:
    """Unknowns (n,) of a phase, of a trajectory: fractions (k,) → states (k, nx) and inputs (k, nu)."""
    x, u = trajectory(mesh)
    nodes = np.hstack([x, u[:, : layout.node_inputs]])
    own = [np.zeros((len(mesh) - 1, 0))]
    for c in sorted({*layout.inner, *layout.held}):
        x, u = trajectory(mesh[:-1] + c * np.diff(mesh))
        own += [x] * (c in layout.inner) + [u] * (c in layout.held)
    return np.concatenate([np.hstack([nodes[:-1], *own]).ravel(), nodes[-1]])


def coordinates(layout: Layout, mesh: Array) -> tuple[Array, Array]:
    """What the unknowns (n,) of a phase are, states 0 … nx − 1 and then inputs, and the fractions at which they are."""
    width = layout.nx + layout.nu

    def numbers(at: Array) -> tuple[Array, Array]:
        every = np.tile(np.arange(width, dtype=float), (len(at), 1))
        return every[:, : layout.nx], every[:, layout.nx :]

    def fractions(at: Array) -> tuple[Array, Array]:
        every = np.tile(np.asarray(at)[:, None], (1, width))
        return every[:, : layout.nx], every[:, layout.nx :]

    return placed(layout, mesh, numbers), placed(layout, mesh, fractions)


def size_of(lower: Array, upper: Array, guess: Array) -> Array:
    """Sizes of unknowns: of their bounds, else of the guess, else 1."""
    bounded = np.isfinite(lower) & np.isfinite(upper)
    of_bounds = np.where(bounded, np.maximum(np.abs(lower), np.abs(upper)), 0.0)
    of_guess = np.abs(guess) if np.ndim(guess) <= 1 else np.abs(guess).max(axis=0)
    size = np.where(bounded, np.maximum(of_bounds, 0.0), of_guess)
    return np.asarray(np.where(size > 0, size, 1.0))


def first_duration(phase: Phase) -> float:
    """The duration to begin with."""
    low, high = phase.duration
    if phase.duration_guess is not None:
        return float(np.clip(phase.duration_guess, low, high))
    return float(np.sqrt(low * high)) if np.isfinite(high) else max(1.0, 2 * low)


def first_guess(phase: Phase) -> Trajectory:
    """Where a phase starts from: what the user gave, else straight from the start to the end, with inputs near zero."""
    if phase.guess is not None:
        return between(*phase.guess)
    first, last = (_known(*side) for side in (phase.start, phase.end))
    first, last = np.where(np.isnan(first), last, first), np.where(np.isnan(last), first, last)
    near_zero = np.clip(0.0, *phase.x_bounds)
    x = np.where(np.isnan([first, last]), near_zero, [first, last])
    return between(np.array([0.0, 1.0]), x, np.tile(np.clip(np.zeros(phase.inputs), *phase.u_bounds), (2, 1)))


def _known(low: Array, high: Array) -> Array:
    """The middle of bounds (nx,); NaN where there are not two."""
    both = np.isfinite(low) & np.isfinite(high)
    return np.where(both, 0.5 * (np.where(both, low, 0.0) + np.where(both, high, 0.0)), np.nan)


def between(times: Array, x: Array, u: Array) -> Trajectory:
    """Linear interpolation of states (n, nx) and inputs (n, nu)."""

    def trajectory(at: Array) -> tuple[Array, Array]:
        states, inputs = (
            np.array([np.interp(at, times, column) for column in part.T]).reshape(part.shape[1], len(at)).T
            for part in (x, u)
        )  # fmt: skip
        return states, inputs

    return trajectory
