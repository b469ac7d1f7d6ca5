"""The exceptions of `learning`: the vocabulary of the other packages, which this one may not import."""


class LearningError(Exception):
    """Base of every error that `learning` raises on purpose."""


class InputError(LearningError, ValueError):
    """Bad input, in one line: argument, what was got, what was expected, and the cure.

    Attributes
    ----------
    argument : str
        Name of the argument, as the caller wrote it.
    got, expected : object
        What was passed and what would have been accepted, in words or as the value itself.
    cure : str
        What to do about it; may be empty.
    """

    def __init__(self, argument: str, got: object, expected: object, cure: str = "") -> None:
        super().__init__(argument, got, expected, cure)  # all of them, so that the exception can be pickled
        self.argument = argument
        self.got = got
        self.expected = expected
        self.cure = cure

    def __str__(self) -> str:
        return f"{self.argument}: got {self.got}, expected {self.expected}." + (f" {self.cure}" if self.cure else "")


class CheckpointError(LearningError):
    """A file that is not a saved network, or one of another version.

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
