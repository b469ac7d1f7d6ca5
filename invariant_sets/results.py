"""Result of a set computation, with status and certificate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ccdtools_ground.outcome import Outcome
from invariant_sets.polytope import Polytope
from invariant_sets.time_limits import LimitReached, TimeLimitReached
from invariant_sets.tolerances import MEMBERSHIP


class Status(Outcome):
    """Outcome of a computation; the value is advice."""

    CONVERGED = "The set is what was asked for, to the stated tolerance."
    EMPTY = "No state has the property: enlarge X or U, or shrink W."
    ITERATION_LIMIT = (
        "The iteration limit came first: `set` is invariant (or empty) but not maximal, `outer` is not "
        "invariant. Increase `max_iterations` or `tol`."
    )
    FACET_LIMIT = (
        "The set needs more facets than `max_facets`, or than Qhull can resolve: `set` is invariant (or "
        "empty) but not the extremal one. Increase `max_facets` or `tol`."
    )
    TIME_LIMIT = (
        "The time limit came first: `set` is invariant but not the extremal one, and `certificate.gap` says "
        "how far `outer` is from it; it is empty if none was found in time. Increase `time_limit` or `tol`."
    )
    NOT_CERTIFIED = (
        "The check of the result failed, so `set` is empty and only `outer` holds. The data are badly "
        "scaled or a mode is nearly marginal: rescale, or increase `tol`."
    )
    NOT_MAXIMAL = (
        "`set` is invariant, but one more backward step would enlarge it by `certificate.missing`, so "
        "neither it nor `outer` is known to be the maximal one. Rescale the data, or increase `tol`."
    )
    OUTER_ONLY = (
        "X is unbounded and the recursion has not ended in an invariant set: only `outer` holds. "
        "Intersect X with a box."
    )


@dataclass(frozen=True)
class Certificate:
    """Check of the result at every vertex or facet.

    Attributes
    ----------
    violation : float
        Largest amount by which a successor leaves the set, relative to the range of the violated row over the
        bounding box of the set [-]. Negative: every successor lies inside. inf: nothing was checked.
    gap : float
        Least g with outer ⊆ (1 + g) set, about the equilibrium [-]. inf if not known.
    points : int
        Number of vertices or facets checked.
    tolerance : float
        Violation that still counts as none [-].
    outside : float
        Largest amount by which the set leaves X, relative as above [-].
    missing : float
        Largest amount by which one more backward step would enlarge the set, relative as above [-]; inf if it was
        not checked, because the set is not claimed to be maximal.
    """

    violation: float
    gap: float
    points: int
    tolerance: float = MEMBERSHIP
    outside: float = 0.0
    missing: float = np.inf

    @property
    def holds(self) -> bool:
        """Whether the set has the property, inside X, at the tolerance."""
        return bool(np.isfinite(self.violation) and max(self.violation, self.outside) <= self.tolerance)


@dataclass(frozen=True)
class SetResult:
    """Result of every set computation.

    Attributes
    ----------
    set : Polytope
        The set; invariant ones at `certificate.tolerance`. The empty set where none was found: only with the status
        EMPTY does that say that there is none.
    outer : Polytope
        Contains the true extremal set; not invariant in general.
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

    @property
    def is_bounded(self) -> bool:
        """Whether the set fits into a box."""
        return self.set.is_bounded

    def __repr__(self) -> str:
        kind = "empty" if self.set.is_empty else "bounded" if self.is_bounded else "unbounded"
        return (
            f"SetResult({self.status.name}, {kind} set of dimension {self.set.dim}, {len(self.set.b)} rows, "
            f"{self.iterations} steps, violation {self.certificate.violation:.1e}, gap {self.certificate.gap:.1e})"
        )


def status_of(limit: LimitReached) -> Status:
    """Status that belongs to a cap."""
    return Status.TIME_LIMIT if isinstance(limit, TimeLimitReached) else Status.FACET_LIMIT


def no_set(nx: int, iterations: int, outer: Polytope | None = None, status: Status = Status.EMPTY) -> SetResult:
    """Result with the empty set; `outer` too unless given."""
    nothing = Polytope.empty(nx)
    gap = 0.0 if status is Status.EMPTY else np.inf
    return SetResult(nothing, nothing if outer is None else outer, status, iterations, Certificate(np.inf, gap, 0))
