"""The exceptions of `ccdtools`; the base of them all and `InputError` are those of the other packages."""

from ccdtools_ground.errors import CCDError, InputError

__all__ = ["CCDError", "InputError", "JumpWarning", "LimitWarning", "NotDetectableError", "SamplingWarning"]


class NotDetectableError(CCDError, ValueError):
    """No steady estimator exists: a mode that does not decay is not seen, or no noise reaches it.

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
    """A plant has a mode that its sampling time hardly resolves, or not at all, at some design."""


class JumpWarning(UserWarning):
    """The dynamics of a plant jump. There integration is of first order, and derivatives say nothing."""


class LimitWarning(UserWarning):
    """No controller can keep the state limits of a co-design from its start."""
