"""Control laws that belong to a design: what a nested search closes the loop with at every design it looks at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.design_controllers import HORIZON, linear_mpc, nonlinear_mpc, saturated_lqr
from ccdtools.co_design.episodes import Law
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.controllers import Controller, Passive
from mpc import lqr_sensitivity

WEIGHT_STEP = 1e-5  # of the unit box: of the central differences of weights that depend on the design


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
        return _on_line(self.controller(problem, p.detach().numpy()))

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
        return _on_line(self.controller(problem, p.detach().numpy()))

    def controller(self, problem: CoDesignProblem, p: Array) -> Controller:
        """The MPC of a design."""
        return nonlinear_mpc(problem, p, horizon=self.horizon)


def _on_line(controller: Controller) -> Law:
    """A controller of the state as a law."""
    return lambda x: x.new_tensor(controller(x.detach().numpy()))


class _Gain(torch.autograd.Function):
    """K(p) (nu, nx) of the regulator, with its exact derivative."""

    @staticmethod
    def forward(ctx, p: Tensor, problem: CoDesignProblem) -> Tensor:
        """The gain."""
        at = p.detach().numpy()
        if not ctx.needs_input_grad[0]:
            return torch.tensor(saturated_lqr(problem, at).K)
        found = lqr_slopes(problem, at)
        ctx.slopes = torch.tensor(found.dK)
        return torch.tensor(found.K)

    @staticmethod
    def backward(ctx, gradient: Tensor):
        """By the chain rule."""
        return torch.einsum("ux,uxp->p", gradient, ctx.slopes), None


def lqr_slopes(problem: CoDesignProblem, p: Array) -> Any:
    """Gain and cost of the LQR of a design, with their derivatives by the design: an `LQRSensitivity`."""
    A, B, _ = problem.model.matrices(p)
    dA, dB, _ = model_slopes(problem, p)
    return lqr_sensitivity(A, B, **problem.weights(p).keywords(), dA=dA, dB=dB, **weight_slopes(problem, p))


def model_slopes(problem: CoDesignProblem, p: Array) -> tuple[Array, Array, Array]:
    """∂A/∂p (nx, nx, np), ∂B/∂p (nx, nu, np) and ∂E/∂p (nx, nw, np) of the model, or of its linearisation."""
    model = problem.model
    columns = model.nx + model.nu + model.nw
    slopes = np.asarray(model.jacobian(p), dtype=float).reshape(columns, model.nx, len(p)).transpose(1, 0, 2)
    return slopes[:, : model.nx], slopes[:, model.nx : model.nx + model.nu], slopes[:, model.nx + model.nu :]


def weight_slopes(problem: CoDesignProblem, p: Array) -> dict[str, Array]:
    """∂Q/∂p, ∂R/∂p and ∂S/∂p by name, last axis np; nothing where the weights are the same at every design."""
    if not hasattr(problem.objective, "stage_cost") or getattr(problem.objective, "Q", None) is not None:
        return {}
    space = problem.design
    step = WEIGHT_STEP * space.allowed.width * space.free
    columns = []
    for i in range(len(p)):
        ends = []
        for side in (1.0, -1.0):
            at = p.copy()
            at[i] = np.clip(p[i] + side * step[i], space.lower[i], space.upper[i])
            ends.append((at[i], problem.weights(at)))
        (high, above), (low, below) = ends
        apart = high - low if high > low else 1.0
        S = problem.model.nx, problem.model.nu
        columns.append([
            (above.Q - below.Q) / apart, (above.R - below.R) / apart,
            ((np.zeros(S) if above.S is None else above.S) - (np.zeros(S) if below.S is None else below.S)) / apart,
        ])  # fmt: skip
    named = {f"d{name}": np.stack([one[k] for one in columns], axis=-1) for k, name in enumerate("QRS")}
    if problem.weights(p).S is None and not named["dS"].any():
        named.pop("dS")
    return named

