"""What can go wrong in `ccdtools`: one base class, so that a caller can catch them all."""


class CCDError(Exception):
    """Base of every error that `ccdtools` raises on purpose."""


class InputError(CCDError, ValueError):
    """Bad input: one line that names the argument, what was got, what was expected and the cure."""
