"""Nearest allowed point of the unit box of designs.

References
----------
Kraft, "A software package for sequential quadratic programming", DFVLR-FB 88-28, 1988 (SLSQP, in SciPy).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import product

import numpy as np
from scipy.optimize import minimize

from ccdtools.arrays import Array
from ccdtools.plants.design_constraints import UnitConstraints
from ccdtools.plants.tolerances import EXACT, NEAREST


def nearest(
    limits: UnitConstraints, v: Array, *, free: Array, starts: Iterable[Array] = (), thorough: bool = False
) -> Array | None:
    """Nearest allowed point to `v`, held entries unchanged; None if none is found.

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

    def places() -> Iterator[Array]:
        """Starting points of the searches."""
        yield v
        yield allowed_point(limits, v, free)[0]
        yield from starts

    best: Array | None = None
    for place in places():
        begun = np.where(free, place, v)
        for u in (_searched(limits, begun, free, v), begun):
            if limits.violation(u) <= EXACT:
                break
        else:
            continue
        away = float(np.linalg.norm(v - u))
        if best is None or away < np.linalg.norm(v - best) - EXACT:
            best = u
        if not thorough and np.linalg.norm(limits.prices(u, v - u, free)[2]) <= NEAREST * away:
            break
    return best


def allowed_point(limits: UnitConstraints, start: Array, free: Array) -> tuple[Array, float]:
    """Allowed or least violated point found, and its violation."""
    u = _searched(limits, start, free)
    violations = limits.violation(np.array([start, u]))
    return (u, violations[1]) if violations[1] < violations[0] else (start, violations[0])


def nearest_whole(values: Array, lower: Array, upper: Array, width: Array) -> Array:
    """Whole numbers (n, k) within bounds, by distance from `values` in `width`.

    All of them where these are few; of more, those in a box about the values.
    """
    low = np.ceil(lower - 1e-9)
    count = np.floor(upper + 1e-9) - low + 1
    most = count.copy()
    while np.prod(count) > 4096:  # combinations of whole numbers
        longest = np.argmax(count)
        count[longest] = np.ceil(count[longest] / 2)
    first = np.clip(np.round(values) - count // 2, low, low + most - count)
    numbers = np.array(list(product(*(np.arange(n) for n in count)))) + first
    return np.asarray(numbers[np.argsort((((numbers - values) / width) ** 2).sum(axis=1), kind="stable")])


def _searched(limits: UnitConstraints, start: Array, free: Array, target: Array | None = None) -> Array:
    """Nearest allowed point to a target, or the least violated one."""
    size = int(free.sum())
    u = start.copy()
    if not size:
        return u
    first = start[free] if target is not None else np.r_[start[free], float(limits.violation(start))]
    wanted = np.zeros(size) if target is None else target[free]
    slack = np.ones((limits.count, len(first) - size))

    def at(z: Array) -> Array:
        """Point with those free entries."""
        u[free] = z[:size]
        return u

    def cost(z: Array) -> float:
        """Half the squared distance, or t."""
        return float(z[-1]) if target is None else 0.5 * float((z - wanted) @ (z - wanted))

    with np.errstate(all="ignore"):
        found = minimize(
            cost, first, jac=lambda z: np.eye(size + 1)[-1] if target is None else z - wanted, method="SLSQP",
            bounds=[(0.0, 1.0)] * size + [(0.0, None)] * (len(first) - size), options={"ftol": 1e-14, "maxiter": 100},
            constraints={"type": "ineq", "fun": lambda z: slack @ z[size:] - limits.values(at(z)),
                         "jac": lambda z: np.hstack([-limits.jacobian(at(z))[:, free], slack])},
        )  # fmt: skip
    return np.clip(at(found.x if np.isfinite(found.x).all() else first), 0.0, 1.0).copy()
