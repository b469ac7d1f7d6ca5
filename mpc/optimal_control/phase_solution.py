"""One phase of a solution."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpc.budgets import LIMIT_CHECKS
from mpc.checks import Array, as_floats
from mpc.optimal_control.interval import layout_of, times_of
from mpc.optimal_control.phase import evaluated, interpolated, signal_along
from mpc.optimal_control.pieces import interval_function
from mpc.optimal_control.program import PhasePart
from mpc.optimal_control.schemes import Collocation, MultipleShooting


@dataclass(frozen=True, eq=False)
class Stages:
    """Values at the d points of every interval."""

    times: Array  # (N, d)
    states: Array  # (N, d, nx)
    inputs: Array  # (N, d, nu)
    along: Array  # (N, c, nx): states there; of shooting at both ends of every step of its integration
    rates: Array  # (N, c, nx): dx/dt at these


@dataclass(frozen=True, eq=False)
class PhaseSolution:
    """One phase of a solution.

    Attributes
    ----------
    times : (N + 1,) array
        Of the mesh [s].
    states : (N + 1, nx) array
    costates : (N + 1, nx) array
        How the optimal cost from there on changes with the state.
    stages : Stages
        What is known at the points of every interval.
    part : PhasePart
        The phase of the program that it solves.
    weight : float
        Of its cost.
    p : (np,) array
        The shared parameters.
    """

    times: Array
    states: Array
    costates: Array
    stages: Stages
    part: PhasePart
    weight: float
    p: Array

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.times[-1] - self.times[0])

    @property
    def inputs(self) -> Array:
        """Inputs (n, nu) at `input_times`."""
        N, d, _ = self.stages.inputs.shape  # nu may be 0
        return self.stages.inputs[:, :, : self._nu].reshape(N * d, self._nu)

    @property
    def _nu(self) -> int:
        """Inputs that are no algebraic variables."""
        return self.part.phase.inputs - self.part.phase.algebraics

    @property
    def input_times(self) -> Array:
        """Times (n,) at which inputs are unknowns."""
        return self.stages.times.ravel()

    def x(self, t: ArrayLike) -> Array:
        """States (..., nx) at times (...), held beyond both ends."""
        k, tau, shape = self._located(t)
        return self.states_within(k, tau).reshape(*shape, self.states.shape[1])

    def u(self, t: ArrayLike) -> Array:
        """Inputs (..., nu) at times (...)."""
        k, tau, shape = self._located(t)
        return self.inputs_within(k, tau)[:, : self._nu].reshape(*shape, self._nu)

    def z(self, t: ArrayLike) -> Array:
        """Algebraic variables (..., nz) at times (...)."""
        k, tau, shape = self._located(t)
        return self.inputs_within(k, tau)[:, self._nu :].reshape(*shape, self.part.phase.algebraics)

    def states_within(self, k: Any, tau: Array) -> Array:
        """States (n, nx) at fractions (n,) of intervals k (n,)."""
        h = np.diff(self.times)[k][:, None]
        if self.part.phase.discrete:
            return np.asarray(self.states[np.minimum(np.round(k + tau).astype(int), len(self.states) - 1)])
        if isinstance(self.part.scheme, Collocation):
            weights = self.part.scheme.integrals(tau)
            return np.asarray(self.states[k] + h * np.einsum("nj,nji->ni", weights, self.stages.rates[k]))
        steps, x, rates = self.stages.along.shape[1] - 1, self.stages.along, self.stages.rates
        j = np.minimum((tau * steps).astype(int), steps - 1)
        a = (tau * steps - j)[:, None]
        b = a - 1  # of the cubic that meets states and rates at both ends of a step
        ends = x[k, j] * (1 + 2 * a) * b**2 + x[k, j + 1] * a**2 * (3 - 2 * a)
        return np.asarray(ends + h / steps * (rates[k, j] * a * b**2 + rates[k, j + 1] * a**2 * b))

    def inputs_within(self, k: Any, tau: Array) -> Array:
        """Inputs and algebraic variables (n, nu + nz) at fractions (n,) of intervals k (n,)."""
        inputs = self.stages.inputs[k]
        if not isinstance(self.part.scheme, Collocation) or self.part.phase.discrete:
            return np.asarray(inputs[:, 0])
        inputs = np.asarray(np.einsum("nj,nji->ni", self.part.scheme.basis(tau), inputs))
        return self._with_solved_z(k, tau, inputs) if self.part.phase.algebraics and tau.size else inputs

    def _with_solved_z(self, k: Any, tau: Array, inputs: Array) -> Array:
        """Inputs (n, nu + nz) with z after one Newton step from the polynomials."""
        phase, f, z = self.part.phase, self.part.functions, slice(self._nu, None)
        rows = slice(len(f.path_names) - phase.algebraics, None)
        at = self.states_within(k, tau), inputs, self.times[k] + tau * np.diff(self.times)[k]
        slopes = self.evaluated(f.path_slopes, *at).reshape(len(inputs), -1, len(f.path_names))
        J = np.nan_to_num(slopes[:, phase.states :, rows][:, z].swapaxes(1, 2))
        step = np.linalg.pinv(J) @ self.evaluated(f.path, *at)[:, rows, None]
        return np.hstack([inputs[:, : self._nu], inputs[:, z] - step[:, :, 0]])

    def evaluated(self, function: ca.Function, x: Array, u: Array, t: Array) -> Array:
        """Values (n, m) of a function at n points."""
        return evaluated(function, self.part.phase, x, u, t, self.p)

    def at_fractions(self, at: Array) -> tuple[Array, Array]:
        """States and all inputs at fractions (n,) of the phase."""
        k, tau, _ = self._located(self.times[0] + at * self.duration)
        return self.states_within(k, tau), self.inputs_within(k, tau)

    def costate(self, t: ArrayLike) -> Array:
        """Costates (..., nx) at times (...), linear between the mesh points."""
        return interpolated(as_floats("t", t), self.times, self.costates)

    def _located(self, t: ArrayLike) -> tuple[Any, Array, tuple[int, ...]]:
        """Interval and fraction of each time, and the shape of the times."""
        given = as_floats("t", t)
        inside = np.clip(given.ravel(), self.times[0], self.times[-1])
        k = np.clip(np.searchsorted(self.times, inside, side="right") - 1, 0, len(self.times) - 2)
        return k, (inside - self.times[k]) / np.diff(self.times)[k], given.shape


def phase_solution(part: PhasePart, v: Array, p: Array, clock: tuple[float, float], multipliers: Array,
                   weight: float) -> PhaseSolution:  # fmt: skip
    """Phase solution from the unknowns (n,) of a program."""
    layout, N = part.layout, part.intervals
    start, length = clock
    nodes, own, *of_points = part.unknowns(v)
    x = nodes[: layout.nx]
    discrete = part.phase.discrete  # in whole steps
    mesh_times = start + (np.arange(N + 1.0) if discrete else length * part.mesh)
    times = mesh_times[:-1, None] if discrete else start + length * times_of(layout.points, part.mesh)
    h = np.ones(N) if discrete else length * np.diff(part.mesh)
    w = signal_along(part.phase, times_of(layout.signals, part.mesh))
    stage_states, stage_inputs = (np.stack(values, axis=0).transpose(2, 0, 1) for values in of_points)
    at, states, inputs = times, stage_states, stage_inputs
    if isinstance(part.scheme, MultipleShooting) and not discrete:
        steps = part.scheme.substeps if part.scheme.integrator == "rk4" else LIMIT_CHECKS
        states, _ = stepped(part, x[:, :-1], own, p, mesh_times, part.scheme, max(steps, rows_within(part)))
        at = start + length * times_of(np.linspace(0, 1, states.shape[1]).tolist(), part.mesh)
        inputs = np.repeat(inputs, states.shape[1], axis=1)
    flat_states, flat_inputs = (values.reshape(at.size, values.shape[2]) for values in (states, inputs))
    rates = evaluated(part.functions.dynamics, part.phase, flat_states, flat_inputs, at.ravel(), p)
    # costates are the Lagrangian's derivatives by the interval ends
    arguments = [x[:, :-1], nodes[layout.nx :, :-1], own, x[:, 1:], nodes[layout.nx :, 1:], p, mesh_times[None, :-1],
                 h[None], w.T]  # fmt: skip
    pushes = [multipliers[rows].reshape(N, -1).T for rows in (part.defects, part.path)]
    values = [np.zeros((part.interval.numel_out(i), N)) for i in range(3)]
    found = part.interval.reverse(1)(*arguments, *values, pushes[0], weight, pushes[1])
    costates = np.vstack([np.asarray(found[0], dtype=float).T, -np.asarray(found[3], dtype=float).T[-1:]])
    stages = Stages(times, stage_states, stage_inputs, states, rates.reshape(states.shape))
    return PhaseSolution(mesh_times, x.T, costates, stages, part, weight, p)


def rows_of_signal(part: PhasePart) -> int:
    """Rows of a signal's table, 1 without one."""
    signal = part.phase.signal
    return len(signal) if isinstance(signal, np.ndarray) else 1


def rows_within(part: PhasePart) -> int:
    """Rows of a signal's table within the longest interval, rounded up."""
    return int(np.ceil(np.diff(part.mesh).max() * (rows_of_signal(part) - 1)))


def stepped(part: PhasePart, x: Array, own: Array, p: Array, times: Array, scheme: MultipleShooting,
            count: int) -> tuple[Array, Array]:  # fmt: skip
    """States (N, count + 1, nx) by steps from states (nx, N), and costs (N,)."""
    one, none, h = replace(scheme, substeps=1), np.zeros((0, len(times) - 1)), np.diff(times) / count
    layout = layout_of(part.phase, part.layout.nw, one)
    step, states, cost = interval_function(part.phase, part.functions, one, layout, len(p)), [x], np.zeros(len(h))
    for j in range(count):
        w = signal_along(part.phase, times_of([(j + c) / count for c in layout.signals], part.mesh)).T
        found = step(states[-1], none, own, np.zeros(x.shape), none, p, (times[:-1] + j * h)[None], h[None], w)
        states.append(np.asarray(found[0], dtype=float))
        cost = cost + np.asarray(found[1], dtype=float).ravel()
    return np.stack(states, axis=0).transpose(2, 0, 1), cost
