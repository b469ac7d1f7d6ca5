"""Starts of a method's searches, and active constraints at their ends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.methods.descent import Cost, value_of
from ccdtools.co_design.result import Valley
from ccdtools.co_design.tolerances import AGREEING, COST_STEP, LEVEL_SLOPE, SAME_PLACE
from ccdtools.plants.design_constraints import held
from ccdtools.plants.design_space import DesignSpace
from ccdtools.plants.tolerances import ON_EDGE

OTHERS = "other whole numbers were never looked at: raise starts"


@dataclass(frozen=True)
class Held:
    """Prices of active bounds and constraints, and the slope left.

    Attributes
    ----------
    multipliers : dict
        By how much the return would rise per unit of an active bound or constraint, by name.
    rest : float
        Slope of the return along the directions that are left, per unit-box length.
    """

    multipliers: dict[str, float]
    rest: float


def active_set_at(space: DesignSpace, v: Array, slope: Array, violations: Mapping[str, Array] | None = None) -> Held:
    """Active bounds and constraints at a point with this slope (np,).

    Where the slope is unknown, NaN is left.

    Active limits of the closed loop are constraints, too: by name, the slopes (np,) of their violations.
    """
    if not np.isfinite(slope).all():
        return Held({}, float("nan"))
    free = space.allowed.free
    push = np.where(free, -slope, 0.0)
    eye = np.eye(len(v))
    at = free & ((v <= 0) | (v >= 1))
    edges = [np.asarray(normal) for normal in (violations or {}).values()]
    named = [(name, 1.0) for name in violations or {}]
    if space.allowed.limits is not None:
        normals, distances = space.allowed.limits.edges(v, push)
        steepness = _steepness(space, v)
        for k in np.flatnonzero(distances <= ON_EDGE):
            edges.append(normals[k])
            named.append((space.constraint_names[int(k)], steepness[k] if steepness[k] > 0 else np.inf))
    edges += [eye[i] if v[i] >= 1 else -eye[i] for i in np.flatnonzero(at)]
    named += [(space.names[i], space.allowed.width[i]) for i in map(int, np.flatnonzero(at))]
    normals = np.reshape(edges, (-1, len(v))) * free
    paid = held(normals, push)
    prices = {name: float(price / unit) for (name, unit), price in zip(named, paid) if price > 0}
    return Held(prices, float(np.linalg.norm(push - paid @ normals)))


def _steepness(space: DesignSpace, v: Array) -> Array:
    """Lengths (ng,) of the constraint slopes along the free entries."""
    p = ca.SX.sym("p", space.dim)
    J = ca.Function("J", [p], [ca.densify(ca.jacobian(space.constraints(p), p))])
    slopes = np.asarray(J(space.from_unit(v)), dtype=float) * space.allowed.width
    return np.asarray(np.linalg.norm(slopes[:, space.allowed.free], axis=1))


def confirmed(cost: Cost, space: DesignSpace, v: Array, *, size: float) -> bool:
    """True if differences confirm the slope along a random free direction."""
    free = space.allowed.free
    if not free.any():
        return True
    direction = np.where(free, np.random.default_rng(0).standard_normal(len(v)), 0.0)
    direction /= np.abs(direction).max()
    centre = np.where(free, np.clip(v, COST_STEP, 1 - COST_STEP), v)
    ahead, behind = (value_of(cost, centre + side * COST_STEP * direction) for side in (1, -1))
    about = cost(centre)[1]
    shown = (ahead - behind) / (2 * COST_STEP)
    return bool(np.isfinite(shown) and abs(shown - about @ direction) <= AGREEING * abs(shown) + LEVEL_SLOPE * size)


def start_points(space: DesignSpace, design: Array, found: tuple[Valley, ...], most: int) -> list[Array]:
    """Starting points: the given design and the best other optima."""
    starts = [space.allowed.rounded(space.to_unit(design))]
    for valley in found:
        v = space.to_unit(valley.design)
        if len(starts) < most and all(np.abs(v - one).max() > SAME_PLACE for one in starts):
            starts.append(v)
    return starts
