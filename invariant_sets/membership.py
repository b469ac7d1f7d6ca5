"""Membership of points in rows, up to slack and rounding."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def rows_hold(points: Array, A: Array, b: Array, slack: Array, rounding: float, reach: Array | None) -> Array:
    """Whether A x <= b + max(slack, rounding (|b| + |A||x|)), (k,) bools.

    Parameters
    ----------
    points : (k, n) array
        Points; one with NaN satisfies no row.
    A, b, slack : (m, n), (m,) and (m,) arrays
        Rows, and by how much each may be violated wherever the point lies.
    rounding : float
        Part of |b| + |A||x| by which the row may be violated besides.
    reach : (n,) array, optional
        No point that satisfies the rows has larger coordinates |x|; None if that is not known.
    """
    if not len(b):
        return np.asarray(np.isfinite(points).all(axis=1))
    inside = np.ones(len(points), bool)
    least = (b + np.maximum(slack, rounding * np.abs(b)))[:, None]  # the limit wherever the point lies
    most = None if reach is None else b + _allowed(A, b, slack, rounding, reach)
    settled = most is not None and bool((most <= least[:, 0]).all())
    for start in range(0, len(points), 8192):
        part = slice(start, start + 8192)  # its products with all rows stay in the cache
        if settled:
            np.less_equal(A @ points[part].T, least).all(axis=0, out=inside[part])
        else:
            inside[part] = _hold_there(points[part], A, b, slack, rounding, most)
    return inside


def _hold_there(points: Array, A: Array, b: Array, slack: Array, rounding: float, most: Array | None) -> Array:
    """Whether points (k,) satisfy the rows with the rounding at each."""
    values = A @ points.T
    least = b + np.maximum(slack, rounding * np.abs(b))
    answer: Array = np.less_equal(values, least[:, None]).all(axis=0)
    possible = True if most is None else np.less_equal(values, most[:, None]).all(axis=0)
    near = np.flatnonzero(possible & ~answer)
    if len(near):
        limit = b + _allowed(A, b, slack, rounding, np.abs(points[near]))
        answer[near] = np.less_equal(values[:, near].T, limit).all(axis=1)
    return answer


def _allowed(A: Array, b: Array, slack: Array, rounding: float, size: Array) -> Array:
    """Allowed violation (m,) or (k, m) at sizes |x| (n,) or (k, n)."""
    terms = np.abs(b) + size @ np.abs(A).T
    allowed: Array = np.maximum(slack, rounding * np.where(np.isfinite(terms), terms, 0.0))
    return allowed
