"""Exceptions and warnings of `ccdtools`."""

from ccdtools_ground.errors import CCDError, InputError

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


class SimulatorError(InputError):
    """A simulator hangs or dies in mid-run.

    Attributes
    ----------
    step : int or None
        Sample of the simulation in which it did.
    kept : Trajectory, Deployment or None
        What was gathered before: the samples of `simulate` or `deploy`, or the parts of `deploy_and_update` that ended.
    """

    step: int | None = None
    kept: object = None

    def __str__(self) -> str:
        return super().__str__() + ("" if self.step is None else f" It was at step {self.step} of a simulation.")


class SamplingWarning(UserWarning):
    """A sampling time hardly resolves a mode of the plant, or not at all."""


class JumpWarning(UserWarning):
    """The dynamics of a plant jump, which limits integration and derivatives there."""


class LimitWarning(UserWarning):
    """No controller can keep the state limits of a co-design from its start."""
