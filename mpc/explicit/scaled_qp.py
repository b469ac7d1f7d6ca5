"""Parametric QP as a least-distance problem in scaled coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from mpc.checks import Array, Flags, Ints, as_halfspaces
from mpc.exceptions import InputError, NotConvexError
from mpc.halfspaces import box_of
from mpc.parametric_qp import ParametricQP
from mpc.tolerances import EXCLUDED, FAR_OPTIMUM, NEGLIGIBLE, NOT_NEAR, PRIMAL, ROUNDED_SUM


class ParameterSet(NamedTuple):
    """Parameters θ = centre + half * t with unit rows normals t <= bounds."""

    normals: Array
    bounds: Array
    centre: Array
    half: Array


def scale_parameters(theta_set: Any, n: int) -> ParameterSet:
    """Parameter set scaled to the bounding box [-1, 1].

    Raises
    ------
    InputError
        Not a set in n dimensions, or empty, flat or unbounded.
    """
    if theta_set is None:
        raise InputError("theta_set", "None", f"a bounded Polytope in {n} dimensions")
    H, h = as_halfspaces("theta_set", theta_set, n)
    low, high = _bounding_box(H, h)
    centre = (low + high) / 2
    half = (high - low) / 2
    rows = np.hstack([H * half, (h - H @ centre)[:, None]])
    length = np.linalg.norm(rows[:, :-1], axis=1)
    rows = rows[length > 0] / length[length > 0, None]
    return ParameterSet(np.ascontiguousarray(rows[:, :-1]), np.ascontiguousarray(rows[:, -1]), centre, half)


@dataclass(frozen=True, eq=False)
class ScaledQP:
    """Minimise ½|v|² subject to Mv <= D [t; 1], TA t <= Tb."""

    # constraints, rows of M of unit length; rows that repeat another are left out
    M: Array  # (k, nz)
    D: Array  # (k, nt + 1)
    # shift of the bounds that decides between active sets which are optimal together; a function of the row alone
    tie: Array  # (k,)
    gram: Array  # (k, k): MM'
    # the parameter set, with the constraints in which no input occurs
    TA: Array  # (j, nt)
    Tb: Array  # (j,)
    origin: Ints  # (k,) int: row of `ParametricQP.G` behind each row of M
    # z = back v + free [t; 1]
    back: Array  # (nz, nz)
    free: Array  # (nz, nt + 1)
    # θ = centre + half * t
    centre: Array  # (nt,)
    half: Array  # (nt,)
    # distance of the unconstrained optimum v = 0 from the bounds, in units of the largest of those that may be met
    far: float
    # the bounds as the user states them, where z = 0 is v = 0, in units of their own sizes: the same however far the
    # optimum is
    own: Array  # (k, nt + 1)
    own_unit: float  # that size, in units of D

    @cached_property
    def reach(self) -> float:
        """Largest variables for which feasibility is asked."""
        largest = float(np.abs(self.D).sum(axis=1).max(initial=1.0))
        return EXCLUDED * min(largest, EXCLUDED)

    @cached_property
    def joint(self) -> tuple[Array, Array]:
        """Unit rows (J, h) of all constraints J [t; v] <= h."""
        zeros = np.zeros((len(self.TA), self.M.shape[1]))
        rows = np.vstack([np.hstack([-self.D[:, :-1], self.M]), np.hstack([self.TA, zeros])])
        right = np.concatenate([self.D[:, -1], self.Tb])
        length = np.linalg.norm(rows, axis=1)
        return np.ascontiguousarray(rows / length[:, None]), right / length

    def rows(self, kept: Ints) -> ScaledQP:
        """Problem with some of its constraints only."""
        M = np.ascontiguousarray(self.M[kept])
        D = np.ascontiguousarray(self.D[kept])
        gram = np.ascontiguousarray(self.gram[np.ix_(kept, kept)])
        return replace(self, M=M, D=D, tie=self.tie[kept], gram=gram, origin=self.origin[kept], own=self.own[kept])

    def unscale_rows(self, rows: Array) -> tuple[Array, Array]:
        """Half-spaces (k, nt + 1) in t as (H, h) in θ."""
        H = np.ascontiguousarray(rows[:, :-1] / self.half)
        return H, rows[:, -1] + H @ self.centre


def scale_qp(problem: ParametricQP, domain: ParameterSet) -> ScaledQP:
    """Problem with unit Hessian, unit rows and parameters in [-1, 1].

    Rows without a bound (w = inf) are left out.

    Raises
    ------
    InputError
        The data hold NaN or infinite numbers, or a row without inputs excludes every parameter.
    NotConvexError
        The Hessian is not positive definite.
    """
    bounded = _bounded_rows(problem)
    size, factor = _unit_hessian(problem)
    cost = size[:, None] * np.hstack([problem.F * domain.half, (problem.F @ domain.centre + problem.f)[:, None]])
    solved = solve_triangular(factor, np.hstack([cost, np.eye(problem.nz)]), lower=True)
    shift = -solved[:, : cost.shape[1]]  # the unconstrained v
    back = size[:, None] * solved[:, cost.shape[1] :].T
    M = problem.G[bounded] @ back
    S = problem.S[bounded]
    right = np.hstack([S * domain.half, (problem.w[bounded] + S @ domain.centre)[:, None]])
    D = right - M @ shift
    length = np.linalg.norm(M, axis=1)
    vanishing = _vanishing(length, right, shift)
    nothing = ROUNDED_SUM * _typical(right)
    TA, Tb = with_parameter_rows(domain.normals, domain.bounds, right[vanishing], nothing)
    origin = np.flatnonzero(~vanishing)
    M = M[origin] / length[origin, None]
    D = D[origin] / length[origin, None]
    own = right[origin] / length[origin, None]
    own_unit = _typical(own)
    own = own / own_unit
    unit = _unit_of(D)
    gram = M @ M.T
    wide = widths(gram, np.abs(own).sum(axis=1) * own_unit)
    far = unit / float(wide[(wide <= NOT_NEAR * unit) & (wide > ROUNDED_SUM * unit)].max(initial=0.0) or own_unit)
    D = D / unit
    kept = _without_duplicates(M, own, gram)
    tie = 1.0 + 0.5 * np.sin(M @ _waves(M.shape[1]) + D @ _waves(D.shape[1]))
    whole = ScaledQP(
        M, D, tie, gram, TA, Tb, bounded[origin], unit * back, back @ shift, domain.centre, domain.half, far, own,
        own_unit / unit,
    )  # fmt: skip
    return whole if len(kept) == len(M) else whole.rows(kept)


def without_far_bounds(problem: ParametricQP, domain: ParameterSet) -> ParametricQP:
    """Problem without bounds far beyond the nearest, such as 1e20.

    Beside them the others would have no size. The same object is returned where there are none.
    """
    bounded = _bounded_rows(problem)
    G = problem.G[bounded] / np.sqrt(np.where(np.diag(problem.H) > 0, np.diag(problem.H), 1.0))
    length = np.linalg.norm(G, axis=1)
    bounded = bounded[length > 0]
    G = G[length > 0] / length[length > 0, None]
    right = np.hstack([problem.S * domain.half, (problem.w + problem.S @ domain.centre)[:, None]])[bounded]
    right = right / length[length > 0, None]
    wide = widths(G @ G.T, np.abs(right).sum(axis=1))
    far = bounded[right[:, -1] > FAR_OPTIMUM * wide.min(initial=np.inf, where=wide > 0)]
    if not len(far):
        return problem
    w = problem.w.copy()
    w[far] = np.inf
    return replace(problem, w=w)


def _bounded_rows(problem: ParametricQP) -> Ints:
    """Rows with a bound; other data must be finite."""
    for name in ("H", "F", "f", "G", "S", "w"):
        values = getattr(problem, name)
        strange = ~np.isfinite(values) & ~((name == "w") & (values == np.inf))
        if strange.any():
            place = np.argwhere(strange)[0].tolist()
            raise InputError("problem", f"{values[tuple(place)]} in {name} at {place}", "finite numbers")
    return np.flatnonzero(np.isfinite(problem.w))


def widths(gram: Array, sizes: Array) -> Array:
    """Size of each bound, or of a larger opposite one."""
    wide = sizes.copy()
    first, second = np.nonzero(gram < PRIMAL - 1)
    np.maximum.at(wide, first, sizes[second])
    return wide


def _waves(n: int) -> Array:
    """Frequencies for the tie-breaking shift of each row."""
    return np.asarray(np.sqrt(2.0 + np.arange(n)))


def _unit_hessian(problem: ParametricQP) -> tuple[Array, Array]:
    """Variable sizes for a unit Hessian diagonal, and its Cholesky factor."""
    diagonal = np.diag(problem.H)
    size = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    H = problem.H * np.outer(size, size)
    smallest = float(np.linalg.eigvalsh(H)[0]) if (diagonal > 0).all() else -1.0
    if not smallest >= ROUNDED_SUM:
        got = f"a Hessian H with the smallest scaled eigenvalue {smallest:.3g}"
        raise NotConvexError("H", got, f"one above {ROUNDED_SUM:g}", "Add a cost on every variable.", smallest)
    return size, np.asarray(np.linalg.cholesky(H), dtype=np.float64)


def _vanishing(length: Array, right: Array, shift: Array) -> Flags:
    """Whether each row restricts the parameter only, up to rounding."""
    moved = length > 0
    reach = _typical(right[moved] / length[moved, None])  # what the bounds ask of v, where its optimum is zero
    typical = max(float(np.abs(shift).sum(axis=1).max(initial=0.0)), reach)
    theta = np.abs(right[:, :-1]).max(axis=1, initial=0.0)
    return np.asarray((length == 0) | (length * typical < ROUNDED_SUM * theta))


def with_parameter_rows(TA: Array, Tb: Array, right: Array, nothing: float = 0.0) -> tuple[Array, Array]:
    """Parameter set with unit rows of 0 <= right [t; 1] added.

    nothing : size of what is rounding of a bound.
    """
    if not len(right):
        return TA, Tb
    length = np.linalg.norm(right[:, :-1], axis=1)
    constant = length <= ROUNDED_SUM * np.abs(right).max(axis=1, initial=0.0)
    if (right[constant, -1] < -nothing).any():
        raise InputError("theta_set", "a set that one constraint without inputs excludes", "some feasible parameter")
    rows = right[~constant] / length[~constant, None]
    return np.ascontiguousarray(np.vstack([TA, -rows[:, :-1]])), np.concatenate([Tb, rows[:, -1]])


def _unit_of(D: Array) -> float:
    """Size of the bounds, from parameter changes or the nearest row.

    Rows far away have large constants, so the constants say nothing. Where parameters change less than half of the
    rows, it is the size of the lower quarter of those that are not zero: one row may be as near as it likes.
    """
    if not len(D):
        return 1.0
    changes = np.sort(np.abs(D[:, :-1]).sum(axis=1))
    change = float(changes[len(D) // 2])
    if change > max(NEGLIGIBLE * float(changes[-1]), ROUNDED_SUM * _typical(D)):
        return max(change, float(np.abs(D).sum(axis=1).min()))
    sizes = np.sort(_beyond_rounding(D))
    return float(sizes[len(sizes) // 4]) if len(sizes) else 1.0


def _typical(D: Array) -> float:
    """Median size of the bounds that are not zero."""
    sizes = _beyond_rounding(D)
    return float(np.median(sizes)) if len(sizes) else 1.0


def _beyond_rounding(D: Array) -> Array:
    """Sizes of the bounds beyond zero and rounding."""
    sizes = np.abs(D).sum(axis=1)
    return np.asarray(sizes[sizes > ROUNDED_SUM * np.abs(D[:, :-1]).sum(axis=1).max(initial=0.0)])


def twins(M: Array, D: Array, gram: Array, sign: float, tolerance: float) -> tuple[Ints, Ints]:
    """Pairs of rows of M that are the same up to `sign`, as are their rows of D beside the sizes of these."""
    first, second = np.nonzero(np.triu(sign * gram > 1 - tolerance, 1))
    size = np.maximum(np.abs(D[first]), np.abs(D[second])).max(axis=1, initial=0.0)
    apart = np.abs(D[first] - sign * D[second]).max(axis=1, initial=0.0)
    close = (apart <= tolerance * size) & (np.abs(M[first] - sign * M[second]).max(axis=1, initial=0.0) < tolerance)
    return first[close], second[close]


def _without_duplicates(M: Array, D: Array, gram: Array) -> Ints:
    """Rows without duplicates, each kept with its tightest bound."""
    dropped = np.zeros(len(M), dtype=bool)
    for i, j in zip(*twins(M, D[:, :-1], gram, 1.0, PRIMAL)):
        if not dropped[i] and not dropped[j]:
            dropped[j if D[i, -1] <= D[j, -1] else i] = True
    return np.flatnonzero(~dropped)


def _bounding_box(H: Array, h: Array) -> tuple[Array, Array]:
    """Bounding box of {θ : Hθ <= h}, of full dimension."""
    single = np.count_nonzero(H, axis=1) == 1
    box = box_of(H[single], h[single])
    if box is None or not np.isfinite(box).all() or (h[~H.any(axis=1)] < 0).any():
        box = _box_of_polytope(H, h)
    low, high = box
    flat = np.flatnonzero(high - low <= PRIMAL * np.maximum(np.abs(low), np.abs(high)))
    if len(flat):
        j = int(flat[0])
        got = f"a set with parameter {j} in [{low[j]:.6g}, {high[j]:.6g}]"
        raise InputError("theta_set", got, "a bounded set of full dimension", "It is empty or flat.")
    return low, high


def _box_of_polytope(H: Array, h: Array) -> tuple[Array, Array]:
    """Bounding box by linear programs."""
    from invariant_sets import Polytope

    polytope = Polytope(H, h)
    if polytope.is_empty:
        raise InputError("theta_set", "an empty set", "a bounded set of full dimension")
    low, high = polytope.bounding_box()
    unbounded = np.flatnonzero(~np.isfinite(low) | ~np.isfinite(high))
    if len(unbounded):
        raise InputError("theta_set", f"a set unbounded in parameter {int(unbounded[0])}", "a bounded set")
    return low, high
