"""The steady Kalman filter, from the checked regulator of the dual pair (Aᵀ, Cᵀ)."""

from __future__ import annotations

import numpy as np

from ccdtools.arrays import Array
from ccdtools.exceptions import NotDetectableError
from mpc import NotStabilisableError, lqr
from mpc.lqr import cost_units
from mpc.modes import Mode, least_reached
from mpc.tolerances import REACH, UNIT_CIRCLE, UNSEEN

MAINLY = 0.5  # of the largest part of a mode: states with less are not named


def steady_covariance(A: Array, C: Array, W: Array, V: Array) -> Array:
    """P = A (P − P Cᵀ (C P Cᵀ + V)⁻¹ C P) Aᵀ + W, the stabilising solution: covariance of x_k given y up to k − 1.

    `mpc.lqr` verifies that the equation holds and the error of the filter decays, in units of the solution alone.

    Raises
    ------
    NotDetectableError
        If the outputs do not see a mode that does not decay, or hardly; or no noise reaches one on the unit circle.
    """
    try:
        _, P = lqr(A.T, C.T, Q=W, R=V)
    except NotStabilisableError as error:
        raise _named(A, C, W, V, error) from None
    return P


def _named(A: Array, C: Array, W: Array, V: Array, error: NotStabilisableError) -> NotDetectableError:
    """The error that names the mode of an error of the dual pair; where it has none, the one that is seen least."""
    unit, _ = cost_units(A.T, C.T, W, V)
    none = np.ones(len(A))
    own = None if error.eigenvalue is None else [error.eigenvalue]
    if error.message.startswith("Q:"):
        mode = least_reached(A, W, own or lasting(A), 1 / unit, none)
        return NotDetectableError(
            f"W: got no noise on {mode_text(mode)} on the unit circle, so the steady filter would never "
            "correct it; expected W to reach it. Give it noise, however small, or use steady=False with P0.",
            mode.eigenvalue, states_of(mode),
        )  # fmt: skip
    mode = least_reached(A.T, C.T, own or lasting(A) or np.linalg.eigvals(A), unit, none)
    if mode.strength < REACH:
        return NotDetectableError(
            f"(A, C): got a pair that is not detectable, the outputs see {mode_text(mode)} with relative "
            f"strength {mode.strength:.1e}, expected >= {REACH:.0e}. Measure it, or use steady=False with P0.",
            mode.eigenvalue, states_of(mode),
        )  # fmt: skip
    return NotDetectableError(
        "(A, C): got a Riccati equation without a solution that can be relied on, expected one. Of the modes that do "
        f"not decay the outputs see {mode_text(mode)} least, with relative strength {mode.strength:.1e}: "
        "measure it, check that V is not far too small, or use steady=False with P0.",
        mode.eigenvalue, states_of(mode),
    )  # fmt: skip


def lasting(A: Array) -> list[complex]:
    """Eigenvalues of modes that do not decay."""
    return [complex(value) for value in np.linalg.eigvals(A) if abs(value) >= 1 - max(UNIT_CIRCLE, UNSEEN)]


def mode_text(mode: Mode) -> str:
    """A mode in words."""
    names = ", ".join(f"x{i + 1}" for i in states_of(mode))
    return f"the mode at eigenvalue {mode.value} (modulus {abs(mode.eigenvalue):.4g}), mostly of {names},"


def states_of(mode: Mode) -> tuple[int, ...]:
    """The states that a mode is mostly made of."""
    return tuple(int(i) for i in np.flatnonzero(mode.parts >= MAINLY * mode.parts.max()))
