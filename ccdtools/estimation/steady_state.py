"""Steady Kalman filter from the dual regulator (Aᵀ, Cᵀ), and detectability."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ccdtools.arrays import Array
from ccdtools.estimation.tolerances import FLAT_OUTPUT, MAIN_STATES
from ccdtools.exceptions import NotDetectableError
from ccdtools_ground.outcome import Outcome
from mpc import NotStabilisableError, lqr
from mpc.riccati import Mode, cost_units, least_reached
from mpc.tolerances import NEAR_CIRCLE, REACH

Slopes = Callable[[Array], tuple[Array, Array]]  # x (n, nx) → F (n, nx, nx) and H (n, ny, nx)


def steady_covariance(A: Array, C: Array, W: Array, V: Array) -> Array:
    """Stabilising covariance (nx, nx) of x_k given y up to k − 1.

    `mpc.lqr` verifies P = A (P − P Cᵀ (C P Cᵀ + V)⁻¹ C P) Aᵀ + W and a decaying error, in units of the solution.

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
    """Error that names the mode of a dual error, else the least seen one."""
    unit, _ = cost_units(A.T, C.T, W, V)
    none = np.ones(len(A))
    own = None if error.eigenvalue is None else [error.eigenvalue]
    if error.message.startswith("Q:"):
        mode = least_reached(A, W, own or lasting(A), 1 / unit, none)
        what = f"W: got no noise on {mode_text(mode)} on the unit circle, so the steady filter would never correct it; "
        cure = "expected W to reach it. Give it noise, however small"
    else:
        mode = least_reached(A.T, C.T, own or lasting(A) or np.linalg.eigvals(A), unit, none)
        seen = f"the outputs see {mode_text(mode)} with relative strength {mode.strength:.1e}"
        if mode.strength < REACH:
            what = f"(A, C): got a pair that is not detectable, {seen}, "
            cure = f"expected >= {REACH:.0e}. Measure it"
        else:
            what = "(A, C): got a Riccati equation without a solution that can be relied on, expected one. Of the "
            cure = f"modes that do not decay {seen}, the least: measure it, check that V is not far too small"
    return NotDetectableError(f"{what}{cure}, or use steady=False with P0.", mode.eigenvalue, states_of(mode))


def lasting(A: Array) -> list[complex]:
    """Eigenvalues of modes that do not decay."""
    return [complex(value) for value in np.linalg.eigvals(A) if abs(value) >= 1 - NEAR_CIRCLE]


def mode_text(mode: Mode) -> str:
    """Description of a mode in words."""
    names = ", ".join(f"x{i + 1}" for i in states_of(mode))
    return f"the mode at eigenvalue {mode.value} (modulus {abs(mode.eigenvalue):.4g}), mostly of {names},"


def states_of(mode: Mode) -> tuple[int, ...]:
    """Indices of the states that a mode mostly consists of."""
    return tuple(int(i) for i in np.flatnonzero(mode.parts >= MAIN_STATES * mode.parts.max()))


class Detectability(Outcome):
    """Detectability of modes that do not decay, by a filter's linearisation."""

    SEEN = "seen", "Nothing to do."
    SEEN_AWAY = (
        "not seen at the first estimate, but about it",
        "Start the filter elsewhere, or measure more: at rest there it corrects nothing.",
    )
    DRIFTING = (
        "a mode that neither grows nor decays is not seen",
        "Measure that state, or expect its variance to grow without a bound.",
    )
    UNKNOWN = (
        "the linearisation is not finite",
        "Check the outputs and the dynamics about x0: their derivatives are not finite there.",
    )


def detectability(slopes: Slopes, x0: Array, P0: Array) -> Detectability:
    """Detectability at the first estimate and at points drawn about it.

    Raises
    ------
    NotDetectableError
        If at none of them the outputs depend on the state, or see a mode that grows.
    """
    deviation = np.sqrt(np.maximum(np.diag(P0), 0.0))
    unit = np.where(deviation > 0, deviation, 1.0)
    drawn = np.random.default_rng(0).standard_normal((16, len(x0)))  # points about the estimate
    with np.errstate(all="ignore"):
        F, H = slopes(np.vstack([x0, x0 + deviation * drawn]))
    finite = np.isfinite(F).all(axis=(1, 2)) & np.isfinite(H).all(axis=(1, 2))
    if not finite.any():
        return Detectability.UNKNOWN
    F, H = F[finite], H[finite] * unit
    if not H.any():
        raise NotDetectableError(
            "output: got outputs that do not depend on the state, at x0 or about it, expected a filter with something "
            "to correct. Measure a state, or begin elsewhere.", None, (),
        )  # fmt: skip
    unseen = [_unseen(A, C / unit, unit) for A, C in zip(F, H)]
    growing = [mode for mode in unseen if mode is not None and abs(mode.eigenvalue) > 1 + NEAR_CIRCLE]
    if len(growing) == len(unseen):
        mode = growing[0]
        raise NotDetectableError(
            f"output: got outputs that see {mode_text(mode)} of the linearisation with relative "
            f"strength {mode.strength:.1e}, at x0 and about it, expected >= {REACH:.0e}. Measure it: its variance "
            "would grow without a bound.", mode.eigenvalue, states_of(mode),
        )  # fmt: skip
    if all(mode is not None for mode in unseen):
        return Detectability.DRIFTING
    flat = bool((np.abs(H[0]) <= FLAT_OUTPUT * np.abs(H).max()).all())
    at_first = bool(np.ravel(finite)[0]) and unseen[0] is None and not flat
    return Detectability.SEEN if at_first else Detectability.SEEN_AWAY


def _unseen(A: Array, C: Array, unit: Array) -> Mode | None:
    """Fastest growing unseen mode that does not decay, None if all are seen."""
    for eigenvalue in sorted(lasting(A), key=abs, reverse=True):
        mode = least_reached(A.T, C.T, [eigenvalue], unit, np.ones(len(A)))
        if mode.strength < REACH:
            return mode
    return None
