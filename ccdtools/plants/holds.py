"""Straight inputs and white noise between samples.

References
----------
Van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 23(3), 1978, eq. (1.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.matrix_exponential import balanced, expm, exponential
from ccdtools.plants.plant import Plant, linear_matrices
from ccdtools.plants.tolerances import TAYLOR_DEGREE
from ccdtools_ground.door import as_instance, as_positive, as_weight


@dataclass(frozen=True, eq=False, repr=False)
class FirstOrderHold:
    """Exact model for u and w linear over each sample.

    x⁺ = A(p) x + B₀(p) u + B₁(p) u⁺ + E₀(p) w + E₁(p) w⁺ + c(p). Made by `first_order_hold`.

    Attributes
    ----------
    A, B0, B1, E0, E1, c : casadi.SX
        Expressions in p.
    symbols : casadi.SX (np, 1)
        The design p.
    dt : float
        Sampling time [s].
    design : DesignSpace
    """

    A: ca.SX
    B0: ca.SX
    B1: ca.SX
    E0: ca.SX
    E1: ca.SX
    c: ca.SX
    symbols: ca.SX
    dt: float
    design: DesignSpace

    def __repr__(self) -> str:
        sizes = f"{self.A.shape[0]} states, {self.B0.shape[1]} inputs, {self.E0.shape[1]} disturbances"
        return f"FirstOrderHold({sizes}, dt = {self.dt:g} s, design: {self.design!r})"

    @cached_property
    def function(self) -> ca.Function:
        """p → A, B0, B1, E0, E1, c."""
        parts = [ca.densify(M) for M in (self.A, self.B0, self.B1, self.E0, self.E1, self.c)]
        return ca.Function("matrices", [self.symbols], parts, ["p"], ["A", "B0", "B1", "E0", "E1", "c"])

    def matrices(self, p: ArrayLike = ()) -> tuple[Array, ...]:
        """A (nx, nx), B₀, B₁ (nx, nu), E₀, E₁ (nx, nw), c (nx,) at a design."""
        *parts, c = (np.asarray(M, dtype=float) for M in self.function.call([self.design.check_one(p)]))
        return (*(np.ascontiguousarray(M) for M in parts), c.ravel())


def first_order_hold(plant: Plant, dt: float | None = None) -> FirstOrderHold:
    """Exact model of a linear plant, its inputs straight between samples.

    A recorded road, sampled, is nearer to that than to steps. A controller cannot know u⁺; `discretise` holds u.

    Parameters
    ----------
    plant : Plant
        Continuous, linear in x, u and w.
    dt : float, optional
        Sampling time [s]; the plant's own by default.

    Raises
    ------
    InputError
        If the plant is discrete or nonlinear, or not finite over the box of designs.

    References
    ----------
    Franklin, Powell and Workman, "Digital control of dynamic systems", 3rd ed., 1998, section 6.3.2 (triangle hold).
    """
    as_instance("plant", plant, Plant, "a Plant")
    if not plant.continuous:
        raise InputError("plant", "a discrete plant", "a continuous one")
    dt = as_positive("dt", plant.dt if dt is None else dt, unit="s")
    A, B, E, c = linear_matrices(plant)
    nx, nu, nw = plant.nx, plant.nu, plant.nw
    driven = nu + nw + 1
    M = ca.SX(nx + 2 * driven, nx + 2 * driven)
    M[:nx, : nx + driven] = ca.horzcat(A, B, E, c) * dt
    M[nx : nx + driven, nx + driven :] = ca.SX.eye(driven)
    F = exponential(M, symbols=plant.p, design=plant.design)
    whole, ramp = F[:nx, nx : nx + driven], F[:nx, nx + driven :]  # of a step, and of a ramp from 0 to 1
    begin = whole - ramp
    return FirstOrderHold(
        F[:nx, :nx], begin[:, :nu], ramp[:, :nu], begin[:, nu : nu + nw], ramp[:, nu : nu + nw], whole[:, -1], plant.p,
        dt, plant.design,
    )  # fmt: skip


def noise_covariance(plant: Plant, intensity: ArrayLike, dt: float | None = None) -> ca.Function:
    """Covariance ∫₀^dt e^{Aτ} E S Eᵀ e^{Aᵀτ} dτ of white noise over a sample.

    A disturbance that is held over a sample adds E(p) W E(p)ᵀ instead, with the discrete E and its covariance W.

    Parameters
    ----------
    plant : Plant
        Continuous, linear in x, u and w.
    intensity : (nw, nw) array_like
        S, the two-sided spectral density of w, in its unit squared per Hz.
    dt : float, optional
        Sampling time [s]; the plant's own by default.

    Returns
    -------
    casadi.Function
        p (np,) → (nx, nx).

    Raises
    ------
    InputError
        If the plant is discrete or nonlinear, or S is not symmetric and positive semidefinite.

    References
    ----------
    Van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 23(3), 1978. Its one exponential holds
    e^{−A dt}, which overflows for stiff plants; here the integral of a short time is doubled, Q(2h) = Q(h) + Φ Q(h) Φᵀ.
    """
    as_instance("plant", plant, Plant, "a Plant")
    if not plant.continuous:
        raise InputError("plant", "a discrete plant", "a continuous one", "Its noise is E(p) W E(p)ᵀ.")
    S = as_weight("intensity", intensity, plant.nw)
    dt = as_positive("dt", plant.dt if dt is None else dt, unit="s")
    A, _, E, _ = linear_matrices(plant)
    scale, squarings = balanced(A * dt, symbols=plant.p, design=plant.design)
    D = ca.diag(ca.DM(scale))
    D_inv = ca.diag(ca.DM(1 / scale))
    h = dt / 2.0**squarings
    own = D_inv @ A @ D * h
    term = D_inv @ E @ ca.DM(S) @ E.T @ D_inv * h
    Q = term
    for k in range(2, TAYLOR_DEGREE + 2):
        term = (own @ term + term @ own.T) / k
        Q = Q + term
    transition = expm(own, squarings=0)
    for _ in range(squarings):
        Q = Q + transition @ Q @ transition.T
        transition = transition @ transition
    Q = D @ (Q + Q.T) @ D / 2
    return ca.Function("noise_covariance", [plant.p], [ca.densify(Q)], ["p"], ["Q"])
