"""Likelihood of logged outputs, by the innovations of an extended Kalman filter."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from ccdtools.arrays import Array


@dataclass(frozen=True, eq=False)
class Innovations:
    """Innovations of a log, as functions of parameters θ (m,).

    Of x⁺ = f(x, u, w, θ), y = h(x, u, θ) + v, linearised about the estimates as by `ExtendedKalmanFilter`.

    Attributes
    ----------
    step, output : casadi.Function
        (x, u, w, θ) → x⁺ and (x, u, θ) → y.
    disturbance : (mean, covariance)
        Of w, (nw,) and (nw, nw).
    start : (mean, covariance)
        Of x before the first output.
    rows, inputs : (n, T, ny (1 + ny)) and (n, T, nu) arrays
        Outputs as rows of `whitened`, and what was applied.
    scaled : bool
        Whether two more parameters are logarithms of factors: of the covariances of w, and of the outputs' noise.

    References
    ----------
    Åström, "Maximum likelihood and prediction error methods", Automatica 16, 1980; Harvey, *Forecasting, Structural
    Time Series Models and the Kalman Filter*, 1989, section 3.4 (its information).
    """

    step: ca.Function
    output: ca.Function
    disturbance: tuple[Array, Array]
    start: tuple[Array, Array]
    rows: Array
    inputs: Array
    scaled: bool = False

    @cached_property
    def _sample(self) -> ca.Function:
        """Belief and data of a sample → the next belief, innovations, their variances."""
        x, u, w, p = (ca.MX.sym(name, self.step.size1_in(i)) for i, name in enumerate("xuwp"))
        after, y = self.step(x, u, w, p), self.output(x, u, p)
        moved = ca.Function("moved", [x, u, w, p], [after, ca.jacobian(after, x), ca.jacobian(after, w)])
        seen = ca.Function("seen", [x, u, p], [y, ca.jacobian(y, x)])
        nx, ny = x.numel(), y.numel()
        all_p = ca.MX.sym("all", p.numel() + 2 * self.scaled)
        P, before, row = ca.MX.sym("P", nx, nx), ca.MX.sym("before", u.numel()), ca.MX.sym("row", ny * (1 + ny))
        p, factors = all_p[: p.numel()], ca.exp(all_p[p.numel() :]) if self.scaled else ca.DM.ones(2)
        mean, W = (ca.DM(part) for part in self.disturbance)
        white = ca.reshape(row[ny:], ny, ny)
        y, H = seen(x, before, p)
        r, H = white @ (row[:ny] - y), white @ H
        now, spread = x, P
        innovations, variances = [], []
        for i in range(ny):  # outputs of independent noise, one by one
            h = H[i, :].T
            noise = ca.if_else(ca.sumsqr(white[i, :]) > 0, factors[1], 1.0)  # nothing is told by one that was missed
            variances.append(h.T @ spread @ h + noise)
            innovations.append(r[i] - h.T @ (now - x))
            gain = spread @ h / variances[-1]
            rest = ca.DM.eye(nx) - gain @ h.T
            now, spread = now + gain * innovations[-1], rest @ spread @ rest.T + gain @ gain.T * noise
        after, F, E = moved(now, u, mean, p)
        next_P = F @ spread @ F.T + E @ (W * factors[0]) @ E.T
        told = [ca.vertcat(*innovations), ca.vertcat(*variances)]
        return ca.Function("sample", [x, P, all_p, before, u, row], [after, next_P, *told])

    @cached_property
    def _carried(self) -> ca.Function:
        """`_sample` with slopes by θ beside each value."""
        sample = self._sample
        nx, m = sample.size1_in(0), sample.size1_in(2)
        belief = ca.MX.sym("belief", nx * (1 + nx) * (1 + m))
        x, P, dx, dP = ca.vertsplit(belief, np.cumsum([0, nx, nx * nx, nx * m, nx * nx * m]).tolist())
        p, *data = (ca.MX.sym(f"given{i}", sample.size1_in(i)) for i in range(2, 6))
        given = [x, ca.reshape(P, nx, nx), p, *data]
        nominal = sample(*given)
        held = [ca.DM.zeros(part.numel(), m) for part in data]
        moved = sample.forward(m)(
            *given, *nominal, ca.reshape(dx, nx, m), ca.reshape(dP, nx, nx * m), ca.DM.eye(m), *held
        )
        after = ca.veccat(*nominal[:2], *moved[:2])
        told = ca.veccat(nominal[2], moved[2], nominal[3], moved[3])
        function = ca.Function("carried", [belief, p, *data], [after, told])
        with contextlib.suppress(RuntimeError):  # an implicit step has no scalar instructions, which are faster
            function = function.expand()
        return function

    def at(self, p: Array) -> tuple[Array, Array, Array, Array]:
        """Innovations (N,), variances (N,), and slopes of both by θ, (N, m)."""
        n, steps = self.inputs.shape[:2]
        x, P = self.start
        first = np.concatenate([x, P.ravel(), np.zeros(len(x) * (1 + len(x)) * len(p))])
        belief, step = np.tile(first[:, None], n), self._carried.map(n)
        given, before = np.tile(p[:, None], n), np.zeros_like(self.inputs[:, 0])
        found = []
        for k in range(steps):
            belief, told = step(belief, given, before.T, self.inputs[:, k].T, self.rows[:, k].T)
            before = self.inputs[:, k]
            found.append(np.asarray(told, dtype=float))
        told = np.concatenate(found, axis=1).reshape(2, 1 + len(p), -1)  # ny n T values each
        return told[0, 0], told[1, 0], told[0, 1:].T, told[1, 1:].T
