"""How the return changes with the design, run by run: through the model, and by finite differences."""

from __future__ import annotations

import torch
from torch import Tensor

from ccdtools.co_design.episodes import episode_at
from ccdtools.co_design.problem import CoDesignProblem
from learning.networks import ActorCritic

STEP = 1e-2  # of the central differences, in the unit box
FEW = 6  # parameters, up to which differences may take the place of the gradient through the model

Scenarios = tuple[Tensor, Tensor]


def inside(v: Tensor, step: float = STEP) -> Tensor:
    """The point closest to `v` from which a step to either side stays in the unit box."""
    return v.detach().clamp(step, 1.0 - step)


@torch.no_grad()
def differences(
    problem: CoDesignProblem, agent: ActorCritic, v: Tensor, scenarios: Scenarios, step: float = STEP
) -> Tensor:
    """Central differences of every run's return in the unit box under common random numbers, (n, np), about `v`."""
    centre = inside(v, step)
    columns = []
    for i in range(len(v)):
        h = torch.zeros_like(centre)
        h[i] = step
        ends = [episode_at(problem, agent, centre + sign * h, scenarios).total for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * step))
    return torch.stack(columns, dim=1)


def pathwise_by_run(problem: CoDesignProblem, agent: ActorCritic, v: Tensor, scenarios: Scenarios) -> Tensor:
    """∂/∂v of every run's return through dynamics, policy and reward, (n, np)."""
    each = v.detach().expand(len(scenarios[0]), -1).clone().requires_grad_(True)
    total = episode_at(problem, agent, each, scenarios).total.sum()
    return torch.autograd.grad(total, each)[0].double()


def pathwise_gradient(
    problem: CoDesignProblem, agent: ActorCritic, v: Tensor, scenarios: Scenarios
) -> tuple[Tensor, Tensor]:
    """∂/∂v of the mean return through dynamics, policy and reward, (np,); and the mean return."""
    v = v.detach().clone().requires_grad_(True)
    mean = episode_at(problem, agent, v, scenarios).total.mean()
    (gradient,) = torch.autograd.grad(mean, v)
    return gradient, mean.detach()


def standard_error(by_run: Tensor) -> Tensor:
    """Standard error of the mean over the runs, (np,); infinite for a single run."""
    if len(by_run) < 2:
        return torch.full_like(by_run[0], float("inf"))
    return by_run.std(0) / len(by_run) ** 0.5
