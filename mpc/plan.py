"""Result of an MPC solve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ccdtools_ground.outcome import Outcome
from mpc.checks import Array


class Status(Outcome):
    """Outcome of a solve; the value is the advice."""

    SOLVED = "Solved: the optimality conditions hold to the tolerance."
    SOFTENED = "Infeasible: state constraints were relaxed by the least amount. Ask `explain(x)` which ones conflict."
    INFEASIBLE = "Infeasible even without state constraints. Check that U and the rate limits are compatible."
    INACCURATE = "No solver met the tolerance; the best iterate is returned. Rescale the data or shorten the horizon."
    FOLLOWED = "A real-time iteration: a step towards the optimum, not the optimum. The residuals say how far it was."
    LATE = (
        "The time limit was up: the best of what was reached, the plan of the sample before and the linear law stands "
        "in, see `solver`. Allow more time, shorten the horizon, or set iterations=1."
    )
    REPLACED = (
        "No plan was found: that of the sample before, shifted, or that of the linear law stands in, see `solver`. "
        "Check that the model is finite and smooth within the limits."
    )


@dataclass(frozen=True)
class Residuals:
    """Relative optimality residuals, independent of the solver [-]."""

    stationarity: float
    primal: float
    dual: float
    complementarity: float

    @property
    def worst(self) -> float:
        """Largest of the four; NaN counts as infinite."""
        values = (self.stationarity, self.primal, self.dual, self.complementarity)
        return float(max(v if np.isfinite(v) else np.inf for v in values))


@dataclass(frozen=True, eq=False)
class Plan:
    """Optimal inputs and the states they lead to.

    Attributes
    ----------
    inputs : (N, nu) array
        u_0 … u_{N-1}, in the units of the plant.
    states : (N + 1, nx) array
        x_0 … x_N predicted with the model.
    cost : float
        Σ x'Qx + u'Ru plus the terminal cost and the price of soft constraints, of these inputs and states.
    status : Status
    residuals : Residuals
        Optimality residuals; for a softened plan those of the relaxed problem. Of a plan found stage by stage the
        stationarity is the largest Newton step left, in units of the inputs; of a nonlinear one they are those of the
        last program, and the primal one is the largest gap in the states before it, in their sizes.
    violation : float
        Largest violation of a state or terminal constraint a'x <= b by these states, in units of b; rounding or 0
        when solved with hard ones.
    solve_time : float
        Wall time [s].
    solver : str
        The solver that produced the result.
    costates : (N, nx) array or None
        Slopes of the cost by x_1 … x_N along the plan, of a nonlinear one by quadratic programs.
    pushes : (m,) array or None
        Multipliers of the limits of such a plan.
    hessian : (N + 1, nx + nu, nx + nu) array or None
        Of the Lagrangian at a nonlinear optimum, stage by stage, for the next sample; none where signals may change it.
    """

    inputs: Array
    states: Array
    cost: float
    status: Status
    residuals: Residuals
    violation: float
    solve_time: float
    solver: str
    costates: Array | None = None
    pushes: Array | None = None
    hessian: Array | None = None

    def __post_init__(self) -> None:
        self.inputs.flags.writeable = False
        self.states.flags.writeable = False
        for on in (self.costates, self.pushes, self.hessian):
            if on is not None:
                on.flags.writeable = False

    @property
    def feasible(self) -> bool:
        """Whether the problem was solved as posed; soft constraints may give."""
        return self.status is Status.SOLVED

    def __repr__(self) -> str:
        return (
            f"Plan(N={len(self.inputs)}, cost={self.cost:.6g}, status={self.status.name}, "
            f"kkt={self.residuals.worst:.1e}, time={1e3 * self.solve_time:.3f} ms, solver={self.solver})"
        )
