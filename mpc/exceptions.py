"""The exceptions of `mpc`: misuse is raised, a numerical outcome is a status."""

import invariant_sets.exceptions as sets


class MPCError(Exception):
    """Base of every exception raised by `mpc`."""


class InputError(MPCError, sets.InputError):
    """Bad input, in one line; carries `argument`, `got`, `expected` and `cure`, as in `invariant_sets`."""


class NotConvexError(MPCError, ValueError):
    """A weight or the condensed Hessian is not (semi)definite as required."""


class InfeasibleError(MPCError):
    """No parameter of the set is feasible, so there is no explicit law."""


class NotStabilisableError(MPCError, ValueError):
    """The pair (A, B) cannot be stabilised, or only by absurd gains.

    Attributes
    ----------
    eigenvalue : complex or None
        The unstable eigenvalue of A that the input does not reach, where it is known.
    """

    def __init__(self, message: str, eigenvalue: complex | None = None):
        super().__init__(message)
        self.eigenvalue = eigenvalue
