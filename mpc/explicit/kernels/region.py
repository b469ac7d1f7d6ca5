"""Compiled critical regions: the half-spaces where an active set is optimal, and the active set of one parameter.

Everything works on least-distance data. With H = LL', v = L'z + L⁻¹(Fθ + f) turns the QP into min ½ |v|² subject
to Mv <= d(θ), where M has unit rows. For an active set a the multipliers are λ(θ) = -(M_a M_a')⁻¹ d_a(θ) and the
slack of row i is d_i(θ) + M_i M_a' λ(θ): only the Gram matrix MM' and the affine map d are needed (Bemporad, Morari,
Dua and Pistikopoulos, Automatica 38(1), 2002; Arnström and Axehill, IEEE CDC, 2024). Row i of a critical region
belongs to constraint i whether it is active (its multiplier) or not (its slack), so crossing facet i exchanges i's
membership.

Where a multiplier or a slack is zero on a whole region, several active sets are optimal there. The bounds are then
thought of as d + δ tie with an infinitesimal δ > 0: the sign of the part in δ says which of the sets counts, so that
regions do not overlap (a symbolic perturbation, as in the lexicographic rule of the simplex method).

numba's cache on disk notices a change of the file a function stands in only: `halfspace.py` says what to save then.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from mpc.checks import Array
from mpc.explicit.kernels.data import DEPENDENT, FLAT, FULL, Ints, QPData
from mpc.explicit.kernels.halfspace import gram_solve, project
from mpc.tolerances import DEPENDENT_ROW, PRIMAL, REFINED_ROW, ROUNDED_SUM


@njit(cache=True)
def gram_factor(gram: Array, act: Ints, k: int, L: Array) -> bool:
    """Cholesky factor of gram[act, act]; False when a pivot shows that the active rows are dependent.

    The factor is that of a matrix within rounding of the Gram matrix, however small its pivots are. Rows can be
    dependent although no pivot is small: `row_levers` shows that.
    """
    for a in range(k):
        for e in range(a + 1):
            s = gram[act[a], act[e]]
            for q in range(e):
                s -= L[a, q] * L[e, q]
            if a == e:
                if s < DEPENDENT_ROW:
                    return False
                L[a, a] = np.sqrt(s)
            else:
                L[a, e] = s / L[e, e]
    return True


@njit(cache=True)
def refine(qp: QPData, act: Ints, k: int, L: Array, law: Array) -> None:
    """Solve for what v = M_a' λ misses of a multiplier law (k, n + 2), λ(t) = law [t; 1; δ]: for all of it from zero.

    A second time takes the rounding of a nearly singular Gram matrix out: the error of v falls from that of the Gram
    matrix magnified by its condition to that magnified by the root of it.
    """
    nz = qp.M.shape[1]
    n = qp.D.shape[1] - 1
    v = np.empty(nz)
    x = np.empty(k)
    for c in range(n + 2):
        v[:] = 0.0
        for a in range(k):
            for j in range(nz):
                v[j] += qp.M[act[a], j] * law[a, c]
        for a in range(k):
            x[a] = -qp.D[act[a], c] if c <= n else -qp.tie[act[a]]
            for j in range(nz):
                x[a] -= qp.M[act[a], j] * v[j]
        gram_solve(L, k, x)
        for a in range(k):
            law[a, c] += x[a]


@njit(cache=True)
def variable_size(qp: QPData, act: Ints, k: int, law: Array) -> float:
    """Size of v(t) = M_a' λ(t) over the coefficients of t: |M_a' λ_c|² = -λ_c' d_c, also where multipliers are huge."""
    size = 0.0
    for c in range(qp.D.shape[1]):
        square = 0.0
        for a in range(k):
            square -= law[a, c] * qp.D[act[a], c]
        size += np.sqrt(max(square, 0.0))
    return size


@njit(cache=True)
def row_levers(L: Array, k: int) -> Array:
    """Largest multipliers for a unit v: lengths of the rows of the pseudo-inverse, sqrt of diag (LL')⁻¹."""
    inverse = np.zeros((k, k))
    lever = np.zeros(k)
    for a in range(k):
        inverse[a, a] = 1.0 / L[a, a]
        for e in range(a):
            s = 0.0
            for q in range(e, a):
                s += L[a, q] * inverse[q, e]
            inverse[a, e] = -s / L[a, a]
        for e in range(a + 1):
            lever[e] += inverse[a, e] * inverse[a, e]
    return np.sqrt(lever)


@njit(cache=True)
def region_rows(qp: QPData, act: Ints, k: int, A: Array, b: Array) -> int:
    """Unit half-spaces of the critical region of an active set, row i for constraint i, then the parameter set.

    Returns FULL when there is something to look at, FLAT when a constant row is violated, DEPENDENT.
    """
    m = len(qp.D)
    n = qp.D.shape[1] - 1
    L = np.empty((k, k))
    if k > qp.M.shape[1] or not gram_factor(qp.gram, act, k, L):
        return DEPENDENT
    lever = row_levers(L, k)
    longest = 0.0  # its inverse is the least distance of a row from the span of the others
    for a in range(k):
        longest = max(longest, lever[a])
    if longest * longest * DEPENDENT_ROW > 1.0:
        return DEPENDENT
    law = np.zeros((k, n + 2))
    refine(qp, act, k, L, law)
    if longest * longest * REFINED_ROW > 1.0:
        refine(qp, act, k, L, law)
    reach = variable_size(qp, act, k, law)
    position = np.full(m, -1)
    size = np.zeros(k)
    for a in range(k):
        position[act[a]] = a
        for c in range(n + 1):
            size[a] += abs(law[a, c])
    row = np.empty(n + 2)
    for i in range(m):
        a = position[i]
        if a >= 0:
            zero = PRIMAL * lever[a] * reach
            for c in range(n + 2):
                row[c] = law[a, c]
        else:
            scale = reach
            terms = 0.0
            for c in range(n + 1):
                row[c] = qp.D[i, c]
                scale += abs(qp.D[i, c])
            row[n + 1] = qp.tie[i]
            for e in range(k):
                g = qp.gram[i, act[e]]
                if g != 0.0:
                    terms += abs(g) * size[e]
                    for c in range(n + 2):
                        row[c] += g * law[e, c]
            zero = max(PRIMAL * scale, ROUNDED_SUM * terms)
        norm = 0.0
        for c in range(n):
            norm += row[c] * row[c]
        norm = np.sqrt(norm)
        if norm <= zero:
            if row[n] < -10.0 * zero:
                return FLAT
            if row[n] <= 10.0 * zero and row[n + 1] <= 0.0:
                return FLAT
            for c in range(n):
                A[i, c] = 0.0
            b[i] = 1.0
        else:
            for c in range(n):
                A[i, c] = -row[c] / norm
            b[i] = row[n] / norm
    for i in range(len(qp.Tb)):
        for c in range(n):
            A[m + i, c] = qp.TA[i, c]
        b[m + i] = qp.Tb[i]
    return FULL


@njit(cache=True)
def optimal_at(qp: QPData, act: Ints, k: int, theta: Array) -> bool:
    """Whether independent active rows are optimal at θ: they hold, no multiplier is negative, no row is violated."""
    m = len(qp.D)
    n = len(theta)
    d = np.empty(m)
    for i in range(m):
        d[i] = qp.D[i, n]
        for j in range(n):
            d[i] += qp.D[i, j] * theta[j]
    L = np.empty((k, k))
    if not gram_factor(qp.gram, act, k, L):
        return False
    lam = np.empty(k)
    for a in range(k):
        lam[a] = -d[act[a]]
    gram_solve(L, k, lam)
    for a in range(k):
        if lam[a] < 0.0:
            return False
    for i in range(m):
        slack = d[i]
        for a in range(k):
            slack += qp.gram[i, act[a]] * lam[a]
        d[i] = slack
        if slack < -PRIMAL:
            return False
    loose = 0.0
    for a in range(k):
        loose = max(loose, d[act[a]])
    return loose <= PRIMAL


@njit(cache=True)
def optimal_set(qp: QPData, theta: Array, shift: float, act: Ints) -> int:
    """Active set with positive multipliers of the QP at θ, bounds moved by shift * tie. Negative when infeasible."""
    m, nz = qp.M.shape
    n = len(theta)
    d = np.empty(m)
    for i in range(m):
        d[i] = qp.D[i, n] + shift * qp.tie[i]
        for j in range(n):
            d[i] += qp.D[i, j] * theta[j]
    v = np.empty(nz)
    work = np.empty(nz + 1, np.int64)
    lam = np.empty(nz + 1)
    k = project(qp.M, d, m, np.zeros(nz), PRIMAL, v, work, lam)
    if k < 0:
        return k
    largest = 0.0
    for a in range(k):
        largest = max(largest, lam[a])
    kept = 0
    for a in range(k):
        if lam[a] > PRIMAL * largest:
            act[kept] = work[a]
            kept += 1
    return kept
