"""A discrete model along a whole plan: next states and derivatives of all steps in one call."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array


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
        kind: Any = ca.SX if step.is_a("SXFunction") else ca.MX
        columns = [kind.sym(name, step.numel_in(i)) for i, name in enumerate("xuwp")]
        value = step(*columns)
        derivatives = [ca.densify(ca.jacobian(value, column)) for column in columns[:2]]
        self.step = step
        self._derivatives = ca.Function("derivatives", columns, [ca.densify(value), *derivatives])
        self._along = self._derivatives.map(horizon)
        self._values = step.map(horizon)
        self._rollout = step.mapaccum(horizon)

    def linearised(self, states: Array, inputs: Array, w: Array, p: Array) -> tuple[Array, Array, Array]:
        """Next states (N, nx), A (N, nx, nx) and B (N, nx, nu) at states (N, nx), inputs (N, nu), signals (N, nw)."""
        N, nx = states.shape
        found = self._along(states.T, inputs.T, w.T, np.tile(p[:, None], (1, N)))
        f, A, B = (np.asarray(value, dtype=float) for value in found)
        return f.T, A.reshape(nx, N, -1).transpose(1, 0, 2), B.reshape(nx, N, -1).transpose(1, 0, 2)

    def along(self, states: Array, inputs: Array, w: Array, p: Array) -> Array:
        """Next states (N, nx) at states (N, nx), inputs (N, nu), signals (N, nw)."""
        after = self._values(states.T, inputs.T, w.T, np.tile(p[:, None], (1, len(states))))
        return np.asarray(after, dtype=float).T

    def linearised_at(self, x: Array, u: Array, w: Array, p: Array) -> tuple[Array, Array, Array]:
        """The same at one point."""
        f, A, B = (np.asarray(value, dtype=float) for value in self._derivatives(x, u, w, p))
        return f.ravel(), A, B

    def rolled(self, x: Array, inputs: Array, w: Array, p: Array) -> Array:
        """States (N + 1, nx) from x (nx,) under inputs (N, nu)."""
        after = self._rollout(x, inputs.T, w.T, np.tile(p[:, None], (1, len(inputs))))
        return np.vstack([x, np.asarray(after, dtype=float).T])
