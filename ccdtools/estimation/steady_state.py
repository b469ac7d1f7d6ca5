"""The steady Kalman filter, from the checked regulator of the dual pair (Aᵀ, Cᵀ)."""

from __future__ import annotations

import numpy as np

from ccdtools.arrays import Array
from ccdtools.estimation.belief import gain_of, predicted_covariance, updated_covariance
from ccdtools.exceptions import NotDetectableError
from mpc import NotStabilisableError, lqr
from mpc.lqr import cost_units
from mpc.tolerances import REACH, RICCATI, UNIT_CIRCLE, UNSEEN

MAINLY = 0.5  # of the largest part of a mode: states with less are not named
NEAR_CIRCLE = 1e-6  # distance from the unit circle up to which a mode grows so slowly that its noise does not decide
DOUBLINGS = 60  # steps of a doubling iteration at most: 2^60 samples
CONVERGED = 1e-15  # its last change, relative to each variance


def steady_covariance(A: Array, C: Array, W: Array, V: Array) -> Array:
    """P = A (P − P Cᵀ (C P Cᵀ + V)⁻¹ C P) Aᵀ + W, the stabilising solution: covariance of x_k given y up to k − 1.

    `mpc.lqr` verifies that the equation holds and the error of the filter decays. It measures how well a mode is seen
    in units of the noise, by which a bias that hardly drifts is not seen at all, though its filter is only slow: where
    only such modes are in its way the equation is solved by doubling, and verified, too.

    Raises
    ------
    NotDetectableError
        If the outputs do not see a mode that does not decay, or hardly; or no noise reaches one on the unit circle.
    """
    try:
        _, P = lqr(A.T, C.T, Q=W, R=V)
    except NotStabilisableError as error:
        by_noise = error.message.startswith("Q:")
        slow = None if by_noise else _slow_covariance(A, C, W, V)
        if slow is None:
            raise _named(A, C, W, V, error.eigenvalue, by_noise=by_noise) from None
        return slow
    return P


def _slow_covariance(A: Array, C: Array, W: Array, V: Array) -> Array | None:
    """The same by doubling, where outputs see unstable modes in units of noise, and those on the unit circle in any.

    References
    ----------
    Anderson (1978), Second-order convergent algorithms for the steady-state Riccati equation, Int. J. Control 28(2).
    """
    unit, output_unit = cost_units(A.T, C.T, W, V)
    for eigenvalue in np.linalg.eigvals(A):
        if abs(eigenvalue) < 1 - UNIT_CIRCLE:
            continue
        own = unit if abs(eigenvalue) > 1 + NEAR_CIRCLE else _shown_units(A, C / output_unit[:, None])
        if seen_least(A * own / own[:, None], relative_rows(A * own / own[:, None], C * own), eigenvalue)[1] < REACH:
            return None
    identity = np.eye(len(A))
    F, H = (A * unit / unit[:, None]).T, W / unit / unit[:, None]
    G = (C * unit).T @ np.linalg.solve(V, C * unit)
    for _ in range(DOUBLINGS):
        both = np.linalg.solve(identity + G @ H, np.hstack([F, G]))
        M, N = both[:, : len(A)], both[:, len(A) :]
        more = F.T @ H @ M
        F, G, H = F @ M, G + F @ N @ F.T, H + (more + more.T) / 2
        if not np.isfinite(H).all() or (np.diag(more) <= CONVERGED * np.diag(H)).all():
            break
    P = H * unit * unit[:, None]
    return P if _holds(P, A, C, W, V) else None


def _holds(P: Array, A: Array, C: Array, W: Array, V: Array) -> bool:
    """Whether P solves the equation, in units in which its diagonal is one, and the error of the filter decays."""
    size = np.sqrt(np.diag(P)) if np.isfinite(P).all() else np.zeros(len(P))
    if not (size > 0).all():
        return False
    K = gain_of(P, C, V)
    residual = (predicted_covariance(updated_covariance(P, C, V, K), A, W) - P) / size / size[:, None]
    decays = np.abs(np.linalg.eigvals(A - A @ K @ C)).max() < 1
    return bool(decays and np.abs(residual).max() <= RICCATI)


def _shown_units(A: Array, C: Array) -> Array:
    """Units (nx,) in which every state moves an output by as much within nx samples, whatever units it is given in."""
    rows = C
    shown = np.zeros(len(A))
    for _ in range(len(A)):
        shown = np.maximum(shown, np.abs(rows).max(axis=0))
        rows = rows @ A
    return np.where(shown > 0, 1 / np.where(shown > 0, shown, 1.0), 1.0)


def relative_rows(A: Array, C: Array) -> Array:
    """Rows of C, each as long as A is large: how precise a sensor is, is a matter of V."""
    length = np.linalg.norm(C, axis=1)[:, None]
    return np.asarray(C * _size(A) / np.where(length > 0, length, 1.0))


def _size(A: Array) -> float:
    """The size of A, at least one."""
    return max(1.0, float(np.linalg.norm(A, 2)))


def _named(A: Array, C: Array, W: Array, V: Array, eigenvalue: complex | None, *, by_noise: bool) -> NotDetectableError:
    """The error that names the mode at an eigenvalue; where none is known, the one that the outputs see least."""
    unit, _ = cost_units(A.T, C.T, W, V)
    A = A * unit / unit[:, None]  # in units of the noise
    if by_noise:
        eigenvalue, _, mode = seen_least(A.T, W / unit / unit[:, None], eigenvalue)
        return NotDetectableError(
            f"W: got no noise on {mode_text(eigenvalue, mode)} on the unit circle, so the steady filter would never "
            "correct it; expected W to reach it. Give it noise, however small, or use steady=False with P0.",
            eigenvalue, states_of(mode),
        )  # fmt: skip
    eigenvalue, strength, mode = seen_least(A, relative_rows(A, C * unit), eigenvalue)
    if strength < REACH:
        return NotDetectableError(
            f"(A, C): got a pair that is not detectable, the outputs see {mode_text(eigenvalue, mode)} with relative "
            f"strength {strength:.1e}, expected >= {REACH:.0e}. Measure it, or use steady=False with P0.",
            eigenvalue, states_of(mode),
        )  # fmt: skip
    return NotDetectableError(
        "(A, C): got a Riccati equation without a solution that can be relied on, expected one. Of the modes that do "
        f"not decay the outputs see {mode_text(eigenvalue, mode)} least, with relative strength {strength:.1e}: "
        "measure it, check that V is not far too small, or use steady=False with P0.",
        eigenvalue, states_of(mode),
    )  # fmt: skip


def seen_least(A: Array, rows: Array, eigenvalue: complex | None) -> tuple[complex, float, Array]:
    """The eigenvalue whose mode the rows see least, how strongly, and its parts |v| (nx,); of one, if it is given."""
    found = []
    for one in np.linalg.eigvals(A) if eigenvalue is None else [eigenvalue]:
        if eigenvalue is None and abs(one) < 1 - max(UNIT_CIRCLE, UNSEEN):
            continue
        _, strengths, V = np.linalg.svd(np.vstack([A - one * np.eye(len(A)), rows]))
        found.append((float(strengths[-1]) / _size(A), complex(one), np.abs(V[-1])))
    if not found:
        return complex(max(np.linalg.eigvals(A), key=abs)), np.inf, np.ones(len(A))
    strength, one, mode = min(found, key=lambda each: each[0])
    return one, strength, mode


def mode_text(eigenvalue: complex, mode: Array) -> str:
    """A mode in words."""
    value = f"{eigenvalue.real:.4g}" if abs(eigenvalue.imag) < UNSEEN else f"{eigenvalue:.4g}"
    names = ", ".join(f"x{i + 1}" for i in states_of(mode))
    return f"the mode at eigenvalue {value} (modulus {abs(eigenvalue):.4g}), mostly of {names},"


def states_of(mode: Array) -> tuple[int, ...]:
    """The states that a mode is mostly made of."""
    return tuple(int(i) for i in np.flatnonzero(mode >= MAINLY * mode.max()))
