"""Rates of a plant, their derivatives and zeros."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import qr
from scipy.optimize import least_squares

from ccdtools.arrays import Array, Indices
from ccdtools.exceptions import InputError
from ccdtools.plants.plant import Plant
from ccdtools.plants.tolerances import DEPENDENT_PIVOT, RATE_ROUNDING
from ccdtools_ground.operations import term_sizes


class Rates:
    """Rates of a plant at (x, u): dx/dt or discrete change."""

    def __init__(self, plant: Plant, w: Array) -> None:
        self.z = ca.vertcat(plant.x, plant.u)
        self.states = plant.nx
        rate = plant.dynamics if plant.continuous else plant.dynamics - plant.x
        self.rate = ca.densify(ca.substitute(rate, plant.w, ca.DM(w)) if plant.nw else rate)
        self.jacobian_expression = ca.jacobian(self.rate, self.z)
        arguments = [self.z, plant.p]
        self._rate = ca.Function("rate", arguments, [self.rate])
        self._terms = ca.Function("terms", arguments, [term_sizes(self._rate, *arguments)])
        self._jacobian = ca.Function("jacobian", arguments, [ca.densify(self.jacobian_expression)])
        self._by_design = ca.Function("by_design", arguments, [ca.densify(ca.jacobian(self.rate, plant.p))])

    def __call__(self, z: Array, p: Array) -> Array:
        """Rates (nx,)."""
        return np.asarray(self._rate(z, p), dtype=float).ravel()

    def jacobian(self, z: Array, p: Array) -> Array:
        """∂/∂(x, u) (nx, nx + nu)."""
        return np.asarray(self._jacobian(z, p), dtype=float)

    def by_design(self, z: Array, p: Array) -> Array:
        """∂/∂p (nx, np)."""
        return np.asarray(self._by_design(z, p), dtype=float)

    def at_rest(self, z: Array, p: Array) -> bool:
        """Whether all rates are zero to rounding."""
        rate = self(z, p)
        if not (np.isfinite(rate).all() and np.isfinite(self.jacobian(z, p)).all()):
            return False
        return bool((np.abs(rate) <= self._rounding(z, p)).all())

    def resolution(self, z: Array, p: Array, rows: Indices, chosen: list[int]) -> Array:
        """Shift (nx + nu,) of chosen entries of (x, u) by rounding; 0 elsewhere."""
        moved = np.zeros(len(z))
        J = self.jacobian(z, p)[rows][:, chosen]
        if len(chosen) and np.isfinite(J).all():
            moved[chosen] = np.abs(np.linalg.pinv(J)) @ self._rounding(z, p)[rows]
        return moved

    def _rounding(self, z: Array, p: Array) -> Array:
        """Rest of each rate (nx,) left by rounding."""
        J = np.abs(self.jacobian(z, p))
        size = J @ np.abs(z) + J.max(axis=1) * RATE_ROUNDING
        terms = np.nan_to_num(np.asarray(self._terms(z, p), dtype=float).ravel(), posinf=0.0)
        return np.asarray(RATE_ROUNDING * np.maximum(size, terms))


def rest_near(rates: Rates, z: Array, free: Array, p: Array) -> Array:
    """Point (nx + nu,) at rest, from the guess or around it."""
    rng = np.random.default_rng(0)
    nx = rates.states
    sizes = np.r_[np.full(nx, _size(z[:nx])), np.full(len(z) - nx, _size(z[nx:]))]
    best: tuple[float, Array] = (np.inf, z)
    for start in range(20):  # the guess first
        reached = z.copy()
        if start:
            away = 10.0 ** (-(start // 2) if start % 2 else start // 2)  # farther and nearer, a decade at a time
            reach = np.maximum(np.abs(z), sizes) * away
            reached[free] += (rng.standard_normal(len(z)) * reach)[free]
        reached = _descended(rates, reached, free, p)
        if rates.at_rest(reached, p):
            return reached
        size = float(np.abs(rates(reached, p)).max()) if np.isfinite(rates(reached, p)).all() else np.inf
        best = min(best, (size, reached), key=lambda one: one[0])
        if not free.any():
            break
    raise InputError(
        "plant", f"no equilibrium: the least rate found is {best[0]:.3g}, at (x, u) = {np.round(best[1], 6).tolist()}",
        "one that rests with the given x, u and w", "Free an entry of u (NaN), or give a guess.",
    )  # fmt: skip


def _size(given: Array) -> float:
    """Largest absolute value; one where all are zero."""
    return float(np.abs(given).max(initial=0.0)) or 1.0


def _descended(rates: Rates, z: Array, free: Array, p: Array) -> Array:
    """Point of least rates nearby, by least squares, then Newton's method."""

    def at(v: Any) -> Array:
        """Point with those free entries."""
        full = z.copy()
        full[free] = v
        return full

    if not free.any() or not np.isfinite(rates(z, p)).all():
        return z
    try:
        found = least_squares(
            lambda v: rates(at(v), p), z[free], jac=lambda v: rates.jacobian(at(v), p)[:, free], x_scale="jac",
            xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=200,
        )  # fmt: skip
    except ValueError:  # a residual that is not finite
        return z
    v = found.x
    for _ in range(3):
        J = rates.jacobian(at(v), p)[:, free]
        rate = rates(at(v), p)
        if not (np.isfinite(J).all() and np.isfinite(rate).all()):
            return at(v)
        rows, columns = independent(J)
        step = np.zeros(len(v))
        if len(rows):
            step[columns] = np.linalg.solve(J[np.ix_(rows, columns)], rate[rows])
        closer = rates(at(v - step), p)
        if not np.isfinite(closer).all() or np.abs(closer).max() > np.abs(rate).max():
            break
        v = v - step
    return at(v)


def independent(J: Array) -> tuple[Indices, Indices]:
    """Rows and columns of a regular submatrix of J with its rank."""
    length = np.abs(J).max(axis=1, initial=0.0)
    J = J / np.where(length > 0, length, 1.0)[:, None]
    if J.size == 0 or not J.any():
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    R, columns = qr(J, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(R))
    rank = int((diagonal > DEPENDENT_PIVOT * diagonal[0]).sum())
    columns = np.sort(columns[:rank])
    _, rows = qr(J[:, columns].T, mode="r", pivoting=True)
    return np.sort(rows[:rank]), columns


def newton_step(rates: Rates, rows: Indices, chosen: list[int]) -> ca.SX:
    """z after one Newton step in the chosen entries."""
    if not chosen:
        return rates.z
    own = [int(i) for i in rows]
    step = ca.solve(rates.jacobian_expression[own, chosen], rates.rate[own])
    z = ca.SX(rates.z)
    for k, i in enumerate(chosen):
        z[i] -= step[k]
    return z
