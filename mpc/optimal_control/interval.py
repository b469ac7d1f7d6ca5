"""Unknowns of a phase and equations of one mesh interval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array
from mpc.optimal_control.phase import Phase, PhaseFunctions
from mpc.optimal_control.schemes import Collocation, MultipleShooting, Scheme, runge_kutta

Trajectory = Callable[[Array], tuple[Array, Array]]


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


def interval_function(phase: Phase, functions: PhaseFunctions, scheme: Scheme, layout: Layout,
                      parameters: int) -> ca.Function:  # fmt: skip
    """Function (x, v, own, next x, next v, p, t, h, w) → defects, cost, path values.

    v are the inputs of a node, w the signal (nw, its points).
    """
    scalar = all(
        function is None or function.is_a("SXFunction")
        for function in (functions.dynamics, functions.stage_cost, functions.path)
    ) and getattr(scheme, "integrator", "rk4") == "rk4"  # fmt: skip
    kind = ca.SX if scalar else ca.MX
    sizes = {
        "x": layout.nx, "v": layout.node_inputs, "own": layout.own, "x_next": layout.nx, "v_next": layout.node_inputs,
        "p": parameters, "t": 1, "h": 1, "w": layout.nw * len(layout.signals),
    }  # fmt: skip
    s: dict[str, Any] = {name: kind.sym(name, size) for name, size in sizes.items()}
    w = ca.reshape(s["w"], layout.nw, len(layout.signals))
    if phase.discrete:
        defects, cost, path = _step(functions, s, w)
    elif isinstance(scheme, MultipleShooting):
        defects, cost, path = _shoot(functions, scheme, s, w)
    else:
        defects, cost, path = _collocate(functions, scheme, layout, s, w)
    return ca.Function("interval", list(s.values()), [ca.densify(part) for part in (defects, cost, path)],
                       list(sizes), ["defects", "cost", "path"])  # fmt: skip


def _step(functions: PhaseFunctions, s: dict[str, Any], w: Any) -> tuple[Any, Any, Any]:
    """Equations of one step of discrete dynamics."""
    at = (s["x"], s["own"], w, s["p"], s["t"])
    cost = functions.stage_cost(*at) if functions.stage_cost else 0
    path = functions.path(*at) if functions.path else type(w)(0, 1)
    return functions.dynamics(*at) - s["x_next"], cost, path


def _shoot(functions: PhaseFunctions, scheme: MultipleShooting, s: dict[str, Any], w: Any) -> tuple[Any, Any, Any]:
    """Equations of one shooting interval, with the input held."""
    u, p, t, h = s["own"], s["p"], s["t"], s["h"]

    def rate(z: Any, time: Any, signal: Any) -> Any:
        at = (z[:-1], u, signal, p, time)
        return ca.vertcat(functions.dynamics(*at), functions.stage_cost(*at) if functions.stage_cost else 0)

    z = ca.vertcat(s["x"], 0)
    if scheme.integrator == "rk4":
        step = h / scheme.substeps
        for i in range(scheme.substeps):
            z = runge_kutta(rate, z, t + i * step, step, [w[:, 2 * i + k] for k in range(3)])
    else:
        z = _by_cvodes(functions, scheme, s, w)
    path = functions.path(s["x"], u, w[:, 0], p, s["t"]) if functions.path else type(w)(0, 1)
    return z[:-1] - s["x_next"], z[-1], path


def _by_cvodes(functions: PhaseFunctions, scheme: MultipleShooting, s: dict[str, Any], w: Any) -> Any:
    """State and cost after one interval by CVODES."""
    sizes = {name: s[name].numel() for name in ("x", "own", "p")} | {"w": w.numel(), "t": 1, "h": 1}
    c = {name: ca.MX.sym(name, size) for name, size in sizes.items()}
    tau = ca.MX.sym("tau")
    begin, middle, end_ = ca.horzsplit(ca.reshape(c["w"], -1, 3)) if w.numel() else [ca.MX(0, 1)] * 3
    signal = begin * (2 * tau - 1) * (tau - 1) + middle * 4 * tau * (1 - tau) + end_ * tau * (2 * tau - 1)
    at = (c["x"], c["own"], signal, c["p"], c["t"] + tau * c["h"])
    cost = functions.stage_cost(*at) if functions.stage_cost else 0
    given = ca.vertcat(c["own"], c["p"], c["w"], c["t"], c["h"])
    dae = {"x": c["x"], "p": given, "t": tau, "ode": c["h"] * functions.dynamics(*at), "quad": c["h"] * cost}
    options = {"abstol": scheme.tolerance, "reltol": scheme.tolerance, "quad_err_con": True, "max_num_steps": 100_000,
               "disable_internal_warnings": True}  # fmt: skip
    integrate = ca.integrator("interval", "cvodes", dae, 0.0, 1.0, options)
    end = integrate(x0=s["x"], p=ca.vertcat(s["own"], s["p"], ca.vec(w), s["t"], s["h"]))
    return ca.vertcat(end["xf"], end["qf"])


def _collocate(functions: PhaseFunctions, scheme: Collocation, layout: Layout, s: dict[str, Any],
               w: Any) -> tuple[Any, Any, Any]:  # fmt: skip
    """Equations of one collocation interval."""
    states, inputs = at_points(layout, s["x"], s["v"], s["own"], s["x_next"], s["v_next"])
    rates, costs, path = [], [], []
    for i, c in enumerate(layout.points):
        at = (states[i], inputs[i], w[:, i], s["p"], s["t"] + c * s["h"])
        rates.append(functions.dynamics(*at))
        costs.append(functions.stage_cost(*at) if functions.stage_cost else 0)
        if functions.path and c > 0:
            path.append(functions.path(*at))
    weights = scheme.matrix
    moved = ca.mtimes(ca.horzcat(*rates), ca.DM(weights.T)) * s["h"]
    defects = [s["x"] + moved[:, i] - states[i] for i, c in enumerate(layout.points) if c > 0]
    cost = s["h"] * sum(float(b) * value for b, value in zip(weights[-1], costs))
    return ca.vertcat(*defects), cost, ca.vertcat(*path) if path else type(w)(0, 1)


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


def coordinates(layout: Layout, mesh: Array) -> tuple[Array, Array]:
    """Coordinates (n,) of a phase's unknowns, states before inputs, and fractions."""
    width = layout.nx + layout.nu

    def numbers(at: Array) -> tuple[Array, Array]:
        every = np.tile(np.arange(width, dtype=float), (len(at), 1))
        return every[:, : layout.nx], every[:, layout.nx :]

    def fractions(at: Array) -> tuple[Array, Array]:
        every = np.tile(np.asarray(at)[:, None], (1, width))
        return every[:, : layout.nx], every[:, layout.nx :]

    return placed(layout, mesh, numbers), placed(layout, mesh, fractions)


def size_of(lower: Array, upper: Array, guess: Array) -> Array:
    """Sizes of unknowns by bounds, else guess, else 1."""
    bounded = np.isfinite(lower) & np.isfinite(upper)
    of_bounds = np.where(bounded, np.maximum(np.abs(lower), np.abs(upper)), 0.0)
    of_guess = np.abs(guess) if np.ndim(guess) <= 1 else np.abs(guess).max(axis=0)
    size = np.where(bounded, np.maximum(of_bounds, 0.0), of_guess)
    return np.asarray(np.where(size > 0, size, 1.0))


def first_duration(phase: Phase) -> float:
    """First guess of the duration."""
    low, high = phase.duration
    if phase.duration_guess is not None:
        return float(np.clip(phase.duration_guess, low, high))
    return float(np.sqrt(low * high)) if np.isfinite(high) else max(1.0, 2 * low)


def first_guess(phase: Phase) -> Trajectory:
    """First guess of a phase: the user's, else a straight line."""
    if phase.guess is not None:
        return between(*phase.guess)
    first, last = (_known(*side) for side in (phase.start, phase.end))
    first, last = np.where(np.isnan(first), last, first), np.where(np.isnan(last), first, last)
    near_zero = np.clip(0.0, *phase.x_bounds)
    x = np.where(np.isnan([first, last]), near_zero, [first, last])
    return between(np.array([0.0, 1.0]), x, np.tile(np.clip(np.zeros(phase.inputs), *phase.u_bounds), (2, 1)))


def _known(low: Array, high: Array) -> Array:
    """Middle of bounds (nx,); NaN without two."""
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
