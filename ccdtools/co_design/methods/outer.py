"""The search over the designs of one start: least cost within bounds and constraints, along exact slopes.

References
----------
Kraft, "A software package for sequential quadratic programming", DFVLR-FB 88-28, 1988 (SLSQP, in SciPy).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from ccdtools.arrays import Array
from ccdtools.co_design.feasible import DesignRegion
from ccdtools.plants.design_space import DesignSpace

Cost = Callable[[Array], tuple[float, Array]]

TALL = 2.0  # relative cost from which on it counts by its logarithm: into lost runs it grows by 1e7 within one step
LOST = 1e3  # relative cost of a design where there is none
AGAIN = 3  # searches that follow one another while they gain
GAINED = 1e-7  # of the cost
STEP = 1e-4  # of the unit box: of the differences that a slope is confirmed by


FEASIBLE = 1e-9  # violation of a point that counts as feasible, in the unit box
INSIDE = 1e-10  # how far inside the edges the search keeps
ON_EDGE = 1e-9  # of the unit box: a point this close to a bound is on it
AGREE = 0.05  # of a slope: what differences and it may differ by,
LEVEL = 1e-3  # and of the cost per length of the unit box


class _SpentError(Exception):
    """No evaluation is left."""


@dataclass(eq=False)
class Descent:
    """Where a search ended.

    Attributes
    ----------
    v : (np,) array
        The best feasible point of the unit box that was evaluated.
    cost : float
    slope : (np,) array
        Of the cost there, per unit-box length.
    evaluations : int
    path : list of (v, cost)
        The points that were better than all before.
    spent : bool
        Whether the evaluations ran out.
    """

    v: Array
    cost: float
    slope: Array
    evaluations: int = 0
    path: list[tuple[Array, float]] = field(default_factory=list)
    spent: bool = False


def descend(cost: Cost, space: DesignSpace, v: Array, *, size: float, evaluations: int) -> Descent:
    """From a feasible point of the unit box to the least cost that is found, fixed entries and whole numbers held.

    Parameters
    ----------
    cost : callable
        Point (np,) of the unit box → cost and its slope (np,); infinite where there is none.
    v : (np,) array
    size : float
        Of costs: what gains are compared with.
    evaluations : int
        At most.
    """
    region = DesignRegion(space, v)
    limits = space.allowed.limits
    free = region.free
    found = Descent(v, np.inf, np.zeros(len(v)))

    def at(z: Array) -> Array:
        """The whole point with the free entries `z`."""
        point = v.copy()
        point[free] = np.where(z < ON_EDGE, 0.0, np.where(z > 1 - ON_EDGE, 1.0, z))
        return point

    def evaluated(z: Array) -> tuple[float, Array]:
        """Relative cost, beyond `TALL` its logarithm, and its slope along the free entries."""
        if found.evaluations >= evaluations:
            found.spent = True
            raise _SpentError
        point = at(z)
        value, slope = cost(point)
        found.evaluations += 1
        if value < found.cost and space.allowed.violation(point) <= FEASIBLE:
            found.v, found.cost, found.slope = point, value, slope
            found.path.append((point, value))
        relative = value / size
        if not (np.isfinite(relative) and np.isfinite(slope).all()):
            return LOST, np.zeros(len(z))
        gradient = slope[free] / size
        if relative > TALL:
            return TALL * (1 + float(np.log(relative / TALL))), gradient * TALL / relative
        return float(relative), gradient

    constraints = [] if limits is None else [{
        "type": "ineq", "fun": lambda z: -limits.values(at(z)) - INSIDE,
        "jac": lambda z: -limits.jacobian(at(z))[:, free],
    }]  # fmt: skip
    if not free.any():
        value, slope = cost(v)
        return Descent(v, value, slope, 1, [(v, value)])
    try:
        for _ in range(AGAIN):
            before = found.cost
            minimize(evaluated, found.v[free], jac=True, method="SLSQP", bounds=[(0.0, 1.0)] * int(free.sum()),
                     constraints=constraints, options={"maxiter": evaluations, "ftol": 1e-10})  # fmt: skip
            if not found.cost < before - GAINED * size:
                break
    except _SpentError:
        pass
    return found


@dataclass(frozen=True)
class Held:
    """What holds a design: prices of its active bounds and constraints, and what is left of the slope.

    Attributes
    ----------
    multipliers : dict
        By how much the return would rise per unit of an active bound or constraint, by name.
    rest : float
        Slope of the return along the directions that are left, per unit-box length.
    """

    multipliers: dict[str, float]
    rest: float


def held_by(space: DesignSpace, v: Array, slope: Array) -> Held:
    """What holds a point of the unit box where the cost has this slope (np,)."""
    free = space.allowed.free
    limits = space.allowed.limits
    width = space.allowed.width
    push = np.where(free, -slope, 0.0)
    prices: dict[str, float] = {}
    if limits is not None:
        paid, bounds, rest = limits.prices(v, push, free)
        steepness = _steepness(space, v)
        prices |= {
            name: float(price / steep)
            for name, price, steep in zip(space.constraint_names, paid, steepness)
            if price > 0 and steep > 0
        }
    else:
        bounds = np.where((v <= 0) & (push < 0) | (v >= 1) & (push > 0), push, 0.0)
        rest = push - bounds
    prices |= {name: abs(float(price)) / float(wide) for name, price, wide in zip(space.names, bounds, width) if price}
    return Held(prices, float(np.linalg.norm(rest)))


def _steepness(space: DesignSpace, v: Array) -> Array:
    """Lengths (ng,) of the constraints' slopes along the free entries of the unit box."""
    p = ca.SX.sym("p", space.dim)
    J = ca.Function("J", [p], [ca.densify(ca.jacobian(space.constraints(p), p))])
    slopes = np.asarray(J(space.from_unit(v)), dtype=float) * space.allowed.width
    return np.asarray(np.linalg.norm(slopes[:, space.allowed.free], axis=1))


def confirmed(cost: Cost, space: DesignSpace, v: Array, *, size: float) -> bool:
    """Whether central differences of the cost show its slope, in one random direction of the free entries."""
    free = space.allowed.free
    if not free.any():
        return True
    direction = np.where(free, np.random.default_rng(0).standard_normal(len(v)), 0.0)
    direction /= np.abs(direction).max()
    centre = np.where(free, np.clip(v, STEP, 1 - STEP), v)
    ahead, behind = (cost(centre + side * STEP * direction)[0] for side in (1, -1))
    about = cost(centre)[1]
    shown = (ahead - behind) / (2 * STEP)
    return bool(abs(shown - about @ direction) <= AGREE * abs(shown) + LEVEL * size)
