"""The exceptions of `ccdtools`: one base class, so that a caller can catch them all."""

import invariant_sets.exceptions as sets


class CCDError(Exception):
    """Base of every error that `ccdtools` raises on purpose."""


class InputError(CCDError, sets.InputError):
    """Bad input, in one line; carries `argument`, `got`, `expected` and `cure`, as in `invariant_sets`."""


class SamplingWarning(UserWarning):
    """A plant has a mode that its sampling time hardly resolves, or not at all, for some design of its box."""


class JumpWarning(UserWarning):
    """The dynamics of a plant jump, where integration is of first order and derivatives say nothing."""


class LimitWarning(UserWarning):
    """No controller can keep the state limits of a co-design from its start."""
