"""Sensitivity of optimal cost and law to the design, for LQR and MPC."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ccdtools.arrays import Array, Immutable
from ccdtools.co_design.design_controllers import HORIZON, named_step, regulator_data, weight_changes
from ccdtools.co_design.problem import CoDesignProblem, FixedStart
from ccdtools.design_limits import DesignLimits
from ccdtools.exceptions import InputError
from ccdtools_ground.door import as_choice, as_count, as_instance, as_vector
from mpc import LinearMPC, LQRSensitivity, PlanSensitivity, SensitivityStatus, lqr_sensitivity
from mpc.problem import MPCProblem
from mpc.sensitivities.changes import as_changes

CONTROLLERS = ("lqr", "mpc", "nmpc")

Detail: TypeAlias = LQRSensitivity | PlanSensitivity


@dataclass(frozen=True, eq=False, repr=False)
class DesignSensitivity(Immutable):
    """Derivatives of optimal cost and control law by state and design.

    Attributes
    ----------
    names : tuple of str
        Of the design parameters.
    design, x0 : (np,) and (nx,) arrays
    cost : float
        J*: of LQR x'Px, of MPC that of the horizon with its terminal cost. Without the cost of the design itself. With
        a stated mean of the disturbance x is counted from the rest under it, which moves with the design; what resting
        there costs in each step is no part of J*.
    cost_by_state, cost_by_design : (nx,) and (np,) arrays
    input_by_state, input_by_design : (nu, nx) and (nu, np) arrays
        Of the first input.
    status : SensitivityStatus
        Whether they hold on every side, with advice. LQR knows no limits: its derivatives always do.
    detail : LQRSensitivity or PlanSensitivity
        What they are taken from: all gains, or the whole plan with its active and weakly active constraints.
    """

    names: tuple[str, ...]
    design: Array
    x0: Array
    cost: float
    cost_by_state: Array
    cost_by_design: Array
    input_by_state: Array
    input_by_design: Array
    status: SensitivityStatus
    detail: Detail

    def __repr__(self) -> str:
        slopes = ", ".join(f"{name}: {slope:.4g}" for name, slope in zip(self.names, self.cost_by_design))
        return f"DesignSensitivity(cost={self.cost:.6g}, by design: {slopes}, status={self.status.name})"

    @property
    def elasticities(self) -> Array:
        """Change of J* [%] per per cent of each parameter (np,); 0 if J* is 0."""
        return self.cost_by_design * self.design / self.cost if self.cost else np.zeros_like(self.design)


def design_sensitivity(
    problem: CoDesignProblem, design: ArrayLike, x0: ArrayLike | None = None, *, controller: str = "lqr",
    horizon: int = HORIZON,
) -> DesignSensitivity:  # fmt: skip
    """Exact slopes of optimal cost and law by the design, without noise.

    Parameters
    ----------
    problem : CoDesignProblem
        Model, weights and limits, with what of them depends on the design.
    design : (np,) array
    x0 : (nx,) array, optional
        The state; by default that of a problem with a `FixedStart`.
    controller : {"lqr", "mpc", "nmpc"}
        "lqr": infinite horizon, without limits, by the differentiated Riccati equation. "mpc": with the limits at the
        design, of the linearisation; "nmpc": of the model itself; both by the differentiated optimality conditions.
        Their terminal cost is the Riccati solution, which changes with the design too.
    horizon : int
        Of MPC [steps].

    Returns
    -------
    DesignSensitivity
        Finite differences are never taken: the model's derivatives are CasADi's.

    Raises
    ------
    InputError
        If an argument is none of these, or MPC is asked for limits of outputs, whose derivatives are not known.
    NotStabilisableError
        If the design cannot be stabilised, see `mpc.lqr`.

    Examples
    --------
    >>> found = design_sensitivity(problem, p, x0)
    >>> found.cost_by_design, found.input_by_state
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_choice("controller", controller, CONTROLLERS)
    horizon = as_count("horizon", horizon)
    p = problem.design.check_one(design)
    if x0 is None:
        if not isinstance(problem.scenarios, FixedStart):
            raise InputError("x0", "nothing", f"a state ({problem.model.nx},), because the problem has no FixedStart")
        x0 = problem.scenarios.x0
    x = as_vector("x0", x0, problem.model.nx, of="one per state")
    names = tuple(problem.design.names)
    changes = weight_changes(problem, p)
    weights = problem.weights(p).keywords() | {"horizon": horizon}
    mean = problem.mean_disturbance
    if mean.any():
        weights |= {"E": problem.model.matrices(p)[2], "mean": mean}
        changes |= {"dE": problem.model.derivatives(p)[2]}
    if controller == "lqr":
        data = regulator_data(problem, p)
        found = lqr_sensitivity(**data)
        settled = MPCProblem(data["A"], data["B"], **weights, P=found.P)
        moves = as_changes(settled, {"dA": data["dA"], "dB": data["dB"], **changes}, settles=True).reference
        moves_x, moves_u = np.split(moves, [len(x)])
        away, gain = x - settled.rest[0], found.input_by_state
        slope = found.cost_by_state(away)
        return DesignSensitivity(
            names, p, x, found.cost(away), slope, found.cost_by_parameters(away) - slope @ moves_x, gain,
            found.input_by_parameters(away) - gain @ moves_x + moves_u, SensitivityStatus.SMOOTH, found,
        )  # fmt: skip
    plan = _of_mpc(problem, p, x, controller, weights, changes)
    return DesignSensitivity(
        names, p, x, plan.plan.cost, plan.cost_by_state, plan.cost_by_parameters, plan.input_by_state,
        plan.input_by_parameters, plan.status, plan,
    )  # fmt: skip


def _of_mpc(
    problem: CoDesignProblem, p: Array, x: Array, controller: str, weights: dict[str, Any], changes: dict[str, Array]
) -> PlanSensitivity:
    """Derivatives of the plan of linear or nonlinear MPC."""
    if problem.output_limits is not None:
        cure = 'LQR has none: controller="lqr".'
        raise InputError("problem", "limits of outputs", "limits of states and inputs alone", cure)
    limits: dict[str, Any] = {"X": problem.state_limits(p), "U": problem.input_limits(p)}
    moved: dict[str, Any] = {
        f"d{name}": _bound_changes(limits[name], own, p)
        for name, own in (("X", problem.X), ("U", problem.U))
        if isinstance(own, DesignLimits)
    }
    if controller == "mpc":
        A, B, _ = problem.model.matrices(p)
        dA, dB, _ = problem.model.derivatives(p)
        return LinearMPC(A, B, **weights, **limits).sensitivity(x, dA=dA, dB=dB, **changes, **moved)
    from mpc.optimal_control import NonlinearMPC

    model = problem.model
    own: dict[str, Any] = {name: value for name, value in {**changes, **moved}.items() if name != "dE"}
    stated = {name: value for name, value in weights.items() if name != "E"} | limits
    disturbed = "E" in weights
    stated |= {"disturbances": model.nw} if disturbed else {}
    return NonlinearMPC(named_step(model, disturbed=disturbed), model.nx, model.nu, p=p, **stated).sensitivity(x, **own)


def _bound_changes(limits: Any, own: DesignLimits, p: Array) -> Array:
    """Slopes ∂b/∂p (rows, np) of the facets a'v <= b of a box."""
    bounds = own.both.function(own.entries)
    symbol = ca.SX.sym("p", own.entries)
    J = np.asarray(ca.Function("changes", [symbol], [ca.densify(ca.jacobian(bounds(symbol), symbol))])(p), dtype=float)
    lower, upper = np.split(J, 2)
    rows = np.asarray(limits.A)
    changes: Array = np.maximum(rows, 0.0) @ upper - np.maximum(-rows, 0.0) @ lower
    return changes
