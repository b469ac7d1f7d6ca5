"""Exceptions of `mpc`."""

from __future__ import annotations

from ccdtools_ground.errors import InputError, MPCError, NotConvexError

__all__ = ["InfeasibleError", "InputError", "MPCError", "NotConvexError", "NotStabilisableError"]


class InfeasibleError(MPCError):
    """No feasible parameter, hence no explicit law."""


class NotStabilisableError(MPCError, ValueError):
    """Pair (A, B) that no gain, or only an absurd one, stabilises.

    Attributes
    ----------
    eigenvalue : complex or None
        The eigenvalue of A on or outside the unit circle that the input does not reach, where it is known.
    """

    def __init__(self, message: str, eigenvalue: complex | None = None) -> None:
        super().__init__(message, eigenvalue)
        self.message = message
        self.eigenvalue = eigenvalue

    def __str__(self) -> str:
        return self.message
