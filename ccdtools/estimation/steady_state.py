"""The steady Kalman filter, from the checked regulator of the dual pair (Aᵀ, Cᵀ)."""

from __future__ import annotations

import numpy as np

from ccdtools.arrays import Array
from ccdtools.exceptions import NotDetectableError
from mpc import NotStabilisableError, lqr
from mpc.lqr import cost_units
from mpc.tolerances import REACH, UNIT_CIRCLE, UNSEEN

MAINLY = 0.5  # of the largest part of a mode: states with less are not named


def steady_covariance(A: Array, C: Array, W: Array, V: Array) -> Array:
    """P = A (P − P Cᵀ (C P Cᵀ + V)⁻¹ C P) Aᵀ + W, the stabilising solution: covariance of x_k given y up to k − 1.

    `mpc.lqr` verifies that the equation holds and the error of the filter decays.

    Raises
    ------
    NotDetectableError
        If the outputs do not see a mode that does not decay, or hardly; or no noise reaches one on the unit circle.
    """
    try:
        _, P = lqr(A.T, C.T, Q=W, R=V)
    except NotStabilisableError as error:
        raise _named(A, C, W, V, error.eigenvalue, by_noise=error.message.startswith("Q:")) from None
    return P


def _named(A: Array, C: Array, W: Array, V: Array, eigenvalue: complex | None, *, by_noise: bool) -> NotDetectableError:
    """The error that names the mode at an eigenvalue; where none is known, the one that the outputs see least."""
    unit, output_unit = cost_units(A.T, C.T, W, V)
    A = A * unit / unit[:, None]  # in units of the noise
    C = C * unit / output_unit[:, None]
    W = W / unit / unit[:, None]
    size = max(1.0, float(np.linalg.norm(A, 2)))
    if by_noise:
        eigenvalue, _, mode = _least_of(A.T, W, eigenvalue, size)
        return NotDetectableError(
            f"W: got no noise on {_mode(eigenvalue, mode)}, on the unit circle, so the steady filter would never "
            "correct it; expected W to reach it. Give it noise, however small, or use steady=False with P0.",
            eigenvalue, _states(mode),
        )  # fmt: skip
    length = np.linalg.norm(C, axis=1)[:, None]
    rows = C * size / np.where(length > 0, length, 1.0)
    eigenvalue, strength, mode = _least_of(A, rows, eigenvalue, size)
    if strength < REACH:
        return NotDetectableError(
            f"(A, C): got a pair that is not detectable, the outputs see {_mode(eigenvalue, mode)} with relative "
            f"strength {strength:.1e}, expected >= {REACH:.0e}. Measure it, or use steady=False with P0.",
            eigenvalue, _states(mode),
        )  # fmt: skip
    return NotDetectableError(
        "(A, C): got a Riccati equation without a solution that can be relied on, expected one. Of the modes that do "
        f"not decay the outputs see {_mode(eigenvalue, mode)} least, with relative strength {strength:.1e}: measure "
        "it, check that V is not far too small, or use steady=False with P0.",
        eigenvalue, _states(mode),
    )  # fmt: skip


def _least_of(A: Array, rows: Array, eigenvalue: complex | None, size: float) -> tuple[complex, float, Array]:
    """The eigenvalue whose mode the rows see least, how strongly, and its parts |v| (nx,); of one, if it is given."""
    found = []
    for one in np.linalg.eigvals(A) if eigenvalue is None else [eigenvalue]:
        if eigenvalue is None and abs(one) < 1 - max(UNIT_CIRCLE, UNSEEN):
            continue
        _, strengths, V = np.linalg.svd(np.vstack([A - one * np.eye(len(A)), rows]))
        found.append((float(strengths[-1]) / size, complex(one), np.abs(V[-1])))
    if not found:
        return complex(max(np.linalg.eigvals(A), key=abs)), np.inf, np.ones(len(A))
    strength, one, mode = min(found, key=lambda each: each[0])
    return one, strength, mode


def _mode(eigenvalue: complex, mode: Array) -> str:
    """A mode in words."""
    value = f"{eigenvalue.real:.4g}" if abs(eigenvalue.imag) < UNSEEN else f"{eigenvalue:.4g}"
    names = ", ".join(f"x{i + 1}" for i in _states(mode))
    return f"the mode at eigenvalue {value} (modulus {abs(eigenvalue):.4g}), mostly of {names},"


def _states(mode: Array) -> tuple[int, ...]:
    """The states that a mode is mostly made of."""
    return tuple(int(i) for i in np.flatnonzero(mode >= MAINLY * mode.max()))
