"""Prediction errors of a plant along logged states, with slopes."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ccdtools.arrays import Array


@dataclass(frozen=True, eq=False)
class StateErrors:
    """Prediction errors of states by parameters (θ, ρ).

    Those of one step, of which the part ρ (nx,) goes on to the next: a disturbance that lasts is not taken for a
    consequence of the state.

    Attributes
    ----------
    told : casadi.Function
        (x, u, x⁺, θ) → errors (nx,) of one step and their slopes (nx, m).
    samples : tuple of arrays (·, n T)
        x, u and x⁺, run by run.
    runs : int
        n.
    """

    told: ca.Function
    samples: tuple[Array, Array, Array]
    runs: int

    @classmethod
    def of(cls, step: ca.Function, w: Array, size: Array) -> StateErrors:
        """Errors of a step, along nothing yet."""
        x, u, after, theta = (ca.MX.sym("given", step.size1_in(i)) for i in (0, 1, 0, 3))
        error = (after - step(x, u, w, theta)) / size
        told = ca.Function("told", [x, u, after, theta], [error, ca.jacobian(error, theta)])
        with contextlib.suppress(RuntimeError):  # an implicit step has no scalar instructions, which are faster
            told = told.expand()
        return cls(told, (np.zeros(0),) * 3, 0)

    def along(self, states: Array, inputs: Array) -> StateErrors:
        """Errors along states (n, T + 1, nx)."""
        columns = (states[:, :-1], inputs, states[:, 1:])
        x, u, after = (column.reshape(-1, column.shape[2]).T for column in columns)
        return replace(self, samples=(x, u, after), runs=len(states))

    def of_one_step(self, theta: Array) -> tuple[Array, Array]:
        """Errors (n, T, nx) of one step, and slopes (n, T, nx, m)."""
        m, count = len(theta), self.samples[0].shape[1]
        error, slope = (np.asarray(part, dtype=float) for part in self.told.map(count)(*self.samples, theta))
        nx = len(error)
        errors = error.T.reshape(self.runs, -1, nx)
        return errors, slope.reshape(nx, count, m).transpose(1, 0, 2).reshape(*errors.shape, m)

    def predicted(self, values: Array) -> tuple[Array, Array]:
        """Errors (n, T − 1, nx) of predictions, and slopes by θ and ρ."""
        nx = len(self.samples[0])
        theta, rho = values[:-nx], values[-nx:]
        error, slope = self.of_one_step(theta)
        by_rho = -error[:, :-1, :, None] * np.eye(nx)
        by_theta = slope[:, 1:] - rho[:, None] * slope[:, :-1]
        return error[:, 1:] - rho * error[:, :-1], np.concatenate([by_theta, by_rho], axis=3)

    def at(self, values: Array) -> tuple[Array, Array, Array, Array]:
        """Errors and variances (N,), with slopes (N, m)."""
        error, slope = self.predicted(values)
        slope = slope.reshape(error.size, len(values))
        return error.ravel(), np.ones(error.size), slope, np.zeros_like(slope)

    def scores(self, values: Array, covariance: Array) -> Array:
        """Slopes (n (T − 1), m) of half of each squared error.

        Errors are those that a fit without the sample would leave, to first order (HC3), by the inverse of Fisher's
        information.
        """
        error, slope = self.predicted(values)
        J = slope.reshape(-1, *slope.shape[2:])
        kept = np.eye(J.shape[1]) - J @ covariance @ J.transpose(0, 2, 1)
        left = np.linalg.solve(kept, error.reshape(len(J), -1, 1))[:, :, 0]
        return np.asarray(np.einsum("ni,nim->nm", left, J))
