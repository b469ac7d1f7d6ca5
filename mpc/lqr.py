"""The infinite-horizon regulator, checked: SciPy's Riccati solver returns gains of 1e8 without a word."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_discrete_are

from mpc.checks import Array, as_pair, as_weight
from mpc.exceptions import NotStabilisableError

_REACH = 1e-7  # relative distance to an unstabilisable pair below which the gain is not trusted


def lqr(A: Any, B: ArrayLike | None = None, *, Q: ArrayLike, R: ArrayLike) -> tuple[Array, Array]:
    """Gain K and cost matrix P of the discrete-time regulator u = -K x.

    Parameters
    ----------
    A : (nx, nx) array, or a discrete-time `control.StateSpace` (then without B)
        State matrix [-].
    B : (nx, nu) array
        Input matrix [-].
    Q : (nx, nx) array or (nx,) diagonal
        State weight, symmetric positive semidefinite.
    R : (nu, nu) array or (nu,) diagonal
        Input weight, symmetric positive semidefinite; singular is legal while B'PB + R is regular.

    Returns
    -------
    K : (nu, nx) array
        Minimises Σ x'Qx + u'Ru; the closed loop A - BK is stable.
    P : (nx, nx) array
        Stabilising solution of the Riccati equation; x'Px is the optimal cost.

    Raises
    ------
    InputError, NotConvexError
        Wrong shapes, NaN, or weights that are not symmetric positive semidefinite.
    NotStabilisableError
        The pair is unstabilisable, nearly so, or a mode on the unit circle carries no cost.

    References
    ----------
    Hautus, *Controllability and observability conditions of linear autonomous systems*, 1969 (the rank test);
    Arnold and Laub, Proc. IEEE 72(12), 1984 (the solver, in SciPy).
    """
    A, B = as_pair(A, B)
    Q, R = as_weight("Q", Q, A.shape[0]), as_weight("R", R, B.shape[1])
    sx, su = _units(Q), _units(R)
    # in the units of the weights (x = x̃/sx, u = ũ/su) the tests below do not depend on the user's units
    As, Bs, Qs, Rs = A * sx[:, None] / sx, B * sx[:, None] / su, Q / np.outer(sx, sx), R / np.outer(su, su)
    _check_reach(As, Bs)
    try:
        Ps = solve_discrete_are(As, Bs, Qs, Rs)
        Ks = np.linalg.solve(Rs + Bs.T @ Ps @ Bs, Bs.T @ Ps @ As)
    except np.linalg.LinAlgError as error:
        raise NotStabilisableError(
            f"the Riccati equation has no stabilising solution ({error}). Check that (A, B) is stabilisable "
            "and that Q sees every mode on the unit circle."
        ) from None
    _check_solution(As, Bs, Qs, Rs, Ps, Ks)
    P = Ps * np.outer(sx, sx)
    return Ks * sx / su[:, None], (P + P.T) / 2


def _units(weight: Array) -> Array:
    d = np.sqrt(np.diag(weight))
    return np.where(d > 0, d, 1.0)


def _check_reach(A: Array, B: Array) -> None:
    """Hautus test: σ_min [A - λI, B] against its scale, for every eigenvalue on or outside the unit circle."""
    size = max(1.0, float(np.linalg.norm(A, 2)))
    for eigenvalue in np.linalg.eigvals(A):
        if abs(eigenvalue) < 1 - 1e-9:
            continue
        pencil = np.hstack([A - eigenvalue * np.eye(len(A)), B])
        reach = np.linalg.svd(pencil, compute_uv=False)[-1] / size
        if reach < _REACH:
            raise NotStabilisableError(
                f"(A, B) cannot be stabilised: the input reaches the mode at eigenvalue {eigenvalue:.4g} "
                f"(modulus {abs(eigenvalue):.4g}) with relative strength {reach:.1e}, expected >= {_REACH:.0e}. "
                "Move the actuator, or rescale R if the input is measured in very different units.",
                complex(eigenvalue),
            )


def _check_solution(A: Array, B: Array, Q: Array, R: Array, P: Array, K: Array) -> None:
    radius = np.abs(np.linalg.eigvals(A - B @ K)).max() if np.isfinite(K).all() else np.inf
    residual = np.inf
    if np.isfinite(P).all():
        residual = np.abs(A.T @ P @ (A - B @ K) + Q - P).max() / max(1.0, float(np.abs(P).max()))
    if radius >= 1 or residual > 1e-6:
        raise NotStabilisableError(
            f"the Riccati solution is not usable: closed-loop spectral radius {radius:.6g} (expected < 1), relative "
            f"residual {residual:.1e} (expected <= 1e-6). The pair (A, B) is close to unstabilisable or badly scaled."
        )
