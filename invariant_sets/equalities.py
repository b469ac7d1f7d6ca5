"""Elimination of equality rows, and first units for it.

References
----------
Golub, Van Loan (2013), Matrix Computations, section 3.4: Gauss–Jordan elimination with complete pivoting.
Ruiz (2001), A scaling algorithm to equilibrate both rows and columns norms in matrices.
"""

from __future__ import annotations

import numpy as np

from invariant_sets.bodies import Body, Stated, bare_body
from invariant_sets.tolerances import COARSE, DEPENDENT, FLAT, ROUNDING

Array = np.ndarray


def eliminated(E: Array, e: Array, sizes: Array, centre: Array, scale: Array) -> Body | None:
    """Affine hull {x : E x = e} as a `Body` without rows, or None if empty.

    Parameters
    ----------
    E, e, sizes : (m, n), (m,) and (m,) arrays
        Equality rows, none of them zero, and the sizes of the terms of e.
    centre : (n,) array
        The free coordinates of the point are taken from here.
    scale : (n,) array
        Size of each coordinate of the set, > 0; it chooses the pivots and scales the basis.

    Notes
    -----
    k coordinates stay free, one a column; the others follow from them. The size of the terms of every entry is
    accumulated beside it, so that an entry counts as zero when it has cancelled, whatever the units of its column.
    """
    n = len(scale)
    if not len(e):
        return bare_body(centre.copy(), np.diag(scale), np.arange(n), np.abs(centre))
    row_sizes = np.abs(E * scale).max(axis=1)
    rows = np.column_stack([E * scale, e]) / row_sizes[:, None]
    terms = np.column_stack([np.abs(E * scale), sizes]) / row_sizes[:, None]
    solved, bound, rest = reduce_rows(rows, terms, n)
    if rest and (np.abs(rows[rest, n]) > FLAT * terms[rest].sum(axis=1)).any():
        return None
    free = np.array([j for j in range(n) if j not in bound], dtype=int)
    basis = np.zeros((n, len(free)))
    basis[free, np.arange(len(free))] = 1.0
    entries = rows[solved][:, free]
    basis[bound] = -np.where(np.abs(entries) > ROUNDING * terms[solved][:, free], entries, 0.0)
    point = np.zeros(n)  # the dependent coordinates are computed anew: a correction would keep old rounding
    point[bound] = rows[solved, n]
    point_terms = np.zeros(n)
    point_terms[bound] = terms[solved, n]
    start = centre[free] / scale[free]
    return bare_body(
        scale * (point + basis @ start),
        scale[:, None] * basis,
        free,
        scale * (point_terms + np.abs(basis) @ np.abs(start)),
    )


def reduce_rows(rows: Array, terms: Array, n: int) -> tuple[list[int], list[int], list[int]]:
    """Rows with pivots, their columns, and the rows left.

    The elimination is in place. The pivots stand in the first n columns of `rows`; `terms` are the sizes of the terms
    of every entry.
    """
    rest = list(range(len(rows)))
    solved: list[int] = []
    bound: list[int] = []
    while rest:
        largest = int(np.abs(rows[rest, :n]).argmax())
        i = rest[largest // n]
        j = largest % n
        if rows[i, j] == 0.0:
            break
        rest.remove(i)
        solved.append(i)
        bound.append(j)
        _clear_column(rows, terms, (i, j), rest, n)
    return solved, bound, rest


def _clear_column(rows: Array, terms: Array, pivot: tuple[int, int], rest: list[int], n: int) -> None:
    """Clear the pivot's column of all rows but its own, in place."""
    i, j = pivot
    terms[i] /= abs(rows[i, j])
    rows[i] /= rows[i, j]
    factors = rows[:, j].copy()
    factors[i] = 0.0
    rows -= factors[:, None] * rows[i]
    terms += np.abs(factors)[:, None] * terms[i]
    rows[:, j] = 0.0
    rows[i, j] = 1.0
    if not rest:
        return
    left = rows[rest, :n]
    rows[rest, :n] = np.where(np.abs(left) > DEPENDENT * terms[rest, :n], left, 0.0)


def balancing(rows: Array) -> tuple[Array, Array]:
    """Factors (m,) and (n,) that balance rows and columns."""
    rows = np.abs(rows)
    by_row = np.ones(len(rows))
    by_column = np.ones(rows.shape[1])
    for _ in range(6):
        size = rows.max(axis=1)
        factor = 1 / np.where(size > 0, size, 1.0)
        rows = rows * factor[:, None]
        by_row = by_row * factor
        columns = rows.max(axis=0)
        if (columns[columns > 0] > 0.5).all():
            break
        factor = 1 / np.where(columns > 0, columns, 1.0)
        rows = rows * factor
        by_column = by_column * factor
    return by_row, by_column


def starting_scale(stated: Stated) -> tuple[Array, Array]:
    """First coordinate lengths (n,), and which inequalities may be far (m,).

    Rows and columns are balanced, so that every coordinate is steep in some row; the tightest steep row on either side
    then gives its length, by its terms where its right-hand side has cancelled. A row is suspected to be far away if
    the terms of the others are nothing beside it.
    """
    A, b, E, e, terms, sizes = stated
    rows = np.concatenate([A, E])
    if not len(rows):
        return np.ones(A.shape[1]), np.zeros(0, bool)
    sign = np.sign(rows)
    right = np.concatenate([np.abs(b), np.abs(e)])
    terms = np.concatenate([terms, sizes])
    right = np.where(right > ROUNDING * terms, right, terms)
    by_row, scale = balancing(rows)
    rows = np.abs(rows) * by_row[:, None] * scale
    right = right * by_row
    terms = terms * by_row
    m = len(b)
    far = (right[:m] > _middle(terms) / COARSE) & (b > 0)
    if right.any():  # the far ones tell no length; beside rows through the origin alone nothing is far
        right = np.append(np.where(right[:m] > _middle(terms[terms > 0]) / COARSE, np.inf, right[:m]), right[m:])
    lengths = _tightest(rows[:m], right[:m], sign[:m])
    noise = right[:m] <= ROUNDING * (rows[:m] @ lengths)  # a row through the origin but for rounding tells no length
    if (noise & (right[:m] > 0)).any():
        lengths = _tightest(rows[:m], np.where(noise, 0.0, right[:m]), sign[:m])
    if len(e) and not lengths.all():  # what an equality leaves, given the lengths of the other coordinates
        reach = np.maximum(right[m:], rows[m:] @ lengths)[:, None] / np.where(rows[m:] > 0.5, rows[m:], 1.0)
        reach = np.where(rows[m:] > 0.5, reach, np.inf).min(axis=0)
        lengths = np.where((lengths == 0) & np.isfinite(reach), reach, lengths)
    known = lengths[lengths > 0]
    usual = 1.0
    if not lengths.all() and right.any():
        usual = float((known if len(known) else right[right > 0]).min())  # the least costs the others no digits
    usual = usual if np.isfinite(usual) else 1.0
    return scale * np.where(lengths > 0, lengths, usual), far


def _tightest(rows: Array, right: Array, sign: Array) -> Array:
    """Larger distance (n,) of steep rows on either side, 0 without any."""
    steep = rows > 0.5
    reach = np.where(steep, right[:, None] / np.where(steep, rows, 1.0), np.inf)
    above = np.where(sign < 0, np.inf, reach).min(axis=0, initial=np.inf)
    below = np.where(sign > 0, np.inf, reach).min(axis=0, initial=np.inf)
    above[above == np.inf] = 0.0
    below[below == np.inf] = 0.0
    return np.asarray(np.maximum(above, below))


def _middle(values: Array) -> float:
    """Upper median of the values (k,), k >= 1."""
    return float(np.sort(values)[len(values) // 2])


def opposite_rows(A: Array, b: Array, terms: Array) -> tuple[Array, Array]:
    """One row of each opposite pair, and the rows these make needless.

    Parameters
    ----------
    A, b, terms : (m, n), (m,) and (m,) arrays
        Inequalities, none of them zero, and the sizes of the terms of b.

    Returns
    -------
    chosen : (q,) int array
        Rows that hold with equality, one of a pair.
    needless : (m,) bool array
        Rows parallel to one of them.

    Notes
    -----
    Entries are compared one by one, relative to themselves, so units and scaled copies play no role. Parallel rows
    have the same projection on a fixed direction, and stand beside one another once these are sorted.
    """
    m, n = A.shape
    if m < 2:
        return np.zeros(0, int), np.zeros(m, bool)
    largest = np.abs(A).argmax(axis=1)
    size = np.abs(A[np.arange(m), largest])
    rows = A / size[:, None]
    right = b / size
    doubt = ROUNDING * terms / size
    projection = rows @ np.cos(np.arange(1, n + 1))
    order = np.argsort(np.abs(projection))
    level = np.abs(projection)[order]
    starts = np.append(0, (level[1:] - level[:-1] > ROUNDING * n).nonzero()[0] + 1)
    needless = np.zeros(m, bool)
    if len(starts) == m:
        return np.zeros(0, int), needless
    chosen: list[int] = []
    upper = np.where(projection > 0, right, np.inf)
    lower = np.where(projection < 0, right, np.inf)
    low = np.minimum.reduceat(lower[order], starts)
    high = np.minimum.reduceat(upper[order], starts)
    pairs = np.isfinite(low) & np.isfinite(high)
    most = np.maximum.reduceat(doubt[order], starts)
    pairs[pairs] = np.abs(low[pairs] + high[pairs]) <= most[pairs]
    for group in pairs.nonzero()[0]:
        members = order[starts[group] : np.append(starts, m)[group + 1]]
        first = members[upper[members].argmin()]
        second = members[lower[members].argmin()]
        parallel = (
            np.abs(rows[members] - np.sign(projection[members] * projection[first])[:, None] * rows[first])
            <= ROUNDING * np.abs(rows[first])
        ).all(axis=1)
        within = abs(right[first] + right[second]) <= max(doubt[first], doubt[second])
        if within and parallel[members == second].all():
            chosen.append(int(first))
            needless[members[parallel]] = True
    return np.array(chosen, dtype=int), needless
