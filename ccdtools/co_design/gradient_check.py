"""Every design gradient beside finite differences: what a co-design looks at before its first move."""

from __future__ import annotations

import numpy as np
import torch

from ccdtools.arrays import Array
from ccdtools.checks import as_count, as_flag, as_generator, as_instance, as_number
from ccdtools.co_design.agents import check_agent
from ccdtools.co_design.design_gradients import Differences, inside, pathwise_by_run, standard_error
from ccdtools.co_design.differentiable_model import scenario_tensors, to_design
from ccdtools.co_design.episodes import episode_at, fewer_runs
from ccdtools.co_design.learned_result import GradientCheck
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.reinforcement.gradients import network_input_gradient
from learning.networks import ActorCritic
from learning.ppo import PPOConfig


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
    """Every design gradient beside finite differences, on the same scenarios.

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
    network = torch.full_like(v, torch.nan)
    if as_flag("network_input", network_input):
        network = network_input_gradient(problem, agent, v, rng=rng, runs=len(pathwise), config=ppo or PPOConfig())
    with torch.no_grad():
        mean = episode_at(problem, agent, v, scenarios).total.mean()
        scale = float(problem.made_by_control(mean, to_design(problem, v)))
    return GradientCheck(
        tuple(problem.design.names), by_difference.mean(0).numpy(), pathwise.mean(0).numpy(), network.double().numpy(),
        standard_error(by_difference).numpy(), standard_error(pathwise).numpy(),
        standard_error(pathwise - by_difference).numpy(), scale,
    )  # fmt: skip
