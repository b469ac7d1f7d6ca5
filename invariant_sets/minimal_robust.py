"""Smallest robust invariant set of a stable loop.

References
----------
Raković, Kerrigan, Kouramas, Mayne (2005), Invariant approximations of the minimal robust positively invariant
set, IEEE TAC 50(3).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from invariant_sets.budgets import MOST_SUM_TERMS
from invariant_sets.engine.certificate import control_violation
from invariant_sets.engine.invariance import Task, largest_invariant_set
from invariant_sets.engine.recursion import Limits
from invariant_sets.exceptions import InputError
from invariant_sets.maximal_sets import NO_INPUT, as_limits
from invariant_sets.polyhedron import nonempty_body
from invariant_sets.polytope import Polytope
from invariant_sets.results import Certificate, SetResult, Status, no_set, status_of
from invariant_sets.system_checks import LinearSystem, Set, checked_disturbance, checked_state_matrix
from invariant_sets.time_limits import LimitReached
from invariant_sets.tolerances import COARSE, FLAT, ROUNDING
from invariant_sets.validation import check_tolerance

Array = np.ndarray


def minimal_robust_positively_invariant_set(
    A: Any,
    W: Set,
    *,
    E: Any = None,
    eps: float = 1e-2,
    max_iterations: int = 500,
    max_facets: int = 2000,
    time_limit: float | None = None,
) -> SetResult:
    """Robust invariant outer approximation of the smallest one, ⊕ᵢ AⁱEW.

    Parameters
    ----------
    A : (nx, nx) array
        State matrix, strictly stable.
    W : Polytope, or bounds (lower, upper)
        Bounded disturbance set, not empty; it need not hold the origin, and may be flat.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if left out.
    eps : float
        Largest relative excess: set ⊆ (1 + eps)·(minimal set), about the mean trajectory's rest point.
    max_iterations, max_facets : int
        Caps on the number of terms and of facets.
    time_limit : float, optional
        Latest end, in seconds from the call; no limit if left out. Then `set` is robust, but not the
        smallest; empty if none was found yet.

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
        raise InputError("W", "None", "a Polytope or bounds (lower, upper)")
    E, noise_set = checked_disturbance(E, W, len(A))
    assert noise_set is not None
    limits = as_limits(check_tolerance(eps, "eps"), max_iterations, max_facets, time_limit)
    radius = float(np.abs(np.linalg.eigvals(A)).max())
    if radius >= 1.0:
        raise InputError("A", f"spectral radius {radius:.6g}", "less than 1", "Close a stabilising loop first.")
    noise = noise_set.vertices @ E.T
    centre = nonempty_body(noise_set.affine_map(E), "W").centre
    rest = np.linalg.solve(np.eye(len(A)) - A, centre)
    size = _extent(A, noise - centre)
    local = A * size / size[:, None]  # in units of the answer's own extent
    pushes = (noise - centre) / size
    Q = _moving_subspace(local, pushes)
    if Q.shape[1] == 0:
        found = _found(Polytope.from_vertices(rest[None]), 0.0, 0, Status.CONVERGED)
    else:
        A_moving = Q.T @ local @ Q
        solid = Polytope.from_vertices(pushes @ Q).affine_dim == len(A_moving)
        scaled = _scaled_sum(A_moving, pushes @ Q, limits) if solid else None
        found = _from_outside(A_moving, pushes @ Q, limits) if scaled is None else scaled
        if found.set.is_empty:
            return no_set(len(A), found.iterations, Polytope(np.zeros((0, len(A))), np.zeros(0)), found.status)
        found = replace(found, set=found.set.affine_map(size[:, None] * Q, rest))
    check = control_violation(LinearSystem(A, np.zeros((len(A), 1)), noise), found.set, NO_INPUT)
    if not check.holds:
        return no_set(len(A), found.iterations, found.set, Status.NOT_CERTIFIED)
    return replace(found, outer=found.set, certificate=replace(check, gap=found.certificate.gap))


def _found(R: Polytope, gap: float, terms: int, status: Status) -> SetResult:
    """Result before its check: robust set, relative excess, terms and status."""
    return SetResult(R, R, status, terms, Certificate(np.inf, gap, 0))


def _extent(A: Array, W: Array) -> Array:
    """Half width (n,) of the smallest robust set, 1 where it has none."""
    eye = np.eye(len(A))
    size = np.maximum(_sum_of_supports(eye, A, W, MOST_SUM_TERMS), _sum_of_supports(-eye, A, W, MOST_SUM_TERMS))
    return np.where(size > 0.0, size, 1.0)


def _moving_subspace(A: Array, W: Array) -> Array:
    """Orthonormal basis (n, k) of the span of W, A W, A² W, …."""
    scale = np.abs(W).max(initial=0.0)
    if scale == 0.0:
        return np.zeros((len(A), 0))
    blocks = [W.T / scale]
    for _ in range(len(A) - 1):
        blocks.append(A @ blocks[-1])
        size = np.abs(blocks[-1]).max()
        blocks[-1] = blocks[-1] / size if size > FLAT else 0 * blocks[-1]
    left, values, _ = np.linalg.svd(np.hstack(blocks), full_matrices=False)
    return left[:, values > FLAT * values.max()]


def _scaled_sum(A: Array, W: Array, limits: Limits) -> SetResult | None:
    """Scaled partial sum for vertices W; None if no term shrinks."""
    hull = Polytope.from_vertices(W)
    target = max(limits.tol / (1 + limits.tol), ROUNDING)
    partial = hull
    image = W
    status = Status.ITERATION_LIMIT
    alpha = np.inf
    best = hull
    terms = 0
    deadline = limits.deadline.part(0.6)  # the rest is for a set from outside and the certificate
    for s in range(1, limits.iterations + 1):
        image = image @ A.T
        shrunk = float(((hull.A @ image.T).max(axis=1) / hull.b).max())
        if shrunk < alpha:
            alpha = shrunk
            best = partial
            terms = s
        if shrunk <= target:
            status = Status.CONVERGED
            break
        try:
            deadline.check_hull(len(partial.vertices) * len(image), len(A))
            partial = Polytope.from_vertices((partial.vertices[:, None] + image[None]).reshape(-1, len(A)))
        except LimitReached as limit:
            status = status_of(limit)
            break
        if len(partial.b) > limits.facets:
            status = Status.FACET_LIMIT
            break
    if alpha >= 1:
        return None
    alpha = max(alpha, 0.0) + ROUNDING
    return _found(best.scale(1 / (1 - alpha)), alpha / (1 - alpha), terms, status)


def _from_outside(A: Array, W: Array, limits: Limits) -> SetResult:
    """Iterate R ← A R ⊕ W from a robust set outside."""
    eye = np.eye(len(A))
    upper = _sum_of_supports(eye, A, W, MOST_SUM_TERMS)
    lower = -_sum_of_supports(-eye, A, W, MOST_SUM_TERMS)
    margin = 0.25 * (upper - lower) + 0.01 * (upper - lower).max()
    noise = Polytope.from_vertices(W)
    box = Polytope.from_bounds(lower - margin, upper + margin)
    task = Task(LinearSystem(A, np.zeros((len(A), 1)), noise.vertices), box, NO_INPUT, replace(limits, tol=COARSE))
    first = largest_invariant_set(task)
    if first.set.is_empty:
        return first
    R = first.set
    gap = np.inf
    partial = noise  # a partial sum, inside the minimal set
    image = W
    for extra in range(limits.iterations + 1):
        steps = first.iterations + extra
        gap = min(gap, _excess(R, partial))
        if gap <= limits.tol:
            return _found(R, gap, steps, Status.CONVERGED)
        try:
            sums = max(len(R.vertices), len(partial.vertices)) * len(W)
            limits.deadline.part(1 / 3).check_hull(sums, len(A))  # three: of the image, its sum, the partial sum
        except LimitReached as limit:
            return _found(R, gap, steps, status_of(limit))
        grown = R.affine_map(A).minkowski_sum(noise)
        image = image @ A.T
        partial = Polytope.from_vertices((partial.vertices[:, None] + image[None]).reshape(-1, len(A)))
        if max(len(grown.b), len(partial.b)) > limits.facets:
            return _found(R, gap, steps, Status.FACET_LIMIT)
        R = grown
    return _found(R, gap, first.iterations + limits.iterations, Status.ITERATION_LIMIT)


def _excess(R: Polytope, partial: Polytope) -> float:
    """Least g with R ⊆ (1 + g) partial, inf if that is flat."""
    if partial.affine_dim < partial.dim or partial.b.min() <= 0:
        return np.inf
    return max(0.0, float((R.support(partial.A) / partial.b).max() - 1.0))


def _sum_of_supports(D: Array, A: Array, W: Array, terms: int) -> Array:
    """Sum Σ_i max_w dᵀAⁱw for every row d of D, truncated."""
    total = np.zeros(len(D))
    directions = np.array(D)
    largest = np.abs(W).max(axis=0)
    for _ in range(terms):
        step = (directions @ W.T).max(axis=1)
        total += step
        if (np.abs(directions) @ largest <= ROUNDING * np.abs(total)).all():
            break
        directions = directions @ A
    return total
