"""How the best design moves with a weight or a datum of its problem.

References
----------
Fiacco, "Introduction to Sensitivity and Stability Analysis in Nonlinear Programming", Academic Press, 1983: the
implicit function theorem at a strict optimum with strict complementarity.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable, Mask
from ccdtools.checks import as_choice, as_count, as_number, as_share, shown
from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.differentiable_model import scenario_tensors
from ccdtools.co_design.episodes import fewer_runs
from ccdtools.co_design.methods.descent import ON_EDGE, Cost, descend
from ccdtools.co_design.methods.laws import LQRLaw
from ccdtools.co_design.methods.loop_cost import LoopCost
from ccdtools.co_design.methods.nested import RUNS, Nested
from ccdtools.co_design.methods.riccati_cost import RiccatiCost
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.trade_off import ProblemOf, stated
from ccdtools.exceptions import InputError
from ccdtools.plants.design_space import DesignSpace

INNER = ("lqr", "riccati")
STEP = 3e-3  # of the box: of the differences of slopes
NEWTON = 4  # steps to the optimum of the cost itself
EVALUATIONS = 100  # of a search
WEAK = 1e-3  # of the cost per length of the box: a price below it may change its side at once
AGREE = 0.1  # of the slope: what it may differ from solving anew by,
LITTLE = 0.01  # and of the box per change of the value by itself


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class OptimumSensitivity(Immutable):
    """How the best design moves with a value θ.

    Attributes
    ----------
    value : float
    design : (np,) array
        The best one at θ.
    slope : (np,) array
        dp*/dθ, by implicit differentiation.
    solved_anew : (np,) array
        The same by a central difference of best designs that were solved for anew.
    return_slope : float
        d(return)/dθ of the best design, solved for anew.
    held : tuple of str
        Bounds and constraints that hold the design, which it moves along.
    weak : tuple of str
        Those whose price is next to nothing: the design leaves them at once to one side, and the slope is one-sided.
    curvature : float
        Least curvature of the cost along the directions that are left, relative to the cost, per box length squared.
        Next to zero, the best design is not one but many; NaN where none is left.
    width : (np,) array
        Of the box.
    names : tuple of str
    """

    value: float
    design: Array
    slope: Array
    solved_anew: Array
    return_slope: float
    held: tuple[str, ...]
    weak: tuple[str, ...]
    curvature: float
    width: Array
    names: tuple[str, ...]

    @property
    def agrees(self) -> bool:
        """Whether both slopes are the same within a tenth, and what does not matter."""
        size = max(abs(self.value), np.finfo(float).tiny)
        gap, anew = ((part / self.width) * size for part in (self.slope - self.solved_anew, self.solved_anew))
        return bool(np.linalg.norm(gap) <= AGREE * np.linalg.norm(anew) + LITTLE)

    def __repr__(self) -> str:
        parts = ", ".join(f"d{name}/dθ {a:.4g} ({b:.4g} solved anew)"
                          for name, a, b in zip(self.names, self.slope, self.solved_anew))  # fmt: skip
        doubt = "" if self.agrees else "; they disagree"
        held = f", held by {', '.join(self.held)}" if self.held else ""
        return f"OptimumSensitivity(θ = {self.value:g}: {parts}{held}{doubt})"


def optimum_sensitivity(
    problem_of: ProblemOf, value: float, *, design: ArrayLike | None = None, inner: str = "lqr", step: float = 0.02,
    runs: int | None = None, seed: int = 0,
) -> OptimumSensitivity:  # fmt: skip
    """The slope dp*/dθ of the best design by nested co-design, with respect to a value θ of its problem.

    The stationarity of the cost on fixed scenarios is differentiated along the directions that active bounds and
    constraints leave; its second derivatives are differences of exact slopes. Bounds, constraints and scenarios may
    depend on θ too. Limits on states are counted in it as far as the objective counts them.

    Parameters
    ----------
    problem_of : callable
        θ → CoDesignProblem, smooth in θ: a weight, a price, a mass of the plant.
    value : float
    design : (np,) array_like, optional
        Where the search for the best design starts; by default where nested co-design ends.
    inner : {"lqr", "riccati"}
        What is optimal: saturated LQR on scenarios, or LQR that never saturates.
    step : float
        Part of θ (of one, if it is 0) that it is changed by in differences.
    runs : int, optional
        Scenarios of 100 steps, 1000 by default.
    seed : int
        Of the scenarios, common to all θ.

    Raises
    ------
    InputError
        If an argument is of the wrong kind, a problem of another number of parameters is stated, or a design that is
        started from cannot be stabilised.
    """
    if not callable(problem_of):
        raise InputError("problem_of", shown(problem_of), "a function of a number that gives a CoDesignProblem")
    theta = as_number("value", value)
    as_choice("inner", inner, INNER)
    change = as_share("step", step) * (abs(theta) or 1.0)
    count = RUNS["lqr"] if runs is None else as_count("runs", runs)
    as_count("seed", seed, least=0)
    here = _Stated.of(problem_of, theta, inner, count, seed)
    space = here.space
    if design is None:
        design = codesign(here.problem, method=Nested(inner), rng=np.random.default_rng(seed)).design
    start = space.to_unit(space.check_feasible(design))
    v, size = here.best(start)
    above, below = (_Stated.of(problem_of, theta + side * change, inner, count, seed, like=here) for side in (1, -1))
    kkt = _Optimum.at(here, v, size)
    kkt = kkt.polished()
    slope = kkt.slope(above, below, 2 * change)
    ends = [other.best(other.space.allowed.rounded(np.clip(other.own(here.shared(kkt.v)), 0, 1)))[0]
            for other in (above, below)]  # fmt: skip
    designs = [other.space.from_unit(end) for other, end in zip((above, below), ends)]
    costs = [other.cost(end)[0] for other, end in zip((above, below), ends)]
    return OptimumSensitivity(
        value=theta, design=space.settled(kkt.v), slope=slope * here.width,
        solved_anew=(designs[0] - designs[1]) / (2 * change), return_slope=float(costs[1] - costs[0]) / (2 * change),
        held=kkt.held, weak=kkt.weak, curvature=kkt.curvature, width=here.width, names=tuple(space.names),
    )  # fmt: skip


@dataclass(eq=False)
class _Stated:
    """The problem at one θ: its cost over the unit box, and the shared coordinates of all θ, the box at the first."""

    problem: CoDesignProblem
    cost: Cost
    lower: Array
    width: Array

    @classmethod
    def of(
        cls, problem_of: Callable[[float], CoDesignProblem], theta: float, inner: str, runs: int, seed: int, *,
        like: _Stated | None = None,
    ) -> _Stated:  # fmt: skip
        """The problem that the function states."""
        problem = stated(problem_of, theta, argument="problem_of")
        space = problem.design
        if like is not None and space.dim != like.space.dim:
            raise InputError("problem_of", f"{space.dim} design parameters at {theta:g}", f"{like.space.dim}")
        cost: Cost
        if inner == "riccati":
            cost = RiccatiCost(problem)
        else:
            drawn = scenario_tensors(problem, fewer_runs(runs, problem.steps), np.random.default_rng(seed))
            cost = LoopCost(problem, LQRLaw(), drawn)
        if like is None:
            return cls(problem, cost, space.lower, space.allowed.width)
        return cls(problem, cost, like.lower, like.width)

    @property
    def space(self) -> DesignSpace:
        """Its designs."""
        return self.problem.design

    def own(self, z: Array) -> Array:
        """Shared coordinates in its own unit box."""
        return np.asarray((self.lower + z * self.width - self.space.lower) / self.space.allowed.width)

    def shared(self, v: Array) -> Array:
        """And the other way round."""
        return np.asarray((self.space.lower + v * self.space.allowed.width - self.lower) / self.width)

    def gradient(self, z: Array) -> Array:
        """Slope (np,) of the cost by the shared coordinates, at a point within its box."""
        return np.asarray(self.cost(np.clip(self.own(z), 0.0, 1.0))[1] / self.space.allowed.width * self.width)

    def constraints(self, z: Array) -> Array:
        """g (ng,) at shared coordinates."""
        return self.space.constraint_values(self.lower + z * self.width)

    def normals(self, z: Array) -> Array:
        """Slopes (ng, np) of g by them."""
        steps = 1e-5 * np.eye(len(z))
        return np.array([(self.constraints(z + h) - self.constraints(z - h)) / 2e-5 for h in steps]).T

    def best(self, v: Array) -> tuple[Array, float]:
        """Where a search from a point of its unit box ends, and how large the cost of control is there."""
        value = self.cost(v)[0]
        size = float(self.problem.made_by_control(-value, self.space.from_unit(v))) if np.isfinite(value) else 1.0
        found = descend(self.cost, self.space, v, size=size or 1.0, evaluations=EVALUATIONS)
        if not np.isfinite(found.cost):
            got = f"{self.space.describe(self.space.from_unit(v))}, which has no LQR to search by"
            raise InputError("design", got, "a design that can be stabilised, at every value that is looked at")
        return found.v, size or 1.0


@dataclass(eq=False)
class _Optimum:
    """The conditions of an optimum, in the shared coordinates."""

    here: _Stated
    v: Array
    size: float
    free: Mask
    low: Mask
    high: Mask
    active: Mask
    prices: Array
    hessian: Array
    gradient: Array
    bound_prices: Array

    @classmethod
    def at(cls, here: _Stated, v: Array, size: float) -> _Optimum:
        """The conditions at a point, which is in the unit box of `here` and so in its shared coordinates."""
        moving = here.space.allowed.free
        gradient = here.gradient(v)
        low = moving & (v <= ON_EDGE)
        high = moving & (v >= 1 - ON_EDGE)
        free = moving & ~low & ~high
        names = here.space.active_constraints(here.space.from_unit(v), tol=1e-4)
        active = np.array([name in names for name in here.space.constraint_names], dtype=bool)
        J = here.normals(v)[active] if active.any() else np.zeros((0, len(v)))
        prices = np.linalg.lstsq(J[:, free].T, -gradient[free], rcond=None)[0] if len(J) and free.any() else np.zeros(
            len(J))  # fmt: skip
        active[np.flatnonzero(active)[prices < 0]] = False
        prices = prices[prices >= 0]
        J = here.normals(v)[active] if active.any() else np.zeros((0, len(v)))
        at_bounds = np.where(low | high, gradient + J.T @ prices, 0.0)
        hessian = np.zeros((len(v), len(v)))
        for i in np.flatnonzero(moving).tolist():
            hessian[:, i] = _difference(here, v, i, active, prices)
        hessian = (hessian + hessian.T) / 2
        return cls(here, v, size, free, low, high, active, prices, hessian, gradient, at_bounds)

    @property
    def normals(self) -> Array:
        """Slopes (k, np) of the active constraints."""
        return self.here.normals(self.v)[self.active] if self.active.any() else np.zeros((0, len(self.v)))

    @property
    def residual(self) -> float:
        """What is left of the slope along the free entries."""
        return float(np.linalg.norm((self.gradient + self.normals.T @ self.prices)[self.free]))

    def polished(self) -> _Optimum:
        """After Newton steps, as long as they bring the conditions closer."""
        best = self
        for _ in range(NEWTON):
            g = best.here.constraints(best.v)[best.active]
            move, _ = best.solved(best.gradient + best.normals.T @ best.prices, g)
            point = np.clip(best.v + move, 0.0, 1.0)
            if (point[best.free] <= 0).any() or (point[best.free] >= 1).any() or np.abs(move).max() > 0.1:
                break
            tried = _Optimum.at(best.here, point, best.size)
            if not tried.residual < 0.5 * best.residual:
                break
            best = tried
        return best

    def solved(self, slope: Array, values: Array, given: Array | None = None) -> tuple[Array, Array]:
        """(dz, dλ) that take a slope (np,) of the cost and values (k,) of active constraints to zero, to first order.

        `given` (np,) are moves of the entries that are not free.
        """
        move = np.zeros(len(self.v)) if given is None else np.where(self.free, 0.0, given)
        J = self.normals
        count, k = int(self.free.sum()), len(J)
        matrix = np.zeros((count + k, count + k))
        matrix[:count, :count] = self.hessian[np.ix_(self.free, self.free)]
        matrix[:count, count:] = J[:, self.free].T
        matrix[count:, :count] = J[:, self.free]
        right = -np.r_[(slope + self.hessian @ move)[self.free], values + J @ move]
        found = np.linalg.lstsq(matrix, right, rcond=None)[0] if len(right) else right
        move[self.free] = found[:count]
        return move, found[count:]

    def slope(self, above: _Stated, below: _Stated, apart: float) -> Array:
        """dz*/dθ (np,)."""
        given = np.zeros(len(self.v))
        for side, edge in ((self.low, 0.0), (self.high, 1.0)):
            ends = [other.shared(np.full(len(self.v), edge)) for other in (above, below)]
            given = np.where(side, (ends[0] - ends[1]) / apart, given)
        turned = (_lagrangian(above, self) - _lagrangian(below, self)) / apart
        values = (above.constraints(self.v) - below.constraints(self.v))[self.active] / apart
        return self.solved(turned, values, given)[0]

    @property
    def held(self) -> tuple[str, ...]:
        """Names of what holds the design."""
        space = self.here.space
        bounds = [f"{name} {'lower' if low else 'upper'}" for name, low, high in zip(space.names, self.low, self.high)
                  if low or high]  # fmt: skip
        return (*bounds, *(name for name, on in zip(space.constraint_names, self.active) if on))

    @property
    def weak(self) -> tuple[str, ...]:
        """Those of them whose price is next to nothing."""
        at = np.flatnonzero(self.low | self.high)
        steep = np.linalg.norm(self.normals, axis=1)
        prices = np.r_[np.abs(self.bound_prices[at]), self.prices * steep]
        return tuple(name for name, price in zip(self.held, prices) if price < WEAK * self.size)

    @property
    def curvature(self) -> float:
        """The least along the directions that are left, relative to the size of the cost."""
        J = self.normals[:, self.free]
        basis = np.eye(int(self.free.sum()))
        if len(J):
            basis = np.linalg.svd(J)[2][np.linalg.matrix_rank(J) :].T
        if not basis.size:
            return float("nan")
        reduced = basis.T @ self.hessian[np.ix_(self.free, self.free)] @ basis
        return float(np.linalg.eigvalsh(reduced)[0]) / self.size


def _difference(here: _Stated, v: Array, i: int, active: Mask, prices: Array) -> Array:
    """Column of the Hessian of the Lagrangian: central within the box, at its edge one-sided."""
    ends = []
    for side in (STEP, -STEP):
        z = v.copy()
        z[i] = np.clip(v[i] + side, 0.0, 1.0)
        slope = here.gradient(z)
        if active.any():
            slope = slope + here.normals(z)[active].T @ prices
        ends.append((z[i], slope))
    (high, ahead), (low, behind) = ends
    return np.asarray((ahead - behind) / (high - low))


def _lagrangian(other: _Stated, at: _Optimum) -> Array:
    """Slope (np,) of the Lagrangian of another θ at this optimum, with the prices of this one."""
    slope = other.gradient(at.v)
    if at.active.any():
        slope = slope + other.normals(at.v)[at.active].T @ at.prices
    return slope
