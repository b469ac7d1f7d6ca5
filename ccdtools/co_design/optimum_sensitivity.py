"""Movement of the best design with a datum, by solving anew."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable
from ccdtools.co_design.codesign import codesign
from ccdtools.co_design.design_controllers import LQR
from ccdtools.co_design.design_search import DesignCost, best_design
from ccdtools.co_design.differentiable_model import fewer_runs, scenario_tensors
from ccdtools.co_design.methods.loop_cost import LoopCost
from ccdtools.co_design.methods.nested import RUNS, Nested
from ccdtools.co_design.methods.riccati_cost import RiccatiCost
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import SAME_SENSITIVITY, SMALL_SENSITIVITY
from ccdtools.co_design.trade_off import ProblemOf, stated
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_choice, as_count, as_number, as_share, shown

INNER = ("lqr", "riccati")


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class OptimumSensitivity(Immutable):
    """Movement of the best design with a value θ.

    Attributes
    ----------
    value : float
    design : (np,) array
        The best one at θ.
    slope : (np,) array
        dp*/dθ: the central difference of the best designs beside θ.
    ahead, behind : (np,) arrays
        The same to either side; they differ where the design meets or leaves a bound, or is one of many.
    return_slope : float
        d(return)/dθ of the best design.
    held : tuple of str
        Active bounds and constraints, which the design moves along.
    width : (np,) array
        Of the box.
    names : tuple of str
    """

    value: float
    design: Array
    slope: Array
    ahead: Array
    behind: Array
    return_slope: float
    held: tuple[str, ...]
    width: Array
    names: tuple[str, ...]

    @property
    def agrees(self) -> bool:
        """True if the slopes to both sides agree within a tenth."""
        size = max(abs(self.value), np.finfo(float).tiny)
        gap, slope = ((part / self.width) * size for part in (self.ahead - self.behind, self.slope))
        return bool(np.linalg.norm(gap) <= SAME_SENSITIVITY * np.linalg.norm(slope) + SMALL_SENSITIVITY)

    def __repr__(self) -> str:
        sides = zip(self.names, self.slope, self.behind, self.ahead)
        parts = ", ".join(
            f"d{name}/dθ {slope:.4g}" + ("" if self.agrees else f" ({behind:.4g} behind, {ahead:.4g} ahead)")
            for name, slope, behind, ahead in sides
        )
        held = f", held by {', '.join(self.held)}" if self.held else ""
        return f"OptimumSensitivity(θ = {self.value:g}: {parts}{held})"


def optimum_sensitivity(
    problem_of: ProblemOf, value: float, *, design: ArrayLike | None = None, inner: str = "lqr", step: float = 0.02,
    runs: int | None = None, seed: int = 0,
) -> OptimumSensitivity:  # fmt: skip
    """Slope dp*/dθ of the best nested design, by a value θ.

    The best designs of θ and of a little more and less are searched along exact slopes on the same scenarios. Bounds,
    constraints and scenarios may depend on θ too. Limits on states are counted in it as far as the objective counts
    them.

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
    problem = stated(problem_of, theta, argument="problem_of")
    space = problem.design
    if design is None:
        design = codesign(problem, method=Nested(inner), rng=np.random.default_rng(seed)).design
    best, _ = _best(problem, space.check_feasible(design), inner, count, seed)
    beside = []
    for side in (1, -1):
        other = stated(problem_of, theta + side * change, argument="problem_of")
        if other.design.dim != space.dim:
            got = f"{other.design.dim} design parameters at {theta + side * change:g}"
            raise InputError("problem_of", got, f"{space.dim}")
        beside.append(_best(other, best, inner, count, seed))
    (above, more), (below, less) = beside
    return OptimumSensitivity(
        value=theta, design=best, slope=(above - below) / (2 * change), ahead=(above - best) / change,
        behind=(best - below) / change, return_slope=(less - more) / (2 * change),
        held=(*(f"{name} {end}" for name, end in space.active_bounds(best).items()), *space.active_constraints(best)),
        width=space.allowed.width, names=tuple(space.names),
    )  # fmt: skip


def _best(problem: CoDesignProblem, design: Array, inner: str, runs: int, seed: int) -> tuple[Array, float]:
    """Best design (np,) found by a search, and its cost."""
    unlimited = replace(problem, limit_tolerance="off")
    space = problem.design
    rng = np.random.default_rng(seed)

    def cost_from(v: Array) -> DesignCost:
        """Cost that is least at the best design."""
        if inner == "riccati":
            return RiccatiCost(unlimited)
        return LoopCost(unlimited, LQR, scenario_tensors(problem, fewer_runs(runs, problem.steps), rng))

    begun = space.from_unit(space.to_unit(design))  # the box may be another one
    found = best_design(unlimited, cost_from, begun, rng, name=inner, starts=1, evaluations=100)
    return found.design, -found.objective
