"""The infinite-horizon regulator, checked: of nearly unstabilisable pairs SciPy returns gains of 1e8 unwarned."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgWarning, solve_discrete_are, solve_discrete_lyapunov

from mpc.checks import Array, as_cross_weight, as_pair, as_weight
from mpc.exceptions import NotStabilisableError
from mpc.tolerances import NEGATIVE_WEIGHT, REACH, RICCATI, RICCATI_REFINED, UNIT_CIRCLE, UNSEEN


def lqr(
    A: Any, B: ArrayLike | None = None, *, Q: ArrayLike, R: ArrayLike, S: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Gain K and cost matrix P of the discrete-time regulator u = -K x.

    Parameters
    ----------
    A : (nx, nx) array, or a discrete-time `control.StateSpace` (then without B)
        State matrix [-].
    B : (nx, nu) array
        Input matrix [-].
    Q : (nx, nx) array, (nx,) diagonal or number
        State weight, symmetric positive semidefinite.
    R : (nu, nu) array, (nu,) diagonal or number
        Input weight, symmetric positive semidefinite; singular is legal while B'PB + R is regular.
    S : (nx, nu) array, optional
        Cross weight, `N` in python-control and MATLAB; [Q S; S' R] is positive semidefinite.

    Returns
    -------
    K : (nu, nx) array
        Minimises Σ x'Qx + 2 x'Su + u'Ru; the closed loop A - BK is stable.
    P : (nx, nx) array
        Stabilising solution of the Riccati equation; x'Px is the optimal cost.

    Raises
    ------
    InputError, NotConvexError
        Wrong shapes, NaN, or weights that are not symmetric positive semidefinite; of [Q S; S' R] it names S.
    NotStabilisableError
        The pair is unstabilisable, nearly so, or a mode on the unit circle carries no cost; with S, a mode of the
        plant under the input -R⁻¹S'x that costs nothing now: a zero of the weighted outputs.

    References
    ----------
    Hautus, *Controllability and observability conditions of linear autonomous systems*, 1969 (the rank test);
    Arnold and Laub, Proc. IEEE 72(12), 1984 (the solver, in SciPy); Hewer, IEEE TAC 16(4), 1971 (its refinement);
    Anderson and Moore, *Optimal Control: Linear Quadratic Methods*, 1990 (the cross weight taken out of a problem).
    """
    A, B = as_pair(A, B)
    Q = as_weight("Q", Q, A.shape[0])
    R = as_weight("R", R, B.shape[1])
    S = as_cross_weight(S, Q, R)
    sx, su = cost_units(A, B, Q, R)
    # in the units of the weights (x = x̃/sx, u = ũ/su) the tests below do not depend on the user's units
    As = A * sx[:, None] / sx
    Bs = B * sx[:, None] / su
    Qs = Q / sx / sx[:, None]
    Rs = R / su / su[:, None]
    Ss = None if S is None else S / su / sx[:, None]
    _check_reach(As, Bs)
    _check_cost(As, Bs, Qs, Rs, Ss)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # the checks below decide
            Ps = _riccati(As, Bs, Qs, Rs, Ss)
            Ks = _gain_of(Ps, As, Bs, Rs, Ss)
    except (np.linalg.LinAlgError, ValueError):  # SciPy's names for the same trouble
        raise NotStabilisableError(
            "(A, B): got a Riccati equation without a stabilising solution, expected one. Check that "
            "(A, B) is stabilisable and that Q sees every mode on the unit circle."
        ) from None
    _check_solution(As, Bs, Qs, Ss, Ps, Ks)
    P = Ps * sx * sx[:, None]
    return Ks * sx / su[:, None], (P + P.T) / 2


def cost_units(A: Array, B: Array, Q: Array, R: Array) -> tuple[Array, Array]:
    """Scales (nx,) and (nu,) that give the weights a unit diagonal.

    A state or input without a weight takes its scale from the states it drives one step later, and a state that
    drives none from the inputs that drive it.
    """
    sx = np.sqrt(np.diag(Q))
    su = np.sqrt(np.diag(R))
    for _ in range(len(sx)):
        driven = (sx[:, None] * np.abs(A)).max(axis=0)
        sx = np.where(sx > 0, sx, driven)
    su = np.where(su > 0, su, (sx[:, None] * np.abs(B)).max(axis=0))
    with np.errstate(divide="ignore"):
        moved = 1 / (np.abs(B) / np.where(su > 0, su, 1.0)).max(axis=1)
    sx = np.where(sx > 0, sx, np.where(np.isfinite(moved), moved, 1.0))
    return sx, np.where(su > 0, su, 1.0)


def _riccati(A: Array, B: Array, Q: Array, R: Array, S: Array | None) -> Array:
    """Stabilising solution, refined by Newton steps where SciPy's leaves a residual."""
    P: Array = solve_discrete_are(A, B, Q, R, s=S)
    K = _gain_of(P, A, B, R, S)
    residual = _residual(P, K, A, B, Q, S)
    for _ in range(3):
        closed = A - B @ K
        if residual <= RICCATI_REFINED or not _radius(closed) < 1:
            break
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LinAlgWarning)  # the residual decides
            cost = Q + K.T @ R @ K
            refined = solve_discrete_lyapunov(closed.T, cost if S is None else cost - S @ K - K.T @ S.T)
        K = _gain_of(refined, A, B, R, S)
        last = residual
        residual = _residual(refined, K, A, B, Q, S)
        if not residual < last:
            break
        P = refined
    return P


def _gain_of(P: Array, A: Array, B: Array, R: Array, S: Array | None) -> Array:
    """Gain that belongs to a cost matrix, for symmetric scaling of B'PB + R."""
    M = R + B.T @ P @ B
    d = np.sqrt(np.abs(np.diag(M)))
    d[d == 0] = 1.0
    slope = B.T @ P @ A if S is None else B.T @ P @ A + S.T
    return np.asarray(np.linalg.solve(M / d / d[:, None], slope / d[:, None]) / d[:, None])


def _check_reach(A: Array, B: Array) -> None:
    """Hautus test: σ_min [A - λI, B] against its scale, for every eigenvalue on or outside the unit circle."""
    size = max(1.0, float(np.linalg.norm(A, 2)))
    length = np.linalg.norm(B, axis=0)
    B = B * size / np.where(length > 0, length, 1.0)  # how strong an actuator is, is a matter of its cost
    for eigenvalue in np.linalg.eigvals(A):
        if abs(eigenvalue) < 1 - UNIT_CIRCLE:
            continue
        pencil = np.hstack([A - eigenvalue * np.eye(len(A)), B])
        reach = np.linalg.svd(pencil, compute_uv=False)[-1] / size
        if reach < REACH:
            raise NotStabilisableError(
                f"(A, B): got a pair that cannot be stabilised, the input reaches the mode at eigenvalue "
                f"{eigenvalue:.4g} (modulus {abs(eigenvalue):.4g}) with relative strength {reach:.1e}, expected >= "
                f"{REACH:.0e}. Move the actuator, or rescale Q if states are measured in very different units.",
                complex(eigenvalue),
            )


def _check_cost(A: Array, B: Array, Q: Array, R: Array, S: Array | None) -> None:
    """The dual test: a mode on the unit circle that Q does not see is never brought back.

    With S it is asked of the plant and the cost that u = v - R⁻¹S'x leaves.
    """
    unseen = "Q: got no weight on the mode"
    if S is not None:
        free = np.linalg.pinv(R, rcond=NEGATIVE_WEIGHT, hermitian=True) @ S.T
        A = A - B @ free
        Q = Q - S @ free
        unseen = "S: got a stage cost without weight on the mode of A - BR⁻¹S'"
    for eigenvalue in np.linalg.eigvals(A):
        if abs(abs(eigenvalue) - 1) > UNSEEN:
            continue
        pencil = np.vstack([A - eigenvalue * np.eye(len(A)), Q])
        if np.linalg.svd(pencil, compute_uv=False)[-1] < UNSEEN * max(1.0, float(np.linalg.norm(A, 2))):
            raise NotStabilisableError(
                f"{unseen} at eigenvalue {eigenvalue:.4g}, on the unit circle, so the Riccati "
                "equation has no stabilising solution; expected Q to see it. Give the mode a weight, however small.",
                complex(eigenvalue),
            )


def _check_solution(A: Array, B: Array, Q: Array, S: Array | None, P: Array, K: Array) -> None:
    """Raise where the closed loop is not stable or the Riccati equation does not hold."""
    radius = _radius(A - B @ K) if np.isfinite(K).all() else np.inf
    residual = _residual(P, K, A, B, Q, S) if np.isfinite(P).all() and np.isfinite(K).all() else np.inf
    if radius >= 1 or residual > RICCATI:
        raise NotStabilisableError(
            f"(A, B): got a Riccati solution with closed-loop spectral radius {radius:.6g} (expected < 1) and "
            f"relative residual {residual:.1e} (expected <= {RICCATI:.0e}). The pair is close to unstabilisable, "
            "its weights to not seeing a mode on the unit circle, or the data are badly scaled."
        )


def _radius(A: Array) -> float:
    """Spectral radius."""
    return float(np.abs(np.linalg.eigvals(A)).max())


def _residual(P: Array, K: Array, A: Array, B: Array, Q: Array, S: Array | None) -> float:
    """Residual of the Riccati equation relative to its largest term."""
    size = max(float(np.abs(P).max()), float(np.abs(Q).max()), np.finfo(float).tiny)
    missed = A.T @ P @ (A - B @ K) + Q - P
    return float(np.abs(missed if S is None else missed - S @ K).max()) / size
