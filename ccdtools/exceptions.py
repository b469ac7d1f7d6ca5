"""Exceptions and warnings of `ccdtools`."""

from ccdtools_ground.errors import CCDError, InputError, SimulatorError

__all__ = ["CCDError", "InputError", "JumpWarning", "LimitWarning", "NotDetectableError", "SamplingWarning",
           "SimulatorError"]  # fmt: skip


class NotDetectableError(CCDError, ValueError):
    """No steady estimator exists: a persistent mode is unseen or noiseless.

    Attributes
    ----------
    eigenvalue : complex or None
        That of the mode, where it is known.
    states : tuple of int
        Indices of the states that the mode is mostly made of.
    """

    def __init__(self, message: str, eigenvalue: complex | None = None, states: tuple[int, ...] = ()) -> None:
        super().__init__(message, eigenvalue, states)
        self.message = message
        self.eigenvalue = eigenvalue
        self.states = states

    def __str__(self) -> str:
        return self.message


class SamplingWarning(UserWarning):
    """A sampling time hardly resolves a mode of the plant, or not at all."""


class JumpWarning(UserWarning):
    """The dynamics of a plant jump, which limits integration and derivatives there."""


class LimitWarning(UserWarning):
    """No controller can keep the state limits of a co-design from its start."""
