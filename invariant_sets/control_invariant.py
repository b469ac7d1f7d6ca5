"""The largest set in which some admissible input can keep the state for ever.

References
----------
Bertsekas (1972), Infinite-time reachability of state-space regions by using feedback control, IEEE TAC 17(5):
the recursion. Blanchini, Miani (2015), Set-Theoretic Methods in Control, chapter 5: contractive sets and finite
termination.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .certificate import control_violation
from .coordinates import LinearSystem, LocalProblem, localise
from .linear_programs import inscribed_ball
from .polytope import Polytope
from .predecessor import predecessor_rows
from .recursion import Outcome, Region, Shape, iterate
from .representation import FLAT, unit_rows
from .results import Certificate, InvariantSet, Status
from .system_checks import checked_system
from .unstable_modes import unstable_bounds
from .validation import check_count, check_tolerance

Array = np.ndarray
INVARIANT = 1e-9  # a successor may leave by this part of the set's extent, and the set still counts as invariant
_STOP = 1e-11  # the outer recursion has converged if no row cuts more, relative to the set
_SMALL = 0.05  # a set smaller than this part of X in some coordinate is rescaled to its own size


def maximal_control_invariant_set(A: Any, B: Any, X: Polytope, U: Polytope, *, E: Any = None,
                                  W: Polytope | None = None, tol: float = 1e-7,
                                  max_iterations: int = 500) -> InvariantSet:
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
    max_iterations : int
        Cap of the recursion.

    Returns
    -------
    InvariantSet
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

    Assumes bounded data of moderate condition; |λ| < 1 + 1e-6 is not treated as unstable. Invariance tolerance:
    1e-9 of the extent of the set, reported in the certificate.

    References
    ----------
    Bertsekas (1972), IEEE TAC 17(5); Blanchini, Miani (2015), sections 5.1 and 5.2; Hu, Lin (2001), chapter 2.
    """
    A, B, E = checked_system(A, B, X, U, E, W)
    tol, max_iterations = check_tolerance(tol), check_count(max_iterations, "max_iterations", 1)
    system = LinearSystem(A, B, None if E is None or W is None else W.vertices @ E.T)
    iterations = 0
    for _ in range(2 * len(A) + 4):
        problem = localise(system, X, U)
        if problem is None:
            return no_set(len(A), iterations)
        if isinstance(problem, Polytope):
            X = problem
            continue
        if problem.basis.shape[1] == 0:
            return _point(system, problem, X, U, iterations)
        start = _bounded_modes(problem, _start(problem, X))
        outcome = _outer(problem, start, max_iterations) if start.shape is Shape.SOLID else Outcome(start, 0, False, 1)
        iterations += outcome.iterations
        region = outcome.region
        if region.shape is Shape.EMPTY:
            return no_set(len(A), iterations)
        if region.shape is Shape.SOLID and not (outcome.converged and _is_small(region, problem)):
            return _finish(system, problem, U, outcome, iterations, tol, max_iterations)
        X = problem.polytope(region.F, region.g, region.V)
    return no_set(len(A), iterations, X, Status.ITERATION_LIMIT)


def no_set(nx: int, iterations: int, outer: Polytope | None = None, status: Status = Status.EMPTY) -> InvariantSet:
    """Return a result with the empty set."""
    nothing = Polytope(np.zeros((1, nx)), [-1.0])
    gap = 0.0 if status is Status.EMPTY else np.inf
    return InvariantSet(nothing, nothing if outer is None else outer, status, iterations,
                        Certificate(-np.inf, gap, 0, INVARIANT))


def _start(problem: LocalProblem, X: Polytope) -> Region:
    if not problem.bounded:
        return Region(problem.F, problem.g, None)
    inverse = (np.linalg.inv if problem.basis.shape[0] == problem.basis.shape[1] else np.linalg.pinv)(problem.basis)
    return Region(problem.F, problem.g, (X.vertices - problem.centre) @ inverse.T)


def _bounded_modes(problem: LocalProblem, region: Region) -> Region:
    if problem.inputs is None or not problem.shifted:
        return region
    D, d, group = unstable_bounds(problem.A, problem.inputs, problem.disturbances)
    if not len(d):
        return region
    D, d = D / np.linalg.norm(D, axis=1)[:, None], d / np.linalg.norm(D, axis=1)
    reach = region.reach(D)
    unbounded = group[~np.isfinite(reach)]
    cutting = (reach > d) & ~np.isin(group, unbounded)
    return region.cut(D[cutting], d[cutting]) if cutting.any() else region


def _is_small(region: Region, problem: LocalProblem) -> bool:
    return problem.bounded and region.V is not None and bool((np.ptp(region.V, axis=0) < 2 * _SMALL).any())


def _predecessor(problem: LocalProblem, factor: float = 1.0):
    def rows(F: Array, g: Array):
        target = factor * g - F @ problem.drift if problem.drift.any() else factor * g
        return predecessor_rows(F, target, problem.A, problem.B, problem.H, problem.h, problem.disturbances)

    return rows


def _outer(problem: LocalProblem, start: Region, limit: int) -> Outcome:
    return iterate(start, _predecessor(problem), _STOP, limit)


def _finish(system: LinearSystem, problem: LocalProblem, U: Polytope, outcome: Outcome, iterations: int, tol: float,
            limit: int) -> InvariantSet:
    """Return the result: an inner set that passes the certificate, beside the outer one."""
    region = outcome.region
    outer = problem.polytope(region.F, region.g, region.V)
    best, extra = None, 0
    for candidate, steps in _candidates(problem, outcome, tol, limit):
        extra += steps
        inner = problem.polytope(candidate.F, candidate.g, candidate.V)
        violation, points = control_violation(system.A, system.B, inner, U, system.disturbances)
        if violation <= INVARIANT:
            best = Certificate(violation, _gap(region, candidate), points, INVARIANT)
            break
    if best is None:
        status = Status.NOT_CERTIFIED if outcome.converged else Status.ITERATION_LIMIT
        if not problem.bounded and not outcome.converged:
            status = Status.OUTER_ONLY
        return no_set(len(system.A), iterations, outer, status)
    status = Status.CONVERGED if best.gap <= tol * (1 + 1e-6) + 1e-9 else Status.ITERATION_LIMIT
    return InvariantSet(inner, outer, status, iterations + extra, best)


def _candidates(problem: LocalProblem, outcome: Outcome, tol: float, limit: int):
    """Yield inner regions and the steps they cost, the best first."""
    region, scales = outcome.region, problem.disturbances is None and problem.shifted
    if scales and outcome.converged:
        yield _shrunk(region, tol / 10), 0
    if problem.shifted and tol > 0:
        for delta in (tol / 100, tol / 10000):
            again = iterate(region, _predecessor(problem, 1 - delta), 1 / (1 - delta) - 1, max(limit // 4, 20))
            if again.converged and again.region.shape is Shape.SOLID:
                yield again.region, again.iterations
    if outcome.converged:
        yield region, 0
    if scales and not outcome.converged:
        for part in (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 0.3):
            yield _shrunk(region, part), 0
    elif problem.shifted and not outcome.converged:
        for delta in (1e-4, 1e-3, 1e-2, 0.1):
            again = iterate(region, _predecessor(problem, 1 - delta), 1 / (1 - delta) - 1, max(limit // 4, 20))
            if again.converged and again.region.shape is Shape.SOLID:
                yield again.region, again.iterations


def _shrunk(region: Region, part: float) -> Region:
    return Region(region.F, (1 - part) * region.g, None if region.V is None else (1 - part) * region.V)


def _gap(outer: Region, inner: Region) -> float:
    """Return the least gap with outer ⊆ (1 + gap) inner."""
    if not len(inner.g):
        return 0.0
    excess = outer.reach(inner.F) - inner.g
    passing = inner.g <= CENTRAL
    if (excess[passing] > CENTRAL).any():
        return np.inf
    return float(max(0.0, (excess[~passing] / inner.g[~passing]).max(initial=0.0)))


CENTRAL = 1e-9  # rows this close to the equilibrium pass through it


def _point(system: LinearSystem, problem: LocalProblem, X: Polytope, U: Polytope, iterations: int) -> InvariantSet:
    """Return X itself, a single point, if some input keeps the state there."""
    H, h = unit_rows(problem.H, problem.h)
    feasible = H is not None and (not len(h) or inscribed_ball(H, h, cap=1.0)[0] >= -FLAT)
    if not feasible or not problem.shifted:
        return no_set(len(system.A), iterations)
    violation, points = control_violation(system.A, system.B, X, U, system.disturbances)
    if violation > INVARIANT:
        return no_set(len(system.A), iterations, X, Status.NOT_CERTIFIED)
    return InvariantSet(X, X, Status.CONVERGED, iterations, Certificate(violation, 0.0, points, INVARIANT))
