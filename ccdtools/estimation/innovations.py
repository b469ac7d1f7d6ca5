"""Innovations of logged outputs, with slopes."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.estimation.regression import predicted, updated


@dataclass(frozen=True, eq=False)
class Innovations:
    """Innovations of a cubature Kalman filter, by parameters θ (m,).

    An extended filter, whose slope is that at its estimate, mistakes what bends within its uncertainty, such as dry
    friction, for noise that lasts.

    Attributes
    ----------
    step, output : casadi.Function
        (x, u, w, θ) → x⁺ and (x, u, θ) → y.
    disturbance, start : (mean, covariance)
        Of w, and of x before the first output.
    rows, inputs : (n, T, ny (1 + ny)) and (n, T, nu) arrays
        Outputs as rows of `whitened`, and what was applied.
    scaled : bool
        Whether θ ends with logarithms of two factors: of the covariances of w, and of the outputs' noise.
    """

    step: ca.Function
    output: ca.Function
    disturbance: tuple[Array, Array]
    start: tuple[Array, Array]
    rows: Array
    inputs: Array
    scaled: bool

    @cached_property
    def _sample(self) -> ca.Function:
        """Belief, θ, data → next belief, innovations, variances."""
        x, before, p = (ca.MX.sym(name, self.step.size1_in(i)) for name, i in (("x", 0), ("before", 1), ("p", 3)))
        nx, ny = x.numel(), self.output.size1_out(0)
        theta = ca.MX.sym("theta", p.numel() + 2 * self.scaled)
        P, u, row = ca.MX.sym("P", nx, nx), ca.MX.sym("u", before.numel()), ca.MX.sym("row", ny * (1 + ny))
        p, factors = theta[: p.numel()], ca.exp(theta[p.numel() :]) if self.scaled else ca.DM.ones(2)
        white = ca.reshape(row[ny:], ny, ny)
        noise = ca.if_else(ca.sum2(white**2) > 0, factors[1], 1.0)  # nothing is told by one that was missed
        known, spread, told = updated(
            lambda x: white @ self.output(x, before, p), x, P, white @ row[:ny], ca.diag(noise)
        )
        mean, W = self.disturbance
        after, next_spread = predicted(
            lambda x, w: self.step(x, u, w, p), known, spread, (ca.DM(mean), ca.DM(W) * factors[0])
        )
        results = [after, next_spread, *(ca.vertcat(*part) for part in zip(*told))]
        return ca.Function("sample", [x, P, theta, before, u, row], results)

    @cached_property
    def _carried(self) -> ca.Function:
        """`_sample` with slopes by θ beside each value."""
        sample = self._sample
        nx, m = sample.size1_in(0), sample.size1_in(2)
        belief = ca.MX.sym("belief", nx * (1 + nx) * (1 + m))
        x, P, dx, dP = ca.vertsplit(belief, np.cumsum([0, nx, nx * nx, nx * m, nx * nx * m]).tolist())
        theta, *data = (ca.MX.sym(f"given{i}", sample.size1_in(i)) for i in range(2, 6))
        given = [x, ca.reshape(P, nx, nx), theta, *data]
        nominal = sample(*given)
        seeds = [ca.reshape(dx, nx, m), ca.reshape(dP, nx, nx * m), ca.DM.eye(m)]
        moved: Any = sample.forward(m)(*given, *nominal, *seeds, *(ca.DM.zeros(part.numel(), m) for part in data))
        after = ca.veccat(*nominal[:2], *moved[:2])
        told = ca.veccat(nominal[2], moved[2], nominal[3], moved[3])
        function = ca.Function("carried", [belief, theta, *data], [after, told])
        with contextlib.suppress(RuntimeError):  # an implicit step has no scalar instructions, which are faster
            function = function.expand()
        return function

    def _along(self, theta: Array) -> tuple[Array, Array]:
        """Innovations above variances, each above its slopes, (2, 1 + m, N); states foretold (n, T, nx)."""
        x, P = self.start
        first = np.concatenate([x, P.ravel(), np.zeros(len(x) * (1 + len(x)) * len(theta))])
        n, steps = self.inputs.shape[:2]
        belief, given, step = np.tile(first[:, None], n), np.tile(theta[:, None], n), self._carried.map(n)
        before, found, foretold = np.zeros_like(self.inputs[:, 0]), [], []
        for k in range(steps):
            foretold.append(np.asarray(belief, dtype=float)[: len(x)].T)
            belief, told = step(belief, given, before.T, self.inputs[:, k].T, self.rows[:, k].T)
            before = self.inputs[:, k]
            found.append(np.asarray(told, dtype=float))
        return np.concatenate(found, axis=1).reshape(2, 1 + len(theta), -1), np.stack(foretold, axis=1)

    def at(self, theta: Array) -> tuple[Array, Array, Array, Array]:
        """Innovations and variances (N,), with slopes (N, m)."""
        told, _ = self._along(theta)
        return told[0, 0], told[1, 0], told[0, 1:].T, told[1, 1:].T

    def normalised(self, theta: Array) -> tuple[Array, Array]:
        """Innovations (n, T, ny) in units of their deviations, and states (n, T, nx) foretold before each sample.

        Innovations are 0 where a sensor told nothing.
        """
        told, foretold = self._along(theta)
        n, steps = self.inputs.shape[:2]
        each = told[0, 0] / np.sqrt(told[1, 0])
        return np.asarray(each.reshape(-1, steps, n).transpose(2, 1, 0)), foretold
