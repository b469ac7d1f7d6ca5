"""Control laws that belong to a design: what a nested search closes the loop with at every design it looks at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

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


class DesignLaw(Protocol):
    """A controller for every design, whose inputs can be differentiated by state and design."""

    @property
    def words(self) -> str:
        """What it is, in words."""
        ...

    @property
    def differentiable(self) -> bool:
        """Whether its inputs can be; if not, slopes are central differences of whole closed loops."""
        ...

    def law(self, problem: CoDesignProblem, p: Tensor) -> Law:
        """States (n, nx) → inputs (n, nu) at a design (np,), tensors in double precision, differentiable in both."""
        ...

    def controller(self, problem: CoDesignProblem, p: Array) -> Controller:
        """The same for use."""
        ...


@dataclass(frozen=True)
class PassiveLaw:
    """u = 0: what the plant does alone."""

    words = "the passive plant"
    differentiable = True

    def law(self, problem: CoDesignProblem, p: Tensor) -> Law:
        """No input."""
        return lambda x: x.new_zeros(len(x), problem.model.nu)

    def controller(self, problem: CoDesignProblem, p: Array) -> Controller:
        """No input."""
        return Passive(problem.model.nu)


@dataclass(frozen=True)
class LQRLaw:
    """u = clip(−K(p) x), K(p) of the Riccati equation of each design."""

    words = "saturated LQR"
    differentiable = True

    def law(self, problem: CoDesignProblem, p: Tensor) -> Law:
        """Saturated LQR, its gain exact and differentiable."""
        K: Tensor = _Gain.apply(p, problem)
        low, high = problem.input_bounds_at(p)
        low, high = (torch.as_tensor(bound, dtype=torch.float64) for bound in (low, high))
        return lambda x: torch.clamp(-x @ K.T, low, high)

    def controller(self, problem: CoDesignProblem, p: Array) -> Controller:
        """Saturated LQR."""
        return saturated_lqr(problem, p)


@dataclass(frozen=True, eq=False)
class SecantLaw:
    """Saturated LQR of the linearisation over the states that the loop of each design visits on given scenarios."""

    scenarios: ScenarioTensors
    words = "saturated LQR of the secant over the visited states"
    differentiable = False

    def law(self, problem: CoDesignProblem, p: Tensor) -> Law:
        """Fitted anew at every design."""
        return _on_line(self.controller(problem, p.detach().numpy()), problem.limit)

    def controller(self, problem: CoDesignProblem, p: Array) -> Controller:
        """Saturated LQR."""
        return fitted(problem, p, self.scenarios).controller


@dataclass(frozen=True)
class MPCLaw:
    """Linear MPC of every design, on line."""

    horizon: int = HORIZON
    differentiable = False

    @property
    def words(self) -> str:
        """What it is, in words."""
        return f"linear MPC (N = {self.horizon})"

    def law(self, problem: CoDesignProblem, p: Tensor) -> Law:
        """A program for every state."""
        return _on_line(self.controller(problem, p.detach().numpy()), problem.limit)

    def controller(self, problem: CoDesignProblem, p: Array) -> Controller:
        """The MPC of a design."""
        return linear_mpc(problem, p, horizon=self.horizon)


@dataclass(frozen=True)
class NonlinearMPCLaw:
    """Nonlinear MPC of every design, on line, by one real-time iteration a sample."""

    horizon: int = HORIZON
    differentiable = False

    @property
    def words(self) -> str:
        """What it is, in words."""
        return f"nonlinear MPC (N = {self.horizon})"

    def law(self, problem: CoDesignProblem, p: Tensor) -> Law:
        """A program for every state, each run with a plan of its own."""
        return _on_line(self.controller(problem, p.detach().numpy()), problem.limit)

    def controller(self, problem: CoDesignProblem, p: Array) -> Controller:
        """The MPC of a design."""
        return nonlinear_mpc(problem, p, horizon=self.horizon)


def _on_line(controller: Controller, limit: Array) -> Law:
    """A controller of the state as a law; a run beyond the divergence limit (nx,) is lost and costs no program."""

    def law(x: Tensor) -> Tensor:
        """The inputs."""
        states = x.detach().numpy()
        lost = (np.abs(states) > limit).any(axis=1)
        return x.new_tensor(controller(np.where(lost[:, None], 0.0, states)))

    return law


class _Gain(torch.autograd.Function):
    """K(p) (nu, nx) of the regulator, with its exact derivative."""

    @staticmethod
    def forward(ctx, p: Tensor, problem: CoDesignProblem) -> Tensor:
        """The gain."""
        at = p.detach().numpy()
        if not ctx.needs_input_grad[0]:
            return torch.tensor(saturated_lqr(problem, at).K)
        found = regulator_of(problem, at)
        ctx.slopes = torch.tensor(found.dK)
        return torch.tensor(found.K)

    @staticmethod
    def backward(ctx, gradient: Tensor):
        """By the chain rule."""
        return torch.einsum("ux,uxp->p", gradient, ctx.slopes), None
