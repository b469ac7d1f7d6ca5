"""How the return changes with the design, run by run: through the model, and by finite differences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.episodes import episode_at
from ccdtools.co_design.problem import CoDesignProblem
from learning.networks import ActorCritic

STEP = 1e-2  # of the central differences, in the unit box
FEW = 6  # parameters, up to which differences may take the place of the gradient through the model

SIGNIFICANT = 3.0  # standard errors of a slope that is not chance
AHEAD = 0.1  # of the box: over this distance a slope must promise a gain that matters
UNRESOLVED = 0.05  # of the return over the distance ahead: a slope with such an error says nothing

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


@dataclass(frozen=True, eq=False)
class Slope:
    """How the mean return rises with the design, inside the unit box; 0 where a bound leaves no room.

    Attributes
    ----------
    mean, error : (np,) arrays
        Finite differences and their standard errors, per length of the unit box.
    room : (np,) array
        Distance to the bound that the slope points at.
    """

    mean: Array
    error: Array
    room: Array

    @classmethod
    def none(cls, size: int) -> Slope:
        """A level one."""
        return cls(np.zeros(size), np.zeros(size), np.ones(size))

    @classmethod
    def measured(cls, problem: CoDesignProblem, agent: ActorCritic, v: Tensor, scenarios: Scenarios) -> Slope:
        """At a point of the unit box, on some scenarios."""
        by_run = differences(problem, agent, v, scenarios)
        slope = by_run.mean(0).numpy()
        point = v.double().numpy()
        room = np.where(slope > 0, 1.0 - point, point)
        mean, error = np.where(room > 0, np.stack([slope, standard_error(by_run).numpy()]), 0.0)
        return cls(mean, error, room)

    def promises(self, gain: float) -> bool:
        """Whether a slope beyond chance, falling to zero over the distance ahead, brings such a gain."""
        promised = np.abs(self.mean) * np.minimum(self.room, AHEAD) / 2
        return bool(((np.abs(self.mean) > SIGNIFICANT * self.error) & (promised > gain)).any())

    def unresolved(self, size: float) -> bool:
        """Whether its error is so large, beside returns of that size, that it says nothing."""
        return bool((self.error * AHEAD > UNRESOLVED * size).any() or not np.isfinite(self.error).all())
