"""The batched, differentiable model that learning runs on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.plants.linear_model import LinearModel
from learning.networks import ActorCritic


class _Matrices(torch.autograd.Function):
    """[A B E](p) with its exact derivative, both evaluated by CasADi in float64."""

    @staticmethod
    def forward(ctx, p: Tensor, model: LinearModel) -> Tensor:
        """Flattened by columns, (nx·(nx + nu + nw),)."""
        at = p.detach().double().numpy()
        ctx.jacobian = np.asarray(model.jacobian(at), dtype=float) if ctx.needs_input_grad[0] else None
        value = np.asarray(model.function(at), dtype=float).ravel(order="F")
        return torch.as_tensor(value, dtype=p.dtype)

    @staticmethod
    def backward(ctx, gradient: Tensor):
        """∂/∂p by the chain rule."""
        jacobian = torch.as_tensor(ctx.jacobian, dtype=gradient.dtype)
        return gradient @ jacobian, None


def matrices(model: LinearModel, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A, B, E at a design tensor (np,), differentiable in it."""
    columns = model.nx + model.nu + model.nw
    M = _Matrices.apply(p, model).reshape(columns, model.nx).T
    return M[:, : model.nx], M[:, model.nx : model.nx + model.nu], M[:, model.nx + model.nu :]


def to_design(problem: CoDesignProblem, v: Tensor) -> Tensor:
    """The design tensor of a point `v` in the unit box."""
    lower = v.new_tensor(problem.design.lower.tolist())
    return lower + v * (v.new_tensor(problem.design.upper.tolist()) - lower)


@dataclass(frozen=True, eq=False)
class Stepper:
    """One step of a problem's model at one design, for batches of torch states."""

    problem: CoDesignProblem
    A: Tensor
    B: Tensor
    E: Tensor
    p: Tensor
    limit: Tensor
    carry: Tensor | None = None  # (nx, nx), of a learned error from the design of its log to this one

    @classmethod
    def at(cls, problem: CoDesignProblem, p: Tensor) -> Stepper:
        """The model at design `p` (np,), differentiable in it."""
        A, B, E = matrices(problem.model, p)
        transport = None if problem.discrepancy is None else problem.discrepancy.transport
        carry = None if transport is None else transport.matrix(E)
        return cls(problem, A, B, E, p, p.new_tensor(problem.limit.tolist()), carry)

    def __call__(self, x: Tensor, e: Tensor, u: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Next states (n, nx), next errors (n, nx) and rewards (n,)."""
        x_next = x @ self.A.T + u @ self.B.T
        discrepancy = self.problem.discrepancy
        penalty: Tensor | float = 0.0
        if discrepancy is None:
            x_next = x_next + w @ self.E.T
        else:
            e, penalty = discrepancy.advance(e, x, u, self.p, w)
            x_next = x_next + (e if self.carry is None else e @ self.carry.T)
        return x_next, e, self.problem.objective.rewards(x_next, u) - penalty

    def left(self, x: Tensor) -> Tensor:
        """Runs beyond the divergence limit, (n,) bool."""
        return ~(x.abs() <= self.limit).all(-1)


def observe(x: Tensor, p: Tensor) -> Tensor:
    """Observations (x, p), (n, nx + np)."""
    return torch.cat([x, p.expand(*x.shape[:-1], p.shape[-1])], dim=-1)


def returns(problem: CoDesignProblem, agent: ActorCritic, p: Tensor, x0: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Undiscounted returns (n,) of the mean policy, and which runs diverged; differentiable end to end.

    Parameters
    ----------
    p : (np,) tensor
    x0 : (n, nx) tensor
    w : (n, T, nw) tensor
    """
    step = Stepper.at(problem, p)
    x = x0
    e = torch.zeros_like(x0)
    total = torch.zeros(len(x0))
    running = torch.ones(len(x0), dtype=torch.bool)
    for k in range(w.shape[1]):
        u = agent.action(agent.latent(observe(x, p)))
        x_next, e_next, reward = step(x, e, u, w[:, k])
        if not bool(running.all()):
            x_next = torch.where(running[:, None], x_next, x)
            e_next = torch.where(running[:, None], e_next, e)
            reward = torch.where(running, reward, 0.0)
        total = total + reward
        x = x_next
        e = e_next
        running = running & ~step.left(x.detach())
    return total, ~running


def returns_at(
    problem: CoDesignProblem, agent: ActorCritic, v: Tensor, scenarios: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """`returns` at a point `v` (np,) of the unit box, on scenarios (x0, w)."""
    return returns(problem, agent, to_design(problem, v), *scenarios)


def mean_return(problem: CoDesignProblem, agent: ActorCritic, v: Tensor, scenarios: tuple[Tensor, Tensor]) -> Tensor:
    """Mean undiscounted return of the mean policy at a point `v` (np,) of the unit box; differentiable."""
    return returns_at(problem, agent, v, scenarios)[0].mean()


def scenario_tensors(problem: CoDesignProblem, runs: int, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """`runs` scenarios of a problem as float32 tensors: (n, nx) and (n, T, nw)."""
    x0, w = problem.scenarios.sample(runs, problem.steps, rng)
    if problem.discrepancy is not None and problem.discrepancy.noise == "quantiles":
        w = rng.random((runs, problem.steps, problem.model.nx))
    return torch.tensor(x0, dtype=torch.float32), torch.tensor(w, dtype=torch.float32)
