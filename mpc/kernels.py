"""Compiled steps of the multiparametric QP solver; imported only when an explicit law is computed.

Everything works on least-distance data. With H = LL', v = L'z + L⁻¹(Fθ + f) turns the QP into min ½ |v|² subject
to Mv <= d(θ), where M has unit rows. For an active set a the multipliers are λ(θ) = -(M_a M_a')⁻¹ d_a(θ) and the
slack of row i is d_i(θ) + M_i M_a' λ(θ): only the Gram matrix MM' and the affine map d are needed (Bemporad, Morari,
Dua and Pistikopoulos, Automatica 38(1), 2002; Arnström and Axehill, IEEE CDC, 2024). Row i of a critical region
belongs to constraint i whether it is active (its multiplier) or not (its slack), so crossing facet i exchanges i's
membership.

numba's cache on disk notices a change of this file, but not for functions of other files that call into it: after a
change here save `search_kernels.py` too.
"""

from __future__ import annotations

import numpy as np
from numba import njit

FULL, FLAT, DEPENDENT = 1, 2, 3  # what is known about an active set; FLAT: empty or of lower dimension
DONE, GROW, PAUSED = 0, 1, 2  # why the exploration returned
RADIUS = 1e-7  # a region with no ball of this radius, in parameters scaled to [-1, 1], is flat
SAME = 1e-7  # normals and offsets closer than this describe the same hyperplane
PIVOT = 1e-10  # squared distance of a unit row from the span of others below which it is dependent


@njit(cache=True)
def project(A, b, m, c, tol, theta, work, lam):
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
        worst, p = tol, -1
        for i in range(m):
            s = -b[i]
            for j in range(n):
                s += A[i, j] * theta[j]
            if s > worst:
                worst, p = s, i
        if p < 0:
            return k
        price = 0.0
        for _ in range(n + m + 2):
            # r: coefficients of row p on the active rows; z: what is left of it
            for a in range(k):
                s = 0.0
                for j in range(n):
                    s += A[work[a], j] * A[p, j]
                for e in range(a):
                    s -= L[a, e] * r[e]
                r[a] = s / L[a, a]
            for a in range(k - 1, -1, -1):
                s = r[a]
                for e in range(a + 1, k):
                    s -= L[e, a] * r[e]
                r[a] = s / L[a, a]
            zz = 0.0
            for j in range(n):
                s = A[p, j]
                for a in range(k):
                    s -= r[a] * A[work[a], j]
                z[j] = s
                zz += s * s
            t, drop = np.inf, -1
            for a in range(k):
                if r[a] > 1e-12 and lam[a] < t * r[a]:
                    t, drop = lam[a] / r[a], a
            full = k < n and zz > 1e-13
            if full:
                s = -b[p]
                for j in range(n):
                    s += A[p, j] * theta[j]
                step = max(s, 0.0) / zz
                if step <= t:
                    t, drop = step, -1
            elif drop < 0:
                return -1
            for a in range(k):
                lam[a] -= t * r[a]
            price += t
            if full:
                for j in range(n):
                    theta[j] -= t * z[j]
            if drop < 0:
                work[k], lam[k] = p, price
                k += 1
                _factor(A, work, k, k - 1, L)
                break
            for a in range(drop, k - 1):
                work[a], lam[a] = work[a + 1], lam[a + 1]
            k -= 1
            _factor(A, work, k, drop, L)
    return -2


@njit(cache=True)
def _factor(A, work, k, start, L):
    """Cholesky factor of the Gram matrix of the active rows, from row `start` on."""
    n = A.shape[1]
    for a in range(start, k):
        for e in range(a + 1):
            s = 0.0
            for j in range(n):
                s += A[work[a], j] * A[work[e], j]
            for q in range(e):
                s -= L[a, q] * L[e, q]
            L[a, e] = np.sqrt(max(s, 1e-30)) if a == e else s / L[e, e]


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
def interior_point(A, b, centre):
    """Write a point well inside {Aθ <= b} into `centre`; returns a radius around it, 0 when there is none >= RADIUS."""
    m, n = A.shape
    shrunk, theta = np.empty(m), np.empty(n)
    work, lam = np.empty(n + 1, np.int64), np.empty(n + 1)
    radius, trial = 0.0, RADIUS
    start = np.zeros(n)
    while trial < 1.0:
        for i in range(m):
            shrunk[i] = b[i] - trial
        if project(A, shrunk, m, start, 1e-2 * RADIUS if trial > RADIUS else 1e-13, theta, work, lam) < 0:
            break
        # the second look: the margin is measured, not believed
        margin = np.inf
        for i in range(m):
            s = b[i]
            for j in range(n):
                s -= A[i, j] * theta[j]
            margin = min(margin, s)
        if margin < 0.9 * trial:
            break
        radius = margin
        for j in range(n):
            centre[j] = theta[j]
            start[j] = theta[j]
        trial *= 20.0
    return radius


@njit(cache=True)
def irredundant(A, b, centre, facets):
    """Rows of {Aθ <= b} that are facets, by Clarkson's method (1994) from an interior point; returns their number."""
    m, n = A.shape
    slack = np.empty(m)
    for i in range(m):
        s = b[i]
        for j in range(n):
            s -= A[i, j] * centre[j]
        slack[i] = s
    order = np.argsort(slack)
    AI, bI = np.empty((m + 1, n)), np.empty(m + 1)
    theta, work, lam = np.empty(n), np.empty(n + 1, np.int64), np.empty(n + 1)
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
            bI[count] = -b[i] - 1e-9
            if project(AI, bI, count + 1, centre, 1e-12, theta, work, lam) < 0:
                break  # redundant beside the facets known so far
            hit, nearest = i, np.inf
            for e in range(m):
                rate = 0.0
                for j in range(n):
                    rate += A[e, j] * (theta[j] - centre[j])
                if rate > 1e-14 and slack[e] < nearest * rate:
                    nearest, hit = slack[e] / rate, e
            if known[hit]:
                hit = i
            known[hit] = True
            facets[count] = hit
            for j in range(n):
                AI[count, j] = A[hit, j]
            bI[count] = b[hit]
            count += 1
    return count


@njit(cache=True)
def to_mask(act, k, mask):
    """Write the active set as bits."""
    for q in range(len(mask)):
        mask[q] = np.uint64(0)
    for a in range(k):
        mask[act[a] >> 6] |= np.uint64(1) << np.uint64(act[a] & 63)


@njit(cache=True)
def from_mask(mask, act):
    """Write the members of a bit mask in increasing order; returns their number."""
    k = 0
    for q in range(len(mask)):
        word = mask[q]
        for s in range(64):
            if word >> np.uint64(s) & np.uint64(1):
                act[k] = 64 * q + s
                k += 1
    return k


@njit(cache=True)
def find(masks, table, mask):
    """Slot of a mask in the hash table: where it is, or where it would go."""
    h = np.uint64(14695981039346656037)
    for q in range(len(mask)):
        h = (h ^ mask[q]) * np.uint64(1099511628211)
        h ^= h >> np.uint64(29)
    size = len(table)
    slot = np.int64(h & np.uint64(size - 1))
    while table[slot] >= 0:
        same = True
        for q in range(len(mask)):
            if masks[table[slot], q] != mask[q]:
                same = False
                break
        if same:
            return slot
        slot = (slot + 1) & (size - 1)
    return slot


@njit(cache=True)
def consider(gram, M, D, TA, Tb, mask, masks, kinds, table, queue, counts):
    """Kind of an active set: looked up, or found out and, when FULL, queued."""
    slot = find(masks, table, mask)
    if table[slot] >= 0:
        return kinds[table[slot]]
    m, n = len(D), D.shape[1] - 1
    act = np.empty(m, np.int64)
    k = from_mask(mask, act)
    A, b, centre = np.empty((m + len(Tb), n)), np.empty(m + len(Tb)), np.empty(n)
    kind = region_rows(gram, D, TA, Tb, M.shape[1], act, k, A, b)
    if kind == FULL and interior_point(A, b, centre) == 0.0:
        kind = FLAT
    index = counts[0]
    counts[0] += 1
    table[slot] = index
    kinds[index] = kind
    for q in range(len(mask)):
        masks[index, q] = mask[q]
    if kind == FULL:
        queue[counts[1]] = index
        counts[1] += 1
    return kind


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


@njit(cache=True)
def across(A, b, facets, count, facet, theta):
    """Write a point just across one facet, away from the others, into θ; False when the facet is too small."""
    n = A.shape[1]
    AI, bI = np.empty((count, n)), np.empty(count)
    work, lam, start = np.empty(n + 1, np.int64), np.empty(n + 1), np.zeros(n)
    margin = 0.1
    while margin > 1e-8:
        for a in range(count):
            sign = -1.0 if facets[a] == facet else 1.0
            for j in range(n):
                AI[a, j] = sign * A[facets[a], j]
            bI[a] = sign * b[facets[a]] - (min(1e-5, margin) if sign < 0 else margin)
        if project(AI, bI, count, start, 1e-13, theta, work, lam) >= 0:
            return True
        margin *= 0.1
    return False


@njit(cache=True)
def explore(gram, M, D, TA, Tb, masks, kinds, table, queue, counts, offsets, rows, budget):
    """Process queued regions: find the facets of each, and the optimal active sets behind every facet.

    counts: [sets known, regions queued, regions processed, facet rows stored].
    """
    m, n = len(D), D.shape[1] - 1
    words = masks.shape[1]
    A, b, centre = np.empty((m + len(Tb), n)), np.empty(m + len(Tb)), np.empty(n)
    facets, twins = np.empty(m + len(Tb), np.int64), np.empty(m + len(Tb), np.int64)
    act, trial, theta = np.empty(m + 1, np.int64), np.empty(m + 1, np.int64), np.empty(n)
    mask, flipped = np.empty(words, np.uint64), np.empty(words, np.uint64)
    one = np.uint64(1)
    while counts[2] < counts[1]:
        if budget == 0:
            return PAUSED
        budget -= 1
        mask[:] = masks[queue[counts[2]]]
        k = from_mask(mask, act)
        region_rows(gram, D, TA, Tb, M.shape[1], act, k, A, b)
        interior_point(A, b, centre)
        count = irredundant(A, b, centre, facets)
        if counts[3] + count > len(rows) or counts[0] + count * (k + 20) > min(len(masks), len(table) // 2):
            return GROW
        for a in range(count):
            for j in range(n):
                rows[counts[3], j] = A[facets[a], j]
            rows[counts[3], n] = b[facets[a]]
            counts[3] += 1
        offsets[counts[2] + 1] = counts[3]
        counts[2] += 1
        for a in range(count):
            facet = facets[a]
            if facet >= m:
                continue  # the border of the parameter set
            found = False
            # rows that share the hyperplane: any combination of them may change membership
            shared = 0
            for i in range(m):
                close = abs(b[i] - b[facet]) < SAME
                for j in range(n):
                    close = close and abs(A[i, j] - A[facet, j]) < SAME
                if close and shared < 4:
                    twins[shared] = i
                    shared += 1
            for combination in range(1, 1 << shared):
                flipped[:] = mask
                for s in range(shared):
                    if combination >> s & 1:
                        flipped[twins[s] >> 6] ^= one << np.uint64(twins[s] & 63)
                kind = consider(gram, M, D, TA, Tb, flipped, masks, kinds, table, queue, counts)
                found = found or kind == FULL
                if kind == DEPENDENT and shared == 1:
                    swapped = exchange(gram, M, D, TA, Tb, act, k, facet, mask, masks, kinds, table, queue, counts)
                    found = found or swapped
            if not found and across(A, b, facets, count, facet, theta):
                kt = optimal_set(M, D, theta, trial)
                if kt >= 0:
                    to_mask(trial, kt, flipped)
                    consider(gram, M, D, TA, Tb, flipped, masks, kinds, table, queue, counts)
    return DONE


@njit(cache=True)
def exchange(gram, M, D, TA, Tb, act, k, entering, mask, masks, kinds, table, queue, counts):
    """Replace a member of a dependent active set by the entering row: one with a positive coefficient has to leave."""
    L, coefficient = np.empty((k, k)), np.empty(k)
    gram_factor(gram, act, k, L)
    for a in range(k):
        coefficient[a] = gram[act[a], entering]
    gram_solve(L, k, coefficient)
    one = np.uint64(1)
    swapped = np.empty(len(mask), np.uint64)
    found = False
    for a in range(k):
        if coefficient[a] > 1e-9:
            swapped[:] = mask
            swapped[entering >> 6] ^= one << np.uint64(entering & 63)
            swapped[act[a] >> 6] ^= one << np.uint64(act[a] & 63)
            kind = consider(gram, M, D, TA, Tb, swapped, masks, kinds, table, queue, counts)
            found = found or kind == FULL
    return found


@njit(cache=True)
def seed(J, h, gram, M, D, TA, Tb, targets, masks, kinds, table, queue, counts):
    """Queue the active sets at feasible parameters near the targets; J [θ; v] <= h is the joint set with unit rows.

    Returns the number of targets for which a feasible parameter was found.
    """
    mj, nj = J.shape
    n = D.shape[1] - 1
    joint, c = np.empty(nj), np.zeros(nj)
    work, lam = np.empty(nj + 1, np.int64), np.empty(nj + 1)
    shrunk, act = np.empty(mj), np.empty(len(D) + 1, np.int64)
    mask = np.empty(masks.shape[1], np.uint64)
    hits = 0
    for t in range(len(targets)):
        c[:n] = targets[t]
        margin = 1e-2
        while margin > 1e-9:
            for i in range(mj):
                shrunk[i] = h[i] - margin
            if project(J, shrunk, mj, c, 1e-12, joint, work, lam) >= 0:
                hits += 1
                k = optimal_set(M, D, joint[:n], act)
                if k >= 0:
                    to_mask(act, k, mask)
                    consider(gram, M, D, TA, Tb, mask, masks, kinds, table, queue, counts)
                break
            margin *= 0.1
        if hits == 0:
            break  # infeasible from one target is infeasible from all
    return hits


@njit(cache=True)
def rehash(masks, table, count):
    """Fill an empty hash table with the masks known so far."""
    for index in range(count):
        table[find(masks, table, masks[index])] = index
