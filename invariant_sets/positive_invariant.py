"""Largest positively invariant set."""

from __future__ import annotations

from typing import Any

import numpy as np

from invariant_sets.control_invariant import Options
from invariant_sets.engine.invariance import Task, largest_invariant_set
from invariant_sets.engine.local_problem import LinearSystem
from invariant_sets.polytope import Polytope
from invariant_sets.results import SetResult
from invariant_sets.system_checks import Set, as_set, checked_disturbance, checked_state_matrix, disturbance_vertices
from invariant_sets.tolerances import GAP
from invariant_sets.validation import as_matrix

Array = np.ndarray
NO_INPUT = Polytope(np.zeros((0, 1)), np.zeros(0), np.ones((1, 1)), np.zeros(1))


def maximal_positively_invariant_set(A: Any, X: Set, *, C: Any = None, E: Any = None, W: Set | None = None,
                                     tol: float = GAP, max_iterations: int = 500,
                                     max_facets: int = 1000, time_limit: float | None = None) -> SetResult:
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
    E, W = checked_disturbance(E, W, len(A))
    system = LinearSystem(A, np.zeros((len(A), 1)), disturbance_vertices(E, W))
    options = Options(tol, max_iterations, max_facets, time_limit)
    return largest_invariant_set(Task(system, X, NO_INPUT, options.limits()))
