"""Discretisation schemes of a trajectory."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import roots_jacobi

from mpc.checks import Array, as_count, as_floats
from mpc.exceptions import InputError
from mpc.tolerances import HIGHEST_DEGREE


@dataclass(frozen=True)
class Collocation:
    """Polynomials that meet the dynamics at points of every interval.

    An implicit Runge–Kutta method: x(τ) = x_k + h Σ a_j(τ) f_j, where a_j is the integral of the j-th Lagrange
    polynomial of the points. With the points 0 and 1 among them inputs are continuous; else every interval has its own.

    Attributes
    ----------
    points : tuple of float
        In (0, 1] or [0, 1], rising, 1 the last.
    name : str
    order : int
        Of the state at the nodes, for smooth solutions.
    """

    points: tuple[float, ...]
    name: str = "collocation"
    order: int = 1

    def __post_init__(self) -> None:
        c = as_floats("points", self.points)
        if c.ndim != 1 or not len(c) or c[-1] != 1 or not (np.diff(c) > 0).all() or c[0] < 0 or np.isnan(c).any():
            raise InputError("points", c, "rising numbers in [0, 1], the last of which is 1")
        object.__setattr__(self, "points", tuple(c.tolist()))

    @property
    def continuous_inputs(self) -> bool:
        """Whether inputs are shared by neighbouring intervals."""
        return self.points[0] == 0

    @property
    def stages(self) -> int:
        """Number of points."""
        return len(self.points)

    def basis(self, tau: Any) -> Array:
        """Lagrange polynomials (n, stages) at fractions (n,) of the interval."""
        c = np.asarray(self.points)
        away = np.asarray(tau, dtype=float)[..., None] - c
        others = ~np.eye(len(c), dtype=bool)
        over = np.array([np.prod(c[j] - c[own]) for j, own in enumerate(others)])
        return np.asarray(np.stack([np.prod(away[..., own], axis=-1) for own in others], axis=-1) / over)

    def integrals(self, tau: Any) -> Array:
        """Integrals (n, stages) of the polynomials from 0 to fractions (n,)."""
        at, weights = np.polynomial.legendre.leggauss(self.stages // 2 + 1)
        given = np.asarray(tau, dtype=float)[..., None]
        values = self.basis(given * (at + 1) / 2)
        return np.asarray(given * np.einsum("g,...gj->...j", weights / 2, values))

    @cached_property
    def matrix(self) -> Array:
        """Runge–Kutta matrix (stages, stages); its last row is the quadrature."""
        return self.integrals(np.asarray(self.points))


def Trapezoidal() -> Collocation:
    """Points 0 and 1: order 2."""
    return Collocation((0.0, 1.0), "trapezoidal", 2)


def HermiteSimpson() -> Collocation:
    """Points 0, 1/2 and 1: order 4."""
    return Collocation((0.0, 0.5, 1.0), "Hermite-Simpson", 4)


def Radau(degree: int = 3) -> Collocation:
    """Legendre–Gauss–Radau points, order 2·degree − 1."""
    d = as_count("degree", degree)
    if d > HIGHEST_DEGREE:
        cure = "Take more intervals instead."
        raise InputError("degree", degree, f"an integer from 1 to {HIGHEST_DEGREE}", cure)
    inner = roots_jacobi(d - 1, 1, 0)[0] if d > 1 else np.zeros(0)
    return Collocation((*(0.5 * (inner + 1)).tolist(), 1.0), f"Radau of degree {d}", 2 * d - 1)


@dataclass(frozen=True)
class MultipleShooting:
    """Multiple shooting with inputs constant over every interval.

    Attributes
    ----------
    substeps : int
        Runge–Kutta steps of order 4 an interval.
    integrator : "rk4" or "cvodes"
        With CVODES the error is its own tolerance, `tolerance`, and steps are as many as that takes.
    tolerance : float
    """

    substeps: int = 1
    integrator: str = "rk4"
    tolerance: float = 1e-9
    name: str = field(default="multiple shooting", init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "substeps", as_count("substeps", self.substeps))
        if self.integrator not in ("rk4", "cvodes"):
            raise InputError("integrator", repr(self.integrator), '"rk4" or "cvodes"')
        tolerance = as_floats("tolerance", self.tolerance)
        if tolerance.ndim or not 0 < tolerance < 1:
            raise InputError("tolerance", repr(self.tolerance), "a number between 0 and 1")

    order = 4
    stages = 1
    continuous_inputs = False


Scheme = Collocation | MultipleShooting
