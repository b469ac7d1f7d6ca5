"""Exceptions of `learning`."""

from ccdtools_ground.errors import InputError, LearningError, SimulatorError

__all__ = ["CheckpointError", "DivergedError", "InputError", "LearningError", "SimulatorError"]


class DivergedError(LearningError):
    """An update whose weights or policy are not finite; the agent is as it was before it.

    Attributes
    ----------
    iteration : int
        The update, from zero.
    """

    def __init__(self, iteration: int) -> None:
        super().__init__(iteration)
        self.iteration = iteration

    def __str__(self) -> str:
        return f"Update {self.iteration} made a policy that is not finite. Try a smaller learning_rate or value_rate."


class CheckpointError(LearningError):
    """A file that is no saved network, or of another version.

    Attributes
    ----------
    path : str
        The file.
    got, expected : str
        What the file holds, and what would have been accepted.
    """

    def __init__(self, path: object, got: object, expected: object) -> None:
        super().__init__(str(path), str(got), str(expected))
        self.path = str(path)
        self.got = str(got)
        self.expected = str(expected)

    def __str__(self) -> str:
        return f"{self.path}: got {self.got}, expected {self.expected}."
