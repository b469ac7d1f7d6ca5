"""Whether outputs see what an extended Kalman filter has to follow, where it begins and about there."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

import numpy as np

from ccdtools.arrays import Array
from ccdtools.estimation.steady_state import lasting, mode_text, states_of
from ccdtools.exceptions import NotDetectableError
from mpc.modes import Mode, least_reached
from mpc.tolerances import NEAR_CIRCLE, REACH

POINTS = 16  # about the first estimate, drawn from its covariance, where the linearisation is looked at
FLAT = 1e-9  # of the largest slope of an output at these points: a slope that is none

Slopes = Callable[[Array], tuple[Array, Array]]  # x (n, nx) → F (n, nx, nx) and H (n, ny, nx)


class Detectability(Enum):
    """What the outputs see of the modes that do not decay, by the linearisation of a filter."""

    SEEN = "seen"
    SEEN_AWAY = "not seen at the first estimate, but about it"
    DRIFTING = "a mode that neither grows nor decays is not seen"
    UNKNOWN = "the linearisation is not finite"

    @property
    def advice(self) -> str:
        """What to do next, in one sentence."""
        return _ADVICE[self]


_ADVICE = {
    Detectability.SEEN: "Nothing to do.",
    Detectability.SEEN_AWAY: "Start the filter elsewhere, or measure more: at rest there it corrects nothing.",
    Detectability.DRIFTING: "Measure that state, or expect its variance to grow without a bound.",
    Detectability.UNKNOWN: "Check the outputs and the dynamics about x0: their derivatives are not finite there.",
}


def detectability(slopes: Slopes, x0: Array, P0: Array) -> Detectability:
    """What a linearisation says at the first estimate, and at points drawn about it.

    Raises
    ------
    NotDetectableError
        If at none of them the outputs depend on the state, or see a mode that grows.
    """
    deviation = np.sqrt(np.maximum(np.diag(P0), 0.0))
    unit = np.where(deviation > 0, deviation, 1.0)
    drawn = np.random.default_rng(0).standard_normal((POINTS, len(x0)))
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
    flat = bool((np.abs(H[0]) <= FLAT * np.abs(H).max()).all())
    at_first = bool(np.ravel(finite)[0]) and unseen[0] is None and not flat
    return Detectability.SEEN if at_first else Detectability.SEEN_AWAY


def _unseen(A: Array, C: Array, unit: Array) -> Mode | None:
    """The mode that does not decay and is not seen; of several the one that grows most. None where all are seen."""
    for eigenvalue in sorted(lasting(A), key=abs, reverse=True):
        mode = least_reached(A.T, C.T, [eigenvalue], unit, np.ones(len(A)))
        if mode.strength < REACH:
            return mode
    return None
