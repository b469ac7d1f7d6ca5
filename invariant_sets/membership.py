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
    inside = np.ones(len(points), bool)
    least = (b + np.maximum(slack, rounding * np.abs(b)))[:, None]  # the limit wherever the point lies
    for start in range(0, len(points), 8192):
        part = points[start:start + 8192]  # its products with all rows stay in the cache
        values = A @ part.T
        within = np.less_equal(values, least).all(axis=0)
        rest = np.flatnonzero(~within)
        terms = np.abs(b) + np.abs(part[rest]) @ np.abs(A).T
        allowed = np.maximum(slack, rounding * np.where(np.isfinite(terms), terms, 0.0))
        within[rest] = np.less_equal(values[:, rest].T, b + allowed).all(axis=1)
        inside[start:start + 8192] = within
    return inside
