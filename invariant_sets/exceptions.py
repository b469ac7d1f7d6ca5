"""Exceptions of this package. A numerical outcome is a status in a result; an exception means misuse."""


class InvariantSetsError(ValueError):
    """Base class of every error raised on purpose by `invariant_sets`."""


class InputError(InvariantSetsError):
    """An argument has the wrong type, shape or sign, or is not finite."""


class UnboundedError(InvariantSetsError):
    """The operation needs a bounded set, for example vertices or a volume."""


class EmptySetError(InvariantSetsError):
    """The operation needs at least one point, for example a sample."""


class NumericalError(InvariantSetsError):
    """No solver could finish; the data are too badly conditioned for double precision."""
