"""Expected cost of unsaturated LQR, by the Riccati equation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.custom_objective import CustomObjective
from ccdtools.co_design.design_controllers import regulator_data, saturated_lqr
from ccdtools.co_design.design_search import DesignCost
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.co_design.risk import Mean
from ccdtools.controllers.controllers import Controller
from ccdtools.exceptions import InputError
from mpc import NotStabilisableError, lqr_sensitivity


@dataclass(eq=False)
class RiccatiCost(DesignCost):
    """Cost E[x0ᵀ P x0] + T tr(P E W Eᵀ), plus the design's, with exact slope.

    What the episodes of a linear model cost to the end of time, if inputs never saturate and the disturbance is white
    with covariance W. Of a model that is not linear it is that of its linearisation at rest, and of a cost that is not
    quadratic that of its expansion there, with what rest itself costs.

    Raises
    ------
    InputError
        If the problem has a learned error, a warm-up, a risk other than the mean, or an objective whose rewards are not
        those of the weights that LQR takes.
    """

    words = "LQR without saturation, by the Riccati equation"

    def __post_init__(self) -> None:
        problem = self.problem
        objective = problem.objective
        own = isinstance(objective, QuadraticObjective) and type(objective).rewards is not QuadraticObjective.rewards
        given = isinstance(objective, CustomObjective) and objective.Q is not None
        refused = {"a learned error of its model": problem.discrepancy is not None,
                   f"the risk {problem.risk!r}": not isinstance(problem.risk, Mean),
                   "an objective with rewards of its own": own,
                   "weights Q and R in the place of those of its cost": given,
                   "a warm-up": problem.warm_up > 0}  # fmt: skip
        for got, is_so in refused.items():
            if is_so:
                cure = "Nested('lqr') simulates the problem as it is."
                raise InputError("method", f"the Riccati equation for a problem with {got}", "one of mean costs", cure)

    def __call__(self, v: Array) -> tuple[float, Callable[[], Array]]:
        """Cost and slope (np,) at a point (np,); infinite without LQR."""
        problem = self.problem
        p = problem.design.from_unit(v)
        try:
            found = lqr_sensitivity(**regulator_data(problem, p))
        except NotStabilisableError:
            return np.inf, lambda: np.zeros(len(v))
        E, dE = problem.model.matrices(p)[2], problem.model.derivatives(p)[2]
        mean, covariance, noise = problem.moments
        noise = noise + np.outer(problem.mean_disturbance, problem.mean_disturbance)
        starts = covariance + np.outer(mean, mean)
        spread = starts + problem.steps * (E @ noise @ E.T)
        objective = problem.objective  # of the first states, next-state rewards count nothing
        first = float(np.sum(objective.Q * starts)) if isinstance(objective, QuadraticObjective) else 0.0
        cost = float(np.sum(found.P * spread)) - first
        slope = np.einsum("xyp,xy->p", found.dP, spread)
        slope = slope + 2 * problem.steps * np.einsum("xy,ywp,wv,xv->p", found.P, dE, noise, E)
        at_rest, rest_slope = self._at_rest(p)
        value = cost + at_rest
        self.remember(p, -value)
        return value, lambda: (slope + rest_slope) * problem.design.allowed.width

    def _at_rest(self, p: Array) -> tuple[float, Array]:
        """Cost of the design and an episode at rest, with slope (np,)."""
        nx, nu, size = self.problem.model.nx, self.problem.model.nu, len(p)
        objective, steps = self.problem.objective, self.problem.steps
        symbol = ca.SX.sym("p", size)
        value = ca.SX(0.0)
        if objective.design_cost is not None:
            value += objective.design_cost.function(size)(symbol) * (steps / (objective.episode or steps))
        if isinstance(objective, CustomObjective):
            value += steps * objective.stage_cost.function(nx, nu, size)(ca.DM.zeros(nx), ca.DM.zeros(nu), symbol)
            if objective.terminal_cost is not None:
                value += objective.terminal_cost.function(nx, size)(ca.DM.zeros(nx), symbol)
        both = ca.Function("cost", [symbol], [value, ca.densify(ca.gradient(value, symbol))])(p)
        return float(both[0]), np.asarray(both[1], dtype=float).ravel()

    def controller(self, p: Array) -> Controller:
        """LQR of a design, saturated where needed."""
        return saturated_lqr(self.problem, p)
