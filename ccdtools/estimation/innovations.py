"""Innovations of logged outputs, with slopes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from mpc.tolerances import ROUNDED_SUM


@dataclass(frozen=True, eq=False)
class Innovations:
    """Innovations of a cubature Kalman filter, by parameters θ (m,).

    An extended one, whose slope is that at its estimate, mistakes what bends within its uncertainty, such as dry
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
    known : (nx,) array
        Deviation of x that is none, of what is known exactly.

    References
    ----------
    Arasaratnam and Haykin, "Cubature Kalman filters", IEEE Transactions on Automatic Control 54, 2009.
    """

    step: ca.Function
    output: ca.Function
    disturbance: tuple[Array, Array]
    start: tuple[Array, Array]
    rows: Array
    inputs: Array
    scaled: bool
    known: Array

    @cached_property
    def _sample(self) -> ca.Function:
        """Belief, θ, data → next belief, innovations, variances."""
        x, before, p = (ca.MX.sym(name, self.step.size1_in(i)) for name, i in (("x", 0), ("before", 1), ("p", 3)))
        nx, ny = x.numel(), self.output.size1_out(0)
        theta = ca.MX.sym("theta", p.numel() + 2 * self.scaled)
        P, u, row = ca.MX.sym("P", nx, nx), ca.MX.sym("u", before.numel()), ca.MX.sym("row", ny * (1 + ny))
        p, factors = theta[: p.numel()], ca.exp(theta[p.numel() :]) if self.scaled else ca.DM.ones(2)
        square, prior = ca.SX.sym("square", nx, nx), ca.SX.sym("prior", nx)
        rounding = ROUNDED_SUM * prior + self.known**2  # a part of what was known before, whatever the units
        root = ca.Function("root", [square, prior], [ca.chol(square + ca.diag(rounding)).T])
        white = ca.reshape(row[ny:], ny, ny)
        y, of_x, of_y = _spread(lambda z: self.output(z, before, p), x, root(P, ca.diag(P)))
        away = ca.vertcat(of_x, white @ of_y)
        noise = ca.if_else(ca.sum2(white**2) > 0, factors[1], 1.0)  # nothing is told by one that was missed
        known, told = ca.vertcat(x, white @ (y - row[:ny])), []
        spread = away @ away.T + ca.diag(ca.vertcat(ca.DM.zeros(nx), noise))
        for i in range(nx, nx + ny):  # what an output misses becomes 0, one by one
            told.append((-known[i], spread[i, i]))
            gain = spread[:, i] / spread[i, i]
            known, spread = known - gain * known[i], spread - gain @ spread[i, :]
        mean, W = self.disturbance
        units = np.where(np.diag(W) > 0, np.sqrt(np.diag(W)), 1.0)
        variances, axes = np.linalg.eigh(W / units / units[:, None])
        some = variances > ROUNDED_SUM  # cubature points along the others would only be further out
        by_w = ca.DM(units[:, None] * axes[:, some] * np.sqrt(variances[some])) * ca.sqrt(factors[0])
        both = ca.vertcat(known[:nx], ca.DM(mean))
        roots = ca.diagcat(root(spread[:nx, :nx], ca.diag(P)), by_w)
        after, _, of_next = _spread(lambda z: self.step(z[:nx, :], u, z[nx:, :], p), both, roots)
        results = [after, of_next @ of_next.T, *(ca.vertcat(*part) for part in zip(*told))]
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


def _spread(function: Callable[[Any], Any], mean: Any, root: Any) -> tuple[Any, Any, Any]:
    """Mean of a function of x, and deviations of x and of it, whose squares are covariances, by cubature points."""
    n = root.shape[1]
    away = n**0.5 * ca.horzcat(root, -root)
    values = function(mean + away)
    middle = ca.sum2(values) / (2 * n)
    return middle, away / (2 * n) ** 0.5, (values - middle) / (2 * n) ** 0.5
