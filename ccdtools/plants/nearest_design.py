"""The nearest point of the unit box that the constraints on a design allow.

References
----------
Kraft, "A software package for sequential quadratic programming", DFVLR-FB 88-28, 1988 (SLSQP, in SciPy); Branch,
Coleman and Li, SIAM J. Sci. Comput. 21, 1999 (least squares within bounds, in SciPy).
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from scipy.optimize import least_squares, minimize

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
        if not thorough and _is_nearest(limits, v, found, free):
            return found
    return best


def allowed_point(limits: UnitConstraints, start: Array, free: Array) -> tuple[Array, float]:
    """A point that the constraints allow, or the least violation of them from a start, and that violation.

    Least squares of what is violated and, where they leave some, the largest violation by SLSQP.
    """
    u = _restored(limits, start, free)
    violation = float(limits.violation(u))
    if violation <= EXACT or not free.any():
        return u, violation
    other = _corrected(limits, _least_violation(limits, u, free), free)
    value = float(limits.violation(other))
    return (other, value) if value < violation else (u, violation)


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
        begun = _restored(limits, start, free) if first is None else first
        found = _corrected(limits, _closest(limits, v, begun, free), free)
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


def _closest(limits: UnitConstraints, v: Array, start: Array, free: Array) -> Array:
    """½|u − v|² within the constraints, by SLSQP."""
    u = start.copy()

    def at(x: Array) -> Array:
        """The point with those free entries."""
        u[free] = x
        return u

    with np.errstate(all="ignore"):
        found = minimize(
            lambda x: 0.5 * float((x - v[free]) @ (x - v[free])), start[free], jac=lambda x: x - v[free],
            method="SLSQP", bounds=[(0.0, 1.0)] * int(free.sum()), options={"ftol": 1e-14, "maxiter": 60},
            constraints={"type": "ineq", "fun": lambda x: -limits.values(at(x)),
                         "jac": lambda x: -limits.jacobian(at(x))[:, free]},
        )  # fmt: skip
    x = found.x if np.isfinite(found.x).all() else start[free]
    return at(np.clip(x, 0.0, 1.0)).copy()


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


def _restored(limits: UnitConstraints, start: Array, free: Array) -> Array:
    """From a start, the least squares of what is violated."""
    if limits.violation(start) <= EXACT or not free.any():
        return start
    u = start.copy()

    def over(x: Array) -> Array:
        """What is violated."""
        u[free] = x
        return np.maximum(limits.values(u) + INWARD, 0.0)

    def slopes(x: Array) -> Array:
        """Its slopes."""
        u[free] = x
        return np.where(limits.values(u)[:, None] + INWARD > 0, limits.jacobian(u)[:, free], 0.0)

    inside = np.clip(start[free], 1e-6, 1.0 - 1e-6)
    with np.errstate(all="ignore"):
        try:
            found = least_squares(over, inside, jac=slopes, bounds=(0.0, 1.0), xtol=1e-15, ftol=1e-15, gtol=1e-15,
                                  max_nfev=100).x  # fmt: skip
        except ValueError:  # not finite at the start
            found = inside
    u[free] = found
    return _corrected(limits, u, free)


def _least_violation(limits: UnitConstraints, start: Array, free: Array) -> Array:
    """The least of the largest violation from a start: t → min with g ≤ t, by SLSQP."""
    size = int(free.sum())
    u = start.copy()

    def at(z: Array) -> Array:
        """The point with those free entries."""
        u[free] = z[:size]
        return u

    down = np.r_[np.zeros(size), 1.0]
    first = np.r_[start[free], float(limits.violation(start))]
    with np.errstate(all="ignore"):
        found = minimize(
            lambda z: z[-1], first, jac=lambda z: down, method="SLSQP",
            bounds=[(0.0, 1.0)] * size + [(0.0, None)], options={"ftol": 1e-14, "maxiter": 100},
            constraints={"type": "ineq", "fun": lambda z: z[-1] - limits.values(at(z)),
                         "jac": lambda z: np.hstack([-limits.jacobian(at(z))[:, free],
                                                     np.ones((limits.count, 1))])},
        )  # fmt: skip
    z = found.x if np.isfinite(found.x).all() else first
    return np.clip(at(z), 0.0, 1.0)


def _is_nearest(limits: UnitConstraints, v: Array, u: Array, free: Array) -> bool:
    """Whether constraints and bounds at `u` hold it against its push towards `v`."""
    return _held_still(v - u, limits.prices(u, v - u, free)[2])


def _held_still(push: Array, rest: Array) -> bool:
    """Whether what is left of a push along the constraints is as good as nothing."""
    return bool(np.linalg.norm(rest) <= NEAREST * np.linalg.norm(push) + 1e-9)
