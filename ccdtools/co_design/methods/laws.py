"""Control laws of a design, for the loops of nested search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import HORIZON, linear_mpc, nonlinear_mpc, regulator_of, saturated_lqr
from ccdtools.co_design.differentiable_model import ScenarioTensors
from ccdtools.co_design.episodes import Law
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.secant import fitted
from ccdtools.controllers.controllers import Controller, Passive


@dataclass(frozen=True, eq=False)
class DesignLaw:
    """Control law for every design.

    Attributes
    ----------
    words : str
    controller : callable
        Problem and design (np,) → controller.
    exact : callable, optional
        Problem and design tensor (np,) → the same law, differentiable by state and design; by default the controller is
        made anew at every design and asked at every state.
    """

    words: str
    controller: Callable[[CoDesignProblem, Array], Controller]
    exact: Callable[[CoDesignProblem, Tensor], Law] | None = None

    def on_line(self, problem: CoDesignProblem, p: Tensor) -> Law:
        """Controller of a design (np,) as a law; a lost run is given no program to solve."""
        controller = self.controller(problem, p.detach().numpy())

        def law(x: Tensor) -> Tensor:
            """Inputs."""
            states = x.detach().numpy()
            lost = (np.abs(states) > problem.limit).any(axis=1)
            return x.new_tensor(controller(np.where(lost[:, None], 0.0, states)))

        return law


class _Gain(torch.autograd.Function):
    """K(p) (nu, nx) of the regulator, with its exact derivative."""

    @staticmethod
    def forward(ctx: Any, p: Tensor, problem: CoDesignProblem) -> Tensor:
        """Gain."""
        at = p.detach().numpy()
        if not ctx.needs_input_grad[0]:
            return torch.tensor(saturated_lqr(problem, at).K)
        found = regulator_of(problem, at)
        ctx.slopes = torch.tensor(found.dK)
        return torch.tensor(found.K)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """Gradient (np,) by the design, by the chain rule."""
        return torch.einsum("ux,uxp->p", gradient, ctx.slopes), None


def _clipped(problem: CoDesignProblem, p: Tensor) -> Law:
    """Law u = clip(−K(p) x), K(p) by each design's Riccati equation."""
    K: Tensor = _Gain.apply(p, problem)
    low, high = (torch.as_tensor(bound, dtype=torch.float64) for bound in problem.input_bounds_at(p))
    return lambda x: torch.clamp(-x @ K.T, low, high)


PASSIVE = DesignLaw(
    "the passive plant", lambda problem, p: Passive(problem.model.nu),
    lambda problem, p: lambda x: x.new_zeros(len(x), problem.model.nu),
)  # fmt: skip
LQR = DesignLaw("saturated LQR", saturated_lqr, _clipped)


def secant_law(scenarios: ScenarioTensors) -> DesignLaw:
    """Saturated LQR of the linearisation over the states that its loop visits in given scenarios."""
    words = "saturated LQR of the secant over the visited states"
    return DesignLaw(words, lambda problem, p: fitted(problem, p, scenarios).controller)


def mpc_law(horizon: int = HORIZON, *, nonlinear: bool = False) -> DesignLaw:
    """MPC of every design, on line; nonlinear by one real-time iteration per sample and run."""
    made = nonlinear_mpc if nonlinear else linear_mpc
    words = f"{'nonlinear' if nonlinear else 'linear'} MPC (N = {horizon})"
    return DesignLaw(words, lambda problem, p: made(problem, p, horizon=horizon))
