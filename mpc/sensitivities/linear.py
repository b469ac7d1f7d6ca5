"""Derivatives of linear MPC by its state and parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mpc.checks import Array
from mpc.plan import Plan
from mpc.problem import MPCProblem
from mpc.rollout import Given, pushes
from mpc.sensitivities.along_plan import sensitivity_of
from mpc.sensitivities.changes import as_changes
from mpc.sensitivities.plan_sensitivity import PlanSensitivity


def linear_sensitivity(
    problem: MPCProblem, plan: Plan, given: Given, derivatives: dict[str, ArrayLike | None]
) -> PlanSensitivity:
    """Derivatives of a plan of linear MPC; see `LinearMPC.sensitivity`."""
    changes = as_changes(problem, derivatives)
    return sensitivity_of(problem, _LinearModel(problem, given, changes.model), changes, plan, given)


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
        """Curvature, which is zero, and mixed derivatives by parameters."""
        size = states.shape[1] + inputs.shape[1]
        mixed = [np.einsum("kx,xyp->kyp", costates, self._changes[name]) for name in ("dA", "dB")]
        return np.zeros((len(inputs), size, size)), np.concatenate(mixed, axis=1)
