"""What holds the design that a search ended at, and whether its slope is that of the cost."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.methods.descent import Cost, value_of
from ccdtools.plants.design_space import DesignSpace

STEP = 1e-4  # of the unit box: of the differences that a slope is confirmed by
AGREE = 0.05  # of a slope: what differences and it may differ by,
LEVEL = 1e-3  # and of the cost per length of the unit box


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
    """What holds a point of the unit box where the cost has this slope (np,); of one that is unknown, NaN is left."""
    if not np.isfinite(slope).all():
        return Held({}, float("nan"))
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
    ahead, behind = (value_of(cost, centre + side * STEP * direction) for side in (1, -1))
    about = cost(centre)[1]
    shown = (ahead - behind) / (2 * STEP)
    return bool(np.isfinite(shown) and abs(shown - about @ direction) <= AGREE * abs(shown) + LEVEL * size)
