"""The nearest point of the unit box that the constraints on a design allow.

References
----------
Kraft, "A software package for sequential quadratic programming", DFVLR-FB 88-28, 1988 (SLSQP, in SciPy).
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from scipy.optimize import minimize

from ccdtools.arrays import Array
from ccdtools.plants.design_constraints import EXACT, UnitConstraints

INWARD = 1e-12  # how far behind the edge the last corrections aim, in the unit box
CORRECTIONS = 8
SLIDES = 40  # along the constraints, where a search ended early,
HALVINGS = 8  # each of them halved so often
LADDER = 1000  # whole numbers of one entry that are looked at
NEAREST = 1e-5  # of the distance: what is left of it along the constraints where a point is the nearest


def nearest(
    limits: UnitConstraints, v: Array, *, free: Array, starts: Iterable[Array] = (), thorough: bool = False
) -> Array | None:
    """The point nearest to `v` that the constraints allow, its held entries as they are; None if none is found.

    Parameters
    ----------
    v : (np,) array
        In the unit box.
    free : (np,) array of bool
        Entries that may move.
    starts : iterable of (np,) arrays
        Where else the search begins.
    thorough : bool
        Go through every start; by default the first point that is the nearest of its surroundings will do.
    """
    if limits.violation(v) <= EXACT:
        return v
    if not free.any():
        return None
    best: Array | None = None
    for start in (v, *starts):
        found = _from(limits, v, np.where(free, start, v), free)
        if found is None:
            continue
        if best is None or np.linalg.norm(found - v) < np.linalg.norm(best - v):
            best = found
        if not thorough and _held_still(v - found, limits.prices(found, v - found, free)[2]):
            return found
    return best


def allowed_point(limits: UnitConstraints, start: Array, free: Array) -> tuple[Array, float]:
    """A point that the constraints allow, or the least violation of them from a start, and that violation.

    The largest violation by SLSQP, corrected by Newton's method.
    """
    violation = float(limits.violation(start))
    if violation <= EXACT or not free.any():
        return start, violation
    u = _corrected(limits, _searched(limits, start, free), free)
    value = float(limits.violation(u))
    return (u, value) if value < violation else (start, violation)


def nearest_whole(values: Array, lower: Array, upper: Array, width: Array) -> Iterator[Array]:
    """Whole numbers (k,) within bounds, in the order of their distance from `values` in units of `width`."""
    bounds = zip(values, np.ceil(lower - 1e-9), np.floor(upper + 1e-9))
    ladders = [_around(value, int(low), int(high)) for value, low, high in bounds]

    def distance(steps: Sequence[int]) -> float:
        """Of the numbers so many steps down their ladders."""
        return float(sum(((ladders[i][s] - values[i]) / width[i]) ** 2 for i, s in enumerate(steps)))

    first = (0,) * len(ladders)
    queue = [(distance(first), first)]
    seen = {first}
    while queue:
        _, steps = heapq.heappop(queue)
        yield np.array([ladders[i][s] for i, s in enumerate(steps)], dtype=float)
        for i in range(len(ladders)):
            further = (*steps[:i], steps[i] + 1, *steps[i + 1 :])
            if further[i] < len(ladders[i]) and further not in seen:
                seen.add(further)
                heapq.heappush(queue, (distance(further), further))


def _around(value: float, low: int, high: int) -> list[int]:
    """The whole numbers of a range, the nearest to a value first; of a long range the nearest thousand."""
    first = int(np.clip(round(value) - LADDER // 2, low, max(low, high - LADDER + 1)))
    return sorted(range(first, min(high + 1, first + LADDER)), key=lambda n: abs(n - value))


def _from(limits: UnitConstraints, v: Array, start: Array, free: Array) -> Array | None:
    """The allowed point near `v` that a search from `start` comes to, if it comes to one."""
    for first in (start, None):
        begun = allowed_point(limits, start, free)[0] if first is None else first
        found = _corrected(limits, _searched(limits, begun, free, v), free)
        if limits.violation(found) <= EXACT:
            return _slid(limits, v, found, free)
        if first is None and limits.violation(begun) <= EXACT:
            return _slid(limits, v, begun, free)
    return None


def _slid(limits: UnitConstraints, v: Array, u: Array, free: Array) -> Array:
    """An allowed point moved along what holds it, as long as that brings it nearer to `v`.

    SLSQP may end early where two constraints leave a line between them: their edges then are all but parallel.
    """
    for _ in range(SLIDES):
        rest = limits.prices(u, v - u, free)[2]
        if _held_still(v - u, rest):
            break
        for length in 0.5 ** np.arange(HALVINGS):
            moved = _corrected(limits, np.clip(u + length * rest, 0.0, 1.0), free)
            if np.linalg.norm(moved - v) < np.linalg.norm(u - v) and limits.violation(moved) <= EXACT:
                break
        else:
            break
        u = moved
    return u


def _searched(limits: UnitConstraints, start: Array, free: Array, target: Array | None = None) -> Array:
    """The point nearest to a target within the constraints; without one, that of least violation: t → min, g ≤ t."""
    size = int(free.sum())
    u = start.copy()
    first = start[free] if target is not None else np.r_[start[free], float(limits.violation(start))]
    wanted = np.zeros(size) if target is None else target[free]
    slack = np.ones((limits.count, len(first) - size))

    def at(z: Array) -> Array:
        """The point with those free entries."""
        u[free] = z[:size]
        return u

    def cost(z: Array) -> float:
        """Half the square of the distance, or t."""
        return float(z[-1]) if target is None else 0.5 * float((z - wanted) @ (z - wanted))

    with np.errstate(all="ignore"):
        found = minimize(
            cost, first, jac=lambda z: np.eye(size + 1)[-1] if target is None else z - wanted, method="SLSQP",
            bounds=[(0.0, 1.0)] * size + [(0.0, None)] * (len(first) - size), options={"ftol": 1e-14, "maxiter": 100},
            constraints={"type": "ineq", "fun": lambda z: slack @ z[size:] - limits.values(at(z)),
                         "jac": lambda z: np.hstack([-limits.jacobian(at(z))[:, free], slack])},
        )  # fmt: skip
    return np.clip(at(found.x if np.isfinite(found.x).all() else first), 0.0, 1.0).copy()


def _corrected(limits: UnitConstraints, u: Array, free: Array) -> Array:
    """A point that is all but allowed, moved by what its constraints are violated by."""
    u = u.copy()
    for _ in range(CORRECTIONS):
        g = limits.values(u)
        over = g > 0
        if not over.any() or not np.isfinite(g).all():
            break
        moving = free.copy()
        J = limits.jacobian(u)[over]
        step = -np.linalg.pinv(J[:, moving]) @ (g[over] + INWARD)
        moved = u[moving] + step
        blocked = (moved < 0) | (moved > 1)
        if blocked.any():  # along the bounds that are in the way
            moving[np.flatnonzero(moving)[blocked & ((u[moving] <= 0) | (u[moving] >= 1))]] = False
            step = -np.linalg.pinv(J[:, moving]) @ (g[over] + INWARD) if moving.any() else np.zeros(0)
            moved = u[moving] + step
        u[moving] = np.clip(moved, 0.0, 1.0)
    return u


def _held_still(push: Array, rest: Array) -> bool:
    """Whether what is left of a push along the constraints is as good as nothing."""
    return bool(np.linalg.norm(rest) <= NEAREST * np.linalg.norm(push) + 1e-9)
