"""What can go wrong in `learning`: one base class, so that a caller can catch them all."""


class LearningError(Exception):
    """Base of every error that `learning` raises on purpose."""


class DataError(LearningError, ValueError):
    """Bad data: one line that names the argument, what was got and what was expected."""


class CheckpointError(LearningError):
    """A file that is not a saved network, or one of another version."""
