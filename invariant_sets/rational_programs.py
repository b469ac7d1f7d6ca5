"""Small linear programs in rational arithmetic.

Doubles are rationals, so the data are taken exactly as they are.

References
----------
Lemke (1954), The dual method of solving the linear programming problem; Bland (1977), New finite pivoting rules for
the simplex method.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

Array = np.ndarray


def exact_optimum(c: Array, A: Array, b: Array) -> tuple[float, Array, Array] | None:
    """Least value, minimiser (n,) and multipliers (m,) in rational arithmetic, or None.

    None if it is empty, too large, or has no bound on a single variable where the cost asks for one: these bounds are
    the first active rows of the dual simplex method.
    """
    active = _first_bounds(c, A) if A.size <= 20_000 else None
    if active is None:
        return None
    rows = [[Fraction(entry) for entry in row] for row in A.tolist()]
    right = [Fraction(entry) for entry in b.tolist()]
    inverse = [[Fraction(0)] * len(c) for _ in c]  # of the active rows; column k belongs to active[k]
    for j, i in enumerate(active):
        inverse[j][j] = 1 / rows[i][j]
    cost = [Fraction(entry) for entry in c.tolist()]
    for pivot in range(300):
        x = [_dot(line, [right[i] for i in active]) for line in inverse]
        excess = [_dot(row, x) - limit for row, limit in zip(rows, right)]
        violated = [i for i, value in enumerate(excess) if value > 0]
        dual = [-_dot(cost, column) for column in zip(*inverse)]
        if not violated:
            multipliers = np.zeros(len(b))
            multipliers[active] = [float(value) for value in dual]
            return float(_dot(cost, x)), np.array([float(value) for value in x]), multipliers
        entering = max(violated, key=excess.__getitem__) if pivot < 60 else violated[0]  # then Bland's
        weights = [_dot(rows[entering], column) for column in zip(*inverse)]
        ratios = [(dual[k] / weight, active[k], k) for k, weight in enumerate(weights) if weight > 0]
        if not ratios:
            return None
        leaving = min(ratios)[2]
        _exchange(inverse, weights, leaving)
        active[leaving] = entering
    return None


def _first_bounds(c: Array, A: Array) -> list[int] | None:
    """Bound on each single variable, opposing the cost c, or None."""
    single = np.count_nonzero(A, axis=1) == 1
    active = []
    for j, cost in enumerate(c):
        bounds = np.flatnonzero(single & (A[:, j] * cost < 0 if cost else A[:, j] != 0))
        if not len(bounds):
            return None
        active.append(int(bounds[0]))
    return active


def _exchange(inverse: list[list[Fraction]], weights: list[Fraction], leaving: int) -> None:
    """Exchange the active row of column `leaving`, in place."""
    for line in inverse:
        line[leaving] /= weights[leaving]
        for k, weight in enumerate(weights):
            if k != leaving and weight:
                line[k] -= weight * line[leaving]


def _dot(first: Sequence[Fraction], second: Sequence[Fraction]) -> Fraction:
    """Sum of products."""
    return sum((one * other for one, other in zip(first, second) if one and other), Fraction(0))
