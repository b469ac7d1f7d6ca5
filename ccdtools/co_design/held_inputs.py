"""Inputs that are held before a policy goes on.

No derivative is taken, so jumps are seen, and what no small change of a policy reaches.

References
----------
Tesauro and Galperin, "On-line policy improvement using Monte-Carlo search", NIPS 1996.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import torch
from torch import Tensor

from ccdtools.co_design.differentiable_model import (
    Law,
    Stepper,
    fewer_runs,
    mean_law,
    scenario_tensors,
    simulated,
    visited,
)
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.statistics import PairedDifference, paired_difference


class Held:
    """Law that begins by holding inputs, each run for samples of its own."""

    def __init__(self, law: Law, first: Tensor, samples: Tensor) -> None:
        self.law, self.first, self.samples, self.k = law, first, samples, -1

    def __call__(self, x: Tensor) -> Tensor:
        """Inputs (n, nu)."""
        self.k += 1
        return torch.where((self.k < self.samples)[:, None], self.first, self.law(x))


@torch.no_grad()
def better_by_holding(
    problem: CoDesignProblem, policy: LearnedPolicy, rng: np.random.Generator, *, work: int = 1_500_000,
    levels: int = 5, durations: int = 5, draws: int = 4, least: int = 16,
) -> PairedDifference:  # fmt: skip
    """Gain of holding other inputs from the start.

    The policy goes on. A warm-up is the policy's own. Held are `levels` values of one input, the others as the policy
    has them, for `durations` from a sample to half an episode. Half of the `draws` of the disturbance choose, the
    others measure. No plan counts that loses runs or leaves the limits further. `work` is about how many steps of the
    model it takes, for `least` starts or more.
    """
    p = torch.tensor(policy.design, dtype=torch.float32)
    T, nu = problem.steps - problem.warm_up, problem.model.nu
    counts = np.unique(np.geomspace(1, max(T / 2, 1), durations).round().astype(int)).tolist()
    tries = list(product(range(nu), np.linspace(-1, 1, levels), counts))
    scenarios = scenario_tensors(problem, fewer_runs(256, problem.steps), rng)
    law = mean_law(policy.agent, p)
    states, *_ = visited(Stepper.at(problem, p), law, scenarios)
    x = states.unflatten(0, (-1, len(scenarios[0])))[problem.warm_up]
    x = x[: max(work // (T * draws * (len(tries) + 1)), least)]
    n = len(x)
    later = replace(problem, warm_up=0)
    step = Stepper.at(later, p)
    w = torch.tensor(later.driving(n * draws, T, rng), dtype=torch.float32)
    limited = problem.limit_tolerance != "off"

    def tried(first: Tensor, samples: Tensor) -> tuple[Tensor, Tensor]:
        """Returns and depths outside the limits (2, n), in the draws that choose and in the others."""
        plan = Held(law, *(part.repeat_interleave(draws, dim=0) for part in (first, samples)))
        seen = simulated(step, plan, (x.repeat_interleave(draws, dim=0), w), depths=limited, guarded=True)
        lost = torch.where(seen.diverged, torch.inf, seen.depth)
        returns, depths = (part.reshape(n, 2, -1).mean(-1).T for part in (seen.total, lost))
        return returns, depths

    usual, samples = law(x), torch.zeros(n, dtype=torch.int64)
    own, deep = tried(usual, samples)
    best, middle, half = own, *(part.expand_as(usual) for part in policy.agent.action_range(p))
    for j, level, count in tries:
        inputs = usual.clone()
        inputs[:, j] = middle[:, j] + level * half[:, j]
        returns, depths = tried(inputs, torch.full_like(samples, count))
        ahead = (returns[0] > best[0]) & (depths[0] <= deep[0])
        best = torch.where(ahead, returns, best)
    return paired_difference(best[1].numpy(), own[1].numpy())
