"""Exceptions of `invariant_sets`."""

from __future__ import annotations

from typing import Any

from ccdtools_ground.errors import InputError, InvariantSetsError

__all__ = ["EmptySetError", "InputError", "InvariantSetsError", "NumericalError", "TimeLimitError", "UnboundedError"]


class _UnusableSet(InvariantSetsError, ValueError):
    """Set with which an operation cannot do anything, and the usual reason."""

    usual: str

    def __init__(self, operation: str, reason: str = "") -> None:
        super().__init__(operation, reason)  # all of them, so that the exception can be pickled
        self.operation = operation
        self.reason = reason or self.usual

    def __str__(self) -> str:
        return f"{self.operation}: {self.reason}."


class UnboundedError(_UnusableSet):
    """Unbounded set where a bounded one is needed.

    Attributes
    ----------
    operation : str
        What was asked for.
    reason : str
        Which set has no end, and what to do.
    """

    usual = "the set is unbounded. Intersect it with a box"


class EmptySetError(_UnusableSet):
    """Empty set where a point is needed.

    Attributes
    ----------
    operation : str
        What was asked for.
    reason : str
        Which set is empty, and what follows.
    """

    usual = "the set is empty"


class NumericalError(InvariantSetsError, ArithmeticError):
    """Failure of all solvers on badly conditioned data.

    Attributes
    ----------
    operation : str
        What could not be computed.
    size : tuple of ints
        Rows (or points) and dimension of the data.
    reason : str
        What the solver said, if anything.
    """

    def __init__(self, operation: str, size: tuple[int, ...] = (), reason: str = "") -> None:
        super().__init__(operation, size, reason)
        self.operation = operation
        self.size = size
        self.reason = reason

    def __str__(self) -> str:
        of = f" of {self.size[0]} rows or points in {self.size[1]} dimensions" if len(self.size) == 2 else ""
        reason = f": {self.reason}" if self.reason else ""
        return f"{self.operation}{of} could not be computed{reason}. Rescale the data."


class TimeLimitError(InvariantSetsError, TimeoutError):
    """Operation beyond its time limit, or the memory of one hull.

    Attributes
    ----------
    operation : str
        What was asked for.
    seconds : float or None
        The time limit; None if there was none.
    reason : str
        What would take so long.
    outer : Polytope or None
        A set that contains the answer.
    """

    def __init__(self, operation: str, seconds: float | None, reason: str, outer: Any = None) -> None:
        super().__init__(operation, seconds, reason, outer)  # all of them, so that the exception can be pickled
        self.operation = operation
        self.seconds = seconds
        self.reason = reason
        self.outer = outer

    def __str__(self) -> str:
        limit = "" if self.seconds is None else f" within {self.seconds:g} s"
        outer = "" if self.outer is None else " The attribute `outer` of this error contains the answer."
        return f"{self.operation} does not end{limit}: {self.reason}.{outer}"
