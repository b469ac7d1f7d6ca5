"""Infinite-horizon regulator, checked for stabilisability."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgWarning, matrix_balance, solve_discrete_are

from ccdtools_ground.door import as_cross_weight, as_pair, as_weight
from ccdtools_ground.tolerances import WEIGHT_ROUNDING
from mpc.checks import Array
from mpc.exceptions import NotStabilisableError
from mpc.tolerances import EPS, NEAR_CIRCLE, REACH, RICCATI, ROUNDED_SUM, SETTLED_MARGIN


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
    # in the units of the weights (x = x̃/sx, u = ũ/su) the solver does not depend on the user's units
    scaled = _Regulation(
        A * sx[:, None] / sx, B * sx[:, None] / su, Q / sx / sx[:, None], R / su / su[:, None],
        np.zeros(B.shape) if S is None else S / su / sx[:, None],
    )  # fmt: skip
    with np.errstate(all="ignore"):  # what overflows is not accepted
        found = scaled.solution(1 / sx)
    if found is None:
        raise _explained(scaled, 1 / sx)
    K, P = found
    return K * sx / su[:, None], P * sx * sx[:, None]


def settled(
    A: Array, B: Array, c: Array, *, Q: ArrayLike, R: ArrayLike, S: ArrayLike | None = None
) -> tuple[Array, Array]:
    """State (nx,) and input (nu,) at which x⁺ = Ax + Bu + c rests at least cost.

    About them c is gone from the model, and from what a plan costs but for a part that no input changes. They are
    where LQR settles with the offset −(R + B'PB)⁻¹ B' (I − (A − BK)')⁻¹ P c.
    """
    K, P = lqr(A, B, Q=Q, R=R, S=S)
    R = as_weight("R", R, B.shape[1])
    still = np.eye(len(A)) - A + B @ K
    offset = -np.linalg.solve(R + B.T @ P @ B, B.T @ np.linalg.solve(still.T, P @ c))
    x = np.asarray(np.linalg.solve(still, B @ offset + c))
    return x, np.asarray(offset - K @ x)


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


@dataclass(frozen=True, eq=False)
class _Regulation:
    """Matrices A, B, Q, R and S of a regulator."""

    A: Array
    B: Array
    Q: Array
    R: Array
    S: Array

    def solution(self, user_unit: Array) -> tuple[Array, Array] | None:
        """Gain and cost matrix, checked; None without a sane solution."""
        for first in (self._by_scipy, self._stabilising):
            found = self._refined(first())
            if found is not None:
                return found if self._sane(found[0], user_unit) else None
        return None

    def _sane(self, K: Array, user_unit: Array) -> bool:
        """Whether in some units the feedback is not absurdly large."""
        for unit in units_of(self.A, np.ones(len(self.A)), user_unit):
            fed, own = (float(np.linalg.norm(M * unit[:, None] / unit)) for M in (self.B @ K, self.A))
            if REACH * fed <= max(1.0, own):
                return True
        return False

    def _by_scipy(self) -> Array:
        """Root of SciPy's cost matrix; NaN without one."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", LinAlgWarning)
                return _root(solve_discrete_are(self.A, self.B, self.Q, self.R, s=self.S if self.S.any() else None))
        except (np.linalg.LinAlgError, ValueError):  # SciPy's names for the same trouble
            return np.full_like(self.A, np.nan)

    def _stabilising(self) -> Array:
        """Root of the cost matrix of some stabilising gain."""
        nx, nu = self.B.shape
        K = np.zeros((nu, nx))
        if _radius(self.A) >= 1:
            (unit,) = units_of(self.A)
            length = np.linalg.norm(self.B * unit[:, None], axis=0)
            length[length == 0] = 1.0
            A, B = self.A * unit[:, None] / unit, self.B * unit[:, None] / length
            other = _Regulation(A, B, np.eye(nx), np.eye(nu), np.zeros(B.shape))
            K = other.gain(other._by_scipy()) * unit / length[:, None]
        return self._root_of(K)

    def _refined(self, root: Array) -> tuple[Array, Array] | None:
        """Gain and cost matrix L'L by Newton's method, or None.

        They settle where a step neither changes P, in units in which its diagonal is one, nor how far the closed loop
        is from the unit circle: that halves with every step where Q does not see a mode there.
        """
        K, P = self.gain(root), root.T @ root
        for _ in range(40):  # from a gain far away each step at least halves the distance
            margin = self._margin(K)
            if not margin >= ROUNDED_SUM:
                return None
            root = self._root_of(K)
            K_after, after = self.gain(root), root.T @ root
            settled = abs(self._margin(K_after) - margin) <= SETTLED_MARGIN * margin
            if settled and _relative(after - P, after) <= RICCATI:  # of the last step most may be rounding
                gained = _relative(self._missed(K_after, after), P) < _relative(self._missed(K, P), P)
                K, P = (K_after, after) if gained else (K, P)
                return (K, P) if margin > NEAR_CIRCLE or self._is_seen(K, P) else None
            K, P = K_after, after
        return None

    def _root_of(self, K: Array) -> Array:
        """Root of the cost matrix of u = -Kx."""
        n = len(self.A)
        return _lyapunov_root(self.A - self.B @ K, self._cost_root[:, :n] - self._cost_root[:, n:] @ K)

    def _is_seen(self, K: Array, P: Array) -> bool:
        """Whether the slowest closed-loop mode costs more than rounding."""
        values, vectors = np.linalg.eig(self.A - self.B @ K)
        slow = int(np.argmax(np.abs(values)))
        mode = vectors[:, slow]
        cost = 2 * (1 - abs(values[slow])) * float((mode.conj() @ P @ mode).real)
        return bool(cost > ROUNDED_SUM * float(np.abs(mode) @ np.abs(self.Q) @ np.abs(mode)))

    def _missed(self, K: Array, P: Array) -> Array:
        """Residual of P in the Riccati equation."""
        return self.A.T @ P @ (self.A - self.B @ K) + self.Q - self.S @ K - P

    def _margin(self, K: Array) -> float:
        """Distance of the closed loop from the unit circle, or NaN."""
        return 1 - _radius(self.A - self.B @ K) if np.isfinite(K).all() else np.nan

    def gain(self, root: Array) -> Array:
        """Gain for a root of a cost matrix, by least squares."""
        n = len(self.A)
        M = np.vstack([self._cost_root[:, n:], root @ self.B])
        right = np.vstack([self._cost_root[:, :n], root @ self.A])
        if not (np.isfinite(M).all() and np.isfinite(right).all()):
            return np.full_like(self.B.T, np.nan)
        d = np.linalg.norm(M, axis=0)
        d[d == 0] = 1.0
        return np.asarray(np.linalg.lstsq(M / d, right, rcond=None)[0] / d[:, None])

    @cached_property
    def _cost_root(self) -> Array:
        """G (nx + nu, nx + nu) with a stage cost |G [x; u]|²."""
        return _root(np.block([[self.Q, self.S], [self.S.T, self.R]]))


def _relative(M: Array, P: Array) -> float:
    """Largest entry of a matrix, relative to P's diagonal."""
    size = np.sqrt(np.abs(np.diag(P)))
    return float(np.where(M == 0, 0.0, np.abs(M) / size / size[:, None]).max())


def _root(M: Array) -> Array:
    """Root L with L'L = M, for symmetric positive semidefinite M."""
    d = np.sqrt(np.abs(np.diag(M)))
    unit = np.where(d > 0, d, 1.0)
    values, vectors = np.linalg.eigh(M / unit / unit[:, None])
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * d)


def _lyapunov_root(A: Array, root: Array) -> Array:
    """Root L with L'L = P = A'PA + root'root for stable A, by doubling.

    Infinite where it does not end.
    """
    for _ in range(60):  # 2^60 samples
        more = root @ A
        root = np.asarray(np.linalg.qr(np.vstack([root, more]), mode="r"))
        if (np.linalg.norm(more, axis=0) <= EPS * np.linalg.norm(root, axis=0)).all():
            return root
        A = A @ A
    return np.full_like(A, np.inf)


class Mode(NamedTuple):
    """Mode of A: eigenvalue, strength [-] and |w| (nx,) of its left vector."""

    eigenvalue: complex
    strength: float
    parts: Array

    @property
    def value(self) -> str:
        """Eigenvalue in four digits."""
        real = abs(self.eigenvalue.imag) < REACH
        return f"{self.eigenvalue.real:.4g}" if real else f"{self.eigenvalue:.4g}"


def least_reached(A: Array, B: Array, eigenvalues: Iterable[complex], *units: Array) -> Mode:
    """Mode of (A, B) reached least at some eigenvalues; infinitely strong without eigenvalues.

    How strongly is σ_min [A - λI, B] relative to A, for columns of B as large as A: how strong an actuator is, is a
    matter of its cost. It depends on the units of the states: of given ones, and of those that balance A, those count
    in which it is largest.

    References
    ----------
    Hautus, *Controllability and observability conditions of linear autonomous systems*, 1969.
    """
    found = []
    scaled = [_sized(A, B, own) for own in units_of(A, *units)]
    for eigenvalue in eigenvalues:
        best = Mode(complex(eigenvalue), -1.0, np.ones(len(A)))
        for (F, G), size in scaled:
            U, strengths, _ = np.linalg.svd(np.hstack([F - eigenvalue * np.eye(len(F)), G]))
            if strengths[-1] / size > best.strength:
                best = Mode(complex(eigenvalue), float(strengths[-1] / size), np.abs(U[:, -1]))
        found.append(best)
    return min(found, key=lambda mode: mode.strength, default=Mode(complex(np.nan), np.inf, np.ones(len(A))))


def units_of(A: Array, *units: Array) -> Iterator[Array]:
    """Factors (nx,) of the states: `units`, then those that balance A."""
    yield from units
    yield 1 / np.asarray(matrix_balance(A, permute=False, separate=True)[1][0])


def _sized(A: Array, B: Array, unit: Array) -> tuple[tuple[Array, Array], float]:
    """Scaled A and B, and the size of A, at least one."""
    F = A * unit[:, None] / unit
    G = B * unit[:, None]
    size = max(1.0, float(np.linalg.norm(F, 2)))
    length = np.linalg.norm(G, axis=0)
    return (F, G * size / np.where(length > 0, length, 1.0)), size


def _explained(scaled: _Regulation, user_unit: Array) -> NotStabilisableError:
    """Error that names the mode that is unreachable or unseen."""
    A, B, Q, R, S = scaled.A, scaled.B, scaled.Q, scaled.R, scaled.S
    none = np.ones(len(A))
    eigenvalues = np.linalg.eigvals(A)
    lost = least_reached(A, B, eigenvalues[np.abs(eigenvalues) >= 1 - NEAR_CIRCLE], none, user_unit)
    what = "Q: got no weight on the mode"
    if S.any():  # of the plant and the cost that u = v - R⁻¹S'x leaves
        free = np.linalg.pinv(R, rcond=WEIGHT_ROUNDING, hermitian=True) @ S.T
        A = A - B @ free
        Q = Q - S @ free
        eigenvalues = np.linalg.eigvals(A)
        what = "S: got a stage cost without weight on the mode of A - BR⁻¹S'"
    unseen = least_reached(A.T, Q, eigenvalues[np.abs(np.abs(eigenvalues) - 1) <= NEAR_CIRCLE], none)
    if unseen.strength < min(REACH, lost.strength):
        return NotStabilisableError(
            f"{what} at eigenvalue {unseen.value}, on the unit circle, so the Riccati "
            "equation has no stabilising solution; expected Q to see it. Give the mode a weight, however small.",
            unseen.eigenvalue,
        )
    if lost.strength < REACH:
        return NotStabilisableError(
            f"(A, B): got a pair that cannot be stabilised, the input reaches the mode at eigenvalue {lost.value} "
            f"(modulus {abs(lost.eigenvalue):.4g}) with relative strength {lost.strength:.1e}, expected >= "
            f"{REACH:.0e}. Move the actuator.",
            lost.eigenvalue,
        )
    return NotStabilisableError(
        "(A, B): got a Riccati equation without a stabilising solution that holds to rounding, expected one. The pair "
        "is close to unstabilisable, its weights to not seeing a mode on the unit circle, or the data are badly scaled."
    )


def _radius(A: Array) -> float:
    """Spectral radius."""
    return float(np.abs(np.linalg.eigvals(A)).max())
