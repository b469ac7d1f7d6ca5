"""The parametric QP as a least-distance problem, scaled for the exploration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.halfspaces import box_of
from mpc.parametric_qp import ParametricQP


@dataclass(frozen=True, eq=False)
class LeastDistance:
    """Minimise ½|v|² subject to Mv <= D [t; 1] for t in {TA t <= Tb}, unit rows, t in [-1, 1].

    The parameter is θ = centre + half * t and z = size L'⁻¹v - H⁻¹(Fθ + f). `J`, `Jb` are the joint constraints on
    [t; v], `origin` the row of `problem.G` behind each row of M.
    """

    problem: ParametricQP
    M: Array
    D: Array
    TA: Array
    Tb: Array
    J: Array
    Jb: Array
    gram: Array
    origin: np.ndarray[Any, np.dtype[np.int64]]
    centre: Array
    half: Array

    def unscale_rows(self, rows: Array) -> tuple[Array, Array]:
        """Half-spaces (k, nt + 1) in t as (H, h) in θ."""
        H = np.ascontiguousarray(rows[:, :-1] / self.half)
        return H, rows[:, -1] + H @ self.centre

    def law(self, active_sets: list[tuple[int, ...]]) -> Array:
        """Minimiser law (n, nz, nt + 1) in the original units: z = law [θ; 1]."""
        problem = self.problem
        right = np.hstack([problem.F, problem.f[:, None]])
        free = -np.linalg.solve(problem.H, right)
        law = np.repeat(free[None], len(active_sets), axis=0)
        Hinv_Gt = np.linalg.solve(problem.H, problem.G.T)
        gram = problem.G @ Hinv_Gt
        d = np.hstack([problem.S, problem.w[:, None]]) - problem.G @ free
        for size in {len(act) for act in active_sets} - {0}:  # together where the number of active rows is the same
            which = [r for r, act in enumerate(active_sets) if len(act) == size]
            act = self.origin[np.array([active_sets[r] for r in which])]
            block = gram[act[:, :, None], act[:, None, :]]
            length = 1 / np.sqrt(np.diagonal(block, axis1=1, axis2=2))
            block = block * length[:, :, None] * length[:, None, :]
            multiplier = -np.linalg.solve(block, d[act] * length[:, :, None]) * length[:, :, None]
            law[which] -= Hinv_Gt.T[act].transpose(0, 2, 1) @ multiplier
        return law


def least_distance(problem: ParametricQP, TA: Array, Tb: Array) -> LeastDistance:
    """Scale parameters to [-1, 1] and rows to unit length; drop duplicate rows; move rows without z to the set."""
    low, high = _bounding_box(TA, Tb)
    centre, half = (low + high) / 2, (high - low) / 2
    L = np.linalg.cholesky(problem.H)
    M = solve_triangular(L, problem.G.T, lower=True).T
    free = np.linalg.solve(problem.H, np.hstack([problem.F, problem.f[:, None]]))
    D = np.hstack([problem.S, problem.w[:, None]]) + problem.G @ free
    D[:, -1] += D[:, :-1] @ centre
    D[:, :-1] *= half
    rows = np.hstack([problem.S * half, (problem.w + problem.S @ centre)[:, None]])
    length = np.linalg.norm(M, axis=1)
    empty = length <= 1e-14 * max(float(length.max(initial=0.0)), np.finfo(float).tiny)
    set_rows = np.vstack([np.hstack([TA * half, -(Tb - TA @ centre)[:, None]]), -rows[empty]])
    norm = np.linalg.norm(set_rows[:, :-1], axis=1)
    if (set_rows[norm == 0, -1] > 0).any():
        raise InputError("theta_set is empty: it has a row 0 <= b with b < 0, or a constraint no input reaches.")
    set_rows = set_rows[norm > 0] / norm[norm > 0, None]
    origin = np.flatnonzero(~empty)
    M, D = M[origin] / length[origin, None], D[origin] / length[origin, None]
    size = float(np.median(np.abs(D).sum(axis=1))) if len(D) else 1.0
    D = D / (size or 1.0)
    kept = _without_duplicates(np.hstack([M, D[:, :-1]]), D[:, -1])
    M, D, origin = np.ascontiguousarray(M[kept]), np.ascontiguousarray(D[kept]), origin[kept]
    joint = np.vstack([
        np.hstack([-D[:, :-1], M, -D[:, -1:]]),
        np.hstack([set_rows[:, :-1], np.zeros((len(set_rows), M.shape[1])), set_rows[:, -1:]]),
    ])  # fmt: skip
    joint /= np.linalg.norm(joint[:, :-1], axis=1)[:, None]
    return LeastDistance(
        problem, M, D, np.ascontiguousarray(set_rows[:, :-1]), np.ascontiguousarray(-set_rows[:, -1]),
        np.ascontiguousarray(joint[:, :-1]), np.ascontiguousarray(-joint[:, -1]), M @ M.T, origin, centre, half,
    )  # fmt: skip


def _without_duplicates(normals: Array, offsets: Array) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Rows that remain when of parallel rows only the tightest is kept."""
    tightest: dict[bytes, int] = {}
    for i, key in enumerate(np.round(normals, 10) + 0.0):
        known = tightest.setdefault(key.tobytes(), i)
        if offsets[i] < offsets[known]:
            tightest[key.tobytes()] = i
    return np.array(sorted(tightest.values()), dtype=np.int64)


def _bounding_box(A: Array, b: Array) -> tuple[Array, Array]:
    """Box around {θ : Aθ <= b}: read off where every side is a row, by linear programs otherwise."""
    single = np.count_nonzero(A, axis=1) == 1
    box = box_of(A[single], b[single])
    if box is None or not np.isfinite(box).all():
        box = _box_by_linear_programs(A, b)
    low, high = box
    flat = np.flatnonzero(high - low <= 1e-9 * np.maximum(np.abs(low), np.abs(high)))
    if len(flat):
        j = int(flat[0])
        raise InputError(
            f"theta_set is empty or flat: parameter {j} lies in [{low[j]:.6g}, {high[j]:.6g}]; expected full dimension."
        )
    return low, high


def _box_by_linear_programs(A: Array, b: Array) -> tuple[Array, Array]:
    from scipy.optimize import linprog

    n = A.shape[1]
    box = np.empty((2, n))
    for side, sign in enumerate((1.0, -1.0)):
        for j in range(n):
            result = linprog(sign * np.eye(n)[j], A_ub=A, b_ub=b, bounds=(None, None))
            if result.status != 0:
                trouble = "empty" if result.status == 2 else f"unbounded in parameter {j}"
                raise InputError(f"theta_set is {trouble}; expected a bounded set of full dimension.")
            box[side, j] = sign * result.fun
    return box[0], box[1]
