"""Derivatives of the infinite-horizon regulator by parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import schur, solve_triangular

from ccdtools_ground.door import Immutable, as_array, as_cross_weight, as_floats, as_pair, as_weight
from ccdtools_ground.tolerances import WEIGHT_ROUNDING
from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.riccati import cost_units, lqr


@dataclass(frozen=True, eq=False, repr=False)
class LQRSensitivity(Immutable):
    """Regulator u = -K x with exact derivatives by parameters p (np,).

    Attributes
    ----------
    K, P : (nu, nx) and (nx, nx) arrays
        Gain, and cost matrix: x'Px is the cost from x.
    dK, dP : (nu, nx, np) and (nx, nx, np) arrays
        ∂K/∂p and ∂P/∂p.
    """

    K: Array
    P: Array
    dK: Array
    dP: Array

    def __repr__(self) -> str:
        nu, nx, count = self.dK.shape
        return f"LQRSensitivity({nx} states, {nu} inputs, {count} parameters)"

    @property
    def input_by_state(self) -> Array:
        """Derivative ∂u/∂x (nu, nx), which is -K."""
        return -self.K

    def input_by_parameters(self, x: ArrayLike) -> Array:
        """Derivative ∂u/∂p (nu, np) at a state (nx,)."""
        return np.asarray(-np.einsum("uxp,x->up", self.dK, self._state(x)))

    def cost(self, x: ArrayLike) -> float:
        """Cost J* = x'Px from a state (nx,)."""
        x = self._state(x)
        return float(x @ self.P @ x)

    def cost_by_state(self, x: ArrayLike) -> Array:
        """Derivative ∂J*/∂x (nx,) at a state (nx,)."""
        return 2 * self.P @ self._state(x)

    def cost_by_parameters(self, x: ArrayLike) -> Array:
        """Derivative ∂J*/∂p (np,) from a state (nx,)."""
        x = self._state(x)
        return np.asarray(np.einsum("x,xyp,y->p", x, self.dP, x))

    def noise_cost(self, W: ArrayLike) -> float:
        """Cost tr(PW) a step under noise covariance W (nx, nx)."""
        return float(np.sum(self.P * as_weight("W", W, len(self.P))))

    def noise_cost_by_parameters(self, W: ArrayLike, dW: ArrayLike | None = None) -> Array:
        """Derivative ∂tr(PW)/∂p (np,) for W (nx, nx), dW (nx, nx, np)."""
        W = as_weight("W", W, len(self.P))
        gradient: Array = np.einsum("xyp,xy->p", self.dP, W)
        if dW is None:
            return gradient
        return np.asarray(gradient + np.einsum("xy,xyp->p", self.P, as_array("dW", dW, self.dP.shape)))

    def _state(self, x: ArrayLike) -> Array:
        """State, checked."""
        return as_array("x", x, (len(self.P),))


def lqr_sensitivity(
    A: Any, B: ArrayLike | None = None, *, Q: ArrayLike, R: ArrayLike, S: ArrayLike | None = None,
    dA: ArrayLike | None = None, dB: ArrayLike | None = None, dQ: ArrayLike | None = None,
    dR: ArrayLike | None = None, dS: ArrayLike | None = None,
) -> LQRSensitivity:  # fmt: skip
    """Gain and cost of `lqr` with exact derivatives by p (np,).

    The Riccati equation holds at every p, so its derivative is a Lyapunov equation of the closed loop, which is solved
    for all parameters with one factorisation.

    Parameters
    ----------
    A, B, Q, R, S
        As for `lqr`.
    dA, dB : (nx, nx, np) and (nx, nu, np) arrays, optional
        ∂A/∂p and ∂B/∂p, the last axis that of the parameters; 0 where they are left out.
    dQ, dR, dS : (nx, nx, np), (nu, nu, np) and (nx, nu, np) arrays, optional
        ∂Q/∂p, ∂R/∂p and ∂S/∂p; 0 where they are left out.

    Returns
    -------
    LQRSensitivity

    Raises
    ------
    InputError, NotConvexError, NotStabilisableError
        Those of `lqr`; derivatives of other shapes, with NaN, or of weights that are not symmetric.

    References
    ----------
    Kao and Hennequin, "Automatic differentiation of Sylvester, Lyapunov, and algebraic Riccati equations", 2020;
    Kitagawa, International Journal of Control 25(5), 1977 (the Lyapunov equation by the Schur form).

    Examples
    --------
    >>> found = lqr_sensitivity(A, B, Q=Q, R=R, dA=dA, dB=dB)
    >>> gradient = found.cost_by_parameters(x0)
    """
    A, B = as_pair(A, B)
    nx, nu = B.shape
    Q = as_weight("Q", Q, nx)
    R = as_weight("R", R, nu)
    S = as_cross_weight(S, Q, R)
    K, P = lqr(A, B, Q=Q, R=R, S=S)
    given = {"dA": (dA, (nx, nx)), "dB": (dB, (nx, nu)), "dQ": (dQ, (nx, nx)), "dR": (dR, (nu, nu)),
             "dS": (dS, (nx, nu))}  # fmt: skip
    dA, dB, dQ, dR, dS = as_derivatives(given, symmetric=("dQ", "dR")).values()
    closed = A - B @ K
    moved = dA - np.einsum("xup,uy->xyp", dB, K)  # ∂(A - BK)/∂p with K held
    driven = np.einsum("yx,yz,zwp->xwp", closed, P, moved)
    cross = np.einsum("xup,uy->xyp", dS, K)
    weights = dQ + np.einsum("ux,uvp,vy->xyp", K, dR, K) - cross - cross.transpose(1, 0, 2)
    sx, su = cost_units(A, B, Q, R)
    unit = sx[:, None] * sx  # of P: the equation is solved in the units of the weights
    right = (weights + driven + driven.transpose(1, 0, 2)) / unit[:, :, None]
    dP = _lyapunov(closed * sx[:, None] / sx, right) * unit[:, :, None]
    M = R + B.T @ P @ B
    slope = np.einsum("yup,yz,zx->uxp", dB, P, closed) + np.einsum("yu,yzp,zx->uxp", B, dP, closed)
    slope += np.einsum("yu,yz,zxp->uxp", B, P, moved) + dS.transpose(1, 0, 2) - np.einsum("uvp,vx->uxp", dR, K)
    scaled = np.linalg.solve(M / su / su[:, None], (slope / su[:, None, None]).reshape(nu, -1))
    return LQRSensitivity(K, P, scaled.reshape(slope.shape) / su[:, None, None], dP)


def _lyapunov(A: Array, C: Array) -> Array:
    """Solution X (n, n, m) of X = A'XA + C, C symmetric, A stable."""
    n, _, m = C.shape
    if m == 0:
        return np.zeros(C.shape)
    T, V = schur(A, output="complex")
    right = np.einsum("ia,ijm,jb->abm", V.conj(), C, V, optimize=True)
    solution = np.zeros_like(right)
    for j in range(n):  # column by column: those before it are known
        known = np.einsum("aim,i->am", solution[:, :j], T[:j, j])
        column = right[:, j] + T.conj().T @ known
        solution[:, j] = solve_triangular(np.eye(n) - T[j, j] * T.conj().T, column, lower=True)
    X = np.einsum("ia,abm,jb->ijm", V, solution, V.conj(), optimize=True).real
    return np.asarray((X + X.transpose(1, 0, 2)) / 2)


def as_derivatives(
    given: Mapping[str, tuple[ArrayLike | None, tuple[int, ...]]],
    *,
    symmetric: tuple[str, ...] = (),
    count: int | None = None,
) -> dict[str, Array]:
    """Derivatives (*shape, np) by name, checked; zeros for None.

    `given` holds values and the shapes of the quantities themselves; np is `count`, or what the first array says. Other
    shapes and numbers of parameters, NaN, and derivatives of `symmetric` matrices that are not symmetric are refused.
    """
    checked: dict[str, Array] = {}
    for name, (value, shape) in given.items():
        if value is None:
            continue
        raw = as_floats(name, value)
        if raw.ndim == len(shape):
            expected = f"({', '.join(map(str, shape))}, np)"
            cure = f"The last axis is that of the parameters; of a single one: {name}[..., None]."
            raise InputError(name, f"shape {raw.shape}", expected, cure)
        array = as_array(name, raw, (*shape, count))
        count = array.shape[-1]
        if name in symmetric:
            gap = float(np.abs(array - array.swapaxes(0, 1)).max(initial=0.0))
            if gap > WEIGHT_ROUNDING * float(np.abs(array).max(initial=0.0)):
                got = f"max |{name} - {name}'| = {gap:.3g}"
                raise InputError(name, got, "a symmetric matrix for every parameter")
        checked[name] = array
    return {name: checked.get(name, np.zeros((*shape, count or 0))) for name, (_, shape) in given.items()}
