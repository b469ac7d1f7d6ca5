"""Sets that can be steered to a target, and sets that can be reached, in a number of steps.

References
----------
Blanchini, Miani (2015), Set-Theoretic Methods in Control, chapter 6. Borrelli, Bemporad, Morari (2017), Predictive
Control for Linear and Hybrid Systems, section 10.1.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from invariant_sets.engine.certificate import control_violation
from invariant_sets.engine.predecessor import project_rows
from invariant_sets.operations import same_space
from invariant_sets.polytope import Polytope
from invariant_sets.results import Certificate, SetResult, Status, no_set
from invariant_sets.system_checks import check_set, checked_state_matrix, checked_system
from invariant_sets.validation import check_count

Array = np.ndarray


def predecessor_set(A: Any, B: Any, S: Polytope, U: Polytope, *, X: Polytope | None = None, E: Any = None,
                    W: Polytope | None = None) -> SetResult:
    """Return {x in X : some u in U has A x + B u + E w in S for all w in W}, the one-step predecessor of S.

    Parameters
    ----------
    A, B : (nx, nx) and (nx, nu) arrays
        Dynamics.
    S, U : Polytope
        Target and input set.
    X : Polytope, optional
        State constraints; the whole space if left out.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if W is given without it.
    W : Polytope, optional
        Bounded disturbance set.

    Raises
    ------
    InputError
        If shapes do not match, numbers are not finite, or W is empty or unbounded.

    References
    ----------
    Blanchini, Miani (2015), section 5.1: Fourier–Motzkin elimination of the inputs. Exact up to rounding; the
    certificate (every vertex, tolerance 1e-9) measures it.
    """
    A = checked_state_matrix(A)
    check_set(S, "S", len(A))
    X = _whole_space(S) if X is None else X
    return controllable_set(A, B, X, U, S, 1, E=E, W=W)


def controllable_set(A: Any, B: Any, X: Polytope, U: Polytope, target: Polytope, steps: int, *, E: Any = None,
                     W: Polytope | None = None) -> SetResult:
    """Return the states in X that inputs in U can steer into `target` in exactly `steps` steps, staying in X.

    Parameters
    ----------
    A, B : (nx, nx) and (nx, nu) arrays
        Dynamics x⁺ = A x + B u + E w.
    X, U, target : Polytope
        State, input and target sets.
    steps : int
        Number of steps, >= 0.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if W is given without it.
    W : Polytope, optional
        Bounded disturbance set; the input may depend on the state, not on w.

    Returns
    -------
    SetResult
        The certificate says by how much the worst vertex of any step misses the set of the step before.

    Raises
    ------
    InputError
        If shapes do not match, numbers are not finite, or W is empty or unbounded.

    References
    ----------
    Borrelli, Bemporad, Morari (2017), algorithm 10.3; robust: algorithm 10.5. Tolerance 1e-9 of the set's extent.
    """
    A, B, E = checked_system(A, B, X, U, E, W)
    check_set(target, "target", len(A))
    steps = check_count(steps, "steps")
    noise = None if E is None or W is None else W.vertices @ E.T
    S, violation, points = (target if steps else target.intersection(X).minimal()), -np.inf, 0
    for step in range(1, steps + 1):
        previous = S.intersection(X) if step > 1 else S
        S = _predecessor(A, B, S, U, X, noise)
        if S.is_empty:
            return no_set(len(A), step)
        worst, checked = _miss(A, B, S, U, previous, noise)
        violation, points = max(violation, worst), points + checked
    return _result(S, steps, violation, points)


def reachable_set(A: Any, B: Any, start: Polytope, U: Polytope, steps: int, *, X: Polytope | None = None,
                  E: Any = None, W: Polytope | None = None) -> SetResult:
    """Return the states that x⁺ = A x + B u + E w can reach from `start` in exactly `steps` steps.

    Parameters
    ----------
    A, B : (nx, nx) and (nx, nu) arrays
        Dynamics.
    start, U : Polytope
        Initial and input sets.
    steps : int
        Number of steps, >= 0.
    X : Polytope, optional
        State constraints that hold after every step.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if W is given without it.
    W : Polytope, optional
        Bounded disturbance set; the disturbance may be any in W.

    Returns
    -------
    SetResult
        The certificate says by how much the support of A R ⊕ B U ⊕ E W exceeds a facet of the set, one support
        function evaluation a facet and step.

    Raises
    ------
    InputError
        If shapes do not match, numbers are not finite, or W is empty or unbounded.

    References
    ----------
    Borrelli, Bemporad, Morari (2017), section 10.1.1. Tolerance 1e-9 of the set's extent.
    """
    A, B, E = checked_system(A, B, start, U, E, W, state_set="start")
    X = _whole_space(start) if X is None else same_space(start, X, "X")
    steps = check_count(steps, "steps")
    R, violation, points = start.intersection(X), -np.inf, 0
    moves = U.affine_map(B)
    if E is not None and W is not None:
        moves = moves.minkowski_sum(W.affine_map(E))
    for step in range(1, steps + 1):
        image = R.affine_map(A).minkowski_sum(moves).minimal()
        if image.intersection(X).is_empty:
            return no_set(len(A), step)
        if len(image.b):
            exact = R._supports(image.A @ A) + moves._supports(image.A)
            excess = (exact - image.b) / image._row_scales[0]
            violation, points = max(violation, float(excess.max())), points + len(image.b)
        R = image.intersection(X)
    if R.is_empty:
        return no_set(len(A), steps)
    return _result(R.minimal(), steps, violation, points)


def _result(S: Polytope, steps: int, violation: float, points: int) -> SetResult:
    if S.is_empty:
        return no_set(S.dim, steps)
    certificate = Certificate(violation, 0.0, points)
    if not certificate.holds:
        return no_set(S.dim, steps, S, Status.NOT_CERTIFIED)
    return SetResult(S, S, Status.CONVERGED, steps, certificate)


def _whole_space(S: Polytope) -> Polytope:
    return Polytope(np.zeros((0, S.dim)), np.zeros(0))


def _predecessor(A: Array, B: Array, S: Polytope, U: Polytope, X: Polytope, noise: Array | None) -> Polytope:
    """Return Pre(S) ∩ X: lift to (x, u), let the lifted body scale itself, eliminate u."""
    n = len(A)
    if noise is not None:
        S = S.pontryagin_difference(Polytope.from_vertices(noise))
    lifted = S.preimage(np.hstack([A, B])).intersection(X.cartesian_product(U))
    body = lifted._body
    if body is None:
        return Polytope(np.zeros((1, n)), [-1.0])
    if body.basis.shape[1] < lifted.dim:
        return lifted.projection(np.arange(n)).minimal()
    F, g = project_rows(body.F, body.g, n)  # a full-dimensional body has a diagonal basis
    F = F / np.diag(body.basis)[:n]
    return Polytope(F, g + F @ body.centre[:n]).minimal()


def _miss(A: Array, B: Array, S: Polytope, U: Polytope, target: Polytope, noise: Array | None) -> tuple[float, int]:
    """Return by how much the worst vertex of S misses `target` under the best input."""
    return control_violation(A, B, S, U, noise, target=target)
