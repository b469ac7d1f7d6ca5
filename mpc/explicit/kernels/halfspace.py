"""Compiled geometry of half-spaces with unit rows: nearest point, interior point, facets, a point across a facet."""

from __future__ import annotations

import numpy as np
from numba import njit

from mpc.checks import Array
from mpc.explicit.kernels import forget_stale
from mpc.explicit.kernels.data import Ints
from mpc.tolerances import CROSSING, DEPENDENT_ROW, EPS, INSIDE, PRIMAL, ROUNDED_SUM


@njit(cache=True)
def gram_solve(L: Array, k: int, x: Array) -> None:
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
def project(A: Array, b: Array, m: int, c: Array, tol: float, theta: Array, work: Ints, lam: Array) -> int:
    """Nearest point of {Aθ <= b} to c, by the dual active-set method of Goldfarb and Idnani (1983), unit rows.

    Writes θ into `theta`, the active rows into `work` and their multipliers into `lam`. Returns the number of active
    rows, -1 when the set is empty, -2 at the iteration limit.
    """
    n = len(c)
    L = np.empty((n + 1, n + 1))
    r = np.empty(n + 1)
    z = np.empty(n)
    for j in range(n):
        theta[j] = c[j]
    k = 0
    for _ in range(50 + 10 * m):
        worst = tol
        p = -1
        for i in range(m):
            s = -b[i]
            for j in range(n):
                s += A[i, j] * theta[j]
            if s > worst:
                worst = s
                p = i
        if p < 0:
            return k
        price = 0.0
        for _ in range(n + m + 2):
            # r: coefficients of row p on the active rows; z: what is left of it
            for a in range(k):
                r[a] = 0.0
                for j in range(n):
                    r[a] += A[work[a], j] * A[p, j]
            gram_solve(L, k, r)
            zz = 0.0
            for j in range(n):
                s = A[p, j]
                for a in range(k):
                    s -= r[a] * A[work[a], j]
                z[j] = s
                zz += s * s
            t = np.inf
            drop = -1
            for a in range(k):
                if r[a] > ROUNDED_SUM and lam[a] < t * r[a]:
                    t = lam[a] / r[a]
                    drop = a
            full = k < n and zz > DEPENDENT_ROW
            if full:
                s = -b[p]
                for j in range(n):
                    s += A[p, j] * theta[j]
                step = max(s, 0.0) / zz
                if step <= t:
                    t = step
                    drop = -1
            elif drop < 0:
                return -1
            for a in range(k):
                lam[a] -= t * r[a]
            price += t
            if full:
                for j in range(n):
                    theta[j] -= t * z[j]
            if drop < 0:
                work[k] = p
                lam[k] = price
                k += 1
                _factor(A, work, k, k - 1, L)
                break
            for a in range(drop, k - 1):
                work[a] = work[a + 1]
                lam[a] = lam[a + 1]
            k -= 1
            _factor(A, work, k, drop, L)
    return -2


@njit(cache=True)
def _factor(A: Array, work: Ints, k: int, start: int, L: Array) -> None:
    """Cholesky factor of the Gram matrix of the active rows, from row `start` on."""
    n = A.shape[1]
    for a in range(start, k):
        for e in range(a + 1):
            s = 0.0
            for j in range(n):
                s += A[work[a], j] * A[work[e], j]
            for q in range(e):
                s -= L[a, q] * L[e, q]
            L[a, e] = np.sqrt(max(s, EPS * EPS)) if a == e else s / L[e, e]


@njit(cache=True)
def side(rows: Array, i: int, t: Array) -> float:
    """Distance of the point t above the hyperplane [a, b] of row i."""
    s: float = -rows[i, len(t)]
    for j in range(len(t)):
        s += rows[i, j] * t[j]
    return s


@njit(cache=True)
def violation(rows: Array, first: int, end: int, t: Array, most: float) -> float:
    """Largest distance of t above the facets of a region. Not searched further once it exceeds `most`."""
    worst = -np.inf
    for i in range(first, end):
        worst = max(worst, side(rows, i, t))
        if worst > most:
            break
    return worst


@njit(cache=True)
def margin_at(A: Array, b: Array, theta: Array) -> float:
    """Least distance of a point from the rows of {Aθ <= b}, negative outside."""
    least = np.inf
    for i in range(len(b)):
        s = b[i]
        for j in range(len(theta)):
            s -= A[i, j] * theta[j]
        least = min(least, s)
    return least


@njit(cache=True)
def interior_point(A: Array, b: Array, wanted: float, centre: Array) -> float:
    """Write a point inside {Aθ <= b} into `centre`. Returns a radius around it, 0 when there is none >= INSIDE.

    Larger radii are tried until one above `wanted` is found or none is left.
    """
    m, n = A.shape
    shrunk = np.empty(m)
    theta = np.empty(n)
    work = np.empty(n + 1, np.int64)
    lam = np.empty(n + 1)
    radius = 0.0
    trial = INSIDE
    start = np.zeros(n)
    while trial < 1.0 and radius <= wanted:
        for i in range(m):
            shrunk[i] = b[i] - trial
        accepted = 0.01 * INSIDE if trial > INSIDE else ROUNDED_SUM
        if project(A, shrunk, m, start, accepted, theta, work, lam) < 0:
            break
        margin = margin_at(A, b, theta)  # the radius is recomputed from the point
        if margin < 0.9 * trial:
            break
        radius = margin
        for j in range(n):
            centre[j] = theta[j]
            start[j] = theta[j]
        trial *= 20.0
    return radius


@njit(cache=True)
def irredundant(A: Array, b: Array, centre: Array, facets: Ints, hits: Array) -> int:
    """Rows of {Aθ <= b} that are facets, by Clarkson's method (1994) from an interior point. Returns their number.

    Writes the point where a ray from the interior has hit each facet into `hits`, the interior point where none did.
    """
    m, n = A.shape
    slack = np.empty(m)
    for i in range(m):
        s = b[i]
        for j in range(n):
            s -= A[i, j] * centre[j]
        slack[i] = s
    order = np.argsort(slack)
    AI = np.empty((m + 1, n))
    bI = np.empty(m + 1)
    theta = np.empty(n)
    work = np.empty(n + 1, np.int64)
    lam = np.empty(n + 1)
    known = np.zeros(m, np.bool_)
    count = 0
    for i in order:
        unit = False
        for j in range(n):
            unit = unit or A[i, j] != 0.0
        if not unit:
            continue
        for _ in range(m):
            if known[i]:
                break
            for j in range(n):
                AI[count, j] = -A[i, j]
            bI[count] = -b[i] - PRIMAL
            if project(AI, bI, count + 1, centre, 10.0 * ROUNDED_SUM, theta, work, lam) < 0:
                break  # redundant beside the facets known so far
            hit = i
            nearest = np.inf
            for e in range(m):
                rate = 0.0
                for j in range(n):
                    rate += A[e, j] * (theta[j] - centre[j])
                if rate > ROUNDED_SUM and slack[e] < nearest * rate:
                    nearest = slack[e] / rate
                    hit = e
            if known[hit]:
                hit = i
                nearest = 0.0
            for j in range(n):
                hits[count, j] = centre[j] + nearest * (theta[j] - centre[j])
            known[hit] = True
            facets[count] = hit
            for j in range(n):
                AI[count, j] = A[hit, j]
            bI[count] = b[hit]
            count += 1
    return count


@njit(cache=True)
def just_behind(A: Array, b: Array, facets: Ints, count: int, number: int, hit: Array, theta: Array) -> bool:
    """Write the point just behind `hit` into θ; False when `hit` is not on the facet, or not clear of the others."""
    for a in range(count):
        slack = b[facets[a]]
        for j in range(len(hit)):
            slack -= A[facets[a], j] * hit[j]
        if a == number and abs(slack) > 0.1 * CROSSING:
            return False
        if a != number and slack < 10.0 * CROSSING:
            return False
    for j in range(len(hit)):
        theta[j] = hit[j] + CROSSING * A[facets[number], j]
    return True


@njit(cache=True)
def across(A: Array, b: Array, facets: Ints, count: int, facet: int, start: Array, margin: float, theta: Array) -> bool:
    """Write a point just across one facet, away from the others, into θ; False when the facet is too small.

    It is the one nearest to `start` with the largest margin to the others, of the given one and smaller ones.
    """
    n = A.shape[1]
    AI = np.empty((count + 1, n))
    bI = np.empty(count + 1)
    work = np.empty(n + 1, np.int64)
    lam = np.empty(n + 1)
    while margin > 0.1 * INSIDE:
        step = min(CROSSING, margin)
        for a in range(count):
            sign = -1.0 if facets[a] == facet else 1.0
            for j in range(n):
                AI[a, j] = sign * A[facets[a], j]
            bI[a] = sign * b[facets[a]] - (step if sign < 0 else margin)
        for j in range(n):  # not farther than twice the step: the region behind may be thin
            AI[count, j] = A[facet, j]
        bI[count] = b[facet] + 2.0 * step
        if project(AI, bI, count + 1, start, ROUNDED_SUM, theta, work, lam) >= 0:
            return True
        margin *= 0.1
    return False


if hasattr(project, "stats"):  # not where numba is told to compile nothing
    forget_stale(project.stats.cache_path)  # all kernels keep theirs in one folder
