"""What an invariance computation returns: the set, how it ended, and a certificate that can be checked."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from .polytope import Polytope


class Status(Enum):
    """How a computation ended; the value is advice."""

    CONVERGED = "The set is invariant and maximal to the stated tolerance."
    EMPTY = "No state can be kept in X for ever: enlarge X or U, or shrink W."
    ITERATION_LIMIT = ("The iteration limit came first: `set` is invariant but not maximal, `outer` is not invariant. "
                       "Increase `max_iterations` or `tol`.")
    NOT_CERTIFIED = ("The certificate failed, so `set` is empty and only `outer` holds. The data are badly scaled or "
                     "a mode is nearly marginal: rescale, or increase `tol`.")
    OUTER_ONLY = ("X is unbounded and the recursion has not ended in an invariant set: only `outer` holds. "
                  "Intersect X with a box.")

    @property
    def advice(self) -> str:
        """What to do about it."""
        return self.value


@dataclass(frozen=True)
class Certificate:
    """Independent check of invariance by one linear program at every vertex (or facet).

    Attributes
    ----------
    violation : float
        Largest amount by which a successor leaves the set, relative to the width of the set along the violated
        facet [-]. Negative: every successor lies inside.
    gap : float
        Least g with outer ⊆ (1 + g) set, about the equilibrium [-]. inf if not known.
    points : int
        Number of linear programs solved.
    tolerance : float
        Violation that counts as invariant [-].
    """

    violation: float
    gap: float
    points: int
    tolerance: float

    @property
    def holds(self) -> bool:
        """Whether the set is invariant at the stated tolerance."""
        return self.violation <= self.tolerance


@dataclass(frozen=True)
class InvariantSet:
    """Result of a maximal invariant set computation.

    Attributes
    ----------
    set : Polytope
        Invariant at `certificate.tolerance`; the empty set where none was found.
    outer : Polytope
        Contains the true maximal set; not invariant in general.
    status : Status
        How the computation ended; `status.advice` says what to do.
    iterations : int
        Steps of the recursion.
    certificate : Certificate
        What was checked, and by how much it holds.
    """

    set: Polytope
    outer: Polytope
    status: Status
    iterations: int
    certificate: Certificate
