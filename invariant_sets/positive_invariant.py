"""Invariant sets of a system without input: the largest one inside constraints, the smallest around a disturbance."""

from __future__ import annotations

from typing import Any

import numpy as np

from .certificate import control_violation
from .coordinates import LinearSystem
from .exceptions import InputError
from .invariance import Limits, largest_invariant_set
from .polytope import Polytope
from .results import Certificate, SetResult, Status
from .system_checks import check_set, checked_disturbance, checked_state_matrix
from .validation import as_matrix, check_count, check_tolerance

Array = np.ndarray
_NO_INPUT = Polytope(np.zeros((0, 1)), np.zeros(0), np.ones((1, 1)), np.zeros(1))


def maximal_positively_invariant_set(A: Any, X: Polytope, *, C: Any = None, E: Any = None, W: Polytope | None = None,
                                     tol: float = 1e-7, max_iterations: int = 500,
                                     max_facets: int = 1000) -> SetResult:
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
    limits = Limits(check_tolerance(tol), check_count(max_iterations, "max_iterations", 1),
                    check_count(max_facets, "max_facets", 1))
    disturbances = None if E is None or W is None else W.vertices @ E.T
    return largest_invariant_set(LinearSystem(A, np.zeros((len(A), 1)), disturbances), X, _NO_INPUT, limits)


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
        `set` = `outer`, robust positively invariant whatever the status; `certificate.gap` is the excess reached.

    Raises
    ------
    InputError
        If A is not strictly stable, shapes do not match or W is empty or unbounded.

    Notes
    -----
    (1 − α)⁻¹ ⊕_{i<s} AⁱW is robust positively invariant if AˢW ⊆ αW, and exceeds the minimal set by at most
    α/(1 − α). It needs W to be full-dimensional with 0 inside: W is shifted to a centre, and where EW is flat, the
    set of a slightly larger disturbance is iterated as R ← A R ⊕ E W, which keeps robust invariance.

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
        approximate = _rakovic if solid else _flat_noise
        R, gap, steps, status = approximate(local, vertices, eps, max_iterations, max_facets)
        R = R.affine_map(Q, rest)
    violation, points = control_violation(A, np.zeros((len(A), 1)), R, _NO_INPUT, noise)
    return SetResult(R, R, status, steps, Certificate(violation, gap, points))


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
        if len(grown.b) > max_facets and best[0] < 1:
            status = Status.FACET_LIMIT
            break
        partial = grown
    alpha, partial, s = best
    if alpha >= 1:
        raise InputError(f"max_iterations = {limit} is too small for any invariant set: the disturbance has not begun "
                         "to shrink. Increase max_iterations.")
    alpha = max(alpha, 0.0) + 1e-12
    return partial.scale(1 / (1 - alpha)), alpha / (1 - alpha), s, status


def _flat_noise(A: Array, W: Array, eps: float, limit: int, max_facets: int) -> tuple[Polytope, float, int, Status]:
    """Iterate R ← A R ⊕ W from the set of W plus a small box; every iterate is robust positively invariant."""
    n = len(A)
    size = np.abs(W).max(axis=0)
    box = Polytope.from_bounds(-(size + size.max()) * 0.05, (size + size.max()) * 0.05)
    larger = (W[:, None] + box.vertices[None]).reshape(-1, n)
    R, gap, steps, status = _rakovic(A, larger, 0.5, limit, max_facets)
    noise = Polytope.from_vertices(W)
    gap = np.inf
    for extra in range(1, limit + 1):
        # R_k = ⊕_{i<k} AⁱW ⊕ Aᵏ R₀, so the excess over the minimal set is at most Aᵏ R₀
        grown = R.affine_map(A).minkowski_sum(noise)
        if len(grown.b) > max_facets:
            return R, gap, steps + extra - 1, Status.FACET_LIMIT
        gap, R = _excess(grown, A, W, extra), grown
        if gap <= eps:
            return R, gap, steps + extra, Status.CONVERGED
    return R, gap, steps + limit, Status.ITERATION_LIMIT if status is Status.CONVERGED else status


def _excess(R: Polytope, A: Array, W: Array, terms: int) -> float:
    """Return by how much R exceeds the partial sum of `terms` powers, a subset of the minimal set, in any facet."""
    directions, inner = R.A, np.zeros(len(R.b))
    for _ in range(terms + 50):
        inner += (directions @ W.T).max(axis=1)
        directions = directions @ A
    return float((R.b / np.maximum(inner, 1e-300)).max() - 1.0)
