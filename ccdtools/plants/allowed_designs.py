"""Allowed points of the unit box of designs, and the nearest of them.

References
----------
Kraft, "A software package for sequential quadratic programming", DFVLR-FB 88-28, 1988 (SLSQP, in SciPy).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import null_space
from scipy.optimize import minimize, nnls
from scipy.stats import qmc

from ccdtools.arrays import Array
from ccdtools.plants.budgets import ALLOWED_STARTS, BOX_SAMPLES, MAX_CORNERS, TRIED_COMBINATIONS
from ccdtools.plants.design_constraints import TINY, UnitConstraints
from ccdtools.plants.tolerances import CURVED, EXACT, NEAREST, ON_BOUND, ON_EDGE


@dataclass(frozen=True, eq=False)
class AllowedDesigns:
    """The allowed points of a unit box.

    Attributes
    ----------
    lower, upper : (np,) arrays
        Of the box, in the units of the design.
    whole : (np,) array of bool
        Entries that are whole numbers.
    function : casadi.Function or None
        p → g(p) ≤ 0.
    """

    lower: Array
    upper: Array
    whole: Any
    function: ca.Function | None

    @cached_property
    def width(self) -> Array:
        """Range of each entry (np,), or one where fixed."""
        width = self.upper - self.lower
        return np.where(width > 0, width, 1.0)

    @cached_property
    def free(self) -> Any:
        """Entries that are neither fixed nor whole numbers, (np,) of bool."""
        return self._moving & ~self.whole

    def sides(self, v: Array) -> Array:
        """Side of the bound that each entry stands at.

        -1 lower, 1 upper, 0 none or fixed, at a point (np,). Bounds of whole numbers are the outermost of them.
        """
        ends = ((end - self.lower) / self.width for end in whole_bounds(self.lower, self.upper))
        lower, upper = (np.where(self.whole, end, bound) for end, bound in zip(ends, (0.0, 1.0)))
        slack = ON_BOUND * self.whole
        return np.where(self._moving, (v >= upper - slack) * 1.0 - (v <= lower + slack), 0.0)

    @property
    def _moving(self) -> Any:
        """Entries that are not fixed, (np,) of bool."""
        return self.upper > self.lower

    @cached_property
    def limits(self) -> UnitConstraints | None:
        """The constraints over the unit box."""
        if self.function is None:
            return None
        return UnitConstraints(self.function, self.lower, self.upper, self._samples)

    @cached_property
    def _samples(self) -> Array:
        """Points (n, np): the centre, a Sobol sequence, corners of ten entries."""
        moving = np.flatnonzero(self._moving)
        points = np.zeros((1 + BOX_SAMPLES, len(self.lower)))
        if not len(moving):
            return points[:1]
        points[:, moving] = 0.5
        points[1:, moving] = qmc.Sobol(len(moving), rng=np.random.default_rng(0)).random(BOX_SAMPLES)
        return np.vstack([points, self.corners])

    @property
    def corners(self) -> Array:
        """Corners (n, np) of the first ten entries that are not fixed, the others in the middle."""
        moving = np.flatnonzero(self._moving)[:MAX_CORNERS]
        corners = np.tile(0.5 * self._moving, (2 ** len(moving), 1))
        corners[:, moving] = list(product((0.0, 1.0), repeat=len(moving)))
        return corners

    def rounded(self, v: Array) -> Array:
        """Points (..., np) with whole-number entries rounded."""
        if not self.whole.any():
            return v
        numbers = np.clip(np.round(self.lower + v * self.width), *whole_bounds(self.lower, self.upper))
        return np.where(self.whole, (numbers - self.lower) / self.width, v)

    def violation(self, v: Array) -> Any:
        """Largest violation at points (n, np) or at one (np,)."""
        return np.zeros(v.shape[:-1]) if self.limits is None else self.limits.violation(v)

    @cached_property
    def known(self) -> Array:
        """Allowed points (n, np) to search from; empty if none is found."""
        samples = self.rounded(self._samples)
        inside: Array = samples[self.violation(samples) <= EXACT]
        if len(inside):
            return inside[:64]  # kept to search from
        least = self.least_violated[None]
        return np.asarray(least[self.violation(least) <= EXACT])

    @cached_property
    def least_violated(self) -> Array:
        """Point (np,) of least violation found from the samples."""
        assert self.limits is not None
        samples = self.rounded(self._samples)
        samples = samples[np.argsort(self.violation(samples), kind="stable")]
        tried = [*samples[:ALLOWED_STARTS], *samples[ALLOWED_STARTS :: max(1, len(samples) // ALLOWED_STARTS)]]
        if self.whole.any():
            between = _allowed_point(self.limits, samples[0], self._moving)[0]
            for centre in (between, samples[0]):
                tried += list(self._by_whole_numbers(centre)[:TRIED_COMBINATIONS])
        least, violation = samples[0], np.inf
        for start in tried:
            u, broken = _allowed_point(self.limits, start, self.free)
            if broken < violation:
                least, violation = u, broken
            if violation <= EXACT:
                break
        return np.asarray(least)

    def _by_whole_numbers(self, v: Array) -> Array:
        """Copies (n, np) of `v` with other whole numbers, nearest first; of many, those in a box about it."""
        lower, upper, width = (part[self.whole] for part in (self.lower, self.upper, self.width))
        values = lower + v[self.whole] * width
        low, high = whole_bounds(lower, upper)
        count = high - low + 1
        while np.prod(count) > 4096:  # combinations of whole numbers
            longest = np.argmax(count)
            count[longest] = np.ceil(count[longest] / 2)
        first = np.clip(np.round(values) - count // 2, low, high + 1 - count)
        numbers = np.array(list(product(*(np.arange(n) for n in count)))) + first
        numbers = numbers[np.argsort((((numbers - values) / width) ** 2).sum(axis=1), kind="stable")]
        points = np.tile(v, (len(numbers), 1))
        points[:, self.whole] = (numbers - lower) / width
        return points

    def combinations(self) -> Array:
        """Combinations (n, np) of whole numbers in the unit box; others 0."""
        return self._by_whole_numbers(self.rounded(np.zeros(len(self.lower))))

    def near(self, v: Array) -> Array | None:
        """Nearest allowed point to `v` (np,); None if none is found.

        Whole numbers are tried from the nearest on; where none of these is allowed, from the ones about the nearest
        point that keeps the constraints with numbers in between, and then those of the known points.
        """
        if not self.whole.any():
            return self.near_with(v, thorough=True)
        best = self._of_whole_numbers(v, v)
        known = sorted(self.known, key=lambda one: _apart(one, v))[:ALLOWED_STARTS]
        if best is None and self.limits is not None:
            between = self._nearest(v, self._moving, known, thorough=True)
            best = None if between is None else self._of_whole_numbers(between, v)
        return known[0] if best is None and known else best

    def _of_whole_numbers(self, centre: Array, v: Array) -> Array | None:
        """Nearest allowed point to `v` with whole numbers about `centre`."""
        best: Array | None = None
        for held in self._by_whole_numbers(centre)[:TRIED_COMBINATIONS]:
            if best is not None and _apart(held, centre) >= _apart(best, centre):
                break
            found = self.near_with(np.where(self.whole, held, v), thorough=True)
            if found is not None and (best is None or _apart(found, v) < _apart(best, v)):
                best = found
        return best

    def near_with(self, v: Array, starts: Sequence[Array] = (), *, thorough: bool = False) -> Array | None:
        """Nearest allowed point to `v` (np,), fixed entries unchanged; None without one.

        Its whole numbers are those of `v`.

        Searches begin at `v`, at `starts` and at known points. Unless `thorough`, the first point that is the nearest
        of its surroundings will do.
        """
        if self.limits is None or self.limits.violation(v) <= EXACT:
            return v
        same = self.known[(np.abs(self.known - v) <= ON_BOUND)[:, ~self.free].all(axis=1)]
        known = sorted(same, key=lambda one: _apart(one, v))[:ALLOWED_STARTS]
        return self._nearest(v, self.free, [*starts, *known], thorough=thorough)

    def _nearest(self, v: Array, free: Array, starts: Iterable[Array], *, thorough: bool) -> Array | None:
        """Nearest allowed point to `v` (np,); None without one.

        It is the nearest from every start, or, unless `thorough`, the first that is one of its surroundings.
        """
        assert self.limits is not None
        limits = self.limits
        if limits.violation(v) <= EXACT:
            return v

        def places() -> Iterator[Array]:
            """Starting points of the searches."""
            yield v
            yield _allowed_point(limits, v, free)[0]
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
            if not thorough and np.linalg.norm(self.prices(u, v - u, free)[-1]) <= NEAREST * away:
                break
        return best

    def prices(
        self, u: Array, push: Array, free: Any, further: Sequence[Array] = ()
    ) -> tuple[Array, Array, Array, Array]:
        """Prices of the edges that hold a point; see `held`.

        Parameters
        ----------
        u, push : (np,) arrays
        free : (np,) array of bool
        further : sequence of (np,) arrays
            Normals of other edges at the point.

        Returns
        -------
        (m,), (ng,), (np,) and (np,) arrays
            Prices of further edges, of the constraints, of the bounds (below zero at a lower one), and what is left
            of the push.
        """
        constraints = (np.zeros((0, len(u))), np.zeros(0)) if self.limits is None else self.limits.edges(u, push)
        eye, side = np.eye(len(u)), self.sides(u)
        parts = [np.reshape(further, (-1, len(u))), constraints[0], -eye, eye]
        normals = np.vstack(parts)
        at = np.r_[np.full(len(further), True), constraints[1] <= ON_EDGE, free & (side < 0), free & (side > 0)]
        paid = np.zeros(len(at))
        paid[at] = held(normals[at][:, free], push[free])
        others, own, low, high = np.split(paid, np.cumsum([len(part) for part in parts])[:-1])
        return others, own, high - low, np.where(free, push - paid @ normals, 0.0)

    def pulled_back(self, v: Array, u: Array, gradient: Array, free: Any) -> Array:
        """Gradient (np,) at `v` of a function of its nearest allowed point.

        The nearest point moves along the constraints that hold it alone, and by less where they are curved away.
        """
        assert self.limits is not None
        push = v - u
        _, constraints, bounds, _ = self.prices(u, push, free)
        eye = np.eye(len(v))
        holding = self.limits.edges(u, push)[0][constraints > 0]
        along = null_space(np.vstack([holding, eye[bounds != 0], eye[~free]]), rcond=1e-8)
        if not along.size:
            return np.zeros(len(v))
        curvature = along.T @ (eye + self.limits.curvature(u, constraints, push)) @ along
        if np.linalg.eigvalsh(curvature)[0] < CURVED:
            curvature = np.eye(along.shape[1])
        return np.asarray(along @ np.linalg.solve(curvature, along.T @ gradient), dtype=float)


def held(normals: Array, push: Array) -> Array:
    """Prices ≥ 0 (m,) of edges with normals (m, np) against a push (np,).

    The rest, push − prices · normals, is the push's projection on the directions that cross no edge (Moreau).
    """
    if not len(normals):
        return np.zeros(0)
    lengths = np.maximum(np.linalg.norm(normals, axis=1), TINY)
    return np.asarray(nnls((normals / lengths[:, None]).T, push)[0] / lengths, dtype=float)


def whole_bounds(lower: Array, upper: Array) -> tuple[Array, Array]:
    """Least and largest whole numbers within bounds."""
    return np.ceil(lower - ON_BOUND), np.floor(upper + ON_BOUND)


def _allowed_point(limits: UnitConstraints, start: Array, free: Array) -> tuple[Array, float]:
    """Allowed or least violated point found, and its violation."""
    u = _searched(limits, start, free)
    violations = limits.violation(np.array([start, u]))
    return (u, violations[1]) if violations[1] < violations[0] else (start, violations[0])


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


def _apart(u: Array, v: Array) -> float:
    """Distance of two points of the unit box."""
    return float(np.linalg.norm(u - v))
