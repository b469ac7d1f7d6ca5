"""Local problem in well-scaled coordinates about an equilibrium.

A flat state set is kept only by inputs that keep the state on its affine hull, so that the recursion sees a
full-dimensional problem with constraints on state and input together.

References
----------
Basile, Marro (1969), Controlled and conditioned invariant subspaces in linear system theory, JOTA 3(5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from invariant_sets.bodies import Body, Stated, row_norms
from invariant_sets.hulls import counter_clockwise
from invariant_sets.interior_form import normals
from invariant_sets.linear_programs import largest_ball, maximise_rows
from invariant_sets.polyhedron import set_of
from invariant_sets.polytope import Polytope
from invariant_sets.projection import unit
from invariant_sets.system_checks import LinearSystem
from invariant_sets.tolerances import COARSE, ROUNDING, SMALL

Array = np.ndarray
Rows = tuple[Array, Array]


def left_inverse(basis: Array) -> Array:
    """Left inverse L (k, n) with L basis = 1, in any units."""
    if basis.shape[0] == basis.shape[1]:
        return np.linalg.inv(basis)
    rows = np.abs(basis).max(axis=1, initial=0.0)
    rows[rows == 0.0] = 1.0
    columns = np.abs(basis / rows[:, None]).max(axis=0)
    return np.asarray(np.linalg.pinv(basis / rows[:, None] / columns) / rows / columns[:, None])


@dataclass(frozen=True)
class Frame:
    """Coordinates x = centre + basis y, with y (k,) and basis (n, k)."""

    centre: Array
    basis: Array

    @cached_property
    def back(self) -> Array:
        """Matrix (k, n) that takes x − centre to y."""
        return left_inverse(self.basis)

    def polytope(self, F: Array, g: Array, V: Array | None = None) -> Polytope:
        """Polytope {x : F y <= g} on the hull; V are its vertices."""
        n, k = self.basis.shape
        rows = F @ self.back
        normal = normals(self.basis) if k < n else np.zeros((0, n))
        rows, right = unit(rows, g)
        V = None if V is None else counter_clockwise(self.centre + V @ self.basis.T)
        return set_of(Polytope, Stated.given(rows, right + rows @ self.centre, normal, normal @ self.centre), V)


@dataclass(frozen=True)
class LocalProblem:
    """Dynamics and constraints in local coordinates y and v."""

    frame: Frame  # back to x
    dynamics: LinearSystem  # the motion of y, but for the drift
    drift: Array  # (k,): y⁺ = A y + B v + w + drift; 0 at equilibria
    states: Rows  # (F, g): state set F y <= g, rows of unit norm
    joint: Rows  # (H, h): rows H [y; v] <= h
    input_moves: Array | None  # (m, k): vertices of B V where V does not depend on y and is bounded
    law: Array  # (nu, 1 + k + q): the input u = law (1, y, v)
    # whether the state set is bounded, and whether y = 0 is an equilibrium
    bounded: bool
    at_equilibrium: bool


def localise(system: LinearSystem, X: Polytope, U: Polytope, units: Array) -> LocalProblem | Polytope | None:
    """Problem in local coordinates, or a flatter X to try, or neither; `units` (nx,) is the first extent."""
    state = X.body
    inputs = U.body
    if state is None or inputs is None:
        return None
    frame, states = _round_frame(X, state)
    mean = np.zeros(X.dim) if system.disturbances is None else system.disturbances.mean(axis=0)
    spread = None if system.disturbances is None else system.disturbances - mean
    k = frame.basis.shape[1]
    # maps of (1, y, v): where the state goes from the centre, the constraints that have to be <= 0, and the input
    drift = system.A @ frame.centre + system.B @ inputs.centre + mean - frame.centre
    motion = np.column_stack([drift, system.A @ frame.basis, system.B @ inputs.basis])
    rows = np.column_stack([-inputs.g, np.zeros((len(inputs.g), k)), inputs.F])
    law = np.column_stack([inputs.centre, np.zeros((U.dim, k)), inputs.basis])
    flat = k < X.dim
    if flat:
        size = np.maximum(np.abs(system.A) @ np.abs(frame.basis).sum(axis=1), units)
        size = np.maximum(size, np.abs(system.B) @ np.abs(inputs.basis).sum(axis=1))
        answer = _stay_on_hull(motion, frame.basis, spread, size)
        if isinstance(answer, tuple):
            held = answer[0] @ frame.back
            return X.intersection(Polytope(A_eq=held, b_eq=answer[1] + held @ frame.centre))
        if answer is None:
            return None
        motion, rows, law = (part @ answer for part in (motion, rows, law))
    local = frame.back @ motion
    dynamics = LinearSystem(local[:, 1 : k + 1], local[:, k + 1 :], None if spread is None else spread @ frame.back.T)
    problem = LocalProblem(
        frame, dynamics, local[:, 0], states, (rows[:, 1:], -rows[:, 0]), None, law, state.bounded, at_equilibrium=False
    )
    if flat:
        vertices = _joint_input_corners(problem)
    else:
        vertices = (U.vertices - inputs.centre) @ left_inverse(inputs.basis).T if inputs.bounded else None
    return _at_equilibrium(problem, vertices, system)


def _stay_on_hull(motion: Array, basis: Array, spread: Array | None, size: Array) -> Array | tuple[Array, Array] | None:
    """Map of (1, y, v') to (1, y, v) on the hull, equalities on y, or None."""
    # `spread` (k, n) are the vertices of the disturbance about its mean, `size` (n,) is one in each coordinate of x
    k = basis.shape[1]
    normal = normals(basis)
    P = normal @ motion[:, 1 : k + 1]
    Q = normal @ motion[:, k + 1 :]
    s = -normal @ motion[:, 0]
    size = np.maximum(np.maximum(np.abs(normal) @ size, np.abs(s)), np.finfo(float).tiny)
    if (
        spread is not None
        and (
            np.abs(spread @ normal.T).max(axis=0)
            > COARSE * np.maximum(size, np.abs(spread).max() + np.finfo(float).tiny)
        ).any()
    ):
        return None
    P = P / size[:, None]
    Q = Q / size[:, None]
    s = s / size
    left, values, vt = np.linalg.svd(Q, full_matrices=True)
    rank = int((values > COARSE).sum())
    rest_P = left[:, rank:].T @ P
    rest_s = left[:, rank:].T @ s
    bound = np.abs(rest_P).max(axis=1, initial=0.0) > COARSE
    if (np.abs(rest_s[~bound]) > COARSE).any():
        return None
    if bound.any():
        return rest_P[bound], rest_s[bound]
    pseudo = vt[:rank].T @ (left[:, :rank].T / values[:rank, None])
    v = np.column_stack([pseudo @ s, -pseudo @ P, vt[rank:].T])  # v = pseudo (s − P y) + free v'
    return np.vstack([np.eye(k + 1, v.shape[1]), v])


def _round_frame(X: Polytope, state: Body) -> tuple[Frame, Rows]:
    """Coordinates with unit extents of X, and its rows in them."""
    frame = Frame(state.centre, state.basis)
    rows = (state.F, state.g)
    k = state.basis.shape[1]
    if not state.bounded or k < 2 or k > 4:
        return frame, rows
    Y = (X.vertices - state.centre) @ frame.back.T
    middle = (Y.max(axis=0) + Y.min(axis=0)) / 2
    widths, axes = np.linalg.eigh((Y - middle).T @ (Y - middle) / len(Y))
    if widths[0] > SMALL**2 * widths[-1]:
        return frame, rows
    turn = axes * np.sqrt(np.maximum(widths, ROUNDING**2 * widths[-1]))
    return Frame(state.centre, state.basis @ turn), unit(state.F @ turn, state.g)


def _joint_input_corners(problem: LocalProblem) -> Array | None:
    """Corners (m, q) of a box around all allowed inputs, or None."""
    k = problem.frame.basis.shape[1]
    q = problem.joint[0].shape[1] - k
    if q == 0:
        return np.zeros((1, 0))
    if not problem.bounded:
        return None
    rows, right = _lifted(problem)
    axes = np.hstack([np.zeros((q, k)), np.eye(q)])
    reach = maximise_rows(np.vstack([axes, -axes]), rows, right)
    if not np.isfinite(reach).all():
        return None
    corners = np.array(np.meshgrid(*zip(-reach[q:], reach[:q]), indexing="ij")).reshape(q, -1)
    return corners.T.copy()


def _lifted(problem: LocalProblem) -> Rows:
    """Unit rows on (y, v), silent ones dropped."""
    F, g = problem.states
    H, h = problem.joint
    rows = np.vstack([np.hstack([F, np.zeros((len(F), H.shape[1] - F.shape[1]))]), H])
    used = np.linalg.norm(rows, axis=1) > ROUNDING
    return unit(rows[used], np.append(g, h)[used])


def _at_equilibrium(problem: LocalProblem, vertices: Array | None, system: LinearSystem) -> LocalProblem | None:
    """Problem about an equilibrium; None if a bounded one has none."""
    # a nonempty compact convex control invariant set holds an equilibrium: Kakutani's theorem on x ↦ successors
    k = problem.dynamics.A.shape[0]
    full = problem.frame.basis.shape[0] == k
    point = _origin(problem, system) if full else None
    if point is None:
        point = _inner_equilibrium(problem)
    if point is None:
        moves = None if vertices is None else vertices @ problem.dynamics.B.T
        return None if problem.bounded else replace(problem, input_moves=moves)
    y = point[:k]
    law = np.column_stack([problem.law @ np.append(1.0, point), problem.law[:, 1:]])
    return replace(
        problem,
        frame=Frame(problem.frame.centre + problem.frame.basis @ y, problem.frame.basis),
        drift=np.zeros(k),
        states=(problem.states[0], problem.states[1] - problem.states[0] @ y),
        joint=(problem.joint[0], problem.joint[1] - problem.joint[0] @ point),
        input_moves=None if vertices is None else (vertices - point[k:]) @ problem.dynamics.B.T,
        law=law,
        at_equilibrium=True,
    )


def _origin(problem: LocalProblem, system: LinearSystem) -> Array | None:
    """Origin in local coordinates, if an inner equilibrium."""
    if system.disturbances is not None and np.abs(system.disturbances.mean(axis=0)).max() > 0:
        return None
    y = -np.linalg.solve(problem.frame.basis, problem.frame.centre)
    dynamics = problem.dynamics
    residual = y - dynamics.A @ y - problem.drift
    q = dynamics.B.shape[1]
    v = np.linalg.lstsq(dynamics.B, residual, rcond=None)[0] if q else np.zeros(0)
    # any v with B v = residual will do as u = 0 does not change the state
    point = np.append(y, v)
    if np.abs(residual - dynamics.B @ v).max() > ROUNDING * max(1.0, np.abs(y).max()):
        return None
    inside = (problem.states[1] - problem.states[0] @ y).min(initial=1.0) > SMALL
    inside = inside and (problem.joint[1] - problem.joint[0] @ point).min(initial=1.0) > 0
    return point if inside else None


def _inner_equilibrium(problem: LocalProblem) -> Array | None:
    """Equilibrium (y, v) deep inside all rows, or None."""
    from scipy.linalg import null_space

    dynamics = problem.dynamics
    matrix = np.hstack([np.eye(len(dynamics.A)) - dynamics.A, -dynamics.B])
    size = row_norms(matrix.T)
    scale = 1.0 / np.maximum(size, 1.0)  # strong inputs need only a small part of U
    rows, right = _lifted(problem)
    matrix = matrix * scale
    rows = rows * scale
    z, *_ = np.linalg.lstsq(matrix, problem.drift, rcond=ROUNDING)
    worst = np.abs(matrix @ z - problem.drift).max(initial=0.0)
    if worst > COARSE * max(1.0, np.abs(problem.drift).max(initial=0.0)):
        return None
    null = null_space(matrix, rcond=COARSE)
    room = right - rows @ z
    slope = rows @ null
    norms = np.linalg.norm(slope, axis=1)
    moving = norms > ROUNDING
    if (room[~moving] < -COARSE).any():
        return None
    if not moving.any():
        return np.asarray(scale * z)
    ball = largest_ball(slope[moving] / norms[moving, None], room[moving] / norms[moving])
    return None if ball.radius < -COARSE else scale * (z + null @ ball.centre)
