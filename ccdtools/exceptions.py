"""The exceptions of `ccdtools`: one base class, so that a caller can catch them all."""

import invariant_sets.exceptions as sets


class CCDError(Exception):
    """Base of every error that `ccdtools` raises on purpose."""


class InputError(CCDError, sets.InputError):
    """Bad input, in one line; carries `argument`, `got`, `expected` and `cure`, as in `invariant_sets`."""
