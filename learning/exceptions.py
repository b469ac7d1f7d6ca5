"""Exceptions of `learning`."""

from ccdtools_ground.errors import InputError, LearningError

__all__ = ["CheckpointError", "InputError", "LearningError"]


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
