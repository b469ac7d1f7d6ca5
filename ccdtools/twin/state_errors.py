"""One-step errors of a plant along logged states, with slopes."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ccdtools.arrays import Array


@dataclass(frozen=True, eq=False)
class StateErrors:
    """One-step errors of states by parameters θ (m,), in sizes of their own.

    Attributes
    ----------
    told : casadi.Function
        (x, u, x⁺, θ) → errors (nx,) and their slopes (nx, m).
    samples : tuple of arrays (·, N)
        x, u and x⁺.
    """

    told: ca.Function
    samples: tuple[Array, Array, Array]

    @classmethod
    def of(cls, step: ca.Function, w: Array, size: Array, states: Array, inputs: Array) -> StateErrors:
        """Errors of a step along states (n, T + 1, nx)."""
        x, u, after, theta = (ca.MX.sym("given", step.size1_in(i)) for i in (0, 1, 0, 3))
        error = (after - step(x, u, w, theta)) / size
        told = ca.Function("told", [x, u, after, theta], [error, ca.jacobian(error, theta)])
        with contextlib.suppress(RuntimeError):  # an implicit step has no scalar instructions, which are faster
            told = told.expand()
        columns = (states[:, :-1], inputs, states[:, 1:])
        return cls(told, tuple(column.reshape(-1, column.shape[2]).T for column in columns))  # type: ignore[arg-type]

    def errors(self, theta: Array) -> tuple[Array, Array]:
        """Errors (N, nx) and slopes (N, nx, m)."""
        m, count = len(theta), self.samples[0].shape[1]
        error, slope = (np.asarray(part, dtype=float) for part in self.told.map(count)(*self.samples, theta))
        return error.T, slope.reshape(len(error), count, m).transpose(1, 0, 2)

    def at(self, theta: Array) -> tuple[Array, Array, Array, Array]:
        """Errors and variances (N nx,), with slopes (N nx, m)."""
        error, slope = self.errors(theta)
        slope = slope.reshape(error.size, len(theta))
        return error.ravel(), np.ones(error.size), slope, np.zeros_like(slope)

    def scores(self, theta: Array) -> Array:
        """Slopes (N, m) of half the square of each sample's errors."""
        error, slope = self.errors(theta)
        return np.asarray(np.einsum("ni,nim->nm", error, slope))
