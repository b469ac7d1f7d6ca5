"""Gradients of episodes of nonlinear plants, with steps of arrays and with compiled ones: least of nine, one thread.

python benchmarks/bench_compiled_steps.py
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from dataclasses import replace

import numpy as np
import torch

from ccdtools.co_design.differentiable_model import episode_at, scenario_tensors
from ccdtools.plants.compiled_step import CompiledStep
from ccdtools.studies import load_study
from learning import ActorCritic

EPISODES = 128


def seconds(problem, agent, scenarios):
    """Least time of a gradient, that of the first one, and the returns."""
    v = torch.full((problem.design.dim,), 0.5, requires_grad=True)
    times = []
    for _ in range(10):
        start = time.perf_counter()
        episode = episode_at(problem, agent, v, scenarios)
        episode.total.mean().backward()
        times.append(time.perf_counter() - start)
    return min(times[1:]), times[0], episode.total.detach()


def main():
    """Print a row for each study."""
    torch.set_num_threads(1)
    print("| study | parts | steps | arrays [s] | compiled [s] | the first [s] | returns differ by |")
    print("|---|---|---|---|---|---|---|")
    for name in ("semi_active_damper", "quarter_car_nonlinear", "pendulum_on_cart", "two_tanks"):
        study = load_study(name)
        problem = study.problem()
        model = problem.model
        if not isinstance(model._own_step, CompiledStep):
            continue
        bounds = (*problem.observation_bounds, *problem.input_bounds)
        agent = ActorCritic(*bounds, seed=0)
        scenarios = scenario_tensors(problem, EPISODES, np.random.default_rng(0))
        plain, _, before = seconds(replace(problem, model=replace(model, compiled=False)), agent, scenarios)
        fast, first, after = seconds(problem, agent, scenarios)
        differ = float(((after - before) / before).abs().max())
        row = (
            f"`{name}`",
            model.substeps,
            problem.steps,
            f"{plain:.2f}",
            f"{fast:.2f}",
            f"{first:.1f}",
            f"{differ:.0e}",
        )
        print("|", " | ".join(map(str, row)), "|")


if __name__ == "__main__":
    main()
