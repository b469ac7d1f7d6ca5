"""Episodes of a policy on the differentiable model.

Long episodes are cut into segments that are computed again on the way back, so that memory grows with the square root
of their length and the gradient stays exact.

References
----------
Chen, Xu, Zhang and Guestrin, "Training deep nets with sublinear memory cost", arXiv:1604.06174, 2016.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ccdtools.co_design.budgets import HELD_SAMPLES, LONGEST_SEGMENT
from ccdtools.co_design.differentiable_model import Stepper, to_design
from learning.networks import ActorCritic, scaled

if TYPE_CHECKING:
    from ccdtools.co_design.problem import CoDesignProblem

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

    def advanced(progress: Progress, w: Tensor) -> Progress:
        """Progress after the steps of `w` (n, T, nw)."""
        for part in w.split(length, dim=1):
            if recomputed:
                progress = checkpoint(
                    _segment, step, law, part, depths, *progress, expected=not guarded, use_reentrant=False
                )
            else:
                progress = _segment(step, law, part, depths, *progress, expected=not guarded)
        return progress

    if warm_up:
        x, e, running, total, *_ = advanced(progress, w[:, :warm_up])
        total = torch.where(running, nothing, total)  # lost runs keep their cost
        progress = (x, e, running, total, nothing, nothing, nothing)
    x, _, running, total, depth, peak, outside = advanced(progress, w[:, warm_up:])
    final = step.final_rewards(x)
    total = total if final is None else total + torch.where(running, final, 0.0).double()
    total = total - step.problem.objective.cost_of_design(step.p, steps)
    return Episode(total, ~running, depth / steps, peak, outside / steps)


def _segment(
    step: Stepper, law: Law, w: Tensor, depths: bool, *before: Tensor, expected: bool = True
) -> Progress:  # fmt: skip
    """Progress after the steps of `w` (n, T, nw).

    It is `expected` that no run diverges: whether one did is looked up at the end, and only then is the segment
    computed again with each run frozen where it was lost. A gradient must not pass through states of 1e30.
    """
    x, e, running, total, depth, peak, outside = before
    guarded = not expected or not bool(running.all())
    drive = step.drive(w)
    states: list[Tensor] = []
    inputs: list[Tensor] = []
    penalties: list[Tensor] = []
    going: list[Tensor] = []
    for k in range(w.shape[1]):
        u = law(x)
        x_next, e_next, penalty = step.advance(x, e, u, drive[:, k])
        if guarded:
            x_next = torch.where(running[:, None], x_next, x)
            e_next = torch.where(running[:, None], e_next, e)
            going.append(running)
            running = running & ~step.left(x_next.detach())
        x = x_next
        e = e_next
        states.append(x)
        inputs.append(u)
        penalties.extend(penalty)
    visited = torch.stack(states)
    if not guarded and bool(step.left(visited.detach()).any()):
        return _segment(step, law, w, depths, *before, expected=False)

    def counted(values: Tensor) -> Tensor:
        """Values (T, n) of steps, zero once a run is lost, in double precision."""
        return (torch.where(torch.stack(going), values, 0.0) if guarded else values).double()

    applied = torch.stack(inputs)
    looks_back = step.problem.objective.looks_back or step.problem.output_limits is not None
    present = torch.cat([before[0][None], visited[:-1]]) if looks_back else visited
    total = total + counted(step.rewards(visited, applied, present)).sum(0)
    if penalties:
        total = total - counted(torch.stack(penalties)).sum(0)
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
    return lambda x: layers(x, torch.tanh, lambda x, W, b: torch.addmm(b, x, W))  # in one kernel


def episode_at(
    problem: CoDesignProblem, agent: ActorCritic, v: Tensor, scenarios: tuple[Tensor, Tensor], *, depths: bool = False
) -> Episode:
    """Run `episode` at unit-box points `v` (np,) or (n, np)."""
    return episode(problem, agent, to_design(problem, v), scenarios, depths=depths)


def fewer_runs(runs: int, steps: int) -> int:
    """Number of `steps`-step episodes with about the samples of `runs` of 100.

    It is at least 16 of `runs`.
    """
    return max(min(runs, 16), min(runs, math.ceil(runs * 100 / steps)))  # at least 16 episodes
