"""Errors of all packages; numerical outcomes are statuses instead."""

from __future__ import annotations


class CCDError(Exception):
    """Base of every error that these packages raise on purpose."""


class InvariantSetsError(CCDError):
    """Base of every error that `invariant_sets` raises on purpose."""


class MPCError(CCDError):
    """Base of every error that `mpc` raises on purpose."""


class LearningError(CCDError):
    """Base of every error that `learning` raises on purpose."""


class InputError(InvariantSetsError, MPCError, LearningError, ValueError):
    """Bad input: argument, what was got, what was expected, and the cure.

    The same class in all four packages: one handler catches it whoever refuses, and so does each package's base.

    Attributes
    ----------
    argument : str
        Name of the argument, as the caller wrote it.
    got, expected : object
        What was passed and what would have been accepted, in words or as the value itself.
    cure : str
        What to do about it; may be empty.
    """

    def __init__(self, argument: str, got: object = None, expected: object = None, cure: str = "") -> None:
        super().__init__(argument, got, expected, cure)  # all of them, so that the exception can be pickled
        self.argument = argument
        self.got = got
        self.expected = expected
        self.cure = cure

    def __str__(self) -> str:
        if self.expected is None:
            return self.argument
        return f"{self.argument}: got {self.got}, expected {self.expected}." + (f" {self.cure}" if self.cure else "")


class NotConvexError(InputError):
    """Weight or condensed Hessian that is not (semi)definite as required.

    Attributes
    ----------
    argument : str
        The weight, or "Hessian".
    eigenvalue : float or None
        Its smallest eigenvalue after scaling to a unit diagonal [-], where that is the trouble.
    """

    def __init__(
        self, argument: str, got: object, expected: object, cure: str = "", eigenvalue: float | None = None
    ) -> None:
        super().__init__(argument, got, expected, cure)
        self.args = (argument, got, expected, cure, eigenvalue)
        self.eigenvalue = eigenvalue


class SimulatorError(InputError):
    """A simulator or environment stops, hangs or dies in a run.

    Attributes
    ----------
    step : int or None
        Sample of the simulation or training, counted from 0, in which it did.
    kept : Trajectory, Deployment or None
        What was gathered before: the samples of `simulate` or `deploy`, or the parts of `deploy_and_update` that ended.
    """

    step: int | None = None
    kept: object = None

    def __str__(self) -> str:
        return super().__str__() + ("" if self.step is None else f" It was at step {self.step}, counted from 0.")
