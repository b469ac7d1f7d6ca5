"""Map of saturated LQR's return over the design box, for starts.

LQR at each design is the optimum where no input saturates, and close to it where inputs saturate little, so that its
map J(p) has the valleys of the co-design itself. (A valley is one of the cost, a hill of the return.)

Designs that break a constraint are moved to the nearest feasible ones, and every combination of whole numbers has hills
of its own.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.stats import qmc
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.budgets import CLIMBED_COMBINATIONS, MAP_POINTS, MOST_CLIMBED
from ccdtools.co_design.design_controllers import lqr_laws
from ccdtools.co_design.differentiable_model import Stepper, fewer_runs, scenario_tensors, simulated, to_design
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import Valley
from ccdtools.co_design.tolerances import COMPASS_LAST_STEP, RIDGE, SAME_PLACE
from ccdtools.plants.design_space import DesignSpace
from ccdtools_ground.door import as_count, as_generator, as_instance

RUNS = 96  # Every design is simulated on the same scenarios, so many.


class Landscape:
    """Mean returns of saturated LQR over the unit box.

    Parameters
    ----------
    problem : CoDesignProblem
        Its discrepancy or replayed errors are part of it.
    rng : numpy.random.Generator
        Draws the scenarios, once.
    runs : int
        Scenarios of 100 steps; of longer ones fewer are taken.
    """

    def __init__(self, problem: CoDesignProblem, rng: np.random.Generator, *, runs: int = RUNS) -> None:
        self.problem = as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
        as_generator("rng", rng)
        self._x0, self._w = scenario_tensors(
            problem, fewer_runs(as_count("runs", runs), problem.steps, problem.model), rng
        )

    def returns(self, points: ArrayLike) -> Array:
        """Mean returns (n,) at points (n, np); −inf without an LQR.

        Nothing can be built where a constraint is broken, or between whole numbers.
        """
        V: Array = np.clip(np.atleast_2d(np.asarray(points, dtype=float)), 0.0, 1.0)
        designs = self.problem.design.from_unit(V)
        gains, offsets = lqr_laws(self.problem, self.problem.model.matrices(designs), designs)
        known = np.isfinite(gains).all(axis=(1, 2)) & self.problem.design.feasible(designs)
        out = np.full(len(V), -np.inf)
        K, k, at = gains[known], offsets[known], V[known]
        parts = [slice(i, i + self._batch) for i in range(0, len(K), self._batch)]
        values = [self._simulated(at[part], K[part], k[part]) for part in parts]
        if values:
            out[known] = np.concatenate(values)
        return out

    @property
    def _batch(self) -> int:
        """Designs simulated side by side."""
        return max(1, 6000 // len(self._x0))  # runs side by side

    @torch.no_grad()
    def _simulated(self, V: Array, K: Array, k: Array) -> Array:
        """Mean returns (n,) of gains `K` (n, nu, nx) and offsets `k` (n, nu) at points `V` (n, np)."""
        runs = len(self._x0)
        gains, offsets = (torch.tensor(part, dtype=torch.float32).repeat_interleave(runs, dim=0) for part in (K, k))
        designs = to_design(self.problem, torch.tensor(V, dtype=torch.float32))
        step = Stepper.for_each(self.problem, designs, runs)
        bounds = self.problem.input_bounds_at(step.p)
        low, high = (torch.as_tensor(bound, dtype=torch.float32) for bound in bounds)

        def law(x: Tensor) -> Tensor:
            """Inputs (n · runs, nu)."""
            return torch.clamp(offsets - torch.bmm(gains, x[:, :, None])[:, :, 0], low, high)

        scenarios = (self._x0.repeat(len(V), 1), self._w.repeat(len(V), 1, 1))
        values = self.problem.risk.values(simulated(step, law, scenarios).total.reshape(len(V), runs))
        return np.asarray(values.mean(1).numpy())


def valleys(problem: CoDesignProblem, design: ArrayLike, *, rng: np.random.Generator) -> tuple[Valley, ...]:
    """Distinct local optima, best first, including that of `design` (np,).

    A space-filling set of designs is simulated with its corners (of up to three parameters); the hills among them are
    climbed by compass search, and hilltops that no ridge parts are one. Of more than three parameters the best sample
    alone is climbed.

    References
    ----------
    Kolda, Lewis and Torczon, SIAM Review 45(3), 2003 (compass search).
    """
    landscape = Landscape(problem, rng)
    space = problem.design
    given = space.allowed.rounded(space.to_unit(space.check_one(design)))
    V = np.vstack([given, _samples(space, rng)])
    J = landscape.returns(V)
    if space.integer:
        V, J, chosen = _hilltops_by_combination(landscape, V, J)
    elif space.free.sum() in MAP_POINTS:
        chosen = _hilltops(V, J)[:MOST_CLIMBED]
    else:
        chosen = [int(np.argmax(J))]
    tops, heights = _climbed(landscape, V[[0, *chosen]], J[[0, *chosen]])
    distinct: list[int] = []
    of_given = -1
    for i in np.argsort(-heights, kind="stable"):
        if not np.isfinite(heights[i]):
            continue
        hill = next((k for k in distinct if _same_hill(landscape, tops[k], tops[i], heights[i])), int(i))
        if hill == i:
            distinct.append(hill)
        if i == 0:  # the given design is the first that was climbed from
            of_given = hill
    return tuple(Valley(space.settled(tops[i]), float(heights[i]), given=i == of_given) for i in distinct)


def combinations(space: DesignSpace) -> float:
    """Number of combinations of whole numbers, at least 1."""
    lower, upper = (bound[space.whole] for bound in space.outermost)
    return float(np.prod(upper - lower + 1.0))


def _samples(space: DesignSpace, rng: np.random.Generator) -> Array:
    """Feasible points (n, np), with every combination of few whole numbers."""
    moving = np.flatnonzero(space.free)
    points = np.zeros((0, space.dim))
    if combinations(space) > CLIMBED_COMBINATIONS or not space.integer:
        spread = _spread(len(moving), rng)
        points = np.zeros((len(spread), space.dim))
        points[:, moving] = spread
        return _feasible(space, space.allowed.rounded(points))
    within = np.flatnonzero(space.allowed.free)
    spread = _spread(len(within), rng) if len(within) else np.zeros((1, 0))
    for numbers in space.allowed.combinations():
        part = np.tile(numbers, (len(spread), 1))
        part[:, within] = spread
        points = np.vstack([points, part])
    return _feasible(space, points)


def _spread(size: int, rng: np.random.Generator) -> Array:
    """Sobol points (n, size) of the unit box, and few corners."""
    points = qmc.Sobol(size, rng=rng).random(MAP_POINTS.get(size, 128))
    return np.vstack([points, list(product((0.0, 1.0), repeat=size))]) if size in MAP_POINTS else points


def _feasible(space: DesignSpace, V: Array) -> Array:
    """Points (n, np) moved to the nearest feasible ones."""
    V = V.copy()
    for i in np.flatnonzero(space.allowed.violation(V) > 0):
        found = space.allowed.near_with(V[i])
        V[i] = V[i] if found is None else found
    return V


def _hilltops_by_combination(landscape: Landscape, V: Array, J: Array) -> tuple[Array, Array, list[int]]:
    """Points (n, np), returns, and the best combinations' highest optima."""
    space = landscape.problem.design
    if combinations(space) > CLIMBED_COMBINATIONS:
        first = np.argsort(-J, kind="stable")[:MOST_CLIMBED]
        visited = [_climbed(landscape, V[[i]], J[[i]], across=True, seen=True) for i in first]
        V = np.vstack([V, *(points for points, _ in visited)])
        J = np.concatenate([J, *(returns for _, returns in visited)])
    keys, which = np.unique(np.round(V[:, space.whole], 9), axis=0, return_inverse=True)
    groups = [np.flatnonzero(which.ravel() == k) for k in range(len(keys))]
    best = sorted((group for group in groups if np.isfinite(J[group]).any()), key=lambda group: -J[group].max())
    tops = (group[_hilltops(V[group], J[group])[:2]] for group in best[:CLIMBED_COMBINATIONS])
    return V, J, [int(i) for top in tops for i in top]


def _hilltops(V: Array, J: Array) -> list[int]:
    """Indices of the points higher than all neighbours, highest first."""
    neighbours = min(len(V), 2 * V.shape[1] + 2)
    _, near = cKDTree(V).query(V, k=neighbours)
    tops = [i for i in range(len(V)) if np.isfinite(J[i]) and J[i] >= J[near[i]].max()]
    return sorted(tops, key=lambda i: -J[i])


def _climbed(
    landscape: Landscape, V: Array, J: Array, *, across: bool = False, seen: bool = False
) -> tuple[Array, Array]:
    """Ends of compass searches and their returns, `across` whole numbers too; if `seen`, all points looked at."""
    space = landscape.problem.design
    V = V.copy()
    J = J.copy()
    size = V.shape[1]
    moving = space.free if across else space.allowed.free
    least = np.where(space.whole, 1.0 / space.allowed.width, 0.0)
    compass = np.vstack([np.eye(size)[moving], -np.eye(size)[moving]])
    step = np.full(len(V), 0.1 if len(compass) else 0.0)
    looked = [(V.copy(), J.copy())]
    for _ in range(60):  # rounds at most
        climbing = np.flatnonzero(step >= COMPASS_LAST_STEP)
        if not len(climbing):
            break
        places = [_about(space, V[i], compass * np.maximum(step[i], least), step[i]) for i in climbing]
        tried = np.vstack(places)
        returns = landscape.returns(tried)
        looked.append((tried, returns))
        first = 0
        for i, place in zip(climbing, places):
            best = first + int(returns[first : first + len(place)].argmax())
            first += len(place)
            if returns[best] > J[i]:
                V[i] = tried[best]
                J[i] = returns[best]
            else:
                step[i] /= 2
    if seen:
        return np.vstack([points for points, _ in looked]), np.concatenate([values for _, values in looked])
    return V, J


def _about(space: DesignSpace, v: Array, moves: Array, reach: float) -> Array:
    """Feasible points (n, np) after moves (m, np) from a point.

    Beside a constraint they are made once more with the other entries giving way along it: of a budget that is spent,
    what one entry leaves goes to another.
    """
    limits = space.allowed.limits
    if limits is not None:
        normals, distances = limits.edges(v)
        close = np.abs(distances) <= reach
        if close.any():
            J = normals[close]
            others = space.allowed.free & (moves == 0)
            along = [move - np.linalg.pinv(J * other) @ (J @ move) for move, other in zip(moves, others)]
            moves = np.vstack([moves, *along])
    return _feasible(space, space.allowed.rounded(np.clip(v + moves, 0.0, 1.0)))


def _same_hill(landscape: Landscape, higher: Array, lower: Array, height: float) -> bool:
    """True if no ridge parts two local optima on a straight path."""
    whole = landscape.problem.design.whole
    if not np.array_equal(np.round(higher[whole], 9), np.round(lower[whole], 9)):
        return False
    if np.abs(higher - lower).max(initial=0.0) <= 2 * COMPASS_LAST_STEP:
        return True
    shares = np.linspace(0, 1, 11)[1:-1, None]  # of the way
    between = landscape.returns(lower + shares * (higher - lower))
    problem = landscape.problem
    size = problem.made_by_control(height, problem.design.from_unit(lower))
    return bool(between.min() >= height - RIDGE * size)


def start_points(space: DesignSpace, design: Array, found: tuple[Valley, ...], most: int) -> list[Array]:
    """Starting points: the given design and the best other optima."""
    starts = [space.allowed.rounded(space.to_unit(design))]
    for valley in found:
        v = space.to_unit(valley.design)
        if len(starts) < most and all(np.abs(v - one).max() > SAME_PLACE for one in starts):
            starts.append(v)
    return starts
