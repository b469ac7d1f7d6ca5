"""Discrete model along a whole plan in one call."""

from __future__ import annotations

import threading
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array
from mpc.optimal_control.functions import symbols_of
from mpc.optimal_control.loop_phase import LoopPhase
from mpc.optimal_control.quadratic_phase import priced, quadratic_parameters, quadratic_phase
from mpc.problem import MPCProblem
from mpc.sensitivities.changes import PlanModel


class Buffered:
    """CasADi function with dense results, of arrays, one row per column, with buffers per thread."""

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._workspace = threading.local()

    def __reduce__(self) -> tuple[Any, ...]:
        """Function without buffers: a copy makes its own."""
        return Buffered, (self.function,)

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
    """x⁺ = f(x, u, w, p), the function `step`, evaluated along plans of N steps, the `horizon`."""

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
        self._at = Buffered(ca.Function("at", columns, [value, *derivatives], {"cse": True}))
        self._linearised = Buffered(self.derivatives.map("linearised", "serial", horizon, [3], []))
        self._one = Buffered(step)
        self._followed = Buffered(_following(step).mapaccum("followed", horizon))
        self._loops: dict[int, LoopPhase] = {}

    def loop(self, law: MPCProblem, p: Array) -> LoopPhase:
        """Statement of a plan as a phase, for all p, built on demand."""
        key = len(law.terminal_rows[1])
        if key not in self._loops:
            soft = np.zeros(priced(law))
            limit = None if law.rate_limit is None else np.append(law.rate_limit, soft + np.inf)
            size, phase = law.state_extent, quadratic_phase(law, self.step)
            p = quadratic_parameters(law, p, (1.0, 1.0), size)
            self._loops[key] = LoopPhase(phase, law.horizon, p, limit, np.append(size, soft + 1.0))
        return self._loops[key]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_loops": {}}

    def linearised(self, states: Array, inputs: Array, w: Array, p: Array) -> tuple[Array, Array, Array]:
        """Next states (N, nx), A (N, nx, nx) and B (N, nx, nu) along a plan."""
        N, nx = states.shape
        f, A, B = self._linearised(states, inputs, w, p)
        A, B = A.reshape(N, nx, nx), B.reshape(N, -1, nx)
        return f, np.ascontiguousarray(A.transpose(0, 2, 1)), np.ascontiguousarray(B.transpose(0, 2, 1))

    def linearised_at(self, x: Array, u: Array, w: Array, p: Array) -> tuple[Array, Array, Array, Array]:
        """Next state, A, B and E at one point."""
        f, A, B, E = self._at(x, u, w, p)
        return f[0], A.T, B.T, E.T

    def along_signals(self, w: Array, p: Array) -> PlanModel:
        """Derivatives along plans under signals w (N, nw) with parameters p (np,)."""

        def first(states: Array, inputs: Array) -> tuple[Array, Array, Array, Array]:
            """f (N, nx), ∂f/∂x, ∂f/∂u and ∂f/∂p (N, nx, ·)."""
            slopes, _ = self._second[1](states, inputs, w, p, np.zeros(states.shape))
            by_parameters = slopes.reshape(len(inputs), len(p), states.shape[1]).transpose(0, 2, 1)
            return *self.linearised(states, inputs, w, p), by_parameters

        def second(states: Array, inputs: Array, costates: Array) -> tuple[Array, Array]:
            """Second derivatives of Σ λ_i f_i by (x, u) and p, (N, nx + nu, ·)."""
            at = (states, inputs, w, p, costates)
            curvature, mixed = self.curvature(*at), self._second[1](*at)[1]
            return curvature, mixed.reshape(len(inputs), len(p), curvature.shape[1]).transpose(0, 2, 1)

        return PlanModel(first, second)

    def curvature(self, states: Array, inputs: Array, w: Array, p: Array, costates: Array) -> Array:
        """Second derivatives (N, nx + nu, nx + nu) of λ'f by (x, u)."""
        N, n = len(inputs), states.shape[1] + inputs.shape[1]
        return self._second[0](states, inputs, w, p, costates)[0].reshape(N, n, n)

    @cached_property
    def _second(self) -> tuple[Buffered, Buffered]:
        """Functions of curvature along a plan; of derivatives by p."""
        columns = list(symbols_of(self.step).values())
        costate, value = type(columns[0]).sym("costate", self.step.numel_out(0)), self.step(*columns)
        curvature, slope = ca.hessian(ca.dot(costate, value), ca.vertcat(*columns[:2]))
        by_p = [ca.densify(ca.jacobian(part, columns[3])) for part in (value, slope)]
        results = [ca.densify(curvature)], by_p
        functions = [ca.Function("second", [*columns, costate], parts, {"cse": True}) for parts in results]
        along = [Buffered(one.map("second_along", "serial", self.horizon, [3], [])) for one in functions]
        return along[0], along[1]

    def at_rest(self, p: Array) -> list[Array]:
        """Derivatives ∂A/∂p (nx, nx, np), ∂B/∂p (nx, nu, np) and ∂E/∂p (nx, nw, np) at rest."""
        found = (np.asarray(ca.densify(value), dtype=float) for value in self._at_rest(0, 0, 0, p))
        sizes = ((self.step.numel_in(0), self.step.numel_in(i), len(p)) for i in range(3))
        return [value.reshape(size, order="F") for value, size in zip(found, sizes)]

    @cached_property
    def _at_rest(self) -> ca.Function:
        """Function of derivatives of A, B and E by p, built on demand."""
        x, u, w, p = symbols_of(self.step).values()
        matrices = [*self.derivatives(x, u, w, p)[1:], ca.jacobian(self.step(x, u, w, p), w)]
        mixed = [ca.jacobian(ca.vec(matrix), p) for matrix in matrices]
        return ca.Function("at_rest", [x, u, w, p], mixed)

    def next(self, x: Array, u: Array, w: Array, p: Array) -> Array:
        """Next state (nx,) at one point."""
        return np.asarray(self._one(x, u, w, p)[0][0])

    def followed(
        self, x: Array, last: Array, states: Array, inputs: Array, gains: Array, limits: tuple[Array, Array, Array],
        w: Array, p: Array,
    ) -> tuple[Array, Array]:  # fmt: skip
        """States (N + 1, nx) and inputs (N, nu) under limited u = v - K(x - s).

        `last` (nu,) is the input one step ago; s, v and K are `states` (N + 1, nx), `inputs` (N, nu) and `gains`
        (N, nu, nx); `limits` are the least and largest input and its largest change, (nu,) each.
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
