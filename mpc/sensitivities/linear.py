"""How linear MPC changes with its first state and with the parameters of its model, weights and limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array
from mpc.exceptions import InputError
from mpc.plan import Plan
from mpc.problem import MPCProblem
from mpc.rollout import Given, pushes
from mpc.sensitivities.along_plan import Changes, sensitivity_of
from mpc.sensitivities.derivatives import as_derivatives
from mpc.sensitivities.plan_sensitivity import PlanSensitivity
from mpc.sensitivities.regulator import lqr_sensitivity


def linear_sensitivity(
    problem: MPCProblem, plan: Plan, given: Given, derivatives: dict[str, ArrayLike | None]
) -> PlanSensitivity:
    """Derivatives of a plan of linear MPC; see `LinearMPC.sensitivity`."""
    nx, nu, nw = problem.nx, problem.nu, problem.nw
    if derivatives["dE"] is not None and not nw:
        raise InputError("dE", "a derivative", "none", "The controller has no disturbance matrix E.")
    if derivatives["dP"] is not None and problem.given_P is None:
        cure = "It is the Riccati solution here, whose derivative follows from the others."
        raise InputError("dP", "a derivative", "none, because no P was given", cure)
    rows = {"dX": len(problem.state_rows[1]), "dU": len(problem.input_rows[1]),
            "d_terminal_set": len(problem.terminal_rows[1]),
            "d_rate_limit": 0 if problem.rate_limit is None else nu}  # fmt: skip
    shapes = {"dA": (nx, nx), "dB": (nx, nu), "dE": (nx, nw), "dQ": (nx, nx), "dR": (nu, nu), "dS": (nx, nu),
              "dP": (nx, nx), **{name: (count,) for name, count in rows.items()}}  # fmt: skip
    found = as_derivatives(
        {name: (derivatives[name], shape) for name, shape in shapes.items()}, symmetric=("dQ", "dR", "dP")
    )
    if problem.given_P is None:
        own = {name: found[name] for name in ("dA", "dB", "dQ", "dR", "dS")}
        found["dP"] = lqr_sensitivity(problem.A, problem.B, Q=problem.Q, R=problem.R, S=problem.S, **own).dP
    bounds = {"state": found["dX"], "input": found["dU"], "terminal": found["d_terminal_set"],
              "rate": np.tile(found["d_rate_limit"], (2, 1))}  # fmt: skip
    changes = Changes(found["dQ"], found["dR"], found["dS"], found["dP"], bounds)
    return sensitivity_of(problem, _LinearModel(problem, given, found), changes, plan, given)


class _LinearModel:
    """Derivatives of x⁺ = Ax + Bu + Ew along a plan."""

    def __init__(self, problem: MPCProblem, given: Given, changes: dict[str, Array]) -> None:
        self._problem = problem
        self._push = pushes(problem, given)
        self._changes = changes
        w = given["w"].reshape(problem.horizon, -1) if "w" in given else np.zeros((problem.horizon, problem.nw))
        self._pushed = np.einsum("xwp,kw->kxp", changes["dE"], w)

    def first(self, states: Array, inputs: Array) -> tuple[Array, Array, Array, Array]:
        """f, ∂f/∂x, ∂f/∂u and ∂f/∂p."""
        A, B, N = self._problem.A, self._problem.B, len(inputs)
        by_parameters = np.einsum("xyp,ky->kxp", self._changes["dA"], states) + self._pushed
        by_parameters += np.einsum("xup,ku->kxp", self._changes["dB"], inputs)
        after = states @ A.T + inputs @ B.T + self._push
        return after, np.broadcast_to(A, (N, *A.shape)), np.broadcast_to(B, (N, *B.shape)), by_parameters

    def second(self, states: Array, inputs: Array, costates: Array) -> tuple[Array, Array]:
        """No curvature, but what costates make of the changes of A and B."""
        size = states.shape[1] + inputs.shape[1]
        mixed = [np.einsum("kx,xyp->kyp", costates, self._changes[name]) for name in ("dA", "dB")]
        return np.zeros((len(inputs), size, size)), np.concatenate(mixed, axis=1)
