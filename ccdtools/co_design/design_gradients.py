"""Gradients of each run's return by the design, pathwise and by differences."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.agents import check_agent
from ccdtools.co_design.differentiable_model import (
    ScenarioTensors,
    episode_at,
    fewer_runs,
    in_double,
    scenario_tensors,
    to_design,
)
from ccdtools.co_design.environment import network_input_gradient
from ccdtools.co_design.learned_result import GradientCheck
from ccdtools.co_design.limits import Prices
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.tolerances import AGREEING, FINER_STEPS, LEVEL_SLOPE, SIGNIFICANT, SLOPE_AHEAD, UNRESOLVED_SLOPE
from ccdtools_ground.door import as_count, as_flag, as_generator, as_instance, as_number
from learning.networks import ActorCritic
from learning.ppo import PPOConfig


def inside(v: Tensor, step: float) -> Tensor:
    """Nearest point to `v` with room for a step to both sides."""
    return v.detach().clamp(step, 1.0 - step)


@dataclass(frozen=True, eq=False)
class Differences:
    """Central differences of every run's return under common random numbers.

    They are taken in the unit box and in double precision.
    """

    problem: CoDesignProblem
    agent: ActorCritic
    scenarios: ScenarioTensors  # (n, nx) and (n, T, nw)
    prices: Prices | None = None  # of leaving X, which then counts as lost return

    def __post_init__(self) -> None:
        object.__setattr__(self, "problem", in_double(self.problem))
        object.__setattr__(self, "agent", copy.deepcopy(self.agent).double())
        object.__setattr__(self, "scenarios", tuple(part.double() for part in self.scenarios))

    def about(self, v: Tensor, step: float) -> Tensor:
        """Slopes (n, np) about a point, or the nearest with room."""
        centre = inside(v.double(), step)
        columns = []
        for i, free in enumerate(self.problem.design.free):
            h = torch.zeros_like(centre)
            if not free:
                columns.append(h.new_zeros(len(self.scenarios[0])))
                continue
            h[i] = step
            columns.append((self._returns(centre + h) - self._returns(centre - h)) / (2 * step))
        return torch.stack(columns, dim=1)

    def step(self, v: Tensor) -> float:
        """Largest step that a smaller one confirms, else the smallest.

        A return that goes with 1/p bends near a small p by far more than a hundredth of the box shows.
        """
        centre = v.detach().double()
        size = self.problem.made_by_control(self._returns(centre).mean(), to_design(self.problem, centre))
        slope = self.about(v, FINER_STEPS[0]).mean(0)
        for step, finer in pairwise(FINER_STEPS):
            finer_slope = self.about(v, finer).mean(0)
            if (finer_slope - slope).norm() <= AGREEING * finer_slope.norm() + LEVEL_SLOPE * size:
                return step
            slope = finer_slope
        return FINER_STEPS[-1]

    @torch.no_grad()
    def _returns(self, v: Tensor) -> Tensor:
        """Returns (n,) less the cost of leaving X."""
        seen = episode_at(self.problem, self.agent, v, self.scenarios, depths=self.prices is not None)
        values: Tensor = self.problem.risk.values(seen.total)
        if self.prices is None:
            return values
        return values - self.prices(seen, v)


def pathwise_by_run(problem: CoDesignProblem, agent: ActorCritic, v: Tensor, scenarios: ScenarioTensors) -> Tensor:
    """Pathwise slopes ∂/∂v of every run's return, (n, np)."""
    each = v.detach().expand(len(scenarios[0]), -1).clone().requires_grad_(True)
    total = problem.risk.values(episode_at(problem, agent, each, scenarios).total).sum()
    return torch.autograd.grad(total, each)[0].double()


def standard_error(by_run: Tensor) -> Tensor:
    """Standard error (np,) of the mean over runs; infinite for one."""
    if len(by_run) < 2:
        return torch.full_like(by_run[0], float("inf"))
    error: Tensor = by_run.std(0) / len(by_run) ** 0.5
    return error


@dataclass(frozen=True, eq=False)
class Slope:
    """Rise of the mean return with the design, where there is room."""

    # finite differences and their standard errors, per length of the unit box; 0 where a bound leaves no room
    mean: Array  # (np,)
    error: Array  # (np,)
    room: Array  # (np,): distance to the bound that the slope points at
    # the same of the slopes that point across a bound; 0 elsewhere
    across: Array  # (np,)
    across_error: Array  # (np,)

    @classmethod
    def none(cls, size: int) -> Slope:
        """Level slope."""
        level = np.zeros(size)
        return cls(level, level, np.ones(size), level, level)

    @classmethod
    def of(cls, by_run: Tensor, v: Tensor) -> Slope:
        """Slope from every run's slopes (n, np) at a point."""
        both = np.stack([by_run.mean(0).numpy(), standard_error(by_run).numpy()])
        point = v.double().numpy()
        room = np.where(both[0] > 0, 1.0 - point, point)
        inside_box = np.where(room > 0, both, 0.0)
        across = np.where(room > 0, 0.0, both)
        return cls(inside_box[0], inside_box[1], room, across[0], across[1])

    def promises(self, gain: float) -> bool:
        """True if a significant slope that falls to zero ahead brings the gain."""
        return _brings(self.mean, self.error, np.minimum(self.room, SLOPE_AHEAD), gain)

    def rises_across_bounds(self, gain: float) -> bool:
        """Whether a wider box brings such a gain."""
        return _brings(self.across, self.across_error, np.full(len(self.across), SLOPE_AHEAD), gain)

    def unresolved(self, size: float) -> bool:
        """True if the error is too large beside such returns."""
        return bool((self.error * SLOPE_AHEAD > UNRESOLVED_SLOPE * size).any() or not np.isfinite(self.error).all())


def _brings(slope: Array, error: Array, distance: Array, gain: float) -> bool:
    """True if a significant slope (np,) falling to zero over its distance brings the gain."""
    return bool(((np.abs(slope) > SIGNIFICANT * error) & (np.abs(slope) * distance / 2 > gain)).any())


def check_gradients(
    problem: CoDesignProblem,
    agent: ActorCritic,
    design: Array,
    *,
    rng: np.random.Generator,
    runs: int = 512,
    step: float | None = None,
    ppo: PPOConfig | None = None,
    network_input: bool = True,
) -> GradientCheck:
    """Every design gradient beside finite differences on common scenarios.

    Parameters
    ----------
    design : (np,) array_like
        Where to compare, in physical units; closer than `step` to a bound, the comparison is made at that distance.
    runs : int
        Scenarios of 100 steps; of longer ones fewer are taken.
    step : float, optional
        Step of the central differences in the unit box; by default 0.01, or less where the return bends more.
    network_input : bool
        Whether to compute the paper's gradient, too, which takes about as long as all the rest.

    Raises
    ------
    InputError
        If an argument is of the wrong kind or out of range.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    check_agent(problem, agent)
    as_generator("rng", rng)
    as_count("runs", runs)
    if step is not None:
        as_number("step", step, expected="a number between 0 and 0.5, or None", low=0.0, high=0.5, strict=True)
    design = problem.design.check_one(design)
    v = torch.tensor(problem.design.to_unit(design), dtype=torch.float32)
    scenarios = scenario_tensors(problem, fewer_runs(runs, problem.steps), rng)
    differences = Differences(problem, agent, scenarios)
    step = differences.step(v) if step is None else step
    v = inside(v, step)
    by_difference = differences.about(v, step)
    pathwise = pathwise_by_run(problem, agent, v, scenarios)
    others = {}
    if as_flag("network_input", network_input):
        found = network_input_gradient(problem, agent, v, rng=rng, runs=len(pathwise), config=ppo or PPOConfig.warm())
        others["network_input"] = found.double().numpy()
    with torch.no_grad():
        mean = episode_at(problem, agent, v, scenarios).total.mean()
        scale = float(problem.made_by_control(mean, to_design(problem, v)))
    return compared(tuple(problem.design.names), pathwise, by_difference, scale, **others)


def compared(
    names: tuple[str, ...], pathwise: Tensor, by_difference: Tensor, scale: float, **others: Any
) -> GradientCheck:
    """Means of every run's slopes (n, np), both ways, with their errors."""
    return GradientCheck(
        names, by_difference.mean(0).numpy(), pathwise.mean(0).numpy(), scale=scale,
        finite_difference_error=standard_error(by_difference).numpy(), pathwise_error=standard_error(pathwise).numpy(),
        deviation_error=standard_error(pathwise - by_difference).numpy(), **others,
    )  # fmt: skip
