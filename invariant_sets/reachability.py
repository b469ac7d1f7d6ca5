"""Controllable and reachable sets in a number of steps.

References
----------
Blanchini, Miani (2015), Set-Theoretic Methods in Control, chapter 6. Borrelli, Bemporad, Morari (2017), Predictive
Control for Linear and Hybrid Systems, section 10.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from invariant_sets.budgets import EXACT_SHARE
from invariant_sets.engine.steps import Step, backward_step, forward_step
from invariant_sets.engine.trajectories import inner_hull
from invariant_sets.exceptions import NumericalError
from invariant_sets.maximal_sets import NO_INPUT
from invariant_sets.polyhedron import set_of
from invariant_sets.polytope import Polytope
from invariant_sets.results import Certificate, SetResult, Status, no_set, status_of
from invariant_sets.system_checks import LinearSystem, Set, as_set, checked_state_matrix, checked_system
from invariant_sets.time_limits import Deadline, LimitReached
from invariant_sets.tolerances import MUCH
from invariant_sets.validation import as_count

Array = np.ndarray


def predecessor_set(
    A: Any,
    B: Any,
    S: Set,
    U: Set | None,
    *,
    X: Set | None = None,
    E: Any = None,
    W: Set | None = None,
    time_limit: float | None = None,
) -> SetResult:
    """States in X that inputs steer into S in one step for all w.

    Parameters
    ----------
    A, B : (nx, nx) and (nx, nu) arrays
        Dynamics; B and U may both be None for a system without input.
    S, U : Polytope, or bounds (lower, upper)
        Target and input set.
    X : Polytope, or bounds (lower, upper), optional
        State constraints; the whole space if left out.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if W is given without it.
    W : Polytope, or bounds (lower, upper), optional
        Bounded disturbance set.
    time_limit : float, optional
        Latest end, in seconds from the call; no limit if left out. At the limit the status is TIME_LIMIT.

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
    S = as_set(S, "S", len(A))
    X = _whole_space(S) if X is None else X
    return controllable_set(A, B, X, U, S, 1, E=E, W=W, time_limit=time_limit)


def controllable_set(
    A: Any,
    B: Any,
    X: Set,
    U: Set | None,
    target: Set,
    steps: int,
    *,
    E: Any = None,
    W: Set | None = None,
    time_limit: float | None = None,
) -> SetResult:
    """States that inputs steer through X into `target` in exactly `steps` steps.

    Parameters
    ----------
    A, B : (nx, nx) and (nx, nu) arrays
        Dynamics; B and U may both be None for a system without input x⁺ = A x + B u + E w.
    X, U, target : Polytope, or bounds (lower, upper)
        State, input and target sets.
    steps : int
        Number of steps, >= 0.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if W is given without it.
    W : Polytope, or bounds (lower, upper), optional
        Bounded disturbance set; the input may depend on the state, not on w.
    time_limit : float, optional
        Latest end, in seconds from the call; no limit if left out. At the limit the status is TIME_LIMIT and
        `set` an inner set, the hull of states of single trajectories (empty with a disturbance).

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
    A, B, U = _with_inputs(A, B, U)
    system, within, inputs = checked_system(A, B, X, U, E, W)
    goal = as_set(target, "target", within.dim)
    steps = as_count("steps", steps, least=0)
    deadline = Deadline.after(time_limit)
    if steps == 0:
        return _exact(goal.intersection(within).minimal(), 0, Certificate(0.0, 0.0, 0))
    size = _units(system.A, within, goal)
    system = _in_units(system, size)
    within = _scaled(within, size)
    goal = _scaled(goal, size)

    def step_back(S: Polytope, deadline: Deadline) -> Step:
        """One step backwards from S, checked."""
        return backward_step(system, S, within, inputs, deadline)

    hull = partial(inner_hull, system=system, sets=(within, within, goal), U=inputs, steps=steps, at=0)
    return _in_given_units(_repeat(step_back, goal, steps, deadline, within, hull if W is None else None), size)


def reachable_set(
    A: Any,
    B: Any,
    start: Set,
    U: Set | None,
    steps: int,
    *,
    X: Set | None = None,
    E: Any = None,
    W: Set | None = None,
    time_limit: float | None = None,
) -> SetResult:
    """States that x⁺ = A x + B u + E w reaches in exactly `steps` steps.

    Parameters
    ----------
    A, B : (nx, nx) and (nx, nu) arrays
        Dynamics; B and U may both be None for a system without input.
    start, U : Polytope, or bounds (lower, upper)
        Initial and input sets.
    steps : int
        Number of steps, >= 0.
    X : Polytope, or bounds (lower, upper), optional
        State constraints that hold after every step.
    E : (nx, nw) array, optional
        Disturbance matrix; the identity if W is given without it.
    W : Polytope, or bounds (lower, upper), optional
        Bounded disturbance set; the disturbance may be any in W.
    time_limit : float, optional
        Latest end, in seconds from the call; no limit if left out. At the limit the status is TIME_LIMIT and
        `set` an inner set, the hull of states of single trajectories.

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
    A, B, U = _with_inputs(A, B, U)
    system, first, inputs = checked_system(A, B, start, U, E, W, name="start")
    within = _whole_space(first) if X is None else as_set(X, "X", first.dim)
    steps = as_count("steps", steps, least=0)
    deadline = Deadline.after(time_limit)
    first = first.intersection(within).minimal()
    if steps == 0 or first.is_empty:
        return _exact(first, 0, Certificate(0.0, 0.0, 0))
    if inputs.is_empty:
        return no_set(first.dim, 0)

    size = _units(system.A, first, within)
    system = _in_units(system, size)
    first = _scaled(first, size)
    within = _scaled(within, size)

    def step_ahead(R: Polytope, deadline: Deadline) -> Step:
        """One step forwards from R, cut by X and checked."""
        moves = inputs.affine_map(system.B)
        if system.disturbances is not None:
            moves = moves.minkowski_sum(Polytope.from_vertices(system.disturbances))
        ahead, check = forward_step(system, R, moves, deadline)
        return ahead.intersection(within).minimal() if len(within.b) + len(within.b_eq) else ahead, check

    last = partial(inner_hull, system=system, sets=(first, within, within), U=inputs, steps=steps, at=steps)
    return _in_given_units(_repeat(step_ahead, first, steps, deadline, within, last), size)


def _units(A: Array, *sets: Polytope) -> Array:
    """Length (n,) of every coordinate, a power of two; shorter where it moves another by far more than its width."""
    size = np.zeros(sets[0].dim)
    for S in sets:
        if not S.is_empty:
            lower, upper = S.bounding_box()
            width = np.where(np.isfinite(upper - lower), upper - lower, 0.0)
            size = np.where(size > 0.0, size, width)
    size = np.where(size > 0.0, size, 1.0)
    for _ in size:
        with np.errstate(divide="ignore", over="ignore"):
            size = np.minimum(size, (MUCH * size[:, None] / np.abs(A)).min(axis=0))
    return np.exp2(np.round(np.log2(size)))


def _in_units(system: LinearSystem, size: Array) -> LinearSystem:
    """Motion of x / size."""
    noise = None if system.disturbances is None else system.disturbances / size
    return LinearSystem(system.A * size / size[:, None], system.B / size[:, None], noise)


def _scaled(S: Polytope, size: Array) -> Polytope:
    """Set {x / size : x in S}; size (n,) are powers of two."""
    body = S.body
    if body is None:
        return Polytope.empty(S.dim)
    body = replace(
        body,
        centre=body.centre / size,
        basis=body.basis / size[:, None],
        half_widths=body.half_widths / size,
        terms=body.terms / size,
    )
    V = None if S.given_vertices is None else S.given_vertices / size
    rows = S.stated
    return set_of(Polytope, rows._replace(A=rows.A * size, A_eq=rows.A_eq * size).unit, V, body)


def _in_given_units(result: SetResult, size: Array) -> SetResult:
    """Result with its sets multiplied by size."""
    return replace(result, set=_scaled(result.set, 1 / size), outer=_scaled(result.outer, 1 / size))


def _repeat(
    step: Callable[[Polytope, Deadline], Step],
    S: Polytope,
    steps: int,
    deadline: Deadline,
    outer: Polytope,
    last: Callable[[Deadline], Polytope | None] | None,
) -> SetResult:
    """Result of `steps` steps from S, or of those before a limit.

    At a limit it has `outer`, and the inner hull of states that `last` finds.
    """
    exact = deadline.part(EXACT_SHARE)
    violation = -np.inf
    missing = 0.0
    points = 0
    for k in range(1, steps + 1):
        try:
            exact.check()
            S, check = step(S, exact)
            if S.is_empty:
                return no_set(S.dim, k)
        except NumericalError:
            return no_set(S.dim, k, _whole_space(S), Status.NOT_CERTIFIED)
        except LimitReached as limit:
            # the inner set has 0.3 s extra, or 1 s without a limit
            late = Deadline.after(0.3 + max(deadline.left, 0.0) if np.isfinite(deadline.end) else 1.0)
            inner = None if last is None else last(late)
            if inner is None:
                return no_set(outer.dim, k - 1, outer, status_of(limit))
            return SetResult(inner, outer, status_of(limit), k - 1, Certificate(0.0, np.inf, len(inner.vertices)))
        violation = max(violation, check.violation)
        missing = max(missing, check.missing)
        points += check.points
    return _exact(S, steps, Certificate(violation, max(missing, 0.0), points, missing=missing))


def _exact(S: Polytope, steps: int, certificate: Certificate) -> SetResult:
    """Result of all steps: CONVERGED if certified and nothing is missing."""
    if S.is_empty:
        return no_set(S.dim, steps)
    if not certificate.holds:
        return no_set(S.dim, steps, S, Status.NOT_CERTIFIED)
    maximal = certificate.gap <= certificate.tolerance
    return SetResult(S, S, Status.CONVERGED if maximal else Status.NOT_MAXIMAL, steps, certificate)


def _with_inputs(A: Any, B: Any, U: Any) -> tuple[Any, Any, Any]:
    """A, B and U; a zero input where both are None."""
    if B is not None or U is not None:
        return A, B, U
    A = checked_state_matrix(A)
    return A, np.zeros((len(A), 1)), NO_INPUT


def _whole_space(S: Polytope) -> Polytope:
    """Whole space that S lies in."""
    return Polytope(np.zeros((0, S.dim)), np.zeros(0))
