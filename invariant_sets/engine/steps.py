"""One step back and one ahead of a set, each checked.

References
----------
Blanchini, Miani (2015), Set-Theoretic Methods in Control, section 5.1. Borrelli, Bemporad, Morari (2017), Predictive
Control for Linear and Hybrid Systems, section 10.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from invariant_sets.engine.certificate import control_violation, precise_minimiser
from invariant_sets.engine.loose_bounds import without_loose_bounds
from invariant_sets.exceptions import NumericalError
from invariant_sets.linear_programs import minimise
from invariant_sets.local_box import HALF_BOX
from invariant_sets.polyhedron import nonempty_body
from invariant_sets.polytope import Polytope
from invariant_sets.projection import project_rows, unit
from invariant_sets.results import Certificate
from invariant_sets.system_checks import LinearSystem
from invariant_sets.time_limits import NO_DEADLINE, Deadline
from invariant_sets.tolerances import FLAT, MEMBERSHIP, MUCH, ROUNDING, SMALL

Array = np.ndarray


Step = tuple[Polytope, Certificate]  # the set after one step, and by how much a vertex is too much or it is too small
_UNCHECKED = Certificate(0.0, np.inf, 0, missing=0.0)


def backward_step(
    system: LinearSystem, S: Polytope, X: Polytope, U: Polytope, deadline: Deadline = NO_DEADLINE
) -> Step:
    """States in X that inputs in U steer into S for all w.

    It is found in one of two ways that share no arithmetic, by elimination of the inputs from the lifted set or by
    the sum of S and the moves of the inputs; the second is tried where the first does not pass its check.
    """
    n = len(system.A)
    tight = S if system.disturbances is None else S.pontryagin_difference(Polytope.from_vertices(system.disturbances))
    system, X, U = without_loose_bounds(system, X, U, tight)
    lifted = tight.preimage(np.hstack([system.A, system.B])).intersection(X.cartesian_product(U))
    if lifted.is_empty:
        return Polytope.empty(n), _UNCHECKED
    if lifted.affine_dim < lifted.dim:
        longer = _without_far_ends(system, S, X, U, lifted, deadline)
        if longer is not None:
            return longer
    ways: list[Callable[[], Polytope | None]] = [
        lambda: _by_elimination(lifted, n, deadline),
        lambda: _by_sum(system, tight, X, U, lifted, deadline),
    ]
    if system.B.shape[1] > 1:
        ways.reverse()
    best = X, replace(_UNCHECKED, violation=np.inf)
    for way in ways:
        try:
            P = way()
            if P is None or P.is_empty:
                continue
            check = control_violation(system, P, U, target=S, deadline=deadline)
            check = replace(check, missing=_too_small(P, lifted, n, deadline))
        except NumericalError:
            continue
        if _worst(check) < _worst(best[1]):
            best = P, check
        if _worst(check) <= MEMBERSHIP:
            break
    return best


def _worst(check: Certificate) -> float:
    """Larger of what is too much and what is missing."""
    return max(check.violation, check.missing)


def _without_far_ends(
    system: LinearSystem, S: Polytope, X: Polytope, U: Polytope, lifted: Polytope, deadline: Deadline
) -> Step | None:
    """Step without ends so far away that a width seems flat, or None.

    In units of what moves the target by `MUCH` times its width, at most of the width of the sets: `1 / FLAT` of them
    away doubles do not tell where the rows are.

    Raises
    ------
    NumericalError
        An end is nearer than that: it would be missed, and beside it the width is nothing.
    """
    n = len(system.A)
    body = nonempty_body(lifted, "backward_step")
    M = np.hstack([system.A, system.B])
    width = nonempty_body(S, "backward_step").half_widths
    with np.errstate(divide="ignore", over="ignore"):
        unit = (np.where(width > 0.0, MUCH * width, np.inf)[:, None] / np.abs(system.A)).min(axis=0, initial=1.0)
        moved = np.minimum(np.abs(system.A) @ unit + np.abs(system.B) @ body.half_widths[n:], 1.0)
    known = ROUNDING * (body.terms + body.half_widths)
    rows = len(X.b) + len(S.b)
    for distance in (1 / FLAT, MUCH):
        states = _without_rows_beyond(X, body.centre[:n], distance * unit + known[:n])
        target = _without_rows_beyond(S, M @ body.centre, distance * moved + np.abs(M) @ known)
        if len(states.b) + len(target.b) == rows:
            continue
        step = backward_step(system, target, states, U, deadline)
        if step[0].affine_dim > lifted.projection(np.arange(n)).affine_dim:
            if distance > MUCH:
                return step
            raise NumericalError("X", X.A.shape, "the width of the set is nothing beside its length")
    return None


def _without_rows_beyond(P: Polytope, point: Array, reach: Array) -> Polytope:
    """P without inequalities that a box about `point` does not meet."""
    near = P.b - P.A @ point <= np.abs(P.A) @ reach
    return Polytope(P.A[near], P.b[near], P.A_eq, P.b_eq)


def _by_elimination(lifted: Polytope, n: int, deadline: Deadline) -> Polytope:
    """Projection of the lifted set on x, by Fourier–Motzkin elimination."""
    body = nonempty_body(lifted, "backward_step")
    if body.basis.shape[1] < lifted.dim:
        return lifted.projection(np.arange(n)).minimal()
    reach = np.full(lifted.dim, HALF_BOX if body.bounded else np.inf)
    F, g = project_rows(body.F, body.g, n, reach=reach, deadline=deadline)
    F = F / np.diag(body.basis)[:n]  # the basis of a full-dimensional body is diagonal
    return Polytope(F, g + F @ body.centre[:n]).minimal()


def _by_sum(
    system: LinearSystem, S: Polytope, X: Polytope, U: Polytope, lifted: Polytope, deadline: Deadline
) -> Polytope | None:
    """Set {x : A x in S ⊕ (−B U)} ∩ X by vertices; None if unbounded."""
    n = len(system.A)
    lower, upper = lifted.bounding_box()
    slack = SMALL * np.maximum(upper - lower, 0.0)[n:]
    useful = U.intersection(Polytope.from_bounds(lower[n:] - slack, upper[n:] + slack))  # strong inputs hide S
    if not (S.is_bounded and useful.is_bounded) or useful.is_empty:
        return None
    deadline.check_hull(len(S.vertices) * len(useful.vertices), n)
    return S.minkowski_sum(useful.affine_map(-system.B)).preimage(system.A).intersection(X).minimal()


def _too_small(P: Polytope, lifted: Polytope, n: int, deadline: Deadline) -> float:
    """Largest relative reach of the lifted set beyond facets of P."""
    body = nonempty_body(lifted, "backward_step")
    F, g = P.relative_rows
    worst = 0.0
    for i, f in enumerate(F):
        deadline.check()
        local = body.basis[:n].T @ f
        level = float(f @ body.centre[:n] - g[i])
        size = float(np.hypot.reduce(local, initial=0.0))
        beyond = size * -minimise(-local / size, body.F, body.g)[0] + level if size > 0.0 else level
        if beyond > MEMBERSHIP and size > 0.0:  # a flat optimum may be found too large: a second solver
            point = precise_minimiser(-local / size, body.F, body.g)
            beyond = beyond if point is None else min(beyond, float(local @ point) + level)
        worst = max(worst, beyond)
    return worst


def forward_step(system: LinearSystem, R: Polytope, moves: Polytope, deadline: Deadline = NO_DEADLINE) -> Step:
    """Step ahead A R ⊕ moves."""
    n = len(system.A)
    if R.is_bounded and moves.is_bounded:
        deadline.check_hull(len(R.vertices) * len(moves.vertices), n)
    image = R.affine_map(system.A).minkowski_sum(moves).minimal()
    if image.is_empty or not len(image.b) + len(image.b_eq):
        return image, _UNCHECKED
    F, g = image.relative_rows
    exact = R.support(F @ system.A) + moves.support(F)
    missing = float((exact - g).max())
    violation = float((g - exact).max())
    if image.is_bounded:
        violation = max(violation, _unreached(system, image, R, moves, deadline))
    return image, Certificate(violation, np.inf, len(g), missing=missing)


def _unreached(system: LinearSystem, image: Polytope, R: Polytope, moves: Polytope, deadline: Deadline) -> float:
    """Largest relative distance of the image's vertices from A R ⊕ moves."""
    start = nonempty_body(R, "forward_step")
    move = nonempty_body(moves, "forward_step")
    n = len(system.A)
    k = start.basis.shape[1]
    q = move.basis.shape[1]
    width = np.ptp(image.vertices, axis=0)
    known = np.abs(system.A) @ start.terms + move.terms
    width = np.maximum(np.where(width > 0.0, width, width.max()), ROUNDING / MEMBERSHIP * known)
    width = np.where(width > 0.0, width, 1.0)
    to = np.hstack([system.A @ start.basis, move.basis]) / width[:, None]
    at = (system.A @ start.centre + move.centre) / width
    rows = np.vstack(
        [
            np.column_stack([to, -np.ones(n)]),
            np.column_stack([-to, -np.ones(n)]),
            np.column_stack([start.F, np.zeros((len(start.g), q + 1))]),
            np.column_stack([np.zeros((len(move.g), k)), move.F, np.zeros(len(move.g))]),
        ]
    )
    cost = np.append(np.zeros(k + q), 1.0)
    worst = 0.0
    for v in image.vertices / width:
        deadline.check()
        scaled, right = unit(rows, np.concatenate([v - at, at - v, start.g, move.g]))
        worst = max(worst, minimise(cost, scaled, right)[0])
    return worst
