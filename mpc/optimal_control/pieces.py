"""Pieces of a program: functions at many places of a mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mpc.checks import Array
from mpc.optimal_control.interval import Layout, at_points
from mpc.optimal_control.phase import Phase, PhaseFunctions
from mpc.optimal_control.schemes import Collocation, MultipleShooting, Scheme, runge_kutta

Numbers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Piece:
    """Function at M places, each value added to a row of [f; g]."""

    function: ca.Function  # (z (n,), data (d,)) → values (k,)
    unknowns: Numbers  # (n, M): which of all they are
    data: Array  # (d, M)
    rows: Numbers  # (k, M): where the values go: 0 is the cost f, 1 + i constraint i
    factors: Array  # (k,): that they are multiplied by

    @property
    def places(self) -> int:
        """Number M of places."""
        return int(self.unknowns.shape[1])

    @property
    def of_cost(self) -> NDArray[np.bool_]:
        """Whether each value (k,) is added to the cost."""
        return np.asarray(self.rows[:, 0] == 0)

    @property
    def symbols(self) -> tuple[Any, Any]:
        """z and data, of the kind of the function."""
        kind = kind_of(self.function)
        return kind.sym("z", self.unknowns.shape[0]), kind.sym("data", self.data.shape[0])


def kind_of(*functions: ca.Function | None) -> Any:
    """SX where all functions have scalar instructions, else MX."""
    return ca.SX if all(function is None or function.is_a("SXFunction") for function in functions) else ca.MX


def piece_of(values: Callable[..., Any], kind: Any, places: dict[str, Numbers], rows: Numbers, *,
             factors: Array | None = None, data: Array | None = None) -> Piece:  # fmt: skip
    """Piece of a function of named unknowns (n, M) or (n, 1) and data."""
    rows = rows.reshape(len(rows), -1)
    count = rows.shape[1]
    data = np.zeros((0, count)) if data is None else data
    factors = np.ones(len(rows)) if factors is None else factors
    z, given = kind.sym("z", sum(len(at) for at in places.values())), kind.sym("data", len(data))
    cuts = np.cumsum([0, *(len(at) for at in places.values())])
    columns = {name: z[int(a) : int(b)] for name, a, b in zip(places, cuts[:-1], cuts[1:])}
    value = ca.densify(ca.vertcat(*(ca.vec(kind(part)) for part in values(**columns, data=given))))
    function = ca.Function("piece", [z, given], [value], ["z", "data"], ["value"], {"cse": True})
    unknowns = np.vstack([np.broadcast_to(at.T, (count, len(at))).T for at in places.values()])
    return Piece(function, unknowns, data, rows, factors)


def interval_function(phase: Phase, functions: PhaseFunctions, scheme: Scheme, layout: Layout,
                      parameters: int) -> ca.Function:  # fmt: skip
    """Function (x, v, own, next x, next v, p, t, h, w) → defects, cost, path values.

    v are the inputs of a node, w the signal (nw, its points).
    """
    scalar = getattr(scheme, "integrator", "rk4") == "rk4"
    kind = kind_of(functions.dynamics, functions.stage_cost, functions.path) if scalar else ca.MX
    sizes = {
        "x": layout.nx, "v": layout.node_inputs, "own": layout.own, "x_next": layout.nx, "v_next": layout.node_inputs,
        "p": parameters, "t": 1, "h": 1, "w": layout.nw * len(layout.signals),
    }  # fmt: skip
    s: dict[str, Any] = {name: kind.sym(name, size) for name, size in sizes.items()}
    w = ca.reshape(s["w"], layout.nw, len(layout.signals))
    if isinstance(scheme, Collocation) and not phase.discrete:
        found = _collocate(functions, scheme, layout, s, w)
    else:
        found = _held(functions, None if phase.discrete else scheme, s, w)
    return ca.Function("interval", list(s.values()), [ca.densify(part) for part in found],
                       list(sizes), ["defects", "cost", "path"])  # fmt: skip


def _held(functions: PhaseFunctions, scheme: Any, s: dict[str, Any], w: Any) -> tuple[Any, Any, Any]:
    """Equations of an interval with the input held: of shooting, or without a scheme of a step of discrete dynamics."""
    u, p, t, h = s["own"], s["p"], s["t"], s["h"]

    def rate(z: Any, time: Any, signal: Any) -> Any:
        at = (z[:-1], u, signal, p, time)
        return ca.vertcat(functions.dynamics(*at), functions.cost_at(*at))

    z = ca.vertcat(s["x"], 0)
    if scheme is None:
        z = rate(z, t, w)
    elif scheme.integrator == "cvodes":
        z = _by_cvodes(functions, scheme, s, w)
    else:
        step = h / scheme.substeps
        for i in range(scheme.substeps):
            z = runge_kutta(rate, z, t + i * step, step, [w[:, 2 * i + k] for k in range(3)])
    return z[:-1] - s["x_next"], z[-1], functions.path_at(s["x"], u, w[:, 0], p, t)


def _by_cvodes(functions: PhaseFunctions, scheme: MultipleShooting, s: dict[str, Any], w: Any) -> Any:
    """State and cost after one interval by CVODES."""
    sizes = {name: s[name].numel() for name in ("x", "own", "p")} | {"w": w.numel(), "t": 1, "h": 1}
    c = {name: ca.MX.sym(name, size) for name, size in sizes.items()}
    tau = ca.MX.sym("tau")
    begin, middle, end_ = ca.horzsplit(ca.reshape(c["w"], -1, 3)) if w.numel() else [ca.MX(0, 1)] * 3
    signal = begin * (2 * tau - 1) * (tau - 1) + middle * 4 * tau * (1 - tau) + end_ * tau * (2 * tau - 1)
    at = (c["x"], c["own"], signal, c["p"], c["t"] + tau * c["h"])
    given = ca.vertcat(c["own"], c["p"], c["w"], c["t"], c["h"])
    rates = {"ode": c["h"] * functions.dynamics(*at), "quad": c["h"] * functions.cost_at(*at)}
    options = {"abstol": scheme.tolerance, "reltol": scheme.tolerance, "quad_err_con": True, "max_num_steps": 100_000,
               "disable_internal_warnings": True}  # fmt: skip
    integrate = ca.integrator("interval", "cvodes", {"x": c["x"], "p": given, "t": tau} | rates, 0.0, 1.0, options)
    end = integrate(x0=s["x"], p=ca.vertcat(s["own"], s["p"], ca.vec(w), s["t"], s["h"]))
    return ca.vertcat(end["xf"], end["qf"])


def _collocate(functions: PhaseFunctions, scheme: Collocation, layout: Layout, s: dict[str, Any],
               w: Any) -> tuple[Any, Any, Any]:  # fmt: skip
    """Equations of one collocation interval."""
    states, inputs = at_points(layout, s["x"], s["v"], s["own"], s["x_next"], s["v_next"])
    places = [
        (x, u, w[:, i], s["p"], s["t"] + c * s["h"]) for i, (c, x, u) in enumerate(zip(layout.points, states, inputs))
    ]
    weights = scheme.matrix
    moved = ca.mtimes(ca.horzcat(*(functions.dynamics(*at) for at in places)), ca.DM(weights.T)) * s["h"]
    later = [i for i, c in enumerate(layout.points) if c > 0]
    defects = [s["x"] + moved[:, i] - states[i] for i in later]
    cost = s["h"] * sum(float(b) * functions.cost_at(*at) for b, at in zip(weights[-1], places))
    return ca.vertcat(*defects), cost, ca.vertcat(*(functions.path_at(*places[i]) for i in later))
