"""Exact zero-order-hold discretisation, symbolic in the design."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import matrix_balance

from ccdtools.arrays import Array
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.plant import Plant

TAYLOR_DEGREE = 14  # with ‖M‖₁ ≤ 1/2 the first neglected term is (1/2)¹⁵/15! ≈ 2e-17


@dataclass(frozen=True, eq=False)
class LinearModel:
    """x⁺ = A(p) x + B(p) u + E(p) w, exact, symbolic and differentiable in p.

    Made by `discretise` or `LinearModel.from_state_space`.
    """

    symbols: ca.SX
    A: ca.SX
    B: ca.SX
    E: ca.SX
    dt: float
    design: DesignSpace | None

    @classmethod
    def from_state_space(cls, system, *, E: ArrayLike | None = None, dt: float | None = None) -> LinearModel:
        """The model of a `control.StateSpace`, without a design.

        Parameters
        ----------
        system : control.StateSpace
            Discrete, or continuous together with `dt`. Its inputs are u; its outputs are not used.
        E : (nx, nw) array_like, optional
            Disturbance matrix, in the same time domain as `system`.
        dt : float, optional
            Sampling time [s] for a continuous system.

        Raises
        ------
        InputError
            If a continuous system comes without a positive `dt`, or a discrete one with a different `dt`; or if
            `E` has the wrong number of rows.
        """
        A, B = (np.atleast_2d(np.asarray(M, dtype=float)) for M in (system.A, system.B))
        E = np.zeros((len(A), 0)) if E is None else np.array(E, dtype=float, ndmin=1)
        if len(E) != len(A):
            raise InputError(f"E: got shape {E.shape}, expected {len(A)} rows, one per state.")
        E = E.reshape(len(A), -1)
        p = ca.SX(0, 1)
        constants = (ca.SX(ca.DM(A)), ca.SX(ca.DM(B)), ca.SX(ca.DM(E)) if E.size else ca.SX(len(A), 0))
        if system.dt:
            own = 1.0 if system.dt is True else float(system.dt)
            if dt is not None and not math.isclose(own, dt):
                raise InputError(f"dt: got {dt} for a system sampled at {own} s, expected {own} or nothing.")
            return cls(p, *constants, own, None)
        if dt is None:
            raise InputError("dt: got nothing for a continuous system, expected a sampling time in seconds.")
        dt = _positive(dt)
        return cls(p, *zero_order_hold(*constants, dt, symbols=p, design=None), dt, None)

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.B.shape[1]

    @property
    def nw(self) -> int:
        """Number of disturbances."""
        return self.E.shape[1]

    @cached_property
    def function(self) -> ca.Function:
        """p → [A B E], (nx, nx + nu + nw)."""
        return ca.Function("matrices", [self.symbols], [ca.densify(ca.horzcat(self.A, self.B, self.E))])

    @cached_property
    def jacobian(self) -> ca.Function:
        """p → ∂vec[A B E]/∂p, (nx·(nx + nu + nw), np), vec by columns."""
        matrices = ca.densify(ca.horzcat(self.A, self.B, self.E))
        return ca.Function("jacobian", [self.symbols], [ca.densify(ca.jacobian(ca.vec(matrices), self.symbols))])

    def matrices(self, p: ArrayLike = ()) -> tuple[Array, Array, Array]:
        """A (nx, nx), B (nx, nu) and E (nx, nw) at a design (np,); stacked along axis 0 for designs (n, np).

        Raises
        ------
        InputError
            If a design has the wrong shape or lies outside its bounds.
        """
        p = self._checked(p)
        columns = self.nx + self.nu + self.nw
        stacked = np.asarray(self.function(np.atleast_2d(p).T), dtype=float)
        matrices = np.ascontiguousarray(stacked.reshape(self.nx, -1, columns).transpose(1, 0, 2))
        M = matrices if p.ndim == 2 else matrices[0]
        return (
            np.ascontiguousarray(M[..., : self.nx]),
            np.ascontiguousarray(M[..., self.nx : self.nx + self.nu]),
            np.ascontiguousarray(M[..., self.nx + self.nu :]),
        )

    def derivatives(self, p: ArrayLike) -> tuple[Array, Array, Array]:
        """∂A/∂p (nx, nx, np), ∂B/∂p (nx, nu, np) and ∂E/∂p (nx, nw, np) at a design (np,)."""
        p = self._checked(p)
        J = np.asarray(self.jacobian(p), dtype=float)
        T = J.reshape(-1, self.nx, len(p)).transpose(1, 0, 2)
        return T[:, : self.nx], T[:, self.nx : self.nx + self.nu], T[:, self.nx + self.nu :]

    def state_space(self, p: ArrayLike = ()):
        """The model at one design as a `control.StateSpace` with inputs u, outputs x and its dt."""
        import control

        A, B, _ = self.matrices(p)
        return control.ss(A, B, np.eye(self.nx), np.zeros((self.nx, self.nu)), self.dt)

    def stepper(self, p: ArrayLike, *, batch: int) -> Callable[[Array, Array, Array], Array]:
        """(x (n, nx), u (n, nu), w (n, nw)) → x⁺ (n, nx) at design `p` (np,)."""
        A, B, E = self.matrices(p)
        return lambda x, u, w: x @ A.T + u @ B.T + w @ E.T

    def _checked(self, p: ArrayLike) -> Array:
        if self.design is None:
            return np.zeros(0)
        return self.design.check(p)


def discretise(plant: Plant, dt: float | None = None) -> LinearModel:
    """The exact zero-order-hold model of a linear plant, symbolic in its design.

    Parameters
    ----------
    plant : Plant
        Linear in x, u and w; any smooth dependence on p. A discrete plant is taken as it is.
    dt : float, optional
        Sampling time [s]; the plant's own by default.

    Returns
    -------
    LinearModel

    Raises
    ------
    InputError
        If the dynamics are not linear in (x, u, w), have a constant term, or a discrete plant is given
        another `dt`.

    References
    ----------
    Van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 23(3), 1978, eq. (1.1);
    Moler and Van Loan, "Nineteen dubious ways …, twenty-five years later", SIAM Review 45, 2003, method 3
    (scaling and squaring), after balancing.
    """
    dt = _positive(plant.dt if dt is None else dt)
    z = ca.vertcat(plant.x, plant.u, plant.w)
    M = ca.jacobian(plant.dynamics, z)
    if ca.depends_on(M, z):
        rows = [plant.state_names[i] for i in range(plant.nx) if ca.depends_on(ca.jacobian(plant.dynamics[i], z), z)]
        raise InputError(f"plant: got dynamics nonlinear in x, u or w for {', '.join(rows)}, expected linear ones.")
    rest = ca.Function("rest", [z, plant.p], [plant.dynamics])(ca.SX.zeros(z.shape), plant.p)
    if not ca.simplify(rest).is_zero():
        raise InputError("plant: got a constant term in the dynamics, expected linear ones; state it as a disturbance.")
    nx, nu = plant.nx, plant.nu
    A, B, E = M[:, :nx], M[:, nx : nx + nu], M[:, nx + nu :]
    if not plant.continuous:
        if not math.isclose(dt, plant.dt):
            raise InputError(f"dt: got {dt} for a plant sampled at {plant.dt} s, expected {plant.dt} or nothing.")
        return LinearModel(plant.p, A, B, E, dt, plant.design)
    A, B, E = zero_order_hold(A, B, E, dt, symbols=plant.p, design=plant.design)
    return LinearModel(plant.p, A, B, E, dt, plant.design)


def _positive(dt: float) -> float:
    if not (np.isfinite(dt) and dt > 0):
        raise InputError(f"dt: got {dt}, expected a positive time in seconds.")
    return float(dt)


def zero_order_hold(
    A: ca.SX, B: ca.SX, E: ca.SX, dt: float, *, symbols: ca.SX, design: DesignSpace | None
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Discrete A, B, E from continuous ones, symbolic in `symbols`: exp([[A, B, E], [0, 0, 0]] dt)."""
    nx, inputs = A.shape[0], B.shape[1] + E.shape[1]
    M = ca.SX(nx + inputs, nx + inputs)
    M[:nx, :] = ca.horzcat(A, B, E) * dt
    samples = _samples(ca.Function("M", [symbols], [M]), design)
    # One fixed diagonal similarity for the whole box: symbolic in p, and it keeps the norm, hence the rounding, small.
    _, (scale, _) = matrix_balance(np.max(np.abs(samples), axis=0), permute=False, separate=True)
    norm = max(float(np.linalg.norm(S / scale[:, None] * scale[None, :], 1)) for S in samples)
    squarings = max(0, math.ceil(math.log2(max(norm, 1e-300))) + 2)
    D, D_inv = ca.diag(ca.DM(scale)), ca.diag(ca.DM(1 / scale))
    F = D @ expm(D_inv @ M @ D, squarings=squarings) @ D_inv
    return F[:nx, :nx], F[:nx, nx : nx + B.shape[1]], F[:nx, nx + B.shape[1] :]


def expm(M: ca.SX, *, squarings: int) -> ca.SX:
    """exp(M) by Taylor expansion of M/2ˢ and s squarings; accurate to rounding for ‖M‖₁ ≤ 2ˢ⁻¹."""
    eye = ca.SX.eye(M.shape[0])
    S = M / 2.0**squarings
    F = eye
    for k in range(TAYLOR_DEGREE, 0, -1):
        F = eye + (S @ F) / k
    for _ in range(squarings):
        F = F @ F
    return F


def _samples(function: ca.Function, design: DesignSpace | None) -> Array:
    """`function` at the corners, the centre and seeded interior points of the design box, (n, rows, columns)."""
    if design is None or design.dim == 0:
        return np.asarray(function(np.zeros(0)), dtype=float)[None]
    corners = np.array(list(product((0.0, 1.0), repeat=min(design.dim, 10))))
    corners = np.pad(corners, ((0, 0), (0, design.dim - corners.shape[1])), constant_values=0.5)
    points = np.vstack([corners, design.to_unit(design.latin_hypercube(64, np.random.default_rng(0)))])
    return np.array([np.asarray(function(p), dtype=float) for p in design.from_unit(points)])
