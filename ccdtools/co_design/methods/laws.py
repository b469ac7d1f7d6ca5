"""Control laws of a design, for the loops of nested search."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import HORIZON, linear_mpc, nonlinear_mpc, saturated_lqr
from ccdtools.co_design.design_sensitivity import regulator_of
from ccdtools.co_design.differentiable_model import ScenarioTensors
from ccdtools.co_design.episodes import Law
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.secant import fitted
from ccdtools.controllers.controllers import Controller, Passive


@dataclass(frozen=True)
class PassiveLaw:
    """Law u = 0 of the plant alone."""

    words = "the passive plant"
    differentiable = True

    def law(self, problem: CoDesignProblem, p: Tensor) -> Law:
        """Law without input."""
        return lambda x: x.new_zeros(len(x), problem.model.nu)

    def controller(self, problem: CoDesignProblem, p: Array) -> Controller:
        """Controller without input."""
        return Passive(problem.model.nu)


@dataclass(frozen=True)
class LQRLaw:
    """Law u = clip(−K(p) x), K(p) by each design's Riccati equation."""

    words = "saturated LQR"
    differentiable = True

    def law(self, problem: CoDesignProblem, p: Tensor) -> Law:
        """Saturated LQR with exact, differentiable gain."""
        K: Tensor = _Gain.apply(p, problem)
        low, high = problem.input_bounds_at(p)
        low, high = (torch.as_tensor(bound, dtype=torch.float64) for bound in (low, high))
        return lambda x: torch.clamp(-x @ K.T, low, high)

    def controller(self, problem: CoDesignProblem, p: Array) -> Controller:
        """Saturated LQR."""
        return saturated_lqr(problem, p)


class _OnLineLaw(ABC):
    """Controller made anew at every design and asked at every state."""

    differentiable = False

    @abstractmethod
    def controller(self, problem: CoDesignProblem, p: Array) -> Controller:
        """Controller of a design."""

    def law(self, problem: CoDesignProblem, p: Tensor) -> Law:
        """Law that gives a lost run no program to solve."""
        controller = self.controller(problem, p.detach().numpy())

        def law(x: Tensor) -> Tensor:
            """Inputs."""
            states = x.detach().numpy()
            lost = (np.abs(states) > problem.limit).any(axis=1)
            return x.new_tensor(controller(np.where(lost[:, None], 0.0, states)))

        return law


@dataclass(frozen=True, eq=False)
class SecantLaw(_OnLineLaw):
    """Saturated LQR of the linearisation over states that its loop visits.

    They are visited on given scenarios.
    """

    scenarios: ScenarioTensors
    words = "saturated LQR of the secant over the visited states"

    def controller(self, problem: CoDesignProblem, p: Array) -> Controller:
        """Saturated LQR."""
        return fitted(problem, p, self.scenarios).controller


@dataclass(frozen=True)
class MPCLaw(_OnLineLaw):
    """MPC of every design, on line; nonlinear by one real-time iteration per sample and run."""

    horizon: int = HORIZON
    nonlinear: bool = False

    @property
    def words(self) -> str:
        """Name of the MPC, with its horizon."""
        return f"{'nonlinear' if self.nonlinear else 'linear'} MPC (N = {self.horizon})"

    def controller(self, problem: CoDesignProblem, p: Array) -> Controller:
        """MPC of a design."""
        return (nonlinear_mpc if self.nonlinear else linear_mpc)(problem, p, horizon=self.horizon)


DesignLaw = PassiveLaw | LQRLaw | SecantLaw | MPCLaw
"""A controller for every design; `differentiable` says whether its inputs are, by state and design."""


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
