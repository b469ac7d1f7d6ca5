"""The exceptions of `ccdtools`: one base class, so that a caller can catch them all."""

import invariant_sets.exceptions as sets


class CCDError(Exception):
    """Base of every error that `ccdtools` raises on purpose."""


class InputError(CCDError, sets.InputError):
    """Bad input, in one line; carries `argument`, `got`, `expected` and `cure`, as in `invariant_sets`."""


class NotDetectableError(CCDError, ValueError):
    """No steady estimator can be relied on: a mode that does not decay is not seen, or no noise reaches it.

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
    """A plant has a mode that its sampling time hardly resolves, or not at all, for some design of its box."""


class JumpWarning(UserWarning):
    """The dynamics of a plant jump, where integration is of first order and derivatives say nothing."""


class LimitWarning(UserWarning):
    """No controller can keep the state limits of a co-design from its start."""
