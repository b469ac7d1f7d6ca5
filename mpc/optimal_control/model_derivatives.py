"""First and second derivatives of a discrete model along a plan, by states, inputs and parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from mpc.checks import Array
from mpc.optimal_control.discrete_model import DiscreteModel
from mpc.optimal_control.functions import symbols_of


class ModelDerivatives:
    """Derivatives of a model by x, u and p, of all steps of a plan in one call.

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
        """∂A/∂p (nx, nx, np) and ∂B/∂p (nx, nu, np) of the linearisation at rest."""
        nx, nu, nw, count = self.sizes
        found = self._at_rest(np.zeros(nx), np.zeros(nu), np.zeros(nw), p)
        dA, dB = (np.asarray(value, dtype=float) for value in found)
        return dA.reshape((nx, nx, count), order="F"), dB.reshape((nx, nu, count), order="F")

    def under(self, w: Array, p: Array) -> AlongSignals:
        """The model under signals (N, nw) with parameters (np,)."""
        return AlongSignals(self, w, p)


@dataclass(frozen=True, eq=False)
class AlongSignals:
    """A model under signals w (N, nw) with parameters p (np,)."""

    derivatives: ModelDerivatives
    w: Array
    p: Array

    def first(self, states: Array, inputs: Array) -> tuple[Array, Array, Array, Array]:
        """f (N, nx), ∂f/∂x, ∂f/∂u and ∂f/∂p (N, nx, ·)."""
        found = self.derivatives.first(states.T, inputs.T, self.w.T, np.tile(self.p[:, None], (1, len(inputs))))
        value, A, B, F = (_stacked(part, len(inputs)) for part in found)
        return value[:, :, 0], A, B, F

    def second(self, states: Array, inputs: Array, costates: Array) -> tuple[Array, Array]:
        """Second derivatives of Σ λ_i f_i by (x, u), and by (x, u) and p, (N, nx + nu, ·)."""
        p = np.tile(self.p[:, None], (1, len(inputs)))
        curvature, mixed = self.derivatives.second(states.T, inputs.T, self.w.T, p, costates.T)
        return _stacked(curvature, len(inputs)), _stacked(mixed, len(inputs))


def _stacked(value: Any, count: int) -> Array:
    """Matrices (count, m, n), of such side by side (m, count · n)."""
    array = np.asarray(value, dtype=float)
    return array.reshape(len(array), count, -1).transpose(1, 0, 2)
