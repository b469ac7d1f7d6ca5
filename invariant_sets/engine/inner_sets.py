"""Invariant sets inside the outer one, the best first.

References
----------
Blanchini (1994), Ultimate boundedness control for uncertain discrete-time systems via set-induced Lyapunov functions,
IEEE TAC 39(2): contraction makes the recursion end in an invariant set. Blanchini, Miani (2015), Set-Theoretic Methods
in Control, 2nd ed., section 5.1 and algorithm 5.1: the backward step.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from invariant_sets.budgets import CHEAP_HULL_DIM
from invariant_sets.engine.local_problem import LocalProblem
from invariant_sets.engine.recursion import Limits, Outcome, Predecessor, Region, Rows, Shape, iterate
from invariant_sets.interior_form import unit_rows
from invariant_sets.projection import eliminate_last, project_rows, unit
from invariant_sets.time_limits import NO_DEADLINE, Deadline, LimitReached
from invariant_sets.tolerances import FLAT, MEMBERSHIP, SHRUNK

Array = np.ndarray


@dataclass(frozen=True)
class Candidate:
    """Inner region, its steps, and its local feedback where known."""

    region: Region
    steps: int = 0
    gain: Array | None = None


def predecessor_of(problem: LocalProblem, factor: float = 1.0, deadline: Deadline = NO_DEADLINE) -> Predecessor:
    """Map from target rows to the predecessor rows of factor · target."""
    dynamics = problem.dynamics

    def rows(target: Rows, fresh: Array | None = None) -> Rows:
        """Predecessor rows of the target, or of its fresh rows."""
        F, g = target
        g = factor * g
        if problem.drift.any():
            g = g - F @ problem.drift
        if dynamics.disturbances is not None:
            g = g - (F @ dynamics.disturbances.T).max(axis=1, initial=-np.inf)
        return predecessor_rows((F, g), dynamics.A, dynamics.B, problem.joint, fresh=fresh, deadline=deadline)

    return rows


def candidates(problem: LocalProblem, outcome: Outcome, region: Region, limits: Limits) -> Iterator[Candidate]:
    """Yield inner regions within the limits, the best first."""
    scales = problem.dynamics.disturbances is None and problem.at_equilibrium
    if outcome.converged:
        if scales:
            yield Candidate(shrunk(region, limits.tol / 10))
        if problem.at_equilibrium and limits.tol > 0:
            for delta in (limits.tol / 100, limits.tol / 10000):
                yield from _contracted(problem, region, delta, limits)
        yield Candidate(region)
        return
    if not problem.bounded:
        return
    if scales:
        for part in SHRUNK:
            yield Candidate(shrunk(region, part))
    if problem.at_equilibrium:
        yield from _grown(problem, region, limits)
        for delta in SHRUNK[3:]:
            yield from _contracted(problem, region, delta, limits)


def shrunk(region: Region, part: float) -> Region:
    """Region times 1 − part."""
    V = None if region.V is None else (1 - part) * region.V
    return Region(region.F, (1 - part) * region.g, V, minimal=region.minimal)


def _contracted(problem: LocalProblem, region: Region, delta: float, limits: Limits) -> Iterator[Candidate]:
    """Yield the largest set that contracts by 1 − delta per step."""
    fewer = replace(limits, iterations=max(limits.iterations // 4, 20))
    again = iterate(region, predecessor_of(problem, 1 - delta, limits.deadline), fewer, stop=1 / (1 - delta) - 1)
    if again.converged and again.region.shape is Shape.SOLID:
        yield Candidate(again.region.tidy(), again.iterations)


def _grown(problem: LocalProblem, region: Region, limits: Limits) -> Iterator[Candidate]:
    """Yield sets of feedbacks, the first grown where possible."""
    seeds = feedback_sets(problem, region, limits)
    first = next(seeds, None)
    if first is None:
        return
    grown, steps = _grow(problem, region, first.region, limits)
    if steps:
        yield Candidate(grown, steps)
        yield first
    else:
        yield from sorted([first, *seeds], key=lambda seed: gap(region, seed.region))


def _grow(problem: LocalProblem, region: Region, seed: Region, limits: Limits) -> tuple[Region, int]:
    """Seed after predecessor steps within the limits, and their number."""
    grown = seed
    steps = 0
    half = limits.deadline.part(0.5)
    predecessor = predecessor_of(problem, deadline=half)
    for _ in range(limits.iterations):
        try:
            half.check()
            R, r = unit_rows(*predecessor((grown.F, grown.g), None))
            larger = region.cut(R, r, half) if R is not None and len(r) else region
        except LimitReached:
            break
        if larger.shape is not Shape.SOLID or len(larger.g) > limits.facets:
            break
        steps += 1
        finished = gap(larger, grown) <= limits.tol / 10
        grown = larger.tidy()
        if finished:
            break
    return grown, steps


def feedback_sets(problem: LocalProblem, region: Region, limits: Limits) -> Iterator[Candidate]:
    """Yield invariant sets of several linear-quadratic feedbacks in the region."""
    for weight in (1.0, 1e-2, 1e2, 1e4):
        K = _feedback(problem, weight)
        if K is None:
            continue
        try:
            candidate = _closed_loop_set(problem, region, K, limits)
        except LimitReached:
            return
        if candidate is not None:
            yield candidate


def _closed_loop_set(problem: LocalProblem, region: Region, K: Array, limits: Limits) -> Candidate | None:
    """Largest set in the region that v = K y keeps, or None."""
    k = len(problem.dynamics.A)
    closed = problem.dynamics.A + problem.dynamics.B @ K
    noise = problem.dynamics.disturbances
    rows, right = unit_rows(problem.joint[0] @ np.vstack([np.eye(k), K]), problem.joint[1])
    if rows is None:
        return None
    seed = region if k <= CHEAP_HULL_DIM else Region(region.F, region.g, None)
    seed = seed.cut(rows, right, limits.deadline)
    if seed.shape is not Shape.SOLID:
        return None

    def backwards(target: Rows, fresh: Array | None) -> Rows:
        """Rows of the states that the feedback takes into the target."""
        F, g = target if fresh is None else (target[0][fresh], target[1][fresh])
        reach = 0.0 if noise is None else (F @ noise.T).max(axis=1)
        return F @ closed, g * (1 - MEMBERSHIP) - reach

    ended = iterate(seed, backwards, limits, stop=MEMBERSHIP)
    if not ended.converged or ended.region.shape is not Shape.SOLID:
        return None
    return Candidate(ended.region.tidy(limits.deadline), ended.iterations, K)


def _feedback(problem: LocalProblem, weight: float) -> Array | None:
    """Stabilising feedback K (q, k) of the local problem, or None."""
    from scipy.linalg import solve_discrete_are

    A = problem.dynamics.A
    B = problem.dynamics.B
    k, q = B.shape
    if q == 0:
        return np.zeros((0, k)) if weight == 1.0 else None
    try:
        with np.errstate(invalid="ignore"):  # SciPy balances by powers of two that may be no integers
            P = solve_discrete_are(A, B, np.eye(k), weight * np.eye(q))
        K = -np.linalg.solve(weight * np.eye(q) + B.T @ P @ B, B.T @ P @ A)
    except (np.linalg.LinAlgError, ValueError):
        return None
    stable = np.isfinite(K).all() and np.abs(np.linalg.eigvals(A + B @ K)).max() < 1.0
    return K if stable else None


def gap(outer: Region, inner: Region) -> float:
    """Least gap with outer ⊆ (1 + gap) inner."""
    if not len(inner.g):
        return 0.0
    excess = outer.reach(inner.F) - inner.g
    passing = inner.g <= FLAT
    if (excess[passing] > FLAT).any():
        return np.inf
    return float(max(0.0, (excess[~passing] / inner.g[~passing]).max(initial=0.0)))


def predecessor_rows(
    target: Rows, A: Array, B: Array, joint: Rows, *, fresh: Array | None = None, deadline: Deadline = NO_DEADLINE
) -> Rows:
    """Unit rows (R, r) of the predecessor set with inputs eliminated.

    Parameters
    ----------
    target : (F, g)
        The target set, already tightened by the disturbance; unit rows.
    A, B : (n, n) and (n, nu) arrays
        Dynamics.
    joint : (H, h)
        Constraints on state and input together.
    fresh : (m,) bool array, optional
        Rows of the target that are new since the last call. With one input, only what follows from these is
        returned: a recursion that only shrinks its set has the rest already.
    deadline : Deadline
        When to stop.

    Notes
    -----
    Assumes coordinates of order one (scale by the bounding boxes first). Redundant rows are removed between
    the inputs, not after the last one. A set without points gives the row 0 x <= −1.
    """
    F, g = target
    H, h = joint
    nu = B.shape[1]
    R = np.vstack([np.hstack([F @ A, F @ B]), H])
    r = np.append(g, h)
    if nu == 1:
        R, r = unit(R, r)
        return eliminate_last(R, r, None if fresh is None else np.append(fresh, np.zeros(len(h), bool)))
    return project_rows(R, r, R.shape[1] - nu, deadline=deadline)
