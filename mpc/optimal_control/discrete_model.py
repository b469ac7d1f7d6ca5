"""Discrete model along a whole plan in one call."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array
from mpc.optimal_control.functions import symbols_of


class Buffered:
    """CasADi function of arrays, one row per column, with buffers per thread.

    Parameters
    ----------
    function : casadi.Function
        With dense results.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._workspace = threading.local()

    def __getstate__(self) -> dict[str, Any]:
        """Fields without buffers: a copy makes its own."""
        return {"function": self.function}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]

    def __call__(self, *arguments: ArrayLike) -> tuple[Array, ...]:
        """Results of the function; a single row of an argument is repeated."""
        own = self._workspace.__dict__
        if not own:
            own.update(self._buffers())
        for into, value in zip(own["arguments"], arguments):
            into[...] = value
        own["evaluate"]()
        return tuple(value.copy() for value in own["results"])

    def _buffers(self) -> dict[str, Any]:
        """Buffers of arguments and results, in CasADi's column order."""
        f = self.function
        arguments = [np.zeros((f.size2_in(i), f.size1_in(i))) for i in range(f.n_in())]
        results = [np.zeros((f.size2_out(i), f.size1_out(i))) for i in range(f.n_out())]
        made: Any = f.buffer()
        buffer, evaluate = made
        for i, array in enumerate(arguments):
            if array.size:
                buffer.set_arg(i, memoryview(array.ravel()))  # type: ignore[arg-type]
        for i, array in enumerate(results):
            if array.size:
                buffer.set_res(i, memoryview(array.ravel()))  # type: ignore[arg-type]
        return {"buffer": buffer, "evaluate": evaluate, "arguments": arguments, "results": results}


class DiscreteModel:
    """x⁺ = f(x, u, w, p), evaluated along plans of N steps.

    Parameters
    ----------
    step : casadi.Function
        (x, u, w, p) → next state.
    horizon : int
        N.
    """

    def __init__(self, step: ca.Function, horizon: int) -> None:
        self.step = step
        self.horizon = horizon
        columns = list(symbols_of(step).values())
        value = ca.densify(step(*columns))
        derivatives = [ca.densify(ca.jacobian(value, column)) for column in columns[:3]]
        names = ["x", "u", "w", "p"]
        self.derivatives = ca.Function(
            "derivatives", columns, [value, *derivatives[:2]], names, ["next", "A", "B"], {"cse": True}
        )
        by_disturbance = ca.Function("by_disturbance", columns, [derivatives[2]], {"cse": True})
        self._at = Buffered(self.derivatives)
        self._by_disturbance = Buffered(by_disturbance)
        self._linearised = Buffered(self.derivatives.map("linearised", "serial", horizon, [3], []))
        self._along = Buffered(step.map("along", "serial", horizon, [3], []))
        self._one = Buffered(step)
        self._followed = Buffered(_following(step).mapaccum("followed", horizon))

    def linearised(self, states: Array, inputs: Array, w: Array, p: Array) -> tuple[Array, Array, Array]:
        """Next states (N, nx), A (N, nx, nx) and B (N, nx, nu) along a plan."""
        N, nx = states.shape
        f, A, B = self._linearised(states, inputs, w, p)
        A, B = A.reshape(N, nx, nx), B.reshape(N, -1, nx)
        return f, np.ascontiguousarray(A.transpose(0, 2, 1)), np.ascontiguousarray(B.transpose(0, 2, 1))

    def linearised_at(self, x: Array, u: Array, w: Array, p: Array) -> tuple[Array, Array, Array]:
        """Next state, A and B at one point."""
        f, A, B = self._at(x, u, w, p)
        return f[0], A.T, B.T

    def by_disturbance(self, x: Array, u: Array, w: Array, p: Array) -> Array:
        """Derivatives (nx, nw) of the next state by w."""
        return self._by_disturbance(x, u, w, p)[0].T

    def curvature(self, states: Array, inputs: Array, w: Array, p: Array, costates: Array) -> Array:
        """Second derivatives (N, nx + nu, nx + nu) of λ'f by (x, u)."""
        n = states.shape[1] + inputs.shape[1]
        return self._curvature(states, inputs, w, p, costates)[0].reshape(len(inputs), n, n)

    @cached_property
    def _curvature(self) -> Buffered:
        """Function of second derivatives, built on demand."""
        columns = list(symbols_of(self.step).values())
        kind = type(columns[0])
        costate = kind.sym("costate", self.step.numel_out(0))
        both = kind.sym("both", columns[0].numel() + columns[1].numel())
        state, action = both[: columns[0].numel()], both[columns[0].numel() :]
        found, _ = ca.hessian(ca.dot(costate, self.step(state, action, *columns[2:])), both)
        found = ca.substitute(found, both, ca.vertcat(*columns[:2]))
        function = ca.Function("curvature", [*columns, costate], [ca.densify(found)], {"cse": True})
        return Buffered(function.map("curvature_along", "serial", self.horizon, [3], []))

    def along(self, states: Array, inputs: Array, w: Array, p: Array) -> Array:
        """Next states (N, nx) along states, inputs and signals."""
        return self._along(states, inputs, w, p)[0]

    def next(self, x: Array, u: Array, w: Array, p: Array) -> Array:
        """Next state (nx,) at one point."""
        return np.asarray(self._one(x, u, w, p)[0][0])

    def followed(
        self, x: Array, last: Array, states: Array, inputs: Array, gains: Array, limits: tuple[Array, Array, Array],
        w: Array, p: Array,
    ) -> tuple[Array, Array]:  # fmt: skip
        """States (N + 1, nx) and inputs (N, nu) under limited u = v - K(x - s).

        Parameters
        ----------
        last : (nu,) array
            The input one step ago.
        states, inputs, gains : (N + 1, nx), (N, nu) and (N, nu, nx) arrays
            s, v and K.
        limits : three (nu,) arrays
            Least and largest input, and its largest change.
        """
        N, nu, nx = gains.shape
        start = np.concatenate([x, last])
        by_columns = gains.transpose(0, 2, 1).reshape(N, nx * nu)
        found = self._followed(start, inputs, states[:-1], by_columns, *limits, w, p)[0]
        return np.vstack([x, found[:, :nx]]), found[:, nx:]


def _following(step: ca.Function) -> ca.Function:
    """Function of one step under u⁺ = v - K(x - s) within limits."""
    nx, nu = step.numel_in(0), step.numel_in(1)
    own = symbols_of(step)
    w, p = own["w"], own["p"]
    kind = type(w)
    now = kind.sym("now", nx + nu)
    v, s = kind.sym("v", nu), kind.sym("s", nx)
    gain = kind.sym("gain", nx * nu)
    low, high, rate = (kind.sym(name, nu) for name in ("low", "high", "rate"))
    x, last = now[:nx], now[nx:]
    u = v - ca.reshape(gain, nu, nx) @ (x - s)
    u = ca.fmax(ca.fmax(low, last - rate), ca.fmin(ca.fmin(high, last + rate), u))
    then = ca.densify(ca.vertcat(step(x, u, w, p), u))
    return ca.Function("following", [now, v, s, gain, low, high, rate, w, p], [then])


class ModelDerivatives:
    """Derivatives of a model by x, u and p along a plan.

    Parameters
    ----------
    model : DiscreteModel
    """

    def __init__(self, model: DiscreteModel) -> None:
        step, horizon = model.step, model.horizon
        x, u, w, p = symbols_of(step).values()
        kind = type(x)
        costate = kind.sym("costate", x.numel())
        value = step(x, u, w, p)
        A, B, F = (ca.densify(ca.jacobian(value, column)) for column in (x, u, p))
        both = ca.vertcat(x, u)
        slope = ca.jtimes(value, both, costate, True) if kind is ca.SX else ca.gradient(ca.dot(costate, value), both)
        second = [ca.densify(ca.jacobian(slope, column)) for column in (both, p)]
        self.sizes = (x.numel(), u.numel(), w.numel(), p.numel())
        self.first = ca.Function("first", [x, u, w, p], [ca.densify(value), A, B, F]).map(horizon)
        self.second = ca.Function("second", [x, u, w, p, costate], second).map(horizon)
        mixed = [ca.densify(ca.jacobian(ca.vec(matrix), p)) for matrix in (A, B)]
        self._at_rest = ca.Function("at_rest", [x, u, w, p], mixed)

    def at_rest(self, p: Array) -> tuple[Array, Array]:
        """Derivatives ∂A/∂p (nx, nx, np) and ∂B/∂p (nx, nu, np) at rest."""
        nx, nu, nw, count = self.sizes
        found = self._at_rest(np.zeros(nx), np.zeros(nu), np.zeros(nw), p)
        dA, dB = (np.asarray(value, dtype=float) for value in found)
        return dA.reshape((nx, nx, count), order="F"), dB.reshape((nx, nu, count), order="F")

    def under(self, w: Array, p: Array) -> AlongSignals:
        """Model under signals (N, nw) with parameters (np,)."""
        return AlongSignals(self, w, p)


@dataclass(frozen=True, eq=False)
class AlongSignals:
    """Model under signals w (N, nw) with parameters p (np,)."""

    derivatives: ModelDerivatives
    w: Array
    p: Array

    def first(self, states: Array, inputs: Array) -> tuple[Array, Array, Array, Array]:
        """f (N, nx), ∂f/∂x, ∂f/∂u and ∂f/∂p (N, nx, ·)."""
        found = self.derivatives.first(states.T, inputs.T, self.w.T, np.tile(self.p[:, None], (1, len(inputs))))
        value, A, B, F = (_stacked(part, len(inputs)) for part in found)
        return value[:, :, 0], A, B, F

    def second(self, states: Array, inputs: Array, costates: Array) -> tuple[Array, Array]:
        """Second derivatives of Σ λ_i f_i by (x, u) and p, (N, nx + nu, ·)."""
        p = np.tile(self.p[:, None], (1, len(inputs)))
        curvature, mixed = self.derivatives.second(states.T, inputs.T, self.w.T, p, costates.T)
        return _stacked(curvature, len(inputs)), _stacked(mixed, len(inputs))


def _stacked(value: Any, count: int) -> Array:
    """Matrices (count, m, n) from one matrix (m, count · n)."""
    array = np.asarray(value, dtype=float)
    return array.reshape(len(array), count, -1).transpose(1, 0, 2)
