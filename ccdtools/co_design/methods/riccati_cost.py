"""The expected cost of LQR that never saturates, by the Riccati equation: exact, without a single simulation."""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import saturated_lqr
from ccdtools.co_design.design_sensitivity import regulator_of
from ccdtools.co_design.objective import QuadraticObjective
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import History
from ccdtools.co_design.risk import Mean
from ccdtools.controllers.controllers import Controller
from ccdtools.exceptions import InputError
from mpc import NotStabilisableError

SAMPLES = 4096  # starts and disturbances that their second moments are taken from
SEED = 0


@dataclass(eq=False)
class RiccatiCost:
    """E[x0ᵀ P x0] + T tr(P E W Eᵀ) and the cost of the design, with its exact slope.

    What the episodes of a linear model cost to the end of time, if inputs never saturate and the disturbance is white
    with covariance W. Of a model that is not linear it is that of its linearisation at rest.

    Raises
    ------
    InputError
        If the problem has a learned error, a warm-up, a risk other than the mean, or rewards of its own.
    """

    problem: CoDesignProblem
    rows: list[tuple] = field(default_factory=list)
    words = "LQR without saturation, by the Riccati equation"

    def __post_init__(self) -> None:
        problem = self.problem
        objective = problem.objective
        own = isinstance(objective, QuadraticObjective) and type(objective).rewards is not QuadraticObjective.rewards
        refused = {"a learned error of its model": problem.discrepancy is not None,
                   f"the risk {problem.risk!r}": not isinstance(problem.risk, Mean),
                   "an objective with rewards of its own": own, "a warm-up": problem.warm_up > 0}  # fmt: skip
        for got, is_so in refused.items():
            if is_so:
                cure = "Nested('lqr') simulates the problem as it is."
                raise InputError("method", f"the Riccati equation for a problem with {got}", "one of mean costs", cure)
        x0, w = problem.scenarios.sample(SAMPLES, problem.steps, np.random.default_rng(SEED))
        self._starts = x0.T @ x0 / len(x0)
        self._noise = np.einsum("nti,ntj->ij", w, w) / (w.shape[0] * w.shape[1])

    def __call__(self, v: Array) -> tuple[float, Array]:
        """Cost and its slope (np,) at a point (np,) of the unit box; infinite where there is no LQR."""
        problem = self.problem
        p = problem.design.from_unit(v)
        try:
            found = regulator_of(problem, p)
        except NotStabilisableError:
            return np.inf, np.zeros(len(v))
        E, dE = problem.model.matrices(p)[2], problem.model.derivatives(p)[2]
        spread = self._starts + problem.steps * (E @ self._noise @ E.T)
        cost = float(np.sum(found.P * spread)) - self._first()
        slope = np.einsum("xyp,xy->p", found.dP, spread)
        slope = slope + 2 * problem.steps * np.einsum("xy,ywp,wv,xv->p", found.P, dE, self._noise, E)
        design_cost, design_slope = self._of_design(p)
        value = cost + design_cost
        count = len(self.rows) + 1
        self.rows.append((count, count, p, -value, 0.0, 0.0))
        return value, (slope + design_slope) * problem.design.allowed.width

    def _first(self) -> float:
        """What the first states cost, which rewards of next states leave out."""
        objective = self.problem.objective
        return float(np.sum(objective.Q * self._starts)) if isinstance(objective, QuadraticObjective) else 0.0

    def _of_design(self, p: Array) -> tuple[float, Array]:
        """What the design costs, and its slope (np,)."""
        given = self.problem.objective.design_cost
        if given is None:
            return 0.0, np.zeros(len(p))
        symbol = ca.SX.sym("p", len(p))
        value = given.function(len(p))(symbol)
        both = ca.Function("cost", [symbol], [value, ca.densify(ca.gradient(value, symbol))])(p)
        share = self.problem.steps / (self.problem.objective.episode or self.problem.steps)
        return float(both[0]) * share, np.asarray(both[1], dtype=float).ravel() * share

    @property
    def evaluations(self) -> int:
        """How many there were."""
        return len(self.rows)

    def controller(self, p: Array) -> Controller:
        """The LQR of a design, saturated where it must be."""
        return saturated_lqr(self.problem, p)

    def history(self) -> History:
        """All evaluations so far."""
        return History(*(np.array(column) for column in zip(*self.rows)))
