"""Innovations of logged outputs, with slopes."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array


@dataclass(frozen=True, eq=False)
class Innovations:
    """Innovations of an extended Kalman filter, by parameters θ (m,).

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
        x, u, w, p = (ca.MX.sym(name, self.step.size1_in(i)) for i, name in enumerate("xuwp"))
        after, y = self.step(x, u, w, p), self.output(x, u, p)
        moved = ca.Function("moved", [x, u, w, p], [after, ca.jacobian(after, x), ca.jacobian(after, w)])
        seen = ca.Function("seen", [x, u, p], [y, ca.jacobian(y, x)])
        nx, ny = x.numel(), y.numel()
        theta = ca.MX.sym("theta", p.numel() + 2 * self.scaled)
        P, before, row = ca.MX.sym("P", nx, nx), ca.MX.sym("before", u.numel()), ca.MX.sym("row", ny * (1 + ny))
        p, factors = theta[: p.numel()], ca.exp(theta[p.numel() :]) if self.scaled else ca.DM.ones(2)
        white, (y, H) = ca.reshape(row[ny:], ny, ny), seen(x, before, p)
        missed, H = white @ (row[:ny] - y), white @ H
        now, spread, told = x, P, []
        for i in range(ny):  # outputs of independent noise, one by one
            h = H[i, :].T
            noise = ca.if_else(ca.sumsqr(white[i, :]) > 0, factors[1], 1.0)  # nothing is told by one that was missed
            told.append((missed[i] - h.T @ (now - x), h.T @ spread @ h + noise))
            gain = spread @ h / told[-1][1]
            rest = ca.DM.eye(nx) - gain @ h.T
            now, spread = now + gain * told[-1][0], rest @ spread @ rest.T + gain @ gain.T * noise
        mean, W = (ca.DM(part) for part in self.disturbance)
        after, F, E = moved(now, u, mean, p)
        after_P = F @ spread @ F.T + E @ (W * factors[0]) @ E.T
        innovations, variances = (ca.vertcat(*part) for part in zip(*told))
        return ca.Function("sample", [x, P, theta, before, u, row], [after, after_P, innovations, variances])

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

    def at(self, theta: Array) -> tuple[Array, Array, Array, Array]:
        """Innovations and variances (N,), with slopes (N, m)."""
        x, P = self.start
        first = np.concatenate([x, P.ravel(), np.zeros(len(x) * (1 + len(x)) * len(theta))])
        n, steps = self.inputs.shape[:2]
        belief, given, step = np.tile(first[:, None], n), np.tile(theta[:, None], n), self._carried.map(n)
        before, found = np.zeros_like(self.inputs[:, 0]), []
        for k in range(steps):
            belief, told = step(belief, given, before.T, self.inputs[:, k].T, self.rows[:, k].T)
            before = self.inputs[:, k]
            found.append(np.asarray(told, dtype=float))
        told = np.concatenate(found, axis=1).reshape(2, 1 + len(theta), -1)
        return told[0, 0], told[1, 0], told[0, 1:].T, told[1, 1:].T

    def normalised(self, theta: Array) -> Array:
        """Innovations (n, T, ny) in units of their deviations; 0 where a sensor told nothing."""
        r, s, *_ = self.at(theta)
        n, steps = self.inputs.shape[:2]
        return np.asarray((r / np.sqrt(s)).reshape(-1, steps, n).transpose(2, 1, 0))
