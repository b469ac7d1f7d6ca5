"""Largest set in which admissible inputs can keep the state.

References
----------
Bertsekas (1972), Infinite-time reachability of state-space regions by using feedback control, IEEE TAC 17(5):
the recursion. Blanchini, Miani (2015), Set-Theoretic Methods in Control, chapter 5: contractive sets and finite
termination.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from invariant_sets.engine.inner_sets import Limits
from invariant_sets.engine.invariance import Task, largest_invariant_set
from invariant_sets.results import SetResult
from invariant_sets.system_checks import Set, checked_system
from invariant_sets.time_limits import Deadline, check_time_limit
from invariant_sets.tolerances import GAP
from invariant_sets.validation import as_count, check_tolerance


def maximal_control_invariant_set(A: Any, B: Any, X: Set, U: Set, *, E: Any = None,
                                  W: Set | None = None, tol: float = GAP, max_iterations: int = 500,
                                  max_facets: int = 1000, time_limit: float | None = None) -> SetResult:
    """Maximal (robust) control invariant set of x⁺ = A x + B u + E w.

    Parameters
    ----------
    A : (nx, nx) array
        State matrix.
    B : (nx, nu) array
        Input matrix.
    X, U : Polytope, or bounds (lower, upper)
        State and input constraints, in the units of x and u; scaling is done here. Each bound is a number for all
        coordinates, or an array of one number each; ±inf is no bound.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if W is given without it.
    W : Polytope, or bounds (lower, upper), optional
        Bounded disturbance set. The set is then robust: the input may not know w.
    tol : float
        Largest relative gap between `outer` and `set`.
    max_iterations, max_facets : int
        Caps of the recursion.
    time_limit : float, optional
        Latest end, in seconds from the call; no limit if left out. At the limit the status is TIME_LIMIT, `set` is
        an invariant inner set, or empty if none was found in time, which does not say that there is none, and `outer`
        is what the recursion had reached.

    Returns
    -------
    SetResult
        `set` is an inner set C: from each x in C some u in U has A x + B u + E w in C for all w, checked at the
        vertices. `outer` contains the true maximal set, and outer ⊆ (1 + tol) set about an equilibrium.

    Raises
    ------
    InputError
        If shapes do not match, numbers are not finite, or W is empty or unbounded.

    Notes
    -----
    The recipe stands in `engine.invariance`.

    Assumes data of moderate condition; |λ| < 1 + 1e-6 is not treated as unstable. Invariance tolerance: 1e-9 of the
    extent of the set; what was measured is in the certificate.

    References
    ----------
    Bertsekas (1972), IEEE TAC 17(5); Blanchini, Miani (2015), sections 5.1 and 5.2; Hu, Lin (2001), Control Systems
    with Actuator Saturation, chapter 2.
    """
    options = Options(tol, max_iterations, max_facets, time_limit)
    return largest_invariant_set(control_task(A, B, X, U, options, E=E, W=W))


@dataclass(frozen=True)
class Options:
    """Tolerance and caps as given, checked by `limits`."""

    tol: Any = GAP
    max_iterations: Any = 500
    max_facets: Any = 1000
    time_limit: Any = None

    def limits(self) -> Limits:
        """Limits with time from now; raise `InputError` for improper numbers."""
        return Limits(check_tolerance(self.tol), as_count("max_iterations", self.max_iterations),
                      as_count("max_facets", self.max_facets),
                      Deadline.after(check_time_limit(self.time_limit)))


def control_task(A: Any, B: Any, X: Set, U: Set, options: Options, *, E: Any = None, W: Set | None = None) -> Task:
    """Checked task of `maximal_control_invariant_set`, or raise `InputError`."""
    checked = checked_system(A, B, X, U, E, W)
    return Task(checked.motion, checked.states, checked.U, options.limits())
