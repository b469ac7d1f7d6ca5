"""Membership of points in rows, up to slack and rounding."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def rows_hold(points: Array, A: Array, b: Array, slack: Array, rounding: float) -> Array:
    """Whether A x <= b + max(slack, rounding (|b| + |A||x|)), (k,) bools.

    Parameters
    ----------
    points : (k, n) array
        Points; one with NaN satisfies no row.
    A, b, slack : (m, n), (m,) and (m,) arrays
        Rows, and by how much each may be violated wherever the point lies.
    rounding : float
        Part of |b| + |A||x| by which the row may be violated besides.
    """
    if not len(b):
        return np.asarray(np.isfinite(points).all(axis=1))

    def limit(size: Array) -> Array:
        """Limits (m,) or (k, m) of the rows at sizes |x| (n,) or (k, n)."""
        terms = np.abs(b) + size @ np.abs(A).T
        return np.asarray(b + np.maximum(slack, rounding * np.where(np.isfinite(terms), terms, 0.0)))

    inside = np.ones(len(points), bool)
    least = limit(np.zeros(A.shape[1]))[:, None]  # wherever the point lies
    for start in range(0, len(points), 8192):
        part = points[start:start + 8192]  # its products with all rows stay in the cache
        values = A @ part.T
        within = np.less_equal(values, least).all(axis=0)
        if not within.all():  # a point is asked itself where the largest of all would be let in
            largest = np.nan_to_num(np.abs(part), nan=0.0, posinf=0.0).max(axis=0)
            near = np.less_equal(values, limit(largest)[:, None]).all(axis=0) & ~within
            within[near] = np.less_equal(values[:, near].T, limit(np.abs(part[near]))).all(axis=1)
        inside[start:start + 8192] = within
    return inside
