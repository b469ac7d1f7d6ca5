"""The problem in coordinates that suit the arithmetic: an equilibrium at 0, sets of order one, nothing flat.

A flat state set is kept only by inputs that keep the state on its affine hull. Those are found here, so that the
recursion sees a full-dimensional problem with constraints on state and input together.

References
----------
Basile, Marro (1969), Controlled and conditioned invariant subspaces in linear system theory, JOTA 3(5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from invariant_sets.interior_form import Body, normals, null_space
from invariant_sets.linear_programs import inscribed_ball, maximise_rows
from invariant_sets.polytope import Polytope
from invariant_sets.validation import frozen

Array = np.ndarray
_ROUND = 1e-8  # relative size below which a coefficient of an equality is rounding


@dataclass(frozen=True)
class LinearSystem:
    """x⁺ = A x + B u + w with w in the hull of the rows of `disturbances` (None: no disturbance)."""

    A: Array
    B: Array
    disturbances: Array | None = None


@dataclass(frozen=True)
class LocalProblem:
    """y⁺ = A y + B v + drift + w with x = centre + basis y, {F y <= g} and {H [y; v] <= h}.

    Attributes
    ----------
    centre, basis : (n,) and (n, k) arrays
        Back to x.
    A, B, drift : arrays
        Dynamics; drift is zero if y = 0 is an equilibrium.
    F, g : arrays
        State set, rows of unit norm.
    H, h : arrays
        Joint rows on (y, v).
    inputs : (m, k) array or None
        Vertices of B V where V does not depend on y and is bounded.
    disturbances : (q, k) array or None
        Vertices of the disturbance, about its mean.
    bounded, shifted : bool
        Whether the state set is bounded, and whether y = 0 is an equilibrium.
    """

    centre: Array
    basis: Array
    A: Array
    B: Array
    drift: Array
    F: Array
    g: Array
    H: Array
    h: Array
    inputs: Array | None
    disturbances: Array | None
    bounded: bool
    shifted: bool

    def polytope(self, F: Array, g: Array, V: Array | None) -> Polytope:
        """Return {x : F y <= g}, with its vertices filled in if V holds those of y."""
        n, k = self.basis.shape
        if k == n:
            rows, normal = F @ np.linalg.inv(self.basis), np.zeros((0, n))
        else:
            rows, normal = F @ np.linalg.pinv(self.basis), normals(self.basis)
        norms = np.linalg.norm(rows, axis=1)
        norms[norms == 0] = 1.0
        rows = rows / norms[:, None]
        P = Polytope(rows, g / norms + rows @ self.centre, normal, normal @ self.centre)
        if V is not None:
            if k == 2:
                middle = V.mean(axis=0)
                V = V[np.argsort(np.arctan2(V[:, 1] - middle[1], V[:, 0] - middle[0]))]
            P.__dict__["vertices"] = frozen(self.centre + V @ self.basis.T)
        return P


def localise(system: LinearSystem, X: Polytope, U: Polytope, units: Array) -> LocalProblem | Polytope | None:
    """Return the problem in local coordinates, a flatter X to try instead, or None if no state can stay in X.

    `units` (nx,) is the extent of the first state set: a flat one has no size across its hull.
    """
    state, inputs = X._body, U._body
    if state is None or inputs is None:
        return None
    N, M = state.basis, inputs.basis
    mean = np.zeros(len(N)) if system.disturbances is None else system.disturbances.mean(axis=0)
    spread = None if system.disturbances is None else system.disturbances - mean
    AN, BM = system.A @ N, system.B @ M
    drift = system.A @ state.centre + system.B @ inputs.centre + mean - state.centre
    Hx, Hu, h = np.zeros((len(inputs.g), N.shape[1])), inputs.F, inputs.g
    flat = N.shape[1] < len(N)
    if flat:
        size = np.maximum(np.abs(system.A) @ np.abs(N).sum(axis=1), units)  # what counts as zero
        size = np.maximum(size, np.abs(system.B) @ np.abs(M).sum(axis=1))
        kept = _stay_on_hull(normals(N), AN, BM, drift, spread, Hu, h, size)
        if kept is None or (isinstance(kept, tuple) and len(kept) == 2):
            if kept is None:
                return None
            P, s = kept
            back = P @ np.linalg.pinv(N)
            return X.intersection(Polytope(np.zeros((0, len(N))), np.zeros(0), back, s + back @ state.centre))
        AN, BM, drift, Hx, Hu, h = kept
    inverse = np.linalg.pinv(N) if flat else np.linalg.inv(N)
    A, B, drift = inverse @ AN, inverse @ BM, inverse @ drift
    w = None if spread is None else spread @ inverse.T
    H = np.hstack([Hx, Hu])
    vertices = _input_vertices(U, inputs, state, H, h, flat)
    problem = LocalProblem(state.centre, N, A, B, drift, state.F, state.g, H, h, vertices, w, state.bounded, False)
    return _at_equilibrium(problem, system, X)


def _input_vertices(U: Polytope, inputs: Body, state: Body, H: Array, h: Array, flat: bool) -> Array | None:
    """Return vertices of a set that holds every local input v; None if there is none."""
    k = state.basis.shape[1]
    q = H.shape[1] - k
    if q == 0:
        return np.zeros((1, 0))
    if not inputs.bounded or (flat and not state.bounded):
        return None
    if not flat:
        return (U.vertices - inputs.centre) @ np.linalg.pinv(inputs.basis).T
    rows = np.vstack([np.hstack([state.F, np.zeros((len(state.F), q))]), H])
    norms = np.linalg.norm(rows, axis=1)
    used = norms > 1e-12
    axes = np.hstack([np.zeros((q, k)), np.eye(q)])
    reach = maximise_rows(np.vstack([axes, -axes]), rows[used] / norms[used, None],
                          np.append(state.g, h)[used] / norms[used])
    if not np.isfinite(reach).all():
        return None
    corners = np.array(np.meshgrid(*zip(-reach[q:], reach[:q]), indexing="ij")).reshape(q, -1)
    return corners.T.copy()


def _stay_on_hull(normal: Array, AN: Array, BM: Array, drift: Array, spread: Array | None, Hu: Array,
                  h: Array, size: Array):
    """Return the problem whose inputs keep the state on the hull; (P, s) with P y = s if it must be flatter; None."""
    P, Q, s = normal @ AN, normal @ BM, -normal @ drift
    size = np.maximum(np.maximum(np.abs(normal) @ size, np.abs(s)), 1e-300)
    if spread is not None and (np.abs(spread @ normal.T).max(axis=0) > _ROUND * np.maximum(
            size, np.abs(spread).max() + 1e-300)).any():
        return None
    P, Q, s = P / size[:, None], Q / size[:, None], s / size
    left, values, vt = np.linalg.svd(Q, full_matrices=True)
    rank = int((values > _ROUND).sum())
    rest_P, rest_s = left[:, rank:].T @ P, left[:, rank:].T @ s
    bound = np.abs(rest_P).max(axis=1, initial=0.0) > _ROUND
    if (np.abs(rest_s[~bound]) > _ROUND).any():
        return None
    if bound.any():
        return rest_P[bound], rest_s[bound]
    pseudo = vt[:rank].T @ (left[:, :rank].T / values[:rank, None])
    G = vt[rank:].T
    return (AN - BM @ pseudo @ P, BM @ G, drift + BM @ pseudo @ s, -Hu @ pseudo @ P, Hu @ G, h - Hu @ pseudo @ s)


def _at_equilibrium(problem: LocalProblem, system: LinearSystem, X: Polytope) -> LocalProblem | None:
    """Return the problem about an equilibrium inside both sets; None if a bounded one has none.

    A nonempty compact convex control invariant set holds an equilibrium (Kakutani's theorem on x ↦ successors).
    """
    k, q = problem.A.shape[0], problem.B.shape[1]
    found = _origin(problem, system) if problem.basis.shape[0] == k else None
    if found is None:
        rows = np.vstack([np.hstack([problem.F, np.zeros((len(problem.F), q))]), problem.H])
        right = np.append(problem.g, problem.h)
        matrix = np.hstack([np.eye(k) - problem.A, -problem.B])
        found = _inner_solution(matrix, problem.drift, rows, right)
    if found is None:
        return None if problem.bounded else problem
    y, v = found[:k], found[k:]
    vertices = None if problem.inputs is None else (problem.inputs - v) @ problem.B.T
    return LocalProblem(problem.centre + problem.basis @ y, problem.basis, problem.A, problem.B, np.zeros(k),
                        problem.F, problem.g - problem.F @ y, problem.H, problem.h - problem.H @ found, vertices,
                        problem.disturbances, problem.bounded, True)


def _origin(problem: LocalProblem, system: LinearSystem) -> Array | None:
    """Return x = 0, u = 0 in local coordinates if it is an equilibrium well inside both sets."""
    if system.disturbances is not None and np.abs(system.disturbances.mean(axis=0)).max() > 0:
        return None
    y = -np.linalg.solve(problem.basis, problem.centre)
    residual = (np.eye(len(y)) - problem.A) @ y - problem.drift
    q = problem.B.shape[1]
    v = np.linalg.lstsq(problem.B, residual, rcond=None)[0] if q else np.zeros(0)
    # any v with B v = residual will do as u = 0 does not change the state
    found = np.append(y, v)
    if np.abs(residual - problem.B @ v).max() > 1e-13 * max(1.0, np.abs(y).max()):
        return None
    inside = (problem.g - problem.F @ y).min(initial=1.0) > 0.02
    inside = inside and (problem.h - problem.H @ found).min(initial=1.0) > 0
    return found if inside else None


def _inner_solution(matrix: Array, right_side: Array, rows: Array, right: Array) -> Array | None:
    """Return z with matrix z = right_side, deep inside rows z <= right; None if there is none."""
    z, *_ = np.linalg.lstsq(matrix, right_side, rcond=1e-12)
    if np.abs(matrix @ z - right_side).max(initial=0.0) > _ROUND * max(1.0, np.abs(right_side).max(initial=0.0)):
        return None
    null = null_space(matrix)
    room = right - rows @ z
    slope = rows @ null
    norms = np.linalg.norm(slope, axis=1)
    moving = norms > 1e-12
    if (room[~moving] < -_ROUND).any():
        return None
    if not moving.any():
        return z
    radius, t = inscribed_ball(slope[moving] / norms[moving, None], room[moving] / norms[moving], cap=1.0)
    return None if radius < -_ROUND else z + null @ t
