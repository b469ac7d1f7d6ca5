"""The largest set in which some admissible input can keep the state for ever.

References
----------
Bertsekas (1972), Infinite-time reachability of state-space regions by using feedback control, IEEE TAC 17(5):
the recursion. Blanchini, Miani (2015), Set-Theoretic Methods in Control, chapter 5: contractive sets and finite
termination.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from . import representation as rep
from .certificate import control_violation
from .exceptions import InputError
from .polytope import Polytope
from .predecessor import predecessor_rows
from .results import Certificate, InvariantSet, Status
from .unstable_modes import unstable_bounds
from .validation import as_matrix, check_count, check_tolerance

Array = np.ndarray
_STOP = 1e-11  # the outer recursion has converged if no row cuts more, relative to the set
_CUT = 1e-12  # rows that cut less are noise


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
        `set` is an inner set, C with A x + B u + E w in C, checked at its vertices; `outer` contains the true
        maximal set, and outer ⊆ (1 + tol) set about an equilibrium.

    Raises
    ------
    InputError
        If shapes do not match, numbers are not finite, or W is unbounded.

    Notes
    -----
    1. Coordinates are shifted to an equilibrium inside X and U and scaled by the bounding boxes.
    2. Unstable modes are bounded first (`unstable_modes`), without which the recursion creeps and stops outside.
    3. Ω ← Pre(Ω) ∩ Ω until no row cuts by more than 1e-11: `outer`.
    4. (1 − tol/10) Ω is invariant with room to spare, because inputs scale with the state; LPs at its vertices say so.
       Where they do not, the recursion is repeated for a contraction factor just below one, which ends in an
       exactly invariant set.

    References
    ----------
    Bertsekas (1972), IEEE TAC 17(5); Blanchini, Miani (2015), sections 5.1 and 5.2; Hu, Lin (2001), chapter 2.
    """
    problem = checked_system(A, B, X, U, E, W)
    tol, max_iterations = check_tolerance(tol), check_count(max_iterations, "max_iterations", 1)
    nx = len(problem.A)
    if X.is_empty or U.is_empty:
        return _empty(nx, 0, tol)
    return _solve(problem, X, U, W, tol, max_iterations)


@dataclass(frozen=True)
class LinearSystem:
    """x⁺ = A x + B u + E w, checked; E is None without disturbances."""

    A: Array
    B: Array
    E: Array | None


def checked_system(A: Any, B: Any, X: Polytope, U: Polytope, E: Any, W: Polytope | None, *,
                   state_set: str = "X") -> LinearSystem:
    """Return the system, or raise `InputError` where shapes, types or numbers do not fit."""
    A = as_matrix(A, "A")
    if A.shape[0] != A.shape[1] or A.shape[0] == 0:
        raise InputError(f"A has shape {A.shape}, expected a square matrix (nx, nx).")
    nx = A.shape[0]
    B = as_matrix(B, "B", rows=nx)
    if B.shape[1] == 0:
        raise InputError(f"B has shape {B.shape}, expected at least one column; use a zero column for no input.")
    check_set(X, state_set, nx)
    check_set(U, "U", B.shape[1])
    if W is None:
        if E is not None:
            raise InputError("E is given without W; give the disturbance set W too.")
        return LinearSystem(A, B, None)
    E = np.eye(nx) if E is None else as_matrix(E, "E", rows=nx)
    check_set(W, "W", E.shape[1])
    if W.is_empty or not W.is_bounded:
        raise InputError(f"W is {'empty' if W.is_empty else 'unbounded'}, expected a bounded, nonempty set.")
    return LinearSystem(A, B, E)


def check_set(value: Any, name: str, dim: int) -> None:
    """Raise `InputError` unless `value` is a `Polytope` of dimension `dim`."""
    if not isinstance(value, Polytope):
        raise InputError(f"{name} must be a Polytope, got {type(value).__name__}.")
    if value.dim != dim:
        raise InputError(f"{name} has dimension {value.dim}, expected {dim}.")


def _empty(nx: int, iterations: int, tol: float, outer: Polytope | None = None,
           status: Status = Status.EMPTY) -> InvariantSet:
    nothing = Polytope(np.zeros((1, nx)), [-1.0])
    gap = 0.0 if status is Status.EMPTY else np.inf
    return InvariantSet(nothing, nothing if outer is None else outer, status, iterations,
                        Certificate(-np.inf, gap, 0, min(tol, 1e-9)))


# --- the work, in scaled coordinates ---------------------------------------------------------------------------


@dataclass(frozen=True)
class _Scaled:
    """x = centre + scale·y: an equilibrium at 0 and a state set of order one."""

    centre: Array
    scale: Array
    A: Array
    B: Array
    H: Array  # rows on the input alone
    h: Array
    inputs: Array  # vertices of B U
    disturbances: Array | None  # vertices of E W

    def polytope(self, F: Array, g: Array, V: Array, shrink: float = 1.0) -> Polytope:
        """Return the set {F y <= shrink g} in the original coordinates, its vertices filled in."""
        rows = F / self.scale
        norms = np.linalg.norm(rows, axis=1)
        rows /= norms[:, None]
        vertices = self.centre + self.scale * V * shrink
        if V.shape[1] == 2:
            vertices = vertices[np.argsort(np.arctan2(V[:, 1], V[:, 0]))]
        P = Polytope(rows, shrink * g / norms + rows @ self.centre)
        vertices.setflags(write=False)
        P.__dict__["vertices"] = vertices
        return P


def _solve(problem: LinearSystem, X: Polytope, U: Polytope, W: Polytope | None, tol: float,
           max_iterations: int) -> InvariantSet:
    nx = len(problem.A)
    scaled = _scale(problem, X, U, W)
    if scaled is None:
        return _empty(nx, 0, tol)
    F, g = rep.unit_rows(X.A * scaled.scale, X.b - X.A @ scaled.centre)
    V = (X.vertices - scaled.centre) / scaled.scale
    D, d = unstable_bounds(scaled.A, scaled.inputs, scaled.disturbances)
    if len(d):
        D, d = rep.unit_rows(D, d)
        F, g, V = _cut(F, g, V, D, d)
    F, g, V, iterations, converged = _recursion(scaled, F, g, V, 1.0, max_iterations)
    if F is None:
        return _empty(nx, iterations, tol)
    outer = scaled.polytope(F, g, V)
    if not converged:
        return _empty(nx, iterations, tol, outer, Status.ITERATION_LIMIT)
    inner = scaled.polytope(F, g, V, 1.0 - tol / 10)
    violation, points = control_violation(problem.A, problem.B, inner, U, problem.E, W)
    certificate = Certificate(violation, tol / (10 - tol), points, min(tol, 1e-9))
    if not certificate.holds:
        return _empty(nx, iterations, tol, outer, Status.NOT_CERTIFIED)
    return InvariantSet(inner, outer, Status.CONVERGED, iterations, certificate)


def _scale(problem: LinearSystem, X: Polytope, U: Polytope, W: Polytope | None) -> _Scaled | None:
    lower, upper = X.vertices.min(axis=0), X.vertices.max(axis=0)
    scale = (upper - lower) / 2
    nx, nu = problem.B.shape
    centre, u0 = np.zeros(nx), np.zeros(nu)
    low, high = U.vertices.min(axis=0), U.vertices.max(axis=0)
    size = np.where(high > low, (high - low) / 2, 1.0)
    A, B = problem.A / scale[:, None] * scale, problem.B / scale[:, None] * size
    H = np.hstack([np.zeros((len(U.b), nx)), U.A * size])
    h = U.b - U.A @ u0
    disturbances = None
    if problem.E is not None and W is not None:
        disturbances = W.vertices @ problem.E.T / scale
    inputs = (U.vertices - u0) / size @ B.T
    return _Scaled(centre, scale, A, B, H, h, inputs, disturbances)


def _recursion(scaled: _Scaled, F: Array, g: Array, V: Array, factor: float, max_iterations: int):
    """Iterate Ω ← {x : A x + B u + E w in factor Ω} ∩ Ω; return (F, g, V, iterations, converged), F None if empty."""
    stop = _STOP + (1.0 / factor - 1.0)
    for iteration in range(1, max_iterations + 1):
        R, r = predecessor_rows(F, factor * g, scaled.A, scaled.B, scaled.H, scaled.h, scaled.disturbances)
        R, r = rep.unit_rows(R, r)
        if R is None:
            return None, g, V, iteration, True
        reach = (R @ V.T).max(axis=1)
        cutting = reach > r + _CUT
        if not cutting.any():
            return F, g, V, iteration, True
        converged = bool((reach[cutting] <= r[cutting] + stop * np.abs(r[cutting])).all())
        if (r[cutting] <= 1e-9).any():
            return None, g, V, iteration, True
        F, g, V = _cut(F, g, V, R[cutting], r[cutting])
        if converged:
            return F, g, V, iteration, True
    return F, g, V, max_iterations, False


def _cut(F: Array, g: Array, V: Array, R: Array, r: Array) -> tuple[Array, Array, Array]:
    rows, values = np.vstack([F, R]), np.append(g, r)
    kept, V = rep.facets_and_vertices(rows, values)
    return rows[kept], values[kept], V
