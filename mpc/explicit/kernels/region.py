"""Compiled critical regions: the half-spaces where an active set is optimal, and the active set of one parameter.

Everything works on least-distance data. With H = LL', v = L'z + L⁻¹(Fθ + f) turns the QP into min ½ |v|² subject
to Mv <= d(θ), where M has unit rows. For an active set a the multipliers are λ(θ) = -(M_a M_a')⁻¹ d_a(θ) and the
slack of row i is d_i(θ) + M_i M_a' λ(θ): only the Gram matrix MM' and the affine map d are needed (Bemporad, Morari,
Dua and Pistikopoulos, Automatica 38(1), 2002; Arnström and Axehill, IEEE CDC, 2024). Row i of a critical region
belongs to constraint i whether it is active (its multiplier) or not (its slack), so crossing facet i exchanges i's
membership.

numba's cache on disk notices a change of the file a function stands in, but not of the files it calls into: after a
change here save `kernels.py` too.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from mpc.explicit.kernels.halfspace import project

FULL, FLAT, DEPENDENT = 1, 2, 3  # what is known about an active set; FLAT: empty or of lower dimension
PIVOT = 1e-10  # squared distance of a unit row from the span of others below which it is dependent


@njit(cache=True)
def gram_factor(gram, act, k, L):
    """Cholesky factor of gram[act, act]; False when the active rows are dependent.

    Rounding enters a pivot magnified by the smallest pivot before it, so the threshold grows with that.
    """
    smallest = 1.0
    for a in range(k):
        for e in range(a + 1):
            s = gram[act[a], act[e]]
            for q in range(e):
                s -= L[a, q] * L[e, q]
            if a == e:
                if s < max(PIVOT, 1e-15 / smallest):
                    return False
                smallest = min(smallest, s)
                L[a, a] = np.sqrt(s)
            else:
                L[a, e] = s / L[e, e]
    return True


@njit(cache=True)
def gram_solve(L, k, x):
    """Solve LL'y = x in place."""
    for a in range(k):
        s = x[a]
        for q in range(a):
            s -= L[a, q] * x[q]
        x[a] = s / L[a, a]
    for a in range(k - 1, -1, -1):
        s = x[a]
        for q in range(a + 1, k):
            s -= L[q, a] * x[q]
        x[a] = s / L[a, a]


@njit(cache=True)
def multipliers(gram, D, act, k, L):
    """Multiplier law (k, n + 1): λ(θ) = law [θ; 1]."""
    law = np.empty((k, D.shape[1]))
    x = np.empty(k)
    for c in range(D.shape[1]):
        for a in range(k):
            x[a] = -D[act[a], c]
        gram_solve(L, k, x)
        for a in range(k):
            law[a, c] = x[a]
    return law


@njit(cache=True)
def region_rows(gram, D, TA, Tb, rank, act, k, A, b):
    """Unit half-spaces of the critical region of an active set, row i for constraint i, then the parameter set.

    Returns FULL when there is something to look at, FLAT when a constant row is violated, DEPENDENT.
    """
    m, n = len(D), D.shape[1] - 1
    L = np.empty((k, k))
    if k > rank or not gram_factor(gram, act, k, L):
        return DEPENDENT
    law = multipliers(gram, D, act, k, L)
    position = np.full(m, -1)
    size = np.zeros(k)
    largest = 0.0
    for a in range(k):
        position[act[a]] = a
        for c in range(n + 1):
            size[a] += abs(law[a, c])
        largest = max(largest, size[a])
    row = np.empty(n + 1)
    for i in range(m):
        a = position[i]
        if a >= 0:
            scale = largest
            for c in range(n + 1):
                row[c] = law[a, c]
        else:
            scale = 0.0
            for c in range(n + 1):
                row[c] = D[i, c]
                scale += abs(D[i, c])
            for e in range(k):
                g = gram[i, act[e]]
                if g != 0.0:
                    scale += abs(g) * size[e]
                    for c in range(n + 1):
                        row[c] += g * law[e, c]
        norm = 0.0
        for c in range(n):
            norm += row[c] * row[c]
        norm = np.sqrt(norm)
        if norm <= 1e-10 * scale:
            if row[n] < -1e-9 * scale or (a >= 0 and row[n] <= 1e-9 * scale):
                return FLAT
            for c in range(n):
                A[i, c] = 0.0
            b[i] = 1.0
        else:
            for c in range(n):
                A[i, c] = -row[c] / norm
            b[i] = row[n] / norm
    for i in range(len(Tb)):
        for c in range(n):
            A[m + i, c] = TA[i, c]
        b[m + i] = Tb[i]
    return FULL


@njit(cache=True)
def optimal_set(M, D, theta, act):
    """Active set with positive multipliers of the QP at θ; -1 when infeasible."""
    m, nz = M.shape
    n = len(theta)
    d = np.empty(m)
    for i in range(m):
        d[i] = D[i, n]
        for j in range(n):
            d[i] += D[i, j] * theta[j]
    v, work, lam = np.empty(nz), np.empty(nz + 1, np.int64), np.empty(nz + 1)
    k = project(M, d, m, np.zeros(nz), 1e-10, v, work, lam)
    if k < 0:
        return k
    largest = 0.0
    for a in range(k):
        largest = max(largest, lam[a])
    kept = 0
    for a in range(k):
        if lam[a] > 1e-10 * largest:
            act[kept] = work[a]
            kept += 1
    return kept
