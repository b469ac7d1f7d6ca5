"""The batched, differentiable model that learning runs on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.risk import fewest_runs
from ccdtools.design_limits import DesignLimits, widest
from ccdtools.limits import StateLimits
from ccdtools.plants.models import Model
from ccdtools.plants.sampled_model import SampledModel

ScenarioTensors: TypeAlias = tuple[Tensor, Tensor]  # initial states (n, nx) and disturbances (n, T, nw)


class _Matrices(torch.autograd.Function):
    """[A B E](p) with its exact derivative, both evaluated by CasADi in float64."""

    @staticmethod
    def forward(ctx, p: Tensor, model: Model) -> Tensor:
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


def matrices(model: Model, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A, B, E at a design tensor (np,), or stacked along axis 0 at designs (n, np); differentiable in it."""
    columns = model.nx + model.nu + model.nw
    flat = _Matrices.apply(p, model) if p.ndim == 1 else torch.stack([_Matrices.apply(one, model) for one in p])
    M = flat.unflatten(-1, (columns, model.nx)).mT
    return M[..., : model.nx], M[..., model.nx : model.nx + model.nu], M[..., model.nx + model.nu :]


def in_double(problem: CoDesignProblem) -> CoDesignProblem:
    """A problem whose learned errors are in double precision."""
    learned = problem.discrepancy
    return problem if learned is None else replace(problem, discrepancy=learned.double())


def to_design(problem: CoDesignProblem, v: Tensor) -> Tensor:
    """The design tensor of a point `v` in the unit box; of many, (n, np), one by one."""
    lower = v.new_tensor(problem.design.lower.tolist())
    return lower + v * (v.new_tensor(problem.design.upper.tolist()) - lower)


@dataclass(frozen=True, eq=False)
class Stepper:
    """One step of a problem's model, for batches of torch states."""

    problem: CoDesignProblem
    # at one design `p` (np,), or stacked (n, nx, ·) at designs (n, np), one per run
    A: Tensor  # (nx, ·)
    B: Tensor  # (nx, ·)
    E: Tensor  # (nx, ·)
    p: Tensor
    limit: Tensor  # (nx,): divergence limit on |x|
    carry: Tensor | None = None  # (nx, nx): of a learned error, from the design of its log to this one

    @classmethod
    def at(cls, problem: CoDesignProblem, p: Tensor) -> Stepper:
        """The model at design `p` (np,) or (n, np), differentiable in it."""
        return cls._of(problem, p, matrices(problem.model, p))

    @classmethod
    def for_each(cls, problem: CoDesignProblem, designs: Tensor, runs: int) -> Stepper:
        """The model at designs (m, np), `runs` runs for each in turn: m · runs in all."""
        A, B, E = (M.repeat_interleave(runs, dim=0) for M in matrices(problem.model, designs))
        return cls._of(problem, designs.repeat_interleave(runs, dim=0), (A, B, E))

    @classmethod
    def _of(cls, problem: CoDesignProblem, p: Tensor, at: tuple[Tensor, Tensor, Tensor]) -> Stepper:
        """The model of a problem with its matrices at `p`."""
        transport = None if problem.discrepancy is None else problem.discrepancy.transport
        carry = None if transport is None else transport.matrix(at[2])
        return cls(problem, *at, p, p.new_tensor(problem.limit.tolist()), carry)

    def __call__(self, x: Tensor, e: Tensor, u: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Next states (n, nx), next errors (n, nx) and rewards (n,)."""
        x_next, e, penalty = self.advance(x, e, u, self.drive(w[:, None])[:, 0])
        return x_next, e, self.rewards(x_next[None], u[None], x[None])[0] - sum(penalty)

    def drive(self, w: Tensor) -> Tensor:
        """What a disturbance (n, T, nw) adds to the states of a linear model, (n, T, nx).

        The disturbance itself where the model is not linear, the noise itself where errors are learned.
        """
        plain = self.problem.discrepancy is not None or isinstance(self.problem.model, SampledModel)
        return w if plain else _times(self.E, w)

    def advance(self, x: Tensor, e: Tensor, u: Tensor, drive: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """Next states and errors (n, nx), and the penalty (n,) of a learned error if there is one."""
        discrepancy = self.problem.discrepancy
        if isinstance(self.problem.model, SampledModel):
            return self._sampled(self.problem.model, x, e, u, drive)
        if discrepancy is None:
            return _plus_times(_plus_times(drive, self.A, x), self.B, u), e, ()
        e, penalty = discrepancy.advance(e, x, u, self.p, drive)
        error = e[..., : x.shape[-1]]  # the rest is what draws remember
        carried = error if self.carry is None else _times(self.carry, error[:, None])[:, 0]
        return _plus_times(_plus_times(carried, self.A, x), self.B, u), e, (penalty,)

    def _sampled(
        self, model: SampledModel, x: Tensor, e: Tensor, u: Tensor, drive: Tensor
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """The same of a model that is not linear."""
        discrepancy = self.problem.discrepancy
        if discrepancy is None:
            return model.pathwise(x, u, drive, self.p), e, ()
        e, penalty = discrepancy.advance(e, x, u, self.p, drive)
        error = e[..., : x.shape[-1]]
        carried = error if self.carry is None else _times(self.carry, error[:, None])[:, 0]
        return model.pathwise(x, u, x.new_zeros(model.nw), self.p) + carried, e, (penalty,)

    def rewards(self, x_next: Tensor, u: Tensor, x: Tensor) -> Tensor:
        """Rewards (T, n) of next states (T, n, nx), inputs (T, n, nu) and present states, asked for in one call."""
        p = self.p if self.p.ndim == 1 else self.p.expand(len(x), *self.p.shape).flatten(0, 1)
        rewards = self.problem.objective.rewards(x_next.flatten(0, 1), u.flatten(0, 1), x.flatten(0, 1), p)
        return rewards.unflatten(0, x_next.shape[:2])

    def final_rewards(self, x: Tensor) -> Tensor | None:
        """What the states (n, nx) at the end of an episode add, (n,); None where nothing does."""
        final: Tensor | None = self.problem.objective.final_rewards(x, self.p)
        return final

    def left(self, x: Tensor) -> Tensor:
        """States (..., nx) beyond the divergence limit, (...,) bool."""
        return ~(x.abs() <= self.limit).all(-1)

    def outside(self, x_next: Tensor, u: Tensor, x: Tensor) -> Tensor:
        """How far steps are outside the limits, (..., n): the largest violation, in half-widths.

        Of a facet of X by the next states (..., n, nx), or of a limit of an output by inputs and present states.
        """
        if isinstance(self.problem.X, DesignLimits):
            depth = self.problem.X.depths(x_next, self.p).amax(-1)
        else:
            F, g = self._facets
            depth = (x_next @ F.T - g).amax(-1)
        limits = self.problem.output_limits
        if limits is not None:
            depth = torch.maximum(depth, limits.depths(x, u, self.p).amax(-1))
        return depth.clamp(min=0.0)

    @cached_property
    def _facets(self) -> tuple[Tensor, Tensor]:
        """X as F x ≤ g, each row divided by the half-width of X along it."""
        limits = StateLimits(widest(self.problem.X))
        return self.limit.new_tensor(limits.rows.tolist()), self.limit.new_tensor(limits.bounds.tolist())


def _times(M: Tensor, x: Tensor) -> Tensor:
    """M x for vectors (n, T, k) and one matrix, or a matrix (n, m, k) for each run."""
    return x @ M.mT


def _plus_times(y: Tensor, M: Tensor, x: Tensor) -> Tensor:
    """y + M x for vectors (n, ·) and one matrix, or a matrix for each run."""
    if M.ndim == 2:
        return torch.addmm(y, x, M.T)
    return torch.baddbmm(y[:, None], x[:, None], M.mT)[:, 0]


def observe(x: Tensor, p: Tensor) -> Tensor:
    """Observations (x, p), (n, nx + np)."""
    return torch.cat([x, p.expand(*x.shape[:-1], p.shape[-1])], dim=-1)


def scenario_tensors(problem: CoDesignProblem, runs: int, rng: np.random.Generator) -> ScenarioTensors:
    """`runs` scenarios of a problem as float32 tensors: (n, nx) and (n, T, nw); of a worst case one a case at least."""
    runs = max(runs, fewest_runs(problem.risk))
    x0, w = problem.scenarios.sample(runs, problem.steps, rng)
    if problem.discrepancy is not None and problem.discrepancy.noise == "quantiles":
        w = problem.driving(runs, problem.steps, rng)
    return torch.tensor(x0, dtype=torch.float32), torch.tensor(w, dtype=torch.float32)
