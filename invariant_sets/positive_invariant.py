"""Invariant sets of a system without input: the largest one inside constraints, the smallest around a disturbance."""

from __future__ import annotations

from typing import Any

import numpy as np

from invariant_sets.control_invariant import Options
from invariant_sets.engine.certificate import control_violation
from invariant_sets.engine.invariance import Task, largest_invariant_set
from invariant_sets.engine.local_problem import LinearSystem
from invariant_sets.exceptions import InputError
from invariant_sets.polytope import Polytope
from invariant_sets.results import Certificate, SetResult, Status, no_set
from invariant_sets.system_checks import check_set, checked_disturbance, checked_state_matrix, disturbance_vertices
from invariant_sets.validation import as_matrix, check_count, check_tolerance

Array = np.ndarray
_SERIES = 5000  # terms of a sum of supports at most
_NO_INPUT = Polytope(np.zeros((0, 1)), np.zeros(0), np.ones((1, 1)), np.zeros(1))


def maximal_positively_invariant_set(A: Any, X: Polytope, *, C: Any = None, E: Any = None, W: Polytope | None = None,
                                     tol: float = 1e-7, max_iterations: int = 500,
                                     max_facets: int = 1000, time_limit: float | None = None) -> SetResult:
    """Return the largest set of states whose trajectories x⁺ = A x + E w keep C x in X for ever.

    Parameters
    ----------
    A : (nx, nx) array
        State matrix, for example A + B K in closed loop.
    X : Polytope
        Constraints on the output y = C x; on the state if C is left out.
    C : (ny, nx) array, optional
        Output matrix. [I; K] with X × U gives the states from which u = K x respects all constraints.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if W is given without it.
    W : Polytope, optional
        Bounded disturbance set.
    tol : float
        Largest relative gap between `outer` and `set`.
    max_iterations, max_facets : int
        Caps of the recursion.
    time_limit : float, optional
        Latest end, in seconds from the call; no limit if left out. At the limit the status is TIME_LIMIT.

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
        check_set(X, "X", len(A))
    else:
        C = as_matrix(C, "C", columns=len(A))
        check_set(X, "X", len(C))
        X = X.preimage(C)
    E = checked_disturbance(E, W, len(A))
    system = LinearSystem(A, np.zeros((len(A), 1)), disturbance_vertices(E, W))
    options = Options(tol, max_iterations, max_facets, time_limit)
    return largest_invariant_set(Task(system, X, _NO_INPUT, options.limits()))


def minimal_robust_positively_invariant_set(A: Any, W: Polytope, *, E: Any = None, eps: float = 1e-2,
                                            max_iterations: int = 500, max_facets: int = 2000) -> SetResult:
    """Return a robust positively invariant outer approximation of the smallest one, ⊕ᵢ AⁱEW.

    Parameters
    ----------
    A : (nx, nx) array
        State matrix, strictly stable.
    W : Polytope
        Bounded disturbance set, not empty; it need not hold the origin, and may be flat.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if left out.
    eps : float
        Largest relative excess: set ⊆ (1 + eps)·(minimal set), about the mean trajectory's rest point.
    max_iterations, max_facets : int
        Caps on the number of terms and of facets.

    Returns
    -------
    SetResult
        `set` = `outer`, robust positively invariant at every vertex unless the status is NOT_CERTIFIED;
        `certificate.gap` is the excess reached, inf if not known.

    Raises
    ------
    InputError
        If A is not strictly stable, shapes do not match or W is empty or unbounded.

    Notes
    -----
    (1 − α)⁻¹ ⊕_{i<s} AⁱW is robust positively invariant if AˢW ⊆ αW, and exceeds the minimal set by at most
    α/(1 − α). It needs W to be full-dimensional with 0 inside: W is shifted to a centre. Where EW is flat, or a cap
    comes before AˢW begins to shrink, the largest robust set in a box around the answer is iterated as
    R ← A R ⊕ E W, which keeps robust invariance, and compared with the partial sum, which is inside.

    References
    ----------
    Raković, Kerrigan, Kouramas, Mayne (2005), Invariant approximations of the minimal robust positively invariant
    set, IEEE TAC 50(3), theorem 1.
    """
    A = checked_state_matrix(A)
    if W is None:
        raise InputError("W must be a Polytope, got None.")
    E = checked_disturbance(E, W, len(A))
    eps = check_tolerance(eps, "eps")
    max_iterations = check_count(max_iterations, "max_iterations", 1)
    max_facets = check_count(max_facets, "max_facets", 1)
    radius = float(np.abs(np.linalg.eigvals(A)).max())
    if radius >= 1.0:
        raise InputError(f"A has spectral radius {radius:.6g}, expected less than 1; close a stabilising loop first.")
    noise = W.vertices @ E.T
    centre = W.affine_map(E)._body.centre  # type: ignore[union-attr]
    rest = np.linalg.solve(np.eye(len(A)) - A, centre)
    Q = _moving_subspace(A, noise - centre)
    if Q.shape[1] == 0:
        R, gap, steps, status = Polytope.from_vertices(rest[None]), 0.0, 0, Status.CONVERGED
    else:
        local, vertices = Q.T @ A @ Q, (noise - centre) @ Q
        solid = Polytope.from_vertices(vertices).affine_dim == len(local)
        approximate = _rakovic if solid else _from_outside
        R, gap, steps, status = approximate(local, vertices, eps, max_iterations, max_facets)
        R = R.affine_map(Q, rest)
    check = control_violation(LinearSystem(A, np.zeros((len(A), 1)), noise), R, _NO_INPUT)
    certificate = Certificate(check.violation, gap, check.points)
    if not certificate.holds:
        return no_set(len(A), steps, R, Status.NOT_CERTIFIED)
    return SetResult(R, R, status, steps, certificate)


def _moving_subspace(A: Array, W: Array) -> Array:
    """Return an orthonormal basis (n, k) of what W, A W, A² W, … span: the minimal set is flat elsewhere."""
    scale = np.abs(W).max(initial=0.0)
    if scale == 0.0:
        return np.zeros((len(A), 0))
    blocks = [W.T / scale]
    for _ in range(len(A) - 1):
        blocks.append(A @ blocks[-1])
        size = np.abs(blocks[-1]).max()
        blocks[-1] = blocks[-1] / size if size > 1e-9 else 0 * blocks[-1]
    left, values, _ = np.linalg.svd(np.hstack(blocks), full_matrices=False)
    return left[:, values > 1e-9 * values.max()]


def _rakovic(A: Array, W: Array, eps: float, limit: int, max_facets: int) -> tuple[Polytope, float, int, Status]:
    """Return the scaled partial sum for vertices W of a full-dimensional set with 0 inside."""
    hull = Polytope.from_vertices(W)
    target = max(eps / (1 + eps), 1e-12)
    partial, image, status = hull, W, Status.ITERATION_LIMIT
    best = (np.inf, hull, 0)
    for s in range(1, limit + 1):
        image = image @ A.T
        alpha = float(((hull.A @ image.T).max(axis=1) / hull.b).max())
        if alpha < best[0]:
            best = (alpha, partial, s)
        if alpha <= target:
            status = Status.CONVERGED
            break
        grown = Polytope.from_vertices((partial.vertices[:, None] + image[None]).reshape(-1, len(A)))
        if len(grown.b) > max_facets:
            status = Status.FACET_LIMIT
            break
        partial = grown
    alpha, partial, s = best
    if alpha >= 1:  # the disturbance has not begun to shrink within the caps: start from outside instead
        return _from_outside(A, W, eps, limit, max_facets)
    alpha = max(alpha, 0.0) + 1e-12
    return partial.scale(1 / (1 - alpha)), alpha / (1 - alpha), s, status


def _from_outside(A: Array, W: Array, eps: float, limit: int, max_facets: int) -> tuple[Polytope, float, int, Status]:
    """Iterate R ← A R ⊕ W from the largest robust set in a box around the answer; every iterate is robust."""
    eye = np.eye(len(A))
    upper, lower = _sum_of_supports(eye, A, W, _SERIES), -_sum_of_supports(-eye, A, W, _SERIES)
    margin = 0.25 * (upper - lower) + 0.01 * (upper - lower).max()
    noise = Polytope.from_vertices(W)
    first = maximal_positively_invariant_set(A, Polytope.from_bounds(lower - margin, upper + margin), W=noise,
                                             max_iterations=limit, max_facets=max_facets)
    if first.set.is_empty:
        raise InputError(f"max_iterations = {limit} or max_facets = {max_facets} is too small for any invariant set. "
                         "Increase them.")
    R, steps, gap = first.set, first.iterations, np.inf
    partial, image = noise, W  # a partial sum, inside the minimal set
    for extra in range(limit + 1):
        gap = min(gap, _excess(R, partial))
        if gap <= eps:
            return R, gap, steps + extra, Status.CONVERGED
        grown, image = R.affine_map(A).minkowski_sum(noise), image @ A.T
        partial = Polytope.from_vertices((partial.vertices[:, None] + image[None]).reshape(-1, len(A)))
        if max(len(grown.b), len(partial.b)) > max_facets:
            return R, gap, steps + extra, Status.FACET_LIMIT
        R = grown
    return R, gap, steps + limit, Status.ITERATION_LIMIT


def _excess(R: Polytope, partial: Polytope) -> float:
    """Return the least g with R ⊆ (1 + g) partial, inf while the partial sum is flat; 0 is inside both."""
    if partial.affine_dim < partial.dim or partial.b.min() <= 0:
        return np.inf
    return max(0.0, float((R._supports(partial.A) / partial.b).max() - 1.0))


def _sum_of_supports(D: Array, A: Array, W: Array, terms: int) -> Array:
    """Return Σ_i max_w dᵀAⁱw for every row d of D, from below: the terms after the last are left out."""
    total, directions = np.zeros(len(D)), np.array(D)
    for _ in range(terms):
        step = (directions @ W.T).max(axis=1)
        total += step
        if np.abs(directions).max() * np.abs(W).max() <= 1e-13 * np.abs(total).max():
            break
        directions = directions @ A
    return total
