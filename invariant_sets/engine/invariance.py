"""Engine behind every maximal invariant set.

1. `local_problem`: coordinates are shifted to an equilibrium inside X and U and scaled by the extents of X. A bounded X
   without an equilibrium holds no invariant set. Flat sets are solved on their affine hull.
2. `loose_bounds`: unstable modes are bounded first; without that the recursion creeps and stops outside.
3. `recursion`: Ω ← Pre(Ω) ∩ Ω until no row cuts any more. This is `outer`. A set that has become small or flat
   starts again at 1.
4. `inner_sets`: (1 − tol/10) Ω is invariant with room to spare, because inputs scale with the state. Disturbances
   do not scale; there the recursion is repeated from Ω for a contraction factor just below one. Where a cap came
   first, the invariant set of a linear feedback is grown from inside. Where two fifths of the time have gone, one such
   set is put in reserve before the recursion goes on.
5. `certificate`: only a set that passes its check at every vertex (or facet) is returned, and only one that one more
   backward step does not enlarge is called maximal.

References
----------
Bertsekas (1972), IEEE TAC 17(5). Blanchini (1994), Ultimate boundedness control for uncertain discrete-time systems
via set-induced Lyapunov functions, IEEE TAC 39(2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from invariant_sets.bodies import row_norms
from invariant_sets.engine import certificate
from invariant_sets.engine.inner_sets import Candidate, candidates, feedback_sets, gap, predecessor_of
from invariant_sets.engine.local_problem import LocalProblem, localise
from invariant_sets.engine.loose_bounds import unstable_bounds, without_loose_bounds
from invariant_sets.engine.observable import observed_directions, quotient
from invariant_sets.engine.recursion import Limits, Outcome, Region, Shape, iterate
from invariant_sets.exceptions import NumericalError, TimeLimitError
from invariant_sets.interior_form import unit_rows
from invariant_sets.linear_programs import largest_ball
from invariant_sets.polytope import Polytope
from invariant_sets.results import Certificate, SetResult, Status, no_set, status_of
from invariant_sets.system_checks import LinearSystem
from invariant_sets.time_limits import Deadline, LimitReached, TimeLimitReached
from invariant_sets.tolerances import FLAT, MEMBERSHIP

Array = np.ndarray


Inner = tuple[Polytope, Certificate, Array]  # a certified inner set and its equilibrium


@dataclass(frozen=True)
class Task:
    """Task of finding the largest invariant set in X within limits."""

    system: LinearSystem
    X: Polytope
    U: Polytope
    limits: Limits


def largest_invariant_set(task: Task, guess: Polytope | None = None) -> SetResult:
    """Largest set in X, and in `guess`, that inputs in U keep.

    The input does not know w. The set is rescaled when it has become small, and solved on its affine hull when
    it has become flat.
    """
    try:
        if guess is None and not task.X.is_bounded and task.U.is_bounded:
            Q = observed_directions(task.system.A, task.X)
            if Q is not None:
                system, X = quotient(task.system, task.X, Q)
                return _extended(_largest(replace(task, system=system, X=X)), Q)
        return _largest(task, guess)
    except LimitReached as limit:  # before the recursion has begun
        status = status_of(limit)
    except TimeLimitError:  # the vertices of X itself are too many
        status = Status.FACET_LIMIT
    except NumericalError:
        status = Status.NOT_CERTIFIED
    return no_set(task.X.dim, 0, task.X, status)


def _extended(result: SetResult, Q: Array) -> SetResult:
    """Result with its sets as cylinders {x : Q x in the set}."""
    if result.outer.is_empty:
        return no_set(Q.shape[1], result.iterations, status=result.status)
    C = no_set(Q.shape[1], 0).set if result.set.is_empty else result.set.preimage(Q)
    return replace(result, set=C, outer=result.outer.preimage(Q))


def _largest(task: Task, guess: Polytope | None = None) -> SetResult:
    """Largest invariant set, by local problems until one is solved."""
    system, X, U = without_loose_bounds(task.system, task.X, task.U)
    task = replace(task, system=system, X=X, U=U)
    X = X if guess is None else X.intersection(guess)
    limits = task.limits
    nx = X.dim
    iterations = 0
    widest = _extent(X)
    reserve: Inner | None = None
    searched = not np.isfinite(limits.deadline.end)
    deadline = limits.deadline.part(0.4)  # a recursion that ends within it needs no inner set in reserve
    for _ in range(4 * nx + 8):
        problem = localise(task.system, X, task.U, widest)
        if isinstance(problem, Polytope):
            X = problem
            continue
        if problem is None:
            return _nothing(task, iterations)
        if problem.frame.basis.shape[1] == 0:
            return _point(task, problem, X, iterations)
        start = _bounded_modes(problem, _start(problem, X))
        steps = limits.iterations - iterations if problem.bounded else min(nx, limits.iterations - iterations)
        own = replace(limits, iterations=max(steps, 1), deadline=deadline)
        outcome = Outcome(start, 0)
        if start.shape is Shape.SOLID and not start.is_small:
            outcome = iterate(start, predecessor_of(problem, deadline=deadline), own)
        if outcome.limit is not None and not searched:
            searched = True
            reserve = _feedback_set(task, problem, start)
            deadline = limits.deadline.part(0.5)  # half of what is left is for the rest of the recursion
            outcome = _continued(problem, outcome, replace(own, deadline=deadline))
        iterations += outcome.iterations
        region = outcome.region if outcome.limit is not None else outcome.region.tidy()
        if region.shape is Shape.EMPTY:
            return _nothing(task, iterations)
        capped = iterations >= limits.iterations or outcome.limit is not None
        if region.shape is Shape.SOLID and (outcome.converged or capped) and not region.is_small:
            return _finish(task, problem, replace(outcome, region=region, iterations=iterations), reserve)
        smaller = problem.frame.polytope(region.F, region.g, region.V)
        X = smaller if smaller.is_empty else _flattened(smaller, widest)
        if limits.deadline.passed:
            break
    status = Status.ITERATION_LIMIT if X.is_bounded else Status.OUTER_ONLY
    status = Status.TIME_LIMIT if limits.deadline.passed else status
    return _fallback(task, reserve, X, status, iterations)


def _continued(problem: LocalProblem, outcome: Outcome, limits: Limits) -> Outcome:
    """Outcome continued where time stopped it; `limits` are the whole's."""
    left = limits.iterations - outcome.iterations
    if outcome.limit is not Status.TIME_LIMIT or left == 0:
        return outcome
    predecessor = predecessor_of(problem, deadline=limits.deadline)
    later = iterate(outcome.region, predecessor, replace(limits, iterations=left), fresh=outcome.fresh)
    return replace(later, iterations=outcome.iterations + later.iterations)


def _extent(X: Polytope) -> Array:
    """Half width (nx,) of X in every coordinate, zero if empty."""
    body = X.body
    return np.zeros(X.dim) if body is None else row_norms(body.basis)


def _flattened(X: Polytope, widest: Array) -> Polytope:
    """X with its almost vanished coordinates fixed."""
    lower, upper = X.bounding_box()
    gone = upper - lower <= FLAT * widest
    if not gone.any():
        return X
    middle = lower[gone] / 2 + upper[gone] / 2
    return X.intersection(Polytope(A_eq=np.eye(X.dim)[gone], b_eq=middle))


def _start(problem: LocalProblem, X: Polytope) -> Region:
    """State set as a region, with vertices where bounded."""
    F, g = problem.states
    if not problem.bounded:
        return Region(F, g, None)
    return Region(F, g, (X.vertices - problem.frame.centre) @ problem.frame.back.T)


def _bounded_modes(problem: LocalProblem, region: Region) -> Region:
    """Region cut by the bounds on the unstable modes."""
    if problem.input_moves is None or not problem.at_equilibrium:
        return region
    D, d, group = unstable_bounds(problem.dynamics.A, problem.input_moves, problem.dynamics.disturbances)
    if not len(d):
        return region
    norms = np.linalg.norm(D, axis=1)
    D = D / norms[:, None]
    d = d / norms
    reach = region.reach(D)
    unbounded = group[~np.isfinite(reach)]
    cutting = (reach > d) & ~np.isin(group, unbounded)
    return region.cut(D[cutting], d[cutting]) if cutting.any() else region


def _feedback_set(task: Task, problem: LocalProblem, start: Region) -> Inner | None:
    """First feedback set in `start` that is certified in part of the time left, or None."""
    if not problem.bounded or not problem.at_equilibrium or start.shape is not Shape.SOLID:
        return None
    deadline = task.limits.deadline.part(0.7)
    rows = replace(start, V=None)
    for candidate in feedback_sets(problem, rows, replace(task.limits, deadline=deadline)):
        inner = _certified(task, problem, rows, candidate, deadline)
        if inner is not None:
            return inner
    return None


def _fallback(task: Task, inner: Inner | None, outer: Polytope, status: Status, steps: int) -> SetResult:
    """Reserve with its gap where it helps, otherwise no set."""
    if inner is None or outer.is_empty or status not in (Status.TIME_LIMIT, Status.FACET_LIMIT):
        return no_set(task.X.dim, steps, outer, status)
    C, check, centre = inner
    reach = outer.support(C.A)
    room = C.b - C.A @ centre
    check = replace(check, gap=float(((reach - C.b) / room).max()))
    return _with_status(task, (C, check, centre), outer, status, steps)


def _finish(task: Task, problem: LocalProblem, outcome: Outcome, reserve: Inner | None) -> SetResult:
    """Result with an inner set that passes the certificate."""
    region = outcome.region
    limits = task.limits
    outer = problem.frame.polytope(region.F, region.g, region.V)
    status = Status.CONVERGED
    if not outcome.converged:
        status = outcome.limit or Status.ITERATION_LIMIT
        status = status if problem.bounded else Status.OUTER_ONLY
    inside = replace(limits, deadline=limits.deadline.part(0.6))  # the rest is for the certificate
    steps = outcome.iterations
    for candidate in candidates(problem, outcome, region, inside):
        steps += candidate.steps
        result = _certified(task, problem, region, candidate, limits.deadline)
        if result is not None:
            return _with_status(task, result, outer, status, steps)
    if status is Status.CONVERGED:
        status = Status.NOT_CERTIFIED if problem.bounded else Status.OUTER_ONLY
    return _fallback(task, reserve, outer, status, steps)


def _certified(
    task: Task, problem: LocalProblem, region: Region, candidate: Candidate, deadline: Deadline
) -> Inner | None:
    """Candidate as a set if certified in time, otherwise None."""
    found = candidate.region
    C = problem.frame.polytope(found.F, found.g, found.V)
    try:
        if candidate.gain is not None and found.V is None:
            moves = np.vstack([np.eye(candidate.gain.shape[1]), candidate.gain])
            gain = problem.law[:, 1:] @ moves @ problem.frame.back
            offset = problem.law[:, 0] - gain @ problem.frame.centre
            check = certificate.feedback_violation(task.system, C, task.U, gain, offset, deadline)
        else:
            check = certificate.control_violation(task.system, C, task.U, deadline=deadline)
        if not check.violation <= MEMBERSHIP:
            return None
        beyond = certificate.outside(C, task.X, by_vertices=found.V is not None)
    except LimitReached:
        return None
    check = replace(check, gap=gap(region, found), outside=beyond)
    return (C, check, problem.frame.centre) if beyond <= MEMBERSHIP else None


def _with_status(task: Task, inner: Inner, outer: Polytope, status: Status, steps: int) -> SetResult:
    """Result with the status that its gap and missing states deserve."""
    C, check, _ = inner
    small = check.gap <= task.limits.tol + MEMBERSHIP
    absent = check.missing
    if small:
        try:
            absent = certificate.missing(task.system, C, task.X, task.U, task.limits.deadline)
        except (LimitReached, NumericalError) as error:
            status = Status.TIME_LIMIT if isinstance(error, TimeLimitReached) else Status.NOT_CERTIFIED
        else:
            status = Status.CONVERGED if absent <= 2 * task.limits.tol + MEMBERSHIP else Status.NOT_MAXIMAL
    elif status is Status.CONVERGED:
        status = Status.ITERATION_LIMIT
    return SetResult(C, outer, status, steps, replace(check, missing=absent))


def _nothing(task: Task, iterations: int) -> SetResult:
    """Empty result, uncertified where an equilibrium exists."""
    nx = task.X.dim
    if task.system.disturbances is None and not task.X.is_empty and not task.U.is_empty:
        still = Polytope(A_eq=np.hstack([np.eye(nx) - task.system.A, -task.system.B]), b_eq=np.zeros(nx))
        if not task.X.cartesian_product(task.U).intersection(still).is_empty:
            return no_set(nx, iterations, task.X, Status.NOT_CERTIFIED)
    return no_set(nx, iterations)


def _point(task: Task, problem: LocalProblem, X: Polytope, iterations: int) -> SetResult:
    """Single point X, if some input keeps the state there."""
    H, h = unit_rows(*problem.joint)
    feasible = H is not None and (not len(h) or largest_ball(H, h).radius >= -FLAT)
    if not feasible or not problem.at_equilibrium:
        return _nothing(task, iterations)
    point = Polytope.from_vertices(problem.frame.centre[None])
    check = certificate.control_violation(task.system, point, task.U)
    if check.violation > MEMBERSHIP:
        return no_set(task.X.dim, iterations, X, Status.NOT_CERTIFIED)
    return SetResult(point, X, Status.CONVERGED, iterations, replace(check, gap=0.0))
