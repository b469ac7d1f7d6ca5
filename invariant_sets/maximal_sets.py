"""Largest sets in which admissible inputs, or the dynamics alone, keep the state.

References
----------
Bertsekas (1972), Infinite-time reachability of state-space regions by using feedback control, IEEE TAC 17(5):
the recursion. Blanchini, Miani (2015), Set-Theoretic Methods in Control, chapter 5: contractive sets and finite
termination.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from invariant_sets.engine.invariance import Task, largest_invariant_set
from invariant_sets.engine.recursion import Limits
from invariant_sets.polytope import Polytope
from invariant_sets.results import SetResult
from invariant_sets.system_checks import (
    LinearSystem,
    Set,
    as_set,
    checked_state_matrix,
    checked_system,
    disturbance_vertices,
)
from invariant_sets.time_limits import Deadline
from invariant_sets.tolerances import COARSE
from invariant_sets.validation import as_count, as_matrix, check_tolerance

NO_INPUT = Polytope(A_eq=[[1.0]], b_eq=[0.0])


def maximal_control_invariant_set(
    A: Any,
    B: Any,
    X: Set,
    U: Set,
    *,
    E: Any = None,
    W: Set | None = None,
    tol: float = COARSE,
    max_iterations: int = 500,
    max_facets: int = 1000,
    time_limit: float | None = None,
) -> SetResult:
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
    task = Task(*checked_system(A, B, X, U, E, W), as_limits(tol, max_iterations, max_facets, time_limit))
    return largest_invariant_set(task)


def maximal_positively_invariant_set(
    A: Any,
    X: Set,
    *,
    C: Any = None,
    E: Any = None,
    W: Set | None = None,
    tol: float = COARSE,
    max_iterations: int = 500,
    max_facets: int = 1000,
    time_limit: float | None = None,
) -> SetResult:
    """Largest set whose trajectories x⁺ = A x + E w keep C x in X.

    Parameters
    ----------
    A : (nx, nx) array
        State matrix, for example A + B K in closed loop.
    X : Polytope, or bounds (lower, upper)
        Constraints on the output y = C x; on the state if C is left out.
    C : (ny, nx) array, optional
        Output matrix. [I; K] with X × U gives the states from which u = K x respects all constraints.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if W is given without it.
    W : Polytope, or bounds (lower, upper), optional
        Bounded disturbance set.
    tol : float
        Largest relative gap between `outer` and `set`.
    max_iterations, max_facets : int
        Caps of the recursion.
    time_limit : float, optional
        Latest end, in seconds from the call; no limit if left out. At the limit the status is TIME_LIMIT and `set`
        an invariant inner set, or empty if none was found in time, which does not say that there is none.

    Returns
    -------
    SetResult
        `set` is positively invariant, checked at its vertices; `outer` contains the true maximal set.

    Raises
    ------
    InputError
        If shapes do not match, numbers are not finite, or W is empty or unbounded.

    Notes
    -----
    Finitely determined if A is strictly stable, (C, A) observable and the origin an inner point of X. Elsewhere
    the same recursion runs to its caps and says so. Invariance tolerance 1e-9 of the extent of the set.

    References
    ----------
    Gilbert, Tan (1991), Linear systems with state and control constraints: the theory and application of maximal
    output admissible sets, IEEE TAC 36(9). Kolmanovsky, Gilbert (1998), Theory and computation of disturbance
    invariant sets for discrete-time linear systems, Mathematical Problems in Engineering 4(4).
    """
    A = checked_state_matrix(A)
    if C is None:
        X = as_set(X, "X", len(A))
    else:
        C = as_matrix(C, "C", columns=len(A))
        X = as_set(X, "X", len(C)).preimage(C)
    system = LinearSystem(A, np.zeros((len(A), 1)), disturbance_vertices(E, W, len(A)))
    return largest_invariant_set(Task(system, X, NO_INPUT, as_limits(tol, max_iterations, max_facets, time_limit)))


def as_limits(tol: Any, max_iterations: Any, max_facets: Any, time_limit: Any) -> Limits:
    """Limits with time from now; raise `InputError` for improper numbers."""
    return Limits(
        check_tolerance(tol),
        as_count("max_iterations", max_iterations),
        as_count("max_facets", max_facets),
        Deadline.after(time_limit),
    )
