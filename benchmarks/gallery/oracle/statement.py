"""A study stated a second time, in plain numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import expm, solve_discrete_are

Array = np.ndarray
Dynamics = Callable[[Array, Array, Array, Array], Array]


@dataclass(frozen=True)
class Statement:
    """A linear plant in its design, what it costs and how it is driven.

    Attributes
    ----------
    matrices : callable
        p (np,) → A_c (nx, nx), B_c (nx, nu), E_c (nx, nw) in continuous time.
    Q, R : (nx,), (nu,) arrays
        Diagonals of the weights of x⁺ and u.
    std : (nw,) array
        Standard deviation of the disturbance, held over a sample.
    x0, p0 : (nx,), (np,) arrays
    lower, upper : (np,) arrays
        Box of designs.
    x_max, u_max : (nx,), (nu,) arrays
        Symmetric limits.
    dt : float
        Sampling time [s].
    steps : int
        Length of an episode.
    real : callable, optional
        (x (n, nx), u (n, nu), w (n, nw), p (np,)) → dx/dt (n, nx) of the real plant; the model if None.
    """

    matrices: Callable[[Array], tuple[Array, Array, Array]]
    Q: Array
    R: Array
    std: Array
    x0: Array
    p0: Array
    lower: Array
    upper: Array
    x_max: Array
    u_max: Array
    dt: float
    steps: int = 100
    real: Dynamics | None = None

    def __post_init__(self) -> None:
        for name in ("Q", "R", "std", "x0", "p0", "lower", "upper", "x_max", "u_max"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float))

    def from_unit(self, v: Array) -> Array:
        """Designs in physical units, of designs in the unit box."""
        return self.lower + np.clip(v, 0.0, 1.0) * (self.upper - self.lower)

    def corners(self) -> Array:
        """The corners of the box of designs, (2^np, np)."""
        return np.array(list(product(*zip(self.lower, self.upper))))

    def sampled(self, p: Array) -> tuple[Array, Array, Array]:
        """A, B and E with u and w held over a sample."""
        Ac, Bc, Ec = (np.atleast_2d(np.asarray(M, dtype=float)) for M in self.matrices(np.asarray(p, dtype=float)))
        nx = len(Ac)
        nu = Bc.shape[1]
        block = np.zeros((nx + nu + Ec.shape[1],) * 2)
        block[:nx] = np.hstack([Ac, Bc, Ec])
        flow = expm(self.dt * block)[:nx]
        return flow[:, :nx], flow[:, nx : nx + nu], flow[:, nx + nu :]

    def gain(self, A: Array, B: Array) -> Array:
        """K of the LQR u = −K x."""
        P = solve_discrete_are(A, B, np.diag(self.Q), np.diag(self.R))
        return np.linalg.solve(np.diag(self.R) + B.T @ P @ B, B.T @ P @ A)

    def disturbance(self, runs: int, seed: int) -> Array:
        """Disturbances (runs, steps, nw), the same for the same seed."""
        rng = np.random.default_rng(seed)
        return self.std * rng.standard_normal((runs, self.steps, len(self.std)))
