"""The engine behind every maximal invariant set: outer recursion, inner candidates, certificate.

References
----------
Bertsekas (1972), IEEE TAC 17(5). Blanchini (1994), Ultimate boundedness control for uncertain discrete-time systems
via set-induced Lyapunov functions, IEEE TAC 39(2): contraction makes the recursion end in an invariant set.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from invariant_sets.engine.certificate import control_violation
from invariant_sets.engine.local_problem import LinearSystem, LocalProblem, localise
from invariant_sets.engine.predecessor import predecessor_rows
from invariant_sets.engine.recursion import Outcome, Region, Shape, iterate
from invariant_sets.engine.unstable_modes import unstable_bounds
from invariant_sets.interior_form import FLAT, unit_rows
from invariant_sets.linear_programs import inscribed_ball
from invariant_sets.polytope import Polytope
from invariant_sets.results import INVARIANT, Certificate, SetResult, Status, no_set

Array = np.ndarray
_STOP = 1e-11  # the outer recursion has converged if no row cuts more, relative to the set
_CENTRAL = 1e-9  # rows this close to the equilibrium pass through it


@dataclass(frozen=True)
class Limits:
    """When to stop.

    Attributes
    ----------
    tol : float
        Largest relative gap between the outer and the inner set [-].
    iterations, facets : int
        Caps.
    """

    tol: float
    iterations: int
    facets: int


def largest_invariant_set(system: LinearSystem, X: Polytope, U: Polytope, limits: Limits,
                          guess: Polytope | None = None) -> SetResult:
    """Return the largest set in X (and in a full-dimensional `guess`) that some u in U can keep the state in.

    The input does not know w. The set is rescaled when it has become small, and solved on its affine hull when
    it has become flat.
    """
    nx, iterations, widest = len(system.A), 0, _extent(X)
    for _ in range(4 * nx + 8):
        problem = localise(system, X, U, widest)
        if problem is None:
            return no_set(nx, iterations)
        if isinstance(problem, Polytope):
            X = problem
            continue
        if problem.basis.shape[1] == 0:
            return _point(system, problem, X, U, iterations)
        start = _bounded_modes(problem, _start(problem, X))
        if guess is not None and start.shape is Shape.SOLID:
            start, guess = _guessed(problem, start, guess), None
        outcome = Outcome(start, 0, False, np.inf)
        if start.shape is Shape.SOLID and not start.is_small:
            steps = limits.iterations - iterations if problem.bounded else min(nx, limits.iterations - iterations)
            outcome = iterate(start, _predecessor(problem), _STOP, max(steps, 1), limits.facets)
        iterations += outcome.iterations
        region = outcome.region.tidy()
        if region.shape is Shape.EMPTY:
            return no_set(nx, iterations)
        capped = iterations >= limits.iterations or outcome.too_many_facets
        smaller = problem.polytope(region.F, region.g, region.V)
        if region.shape is Shape.SOLID and (outcome.converged or capped) and not region.is_small:
            return _finish(system, problem, U, outcome, region, iterations, limits)
        X = _flattened(smaller, widest) if region.is_small else smaller
    return no_set(nx, iterations, X, Status.ITERATION_LIMIT if X.is_bounded else Status.OUTER_ONLY)


def _extent(X: Polytope) -> Array:
    body = X._body
    return np.zeros(X.dim) if body is None else np.linalg.norm(body.basis, axis=1)


def _flattened(X: Polytope, widest: Array) -> Polytope:
    """Return X with the coordinates fixed in which almost nothing is left of the first set."""
    lower, upper = X.bounding_box()
    gone = upper - lower <= FLAT * widest
    if not gone.any():
        return X
    eye = np.eye(X.dim)[gone]
    return X.intersection(Polytope(np.zeros((0, X.dim)), np.zeros(0), eye, eye @ (lower + upper) / 2))


def _start(problem: LocalProblem, X: Polytope) -> Region:
    if not problem.bounded:
        return Region(problem.F, problem.g, None)
    inverse = (np.linalg.inv if problem.basis.shape[0] == problem.basis.shape[1] else np.linalg.pinv)(problem.basis)
    return Region(problem.F, problem.g, (X.vertices - problem.centre) @ inverse.T)


def _guessed(problem: LocalProblem, region: Region, guess: Polytope) -> Region:
    rows, right = unit_rows(guess.A @ problem.basis, guess.b - guess.A @ problem.centre)
    return region.cut(rows, right)


def _bounded_modes(problem: LocalProblem, region: Region) -> Region:
    if problem.inputs is None or not problem.shifted:
        return region
    D, d, group = unstable_bounds(problem.A, problem.inputs, problem.disturbances)
    if not len(d):
        return region
    norms = np.linalg.norm(D, axis=1)
    D, d = D / norms[:, None], d / norms
    reach = region.reach(D)
    unbounded = group[~np.isfinite(reach)]
    cutting = (reach > d) & ~np.isin(group, unbounded)
    return region.cut(D[cutting], d[cutting]) if cutting.any() else region


def _predecessor(problem: LocalProblem, factor: float = 1.0):
    def rows(F: Array, g: Array, fresh: Array | None = None):
        target = factor * g - F @ problem.drift if problem.drift.any() else factor * g
        return predecessor_rows(F, target, problem.A, problem.B, problem.H, problem.h, problem.disturbances,
                                fresh)

    return rows


def _finish(system: LinearSystem, problem: LocalProblem, U: Polytope, outcome: Outcome, region: Region,
            iterations: int, limits: Limits) -> SetResult:
    """Return the result: an inner set that passes the certificate, beside the outer one."""
    outer = problem.polytope(region.F, region.g, region.V)
    status = Status.CONVERGED
    if not outcome.converged:
        status = Status.FACET_LIMIT if outcome.too_many_facets else Status.ITERATION_LIMIT
        status = status if problem.bounded else Status.OUTER_ONLY
    for candidate, steps in _candidates(problem, outcome, region, limits):
        iterations += steps
        inner = problem.polytope(candidate.F, candidate.g, candidate.V)
        violation, points = control_violation(system.A, system.B, inner, U, system.disturbances)
        if violation <= INVARIANT:
            gap = _gap(region, candidate)
            if gap <= limits.tol * (1 + 1e-6) + INVARIANT:
                status = Status.CONVERGED
            elif status is Status.CONVERGED:
                status = Status.ITERATION_LIMIT
            return SetResult(inner, outer, status, iterations, Certificate(violation, gap, points))
    if status is Status.CONVERGED:
        status = Status.NOT_CERTIFIED if problem.bounded else Status.OUTER_ONLY
    return no_set(len(system.A), iterations, outer, status)


def _candidates(problem: LocalProblem, outcome: Outcome, region: Region,
                limits: Limits) -> Iterator[tuple[Region, int]]:
    """Yield inner regions and the steps they cost, the best first."""
    scales = problem.disturbances is None and problem.shifted
    if scales and outcome.converged:
        yield _shrunk(region, limits.tol / 10), 0
    if problem.shifted and outcome.converged and limits.tol > 0:
        for delta in (limits.tol / 100, limits.tol / 10000):
            yield from _contracted(problem, region, delta, limits)
    if outcome.converged:
        yield region, 0
        return
    if scales and problem.bounded:
        for part in (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1):
            yield _shrunk(region, part), 0
    if problem.shifted and problem.bounded:
        yield from _grown(problem, region, limits)
        for delta in (1e-3, 1e-2, 0.1):
            yield from _contracted(problem, region, delta, limits)


def _shrunk(region: Region, part: float) -> Region:
    V = None if region.V is None else (1 - part) * region.V
    return Region(region.F, (1 - part) * region.g, V, minimal=region.minimal)


def _contracted(problem: LocalProblem, region: Region, delta: float, limits: Limits) -> Iterator[tuple[Region, int]]:
    again = iterate(region, _predecessor(problem, 1 - delta), 1 / (1 - delta) - 1, max(limits.iterations // 4, 20),
                    limits.facets)
    if again.converged and again.region.shape is Shape.SOLID:
        yield again.region.tidy(), again.iterations


def _grown(problem: LocalProblem, region: Region, limits: Limits) -> Iterator[tuple[Region, int]]:
    """Grow the positively invariant set of a linear-quadratic feedback by predecessor sets, all of them invariant."""
    K = _feedback(problem)
    if K is None:
        return
    k = problem.A.shape[0]
    closed = problem.A + problem.B @ K
    rows, right = unit_rows(problem.H @ np.vstack([np.eye(k), K]), problem.h)
    if rows is None:
        return
    seed = region.cut(rows, right)
    if seed.shape is not Shape.SOLID:
        return

    def closed_loop(F: Array, g: Array, fresh: Array | None = None):
        F, g = (F, g) if fresh is None else (F[fresh], g[fresh])
        reach = 0.0 if problem.disturbances is None else (F @ problem.disturbances.T).max(axis=1)
        return F @ closed, g * (1 - 1e-9) - reach

    inside = iterate(seed, closed_loop, 1e-9, limits.iterations, limits.facets)
    if not inside.converged or inside.region.shape is not Shape.SOLID:
        return
    grown, steps = inside.region, 0
    for _ in range(limits.iterations):
        R, r = unit_rows(*_predecessor(problem)(grown.F, grown.g))
        larger = region.cut(R, r) if R is not None and len(r) else region
        if larger.shape is not Shape.SOLID or len(larger.g) > limits.facets:
            break
        steps += 1
        finished = _gap(larger, grown) <= limits.tol / 10
        grown = larger.tidy()
        if finished:
            break
    yield grown, steps
    yield inside.region.tidy(), 0


def _feedback(problem: LocalProblem) -> Array | None:
    """Return a stabilising feedback K (q, k) of the local problem, or None."""
    from scipy.linalg import solve_discrete_are

    k, q = problem.A.shape[0], problem.B.shape[1]
    if q == 0:
        return None
    try:
        P = solve_discrete_are(problem.A, problem.B, np.eye(k), np.eye(q))
    except (np.linalg.LinAlgError, ValueError):
        return None
    return -np.linalg.solve(np.eye(q) + problem.B.T @ P @ problem.B, problem.B.T @ P @ problem.A)


def _gap(outer: Region, inner: Region) -> float:
    """Return the least gap with outer ⊆ (1 + gap) inner."""
    if not len(inner.g):
        return 0.0
    excess = outer.reach(inner.F) - inner.g
    passing = inner.g <= _CENTRAL
    if (excess[passing] > _CENTRAL).any():
        return np.inf
    return float(max(0.0, (excess[~passing] / inner.g[~passing]).max(initial=0.0)))


def _point(system: LinearSystem, problem: LocalProblem, X: Polytope, U: Polytope, iterations: int) -> SetResult:
    """Return X itself, a single point, if some input keeps the state there."""
    H, h = unit_rows(problem.H, problem.h)
    feasible = H is not None and (not len(h) or inscribed_ball(H, h, cap=1.0)[0] >= -FLAT)
    if not feasible or not problem.shifted:
        return no_set(len(system.A), iterations)
    point = Polytope.from_vertices(problem.centre[None])
    violation, points = control_violation(system.A, system.B, point, U, system.disturbances)
    if violation > INVARIANT:
        return no_set(len(system.A), iterations, X, Status.NOT_CERTIFIED)
    return SetResult(point, X, Status.CONVERGED, iterations, Certificate(violation, 0.0, points))
