"""Likelihood of parameters by prediction errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import Bounds, minimize

from ccdtools.arrays import Array, Mask
from ccdtools.twin.unknown_plant import UnknownPlant
from mpc.tolerances import NEGLIGIBLE, TOLD


def information_rows(r: Array, s: Array, dr: Array, ds: Array) -> Array:
    """Root (2 N, m) of Fisher's information."""
    return np.vstack([dr / np.sqrt(s)[:, None], ds / (np.sqrt(2) * s)[:, None]])


class Likelihood:
    """Likelihood of parameters, in units from their guess."""

    def __init__(
        self, unknown: UnknownPlant, parts: Sequence[Any], noises: int, end_of_noise: float = np.inf
    ) -> None:  # fmt: skip
        (lower, upper), none = unknown.bounds, np.zeros(noises)
        self.parts = parts
        self.guess = np.concatenate([(lower + upper) / 2, none])
        self.units = np.concatenate([(upper - lower) / 2, none + 1])
        end = np.concatenate([np.full(len(lower), np.inf if unknown.constants else 1.0), none + end_of_noise])
        self.bounds = Bounds(-end, end, keep_feasible=True)
        self._last: tuple[bytes, tuple[float, Array, Array, float]] | None = None

    def values(self, z: Array) -> Array:
        """Parameters (m,) as they are."""
        return np.asarray(self.guess + self.units * z)

    def at(self, z: Array) -> tuple[float, Array, Array, float]:
        """Cost, slope, root of Fisher's information, squared innovations."""
        key = np.asarray(z, dtype=float).tobytes()
        if self._last is None or self._last[0] != key:
            r, s, dr, ds = (np.concatenate(rows) for rows in zip(*(part.at(self.values(z)) for part in self.parts)))
            dr, ds, square = dr * self.units, ds * self.units, r**2 / s
            rows = np.linalg.qr(information_rows(r, s, dr, ds), mode="r")
            cost = float(np.nan_to_num(np.sum(np.log(s) + square) / 2, nan=np.inf))  # where a filter diverges
            slope = dr.T @ (r / s) + ds.T @ ((1 - square) / s) / 2
            self._last = key, (cost, slope, np.asarray(rows), float(square.sum()))
        return self._last[1]

    def largest(self, steps: int = 5) -> Array:
        """Likeliest point (m,), with Fisher's information as curvature."""
        cost, slope = (lambda z: self.at(z)[0]), (lambda z: self.at(z)[1])
        z = minimize(
            cost, 0 * self.guess, jac=slope, hess=lambda z: self.at(z)[2].T @ self.at(z)[2], method="trust-constr",
            bounds=self.bounds, callback=lambda z, _: self.rise(z) <= NEGLIGIBLE,
        ).x  # fmt: skip
        for _ in range(steps):  # along what the log tells much better than the rest its steps end early
            if self.rise(z) <= NEGLIGIBLE or not np.isfinite(self.rise(z)):
                break
            z = np.clip(z - self._best_step(z)[0], self.bounds.lb, self.bounds.ub)
        if not self.rise(z) <= NEGLIGIBLE:  # its barrier may end short of a bound, which a projection reaches
            z = minimize(cost, z, jac=slope, method="L-BFGS-B", bounds=self.bounds).x
        return np.asarray(z)

    def held(self, z: Array) -> Mask:
        """Which of the parameters (m,) a bound holds.

        It is near, and a step of the parameter alone leads to it or beyond.
        """
        _, slope, rows, _ = self.at(z)
        below, above = z - self.bounds.lb, self.bounds.ub - z
        way, push = np.minimum(below, above).clip(max=1.0), np.where(below < above, slope, -slope)
        told = (rows**2).sum(axis=0)
        return np.asarray((way <= NEGLIGIBLE) & (way * told - push <= np.sqrt(NEGLIGIBLE * told)))

    def rise(self, z: Array) -> float:
        """Square of the best step, in standard deviations; NaN where a filter diverges.

        Neither what a bound holds nor what the log leaves open counts: along that the likelihood rises by nothing.
        """
        return self._best_step(z)[1]

    def _best_step(self, z: Array) -> tuple[Array, float]:
        """Gauss–Newton's step (m,) down along what the log tells, and its square in standard deviations."""
        cost, slope, rows, _ = self.at(z)
        move = np.zeros(len(z))
        if not (np.isfinite(cost) and np.isfinite(rows).all()):
            return move, float("nan")
        free = ~self.held(z)
        _, told, modes = np.linalg.svd(rows[:, free])
        modes, told = modes[: len(told)][told > TOLD], told[told > TOLD]
        step = modes @ slope[free] / told
        move[free] = modes.T @ (step / told)
        return move, float(step @ step)
