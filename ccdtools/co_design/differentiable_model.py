"""Batched, differentiable model of a problem, and its episodes.

Long episodes are cut into segments that are computed again on the way back, so that memory grows with the square root
of their length and the gradient stays exact.

References
----------
Chen, Xu, Zhang and Guestrin, "Training deep nets with sublinear memory cost", arXiv:1604.06174, 2016.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ccdtools.co_design.budgets import HELD_SAMPLES, LONGEST_SEGMENT
from ccdtools.co_design.risk import fewest_runs
from ccdtools.exceptions import InputError
from ccdtools.plants.linear_model import LinearModel
from ccdtools_ground.user_functions import at_step
from learning.networks import ActorCritic, scaled

if TYPE_CHECKING:
    from ccdtools.co_design.problem import CoDesignProblem
    from ccdtools.plants.models import Model

ScenarioTensors: TypeAlias = tuple[Tensor, Tensor]  # initial states (n, nx) and disturbances (n, T, nw)


class _Matrices(torch.autograd.Function):
    """[A B E](p) and its exact derivative, by CasADi in float64."""

    @staticmethod
    def forward(ctx: Any, p: Tensor, model: Model) -> Tensor:
        """Flattened by columns, (nx·(nx + nu + nw),)."""
        at = p.detach().double().numpy()
        ctx.jacobian = np.asarray(model.jacobian(at), dtype=float) if ctx.needs_input_grad[0] else None
        value = np.asarray(model.function(at), dtype=float).ravel(order="F")
        return torch.as_tensor(value, dtype=p.dtype)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """∂/∂p by the chain rule."""
        jacobian = torch.as_tensor(ctx.jacobian, dtype=gradient.dtype)
        return gradient @ jacobian, None


def matrices(model: Model, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Matrices A, B, E at a design (np,), or stacked for (n, np)."""
    columns = model.nx + model.nu + model.nw
    flat = _Matrices.apply(p, model) if p.ndim == 1 else torch.stack([_Matrices.apply(one, model) for one in p])
    M = flat.unflatten(-1, (columns, model.nx)).mT
    return M[..., : model.nx], M[..., model.nx : model.nx + model.nu], M[..., model.nx + model.nu :]


def _needed_matrices(problem: CoDesignProblem, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Matrices A, B, E, empty where no step needs them."""
    carried = getattr(problem.discrepancy, "transport", None) is not None
    if carried or isinstance(problem.model, LinearModel):
        return matrices(problem.model, p)
    return p.new_zeros(0), p.new_zeros(0), p.new_zeros(0)


def in_double(problem: CoDesignProblem) -> CoDesignProblem:
    """Problem with learned errors in double precision."""
    learned = problem.discrepancy
    return problem if learned is None else replace(problem, discrepancy=learned.double())


def to_design(problem: CoDesignProblem, v: Tensor) -> Tensor:
    """Design tensor at `v` in the unit box, or at many (n, np)."""
    lower = v.new_tensor(problem.design.lower.tolist())
    return lower + v * (v.new_tensor(problem.design.upper.tolist()) - lower)


@dataclass(frozen=True, eq=False)
class Stepper:
    """Step of a problem's model for batches of torch states."""

    problem: CoDesignProblem
    # at one design `p` (np,), or stacked (n, nx, ·) at designs (n, np), one per run
    A: Tensor  # (nx, ·)
    B: Tensor  # (nx, ·)
    E: Tensor  # (nx, ·)
    p: Tensor
    limit: Tensor  # (nx,): divergence limit on |x|
    carry: Tensor | None = None  # (nx, nx): of a learned error, from the design of its log to this one
    errors: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor] | None = None  # (e, x, u, w) → e⁺, where it is learned

    @classmethod
    def at(cls, problem: CoDesignProblem, p: Tensor) -> Stepper:
        """Model at design `p` (np,) or (n, np), differentiable in `p`."""
        return cls._of(problem, p, _needed_matrices(problem, p))

    @classmethod
    def for_each(cls, problem: CoDesignProblem, designs: Tensor, runs: int) -> Stepper:
        """Model at designs (m, np), each for `runs` consecutive runs."""
        A, B, E = (M.repeat_interleave(runs, dim=0) for M in _needed_matrices(problem, designs))
        return cls._of(problem, designs.repeat_interleave(runs, dim=0), (A, B, E))

    @classmethod
    def _of(cls, problem: CoDesignProblem, p: Tensor, at: tuple[Tensor, Tensor, Tensor]) -> Stepper:
        """Model of a problem with matrices at `p`."""
        learned = problem.discrepancy
        transport = None if learned is None else learned.transport
        carry = None if transport is None else transport.matrix(at[2])
        errors = None if learned is None else learned.errors(p)
        return cls(problem, *at, p, p.new_tensor(problem.limit.tolist()), carry, errors)

    def __call__(self, x: Tensor, e: Tensor, u: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Next states (n, nx), errors (n, nx) and rewards (n,)."""
        x_next, e_next = self.advance(x, e, u, self.drive(w[:, None])[:, 0])
        x_next = self.numbers(x_next)
        return x_next, e_next, self.rewards(x_next[None], u[None], x[None])[0] - self.penalties(e, x, u)

    def drive(self, w: Tensor) -> Tensor:
        """Effect (n, T, nx) of disturbances (n, T, nw) on a linear model.

        The disturbance itself where the model is not linear, the noise itself where errors are learned.
        """
        plain = self.problem.discrepancy is not None or not isinstance(self.problem.model, LinearModel)
        return w if plain else _times(self.E, w)

    def advance(self, x: Tensor, e: Tensor, u: Tensor, drive: Tensor) -> tuple[Tensor, Tensor]:
        """Next states and errors (n, nx)."""
        model = self.problem.model
        if self.errors is not None:
            e = self.errors(e, x, u, drive)
            error = e[..., : x.shape[-1]]  # the rest is what draws remember
            drive = error if self.carry is None else _times(self.carry, error[:, None])[:, 0]
        if isinstance(model, LinearModel):
            return _plus_times(_plus_times(drive, self.A, x), self.B, u), e
        if self.errors is None:
            return model.pathwise(x, u, drive, self.p), e
        return model.pathwise(x, u, x.new_zeros(model.nw), self.p) + drive, e

    def penalties(self, e: Tensor, x: Tensor, u: Tensor) -> Any:
        """Penalties (..., n) of a learned error, given present errors and states (..., n, nx) and inputs; else 0."""
        discrepancy = self.problem.discrepancy
        return 0.0 if discrepancy is None else discrepancy.penalty(e, x, u, self.p)

    def rewards(self, x_next: Tensor, u: Tensor, x: Tensor) -> Tensor:
        """Rewards (T, n) of next states (T, n, nx), inputs (T, n, nu), present states."""
        p = self.p if self.p.ndim == 1 else self.p.expand(len(x), *self.p.shape).flatten(0, 1)
        rewards = self.problem.objective.rewards(x_next.flatten(0, 1), u.flatten(0, 1), x.flatten(0, 1), p)
        by_step: Tensor = rewards.unflatten(0, x_next.shape[:2])
        return by_step

    def final_rewards(self, x: Tensor) -> Tensor | None:
        """Rewards (n,) of final states (n, nx); None if nothing counts."""
        final: Tensor | None = self.problem.objective.final_rewards(x, self.p)
        return final

    def numbers(self, x: Tensor) -> Tensor:
        """States (n, nx), just beyond the divergence limit where a simulator gave no number."""
        beyond = torch.nextafter(self.limit, self.limit.new_tensor(math.inf))
        return torch.where(x.isfinite().all(-1, keepdim=True), x, beyond)

    def left(self, x: Tensor) -> Tensor:
        """States (..., nx) beyond the divergence limit, (...,) bool."""
        return ~(x.abs() <= self.limit).all(-1)

    def within(self, divergence: float) -> Stepper:
        """Stepper that loses runs so many half-widths of X away."""
        return replace(self, limit=self.limit * (divergence / self.problem.divergence))

    def outside(self, x_next: Tensor, u: Tensor, x: Tensor) -> Tensor:
        """Largest violation (..., n) of the limits, in half-widths.

        Of a facet of X by the next states (..., n, nx), or of a limit of an output by inputs and present states.
        """
        given = (x_next, u, x, self.p)
        beyond: Tensor = self.problem.violations.vector(*(part.shape[-1] for part in given))(*given)
        return beyond.masked_fill(beyond.isnan(), math.inf).amax(-1).clamp(min=0.0)


def _times(M: Tensor, x: Tensor) -> Tensor:
    """Products M x of vectors (n, T, k), with common or per-run M."""
    return x @ M.mT


def _plus_times(y: Tensor, M: Tensor, x: Tensor) -> Tensor:
    """Sums y + M x of vectors (n, ·), with common or per-run M."""
    if M.ndim == 2:
        return torch.addmm(y, x, M.T)
    return torch.baddbmm(y[:, None], x[:, None], M.mT)[:, 0]


def observe(x: Tensor, p: Tensor) -> Tensor:
    """Observations (x, p), (n, nx + np)."""
    return torch.cat([x, p.expand(*x.shape[:-1], p.shape[-1])], dim=-1)


def scenario_tensors(problem: CoDesignProblem, runs: int, rng: np.random.Generator) -> ScenarioTensors:
    """Scenarios as float32 tensors (n, nx) and (n, T, nw).

    There are `runs` of them; a worst case has at least one a case.
    """
    runs = max(runs, fewest_runs(problem.risk))
    x0, w = problem.scenarios.sample(runs, problem.steps, rng)
    if problem.discrepancy is not None and problem.discrepancy.noise == "quantiles":
        w = problem.driving(runs, problem.steps, rng)
    return torch.tensor(x0, dtype=torch.float32), torch.tensor(w, dtype=torch.float32)


Law = Callable[[Tensor], Tensor]
Progress = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""States, model errors and runs that go on, and sums of returns, depths, largest depths and samples outside."""


@dataclass(frozen=True, eq=False)
class Episode:
    """Outcome of n episodes, with differentiable returns and violations."""

    total: Tensor  # (n,): undiscounted returns, in double precision
    diverged: Tensor  # (n,) bool: runs that passed the divergence limit; they are frozen there and earn nothing more
    # mean over the steps, and largest, depth outside X in half-widths of X; zero unless asked for
    depth: Tensor  # (n,)
    peak: Tensor  # (n,)
    outside: Tensor  # (n,): fraction of the steps that end outside X; without a gradient, zero unless asked for


def episode(
    problem: CoDesignProblem, agent: ActorCritic, p: Tensor, scenarios: tuple[Tensor, Tensor], *, depths: bool = False
) -> Episode:
    """Episodes of the mean policy at design `p`, fully differentiable.

    Parameters
    ----------
    p : (np,) or (n, np) tensor
        One design for all runs, or one for each.
    scenarios : tensors (n, nx) and (n, T, nw)
        Initial states and disturbances.
    depths : bool
        Measure how far the runs are outside X.
    """
    return simulated(Stepper.at(problem, p), mean_law(agent, p), scenarios, depths=depths)


@torch.no_grad()
def visited(step: Stepper, law: Law, scenarios: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Episode]:
    """States (k, nx) that a law meets, lost runs included, its inputs (k, nu), and the episodes."""
    pairs: list[tuple[Tensor, Tensor]] = []

    def watched(x: Tensor) -> Tensor:
        """Inputs, remembered with their states."""
        pairs.append((x, law(x)))
        return pairs[-1][1]

    episode = simulated(step, watched, scenarios, guarded=True)
    states, inputs = (torch.cat(part) for part in zip(*pairs))
    return states, inputs, episode


def simulated(
    step: Stepper, law: Law, scenarios: tuple[Tensor, Tensor], *, depths: bool = False, guarded: bool = False
) -> Episode:  # fmt: skip
    """Episodes of a law from states (n, nx) to inputs (n, nu).

    With `guarded` the law is called once a step, also where runs diverge, as one with memory has to be.
    """
    x0, w = scenarios
    warm_up = step.problem.warm_up
    steps = w.shape[1] - warm_up
    nothing = torch.zeros(len(x0), dtype=torch.float64)
    running = torch.ones(len(x0), dtype=torch.bool)
    progress: Progress = (x0, torch.zeros_like(x0), running, nothing, nothing, nothing, nothing)
    recomputed = torch.is_grad_enabled() and w.shape[1] > 2 * LONGEST_SEGMENT and w.shape[0] * w.shape[1] > HELD_SAMPLES
    length = math.isqrt(w.shape[1]) if recomputed else LONGEST_SEGMENT
    segment = partial(_segment, expected=not guarded)

    def advanced(progress: Progress, begin: int, end: int) -> Progress:
        """Progress after the steps from `begin` to `end`."""
        for first in range(begin, end, length):
            given = (step, law, w[:, first : min(first + length, end)], first, depths, *progress)
            progress = checkpoint(segment, *given, use_reentrant=False) if recomputed else segment(*given)
        return progress

    if warm_up:
        x, e, running, total, *_ = advanced(progress, 0, warm_up)
        total = torch.where(running, nothing, total)  # lost runs keep their cost
        progress = (x, e, running, total, nothing, nothing, nothing)
    x, _, running, total, depth, peak, outside = advanced(progress, warm_up, w.shape[1])
    final = step.final_rewards(x)
    total = total if final is None else total + torch.where(running, final, 0.0).double()
    total = total - step.problem.objective.cost_of_design(step.p, steps)
    return Episode(total, ~running, depth / steps, peak, outside / steps)


def _segment(
    step: Stepper, law: Law, w: Tensor, first: int, depths: bool, *before: Tensor, expected: bool = True
) -> Progress:  # fmt: skip
    """Progress after the steps of `w` (n, T, nw), counted from `first`.

    It is `expected` that no run diverges: whether one did is looked up at the end, and only then is the segment
    computed again with each run frozen where it was lost. A gradient must not pass through states of 1e30.
    """
    x, e, running, total, depth, peak, outside = before
    guarded = not expected or not bool(running.all())
    drive = step.drive(w)
    states: list[Tensor] = []
    inputs: list[Tensor] = []
    errors: list[Tensor] = []
    going: list[Tensor] = []
    for k in range(w.shape[1]):
        u = law(x)
        try:
            x_next, e_next = step.advance(x, e, u, drive[:, k])
        except InputError as error:
            raise at_step(first + k, error) from error
        if guarded:
            x_next = torch.where(running[:, None], step.numbers(x_next), x)
            e_next = torch.where(running[:, None], e_next, e)
            going.append(running)
            running = running & ~step.left(x_next.detach())
        errors.append(e)
        x = x_next
        e = e_next
        states.append(x)
        inputs.append(u)
    visited = torch.stack(states)
    if not guarded and bool(step.left(visited.detach()).any()):
        return _segment(step, law, w, first, depths, *before, expected=False)

    def counted(values: Tensor) -> Tensor:
        """Values (T, n) of steps, zero once a run is lost, in double precision."""
        return (torch.where(torch.stack(going), values, 0.0) if guarded else values).double()

    applied = torch.stack(inputs)
    learned = step.problem.discrepancy is not None
    looks_back = learned or step.problem.objective.looks_back or step.problem.output_limits is not None
    present = torch.cat([before[0][None], visited[:-1]]) if looks_back else visited
    total = total + counted(step.rewards(visited, applied, present)).sum(0)
    if learned:
        pieces = (values.split(max(1, HELD_SAMPLES // len(x))) for values in (torch.stack(errors), present, applied))
        total = total - counted(torch.cat([step.penalties(*piece) for piece in zip(*pieces)])).sum(0)
    if not depths:
        return x, e, running, total, depth, peak, outside
    own = counted(step.outside(visited, applied, present))
    peak = torch.maximum(peak, own.amax(0))
    return x, e, running, total, depth + own.sum(0), peak, outside + (own > 0).sum(0)


def mean_law(agent: ActorCritic, p: Tensor) -> Law:
    """Mean policy at `p` (np,) or (n, np), from states (n, nx)."""
    latent = latent_law(agent, p)
    action_range = agent.action_range(p)
    return lambda x: scaled(latent(x), action_range)


def latent_law(agent: ActorCritic, p: Tensor) -> Law:
    """Unclipped latent actions (n, nu) of the mean policy, from states (n, nx)."""
    layers = agent.mean_network.at(p, agent.observation_offset, agent.observation_scale)
    seen = len(agent.observation_offset) - p.shape[-1]  # the last of the states
    return lambda x: layers(x[:, -seen:], torch.tanh, lambda x, W, b: torch.addmm(b, x, W))  # in one kernel


def episode_at(
    problem: CoDesignProblem, agent: ActorCritic, v: Tensor, scenarios: tuple[Tensor, Tensor], *, depths: bool = False
) -> Episode:
    """Run `episode` at unit-box points `v` (np,) or (n, np)."""
    return episode(problem, agent, to_design(problem, v), scenarios, depths=depths)


def fewer_runs(runs: int, steps: int, model: Model | None = None) -> int:
    """Number of `steps`-step episodes that take about as long as `runs` of 100.

    Of a model, samples of more than 32 Runge–Kutta parts count as many steps. It is at least 16 of `runs`.
    """
    longer = steps * max(1.0, getattr(model, "parts", 0) / 32)
    return max(min(runs, 16), min(runs, math.ceil(runs * 100 / longer)))  # at least 16 episodes
