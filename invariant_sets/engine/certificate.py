"""Independent checks of an invariant set.

They share nothing with the recursion but the linear programs: the set is taken as the rows and vertices that the user
gets, in the units of the user.
"""

from __future__ import annotations

import daqp
import numpy as np

from invariant_sets.bodies import row_norms
from invariant_sets.budgets import PROGRAMS_PER_CHECK
from invariant_sets.exceptions import NumericalError
from invariant_sets.linear_programs import highs, minimise
from invariant_sets.polyhedron import nonempty_body
from invariant_sets.polytope import Polytope
from invariant_sets.projection import project_rows, unit
from invariant_sets.results import Certificate
from invariant_sets.system_checks import LinearSystem
from invariant_sets.time_limits import NO_DEADLINE, Deadline
from invariant_sets.tolerances import FLAT, LP_SOLVER, MEMBERSHIP, PLACE, ROUNDING

Array = np.ndarray
Rows = tuple[Array, Array]


def control_violation(
    system: LinearSystem, C: Polytope, U: Polytope, *, target: Polytope | None = None, deadline: Deadline = NO_DEADLINE
) -> Certificate:
    """Violation of `target` by C's worst vertex under its best input.

    Parameters
    ----------
    system : LinearSystem
        Dynamics.
    C, U : Polytope
        State and input sets, not empty.
    target : Polytope, optional
        Where the successors must lie; C if left out.
    deadline : Deadline
        When to stop, by `TimeLimitReached`.

    Returns
    -------
    Certificate
        The violation is max over vertices x of min over u in U of max over facets i and disturbances w of
        (fᵢᵀ(A x + B u + w) − gᵢ) / (range of fᵢ over the bounding box of the target). By convexity it bounds the
        violation on all of C. Unbounded sets are checked at the facets of their predecessor set instead.

    Notes
    -----
    The linear program only proposes u; the violation is then recomputed from u by a matrix product, so a solver
    error can make the result too large, never too small.
    """
    target = C if target is None else target
    F, g = tightened_rows(target, system.disturbances)
    if not len(g):
        return Certificate(0.0, np.inf, 0)
    if not C.is_bounded:
        return _violation_at_facets(system, C, U, (F, g), deadline)
    body = nonempty_body(U, "the certificate")
    slope = F @ system.B @ body.basis
    room = g - C.vertices @ (F @ system.A).T - F @ system.B @ body.centre
    terms = np.abs(C.vertices) @ (np.abs(F) @ np.abs(system.A)).T + np.abs(F) @ np.abs(system.B) @ body.terms
    room = room + np.where(PLACE * terms > ROUNDING, PLACE * terms, 0.0)  # a thin target far from what was added
    if slope.shape[1] == 0:
        return Certificate(float((-room).max()), np.inf, len(room))
    return Certificate(_least_violation(slope, room, (body.F, body.g), deadline), np.inf, len(room))


def _least_violation(slope: Array, room: Array, inputs: Rows, deadline: Deadline) -> float:
    """Largest over k of min over v of max (slope v − room_k)."""
    H, h = inputs
    nu = H.shape[1]
    if nu > 1:  # nearly parallel inputs: their difference becomes an input of its own
        turn = np.linalg.svd(slope, full_matrices=True)[2].T
        slope = slope @ turn
        H = H @ turn
    rows = np.zeros((len(slope) + len(H), nu + 1))
    rows[: len(slope), :nu] = slope
    rows[: len(slope), nu] = -1.0
    rows[len(slope) :, :nu] = H
    cost = np.zeros(nu + 1)
    cost[nu] = 1.0
    witnesses = _middle_inputs(slope[:, 0], room, (H, h)) if nu == 1 else np.full((len(room), nu), np.inf)
    leaves = _violations(witnesses, slope, room, (H, h))
    doubtful = np.flatnonzero(~(leaves <= ROUNDING))
    for k in doubtful:
        deadline.check()
        v, _, flag, _ = daqp.solve(None, cost, rows, np.concatenate([room[k], h]), primal_tol=LP_SOLVER)
        witnesses[k] = v[:nu] if flag == 1 else np.inf
    leaves[doubtful] = np.minimum(leaves[doubtful], _violations(witnesses[doubtful], slope, room[doubtful], (H, h)))
    for k in np.argsort(-leaves):  # DAQP stops early where the inputs are nearly parallel
        if leaves[k] <= ROUNDING:
            break
        deadline.check()
        for solver in (_checked_minimiser, precise_minimiser):
            v = solver(cost, rows, np.concatenate([room[k], h]))
            if v is not None:
                leaves[k] = min(leaves[k], _violations(v[None, :nu], slope, room[k : k + 1], (H, h))[0])
            if leaves[k] <= MEMBERSHIP:
                break
        if leaves[k] > MEMBERSHIP:  # confirmed by three solvers: the other vertices cannot mend that
            break
    return float(leaves.max())


def _middle_inputs(slope: Array, room: Array, inputs: Rows) -> Array:
    """Middle (k, 1) of the interval of admissible single inputs."""
    rows = np.concatenate([slope, inputs[0][:, 0]])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ends = np.hstack([room, np.broadcast_to(inputs[1], (len(room), len(inputs[1])))]) / rows
        upper = np.where(rows > 0.0, ends, np.inf).min(axis=1)
        lower = np.where(rows < 0.0, ends, -np.inf).max(axis=1)
        middle = lower / 2 + upper / 2
    return np.where(np.isfinite(middle), middle, 0.0)[:, None]


def _checked_minimiser(cost: Array, rows: Array, right: Array) -> Array | None:
    """Minimiser of the linear program by the package's solvers, or None."""
    try:
        return minimise(cost, rows, right)[1]
    except NumericalError:
        return None


def precise_minimiser(cost: Array, rows: Array, right: Array) -> Array | None:
    """Minimiser by HiGHS at its tightest tolerances, or None."""
    answer = highs(cost, rows, right)
    return None if answer is None else answer[0]


def _violations(v: Array, slope: Array, room: Array, inputs: Rows) -> Array:
    """Violation of each witness (k, nu), shortened where it leaves U; inf without one."""
    with np.errstate(invalid="ignore"):
        excess = (v @ inputs[0].T / inputs[1]).max(axis=1, initial=0.0)
        inside = v / np.maximum(excess, 1.0)[:, None]
        return np.where(np.isfinite(excess), (inside @ slope.T - room).max(axis=1), np.inf)


def feedback_violation(
    system: LinearSystem, C: Polytope, U: Polytope, gain: Array, offset: Array, deadline: Deadline = NO_DEADLINE
) -> Certificate:
    """Violation of C or U by C under the feedback u = gain x + offset."""
    closed = system.A + system.B @ gain
    shift = system.B @ offset
    F, g = tightened_rows(C, system.disturbances)
    H, h = U.relative_rows
    rows = np.vstack([F @ closed, H @ gain])
    right = np.append(g - F @ shift, h - H @ offset)
    worst = -np.inf
    for i in range(0, len(rows), PROGRAMS_PER_CHECK):
        deadline.check()
        worst = max(
            worst, float((C.support(rows[i : i + PROGRAMS_PER_CHECK]) - right[i : i + PROGRAMS_PER_CHECK]).max())
        )
    return Certificate(worst, np.inf, len(rows))


def outside(C: Polytope, X: Polytope, *, by_vertices: bool = True) -> float:
    """Violation of X by C, relative to C's bounding box.

    Without `by_vertices`, by linear programs: for a set in so many dimensions that vertices take too long.
    """
    F, g = X.one_sided
    if not len(g):
        return 0.0
    if by_vertices and C.is_bounded:
        beyond = (F @ C.vertices.T).max(axis=1) - g
        extent = np.ptp(C.vertices, axis=0)
    else:
        beyond = C.support(F) - g
        extent = 2 * row_norms(nonempty_body(C, "the certificate").basis)
    scale = np.abs(F) @ np.maximum(extent, FLAT * extent.max(initial=0.0))
    return float((beyond / np.where(scale > 0.0, scale, 1.0)).max())


def missing(system: LinearSystem, C: Polytope, X: Polytope, U: Polytope, deadline: Deadline = NO_DEADLINE) -> float:
    """Enlargement of C by a backward step, relative to row ranges.

    For every row f of C one linear program: max fᵀx over x in X and u in U with A x + B u + w in C for all w. A set
    that has collapsed, or was cut too far, shows here.
    """
    state = nonempty_body(X, "the certificate")
    inputs = nonempty_body(U, "the certificate")
    F, g = C.relative_rows
    T, t = tightened_rows(C, system.disturbances)
    k = state.basis.shape[1]
    m = len(state.g)
    rows = np.zeros((m + len(inputs.g) + len(t), k + inputs.basis.shape[1]))
    rows[:m, :k] = state.F
    rows[m : m + len(inputs.g), k:] = inputs.F
    rows[m + len(inputs.g) :, :k] = T @ system.A @ state.basis
    rows[m + len(inputs.g) :, k:] = T @ system.B @ inputs.basis
    drift = system.A @ state.centre + system.B @ inputs.centre
    rows, right = unit(rows, np.concatenate([state.g, inputs.g, t - T @ drift]))
    costs = np.zeros((len(F), rows.shape[1]))
    costs[:, :k] = -F @ state.basis
    level = F @ state.centre - g
    size = row_norms(costs)
    moving = np.flatnonzero(size > 0.0)
    beyond = level.copy()
    for i in range(0, len(moving), PROGRAMS_PER_CHECK):
        deadline.check()
        part = moving[i : i + PROGRAMS_PER_CHECK]
        beyond[part] += size[part] * _upper_bounds(costs[part] / size[part, None], rows, right)
    worst = -np.inf
    for row in np.argsort(-beyond):
        if beyond[row] <= worst:
            break
        if beyond[row] > MEMBERSHIP and size[row] > 0.0:  # the multipliers may give too large a bound
            beyond[row] = min(beyond[row], size[row] * -minimise(costs[row] / size[row], rows, right)[0] + level[row])
        worst = max(worst, float(beyond[row]))
    return worst


def _upper_bounds(costs: Array, rows: Array, right: Array) -> Array:
    """Upper bounds of max −costᵀz over the rows, for every cost."""
    dual = np.zeros((len(costs), len(right)))
    solved = np.zeros(len(costs), bool)
    for i, cost in enumerate(costs):
        _, _, flag, info = daqp.solve(None, cost, rows, right, eta_prox=FLAT)
        if flag == 1:
            dual[i] = info["lam"]
            solved[i] = True
    dual = np.maximum(dual, 0.0)
    bounds: Array = dual @ right
    for row in np.flatnonzero(~(solved & (np.abs(costs + dual @ rows).max(axis=1) <= LP_SOLVER))):
        bounds[row] = -minimise(costs[row], rows, right)[0]
    return bounds


def tightened_rows(C: Polytope, disturbances: Array | None) -> Rows:
    """Relative rows of C ⊖ E W."""
    F, g = C.relative_rows
    return F, g if disturbances is None or not len(g) else g - (F @ disturbances.T).max(axis=1)


def _violation_at_facets(
    system: LinearSystem, C: Polytope, U: Polytope, target: Rows, deadline: Deadline
) -> Certificate:
    """Violation of the target's predecessor rows by C."""
    body = nonempty_body(U, "the certificate")
    F, g = target
    state = nonempty_body(C, "the certificate")
    N = state.basis
    rows = np.vstack(
        [
            np.hstack([F @ system.A @ N, F @ system.B @ body.basis]),
            np.hstack([np.zeros((len(body.g), N.shape[1])), body.F]),
        ]
    )
    right = np.append(g - F @ (system.A @ state.centre + system.B @ body.centre), body.g)
    R, r = project_rows(rows, right, N.shape[1], deadline=deadline)
    if not len(r):
        return Certificate(0.0, np.inf, 0)
    values = np.array([-minimise(-row, state.F, state.g)[0] for row in R])
    return Certificate(float(((values - r) / 2.0).max()), np.inf, len(r))
