"""Discretisation of dynamics: schemes of a trajectory, and steps over a sample."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from scipy.special import roots_jacobi

from ccdtools_ground.door import as_choice, as_positive, as_share
from mpc.budgets import HIGHEST_DEGREE
from mpc.checks import Array, as_count, as_floats
from mpc.exceptions import InputError
from mpc.optimal_control.functions import Statement, wanted


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
        as_choice("integrator", self.integrator, ("rk4", "cvodes"))
        object.__setattr__(self, "tolerance", as_share("tolerance", self.tolerance))

    order = 4
    stages = 1
    continuous_inputs = False


Scheme = Collocation | MultipleShooting


def runge_kutta(rate: Any, z: Any, t: Any, h: Any, w: Sequence[Any]) -> Any:
    """Classical Runge–Kutta step; w at begin, middle and end."""
    k1 = rate(z, t, w[0])
    k2 = rate(z + h / 2 * k1, t + h / 2, w[1])
    k3 = rate(z + h / 2 * k2, t + h / 2, w[1])
    k4 = rate(z + h * k3, t + h, w[2])
    return z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def sampled(dynamics: Statement, dt: float, *, parts: int = 4) -> Callable[..., Any]:
    """Step x⁺ = f(x, u, w, p) of dx/dt = dynamics(x, u, w, p).

    Parameters
    ----------
    dynamics : function or casadi.Function
        dx/dt; its arguments are named after what they get: x, u, w, p, t.
    dt : float
        Sample time [s, or the unit of time of the dynamics].
    parts : int
        Steps of the classical Runge–Kutta method of order 4 in a sample: twice as many make the error sixteen times
        smaller. Stiff dynamics need many; `ccdtools.discretise` chooses the number and the method by an accuracy.

    Returns
    -------
    function
        With the same arguments, for `NonlinearMPC(step=…)` or `Phase(dynamics=…, discrete=True)`.

    Raises
    ------
    InputError
        If the dynamics are no function of these names, or dt or the number of parts is not positive.

    Examples
    --------
    >>> law = NonlinearMPC(sampled(cart_pole, 0.02), 4, 1, Q=Q, R=R, horizon=30)  # doctest: +SKIP
    """
    names = wanted("dynamics", dynamics, ("x", "u", "w", "p", "t"))
    if "x" not in names:
        raise InputError("dynamics", f"a function of {', '.join(names) or 'nothing'}", "one of x at least")
    count = as_count("parts", parts)
    h = as_positive("dt", dt) / count
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    own = inspect.Signature([inspect.Parameter(name, kind) for name in names])

    def step(*columns: Any, **named: Any) -> Any:
        """Next state."""
        given = own.bind(*columns, **named).arguments

        def rate(z: Any, time: Any, _: Any) -> Any:
            """dx/dt at a state and a time."""
            value = dynamics(*((given | {"x": z, "t": time})[name] for name in names))
            return ca.vertcat(*value) if isinstance(value, list | tuple) else value

        x, t = given["x"], given.get("t", 0)
        for i in range(count):
            x = runge_kutta(rate, x, t + i * h, h, [None] * 3)
        return x

    step.__signature__ = own  # type: ignore[attr-defined]
    step.__wrapped__ = dynamics  # type: ignore[attr-defined]  # errors name the line of the user's function
    return step
