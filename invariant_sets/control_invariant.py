"""The largest set in which some admissible input can keep the state for ever.

References
----------
Bertsekas (1972), Infinite-time reachability of state-space regions by using feedback control, IEEE TAC 17(5):
the recursion. Blanchini, Miani (2015), Set-Theoretic Methods in Control, chapter 5: contractive sets and finite
termination.
"""

from __future__ import annotations

from typing import Any

from invariant_sets.engine.invariance import Limits, largest_invariant_set
from invariant_sets.engine.local_problem import LinearSystem
from invariant_sets.polytope import Polytope
from invariant_sets.results import SetResult
from invariant_sets.system_checks import checked_system
from invariant_sets.validation import check_count, check_tolerance


def maximal_control_invariant_set(A: Any, B: Any, X: Polytope, U: Polytope, *, E: Any = None,
                                  W: Polytope | None = None, tol: float = 1e-7, max_iterations: int = 500,
                                  max_facets: int = 1000) -> SetResult:
    """Return the maximal (robust) control invariant set of x⁺ = A x + B u + E w in X, with u in U, w in W.

    Parameters
    ----------
    A : (nx, nx) array
        State matrix.
    B : (nx, nu) array
        Input matrix.
    X, U : Polytope
        State and input constraints, in the units of x and u; scaling is done here.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if W is given without it.
    W : Polytope, optional
        Bounded disturbance set. The set is then robust: the input may not know w.
    tol : float
        Largest relative gap between `outer` and `set`.
    max_iterations, max_facets : int
        Caps of the recursion.

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
    1. Coordinates are shifted to an equilibrium inside X and U and scaled by the bounding boxes. A bounded X
       without an equilibrium holds no control invariant set. Flat sets are solved on their affine hull.
    2. Unstable modes are bounded first (`unstable_modes`); without that the recursion creeps and stops outside.
    3. Ω ← Pre(Ω) ∩ Ω until no row cuts by more than 1e-11: `outer`.
    4. (1 − tol/10) Ω is invariant with room to spare, because inputs scale with the state; LPs at its vertices say
       so. Where they do not, or with disturbances, which do not scale, the recursion is repeated from Ω for a
       contraction factor just below one, which ends in an exactly invariant set.
    5. Where a cap comes first, an invariant set of a linear feedback is grown from inside instead.

    Assumes data of moderate condition; |λ| < 1 + 1e-6 is not treated as unstable. Invariance tolerance: 1e-9 of the
    extent of the set; what was measured is in the certificate.

    References
    ----------
    Bertsekas (1972), IEEE TAC 17(5); Blanchini, Miani (2015), sections 5.1 and 5.2; Hu, Lin (2001), Control Systems
    with Actuator Saturation, chapter 2.
    """
    return within(A, B, X, U, E, W, tol, max_iterations, max_facets)


def within(A: Any, B: Any, X: Polytope, U: Polytope, E: Any, W: Polytope | None, tol: float, max_iterations: int,
           max_facets: int, guess: Polytope | None = None) -> SetResult:
    """Return the maximal control invariant set in X ∩ guess; see `maximal_control_invariant_set`."""
    A, B, E = checked_system(A, B, X, U, E, W)
    limits = Limits(check_tolerance(tol), check_count(max_iterations, "max_iterations", 1),
                    check_count(max_facets, "max_facets", 1))
    disturbances = None if E is None or W is None else W.vertices @ E.T
    return largest_invariant_set(LinearSystem(A, B, disturbances), X, U, limits, guess)
