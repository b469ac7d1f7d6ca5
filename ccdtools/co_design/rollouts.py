"""Policy iteration by rollouts.

From states that a policy visits other inputs are held for some samples before the policy goes on. Where that returns
more, on disturbances that did not choose it, too, the policy imitates it. No derivative is taken, so jumps are seen,
and what no small change of a policy reaches.

References
----------
Tesauro and Galperin, "On-line policy improvement using Monte-Carlo search", NIPS 1996. Lagoudakis and Parr,
"Reinforcement learning as classification", ICML 2003.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from torch import Tensor

from ccdtools.arrays import Array
from ccdtools.co_design.differentiable_model import (
    Law,
    ScenarioTensors,
    Stepper,
    episode,
    fewer_runs,
    mean_law,
    observe,
    scenario_tensors,
    simulated,
    visited,
)
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.progress import at
from ccdtools.statistics import PairedDifference, paired_difference
from learning.networks import ActorCritic
from learning.warm_start import fit_further


@dataclass(frozen=True, eq=False)
class Plans:
    """Inputs to hold from n states, and what they return.

    Returns are means over draws of the disturbance that did not choose the inputs.
    """

    first: Tensor  # (n, nu)
    samples: Tensor  # (n,): 0 where the policy's own inputs are best
    returns: Tensor  # (n,): means over the draws
    own: Tensor  # (n,): of the policy alone

    @property
    def gain(self) -> Tensor:
        """What the plans return more (n,), nothing where it is less."""
        return (self.returns - self.own).clamp(min=0.0)


class Held:
    """Law that begins by holding inputs, each run for samples of its own."""

    def __init__(self, law: Law, first: Tensor, samples: Tensor) -> None:
        self.law, self.first, self.samples, self.k = law, first, samples, -1

    def __call__(self, x: Tensor) -> Tensor:
        """Inputs (n, nu)."""
        self.k += 1
        return torch.where((self.k < self.samples)[:, None], self.first, self.law(x))


def improved(
    problem: CoDesignProblem, agent: ActorCritic, design: Array, rng: np.random.Generator, *, rounds: int = 5,
    work: int = 5_000_000,
) -> ActorCritic:  # fmt: skip
    """Best agent of some rounds.

    It is the given one where none is better.

    Parameters
    ----------
    design : (np,) array
        Where it drives.
    work : int
        Steps of the model in a round.
    """
    at("rollouts of the policy, with other inputs held")
    p = torch.tensor(design, dtype=torch.float32)
    judged = scenario_tensors(problem, fewer_runs(1024, problem.steps), rng)
    best = last = agent
    plans: list[tuple[Tensor, Tensor, Tensor]] = []
    for _ in range(rounds):
        plans.append(along_plans(problem, last, p, rng, work=work))
        seen, inputs, weights = (torch.cat(part) for part in zip(*plans))
        last = fit_further(last, seen, inputs, rng, weights=weights)
        if _better(problem, last, best, p, judged):
            best = last
    return best


def better_by_plans(
    problem: CoDesignProblem, policy: LearnedPolicy, rng: np.random.Generator, *, work: int = 1_500_000
) -> PairedDifference:
    """Gain of holding other inputs from the start.

    The policy goes on. A warm-up is the policy's own. `work` is about how many steps of the model it takes, for sixteen
    starts or more.
    """
    p = torch.tensor(policy.design, dtype=torch.float32)
    starts = _seen(problem, policy.agent, p, scenario_tensors(problem, 256, rng))[0]
    plans, _ = best_plans(problem, policy.agent, p, starts, rng, work=work)
    return paired_difference(plans.returns.numpy(), plans.own.numpy())


@torch.no_grad()
def along_plans(
    problem: CoDesignProblem, agent: ActorCritic, p: Tensor, rng: np.random.Generator, *, work: int,
    further: int = 16,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Samples of the best plans.

    They are observations (k, n_obs) from states on that a policy visits, inputs (k, nu) and weights (k,). What is held
    weighs as much more as it gains; of what the policy does afterwards about `further` samples of a run are among them.
    """
    T, step, law = problem.steps - problem.warm_up, Stepper.at(problem, p), mean_law(agent, p)
    x = _seen(problem, agent, p, scenario_tensors(problem, fewer_runs(256, T), rng)).flatten(0, 1)
    x = x[~step.left(x)]
    x = x[torch.as_tensor(rng.permutation(len(x)))]
    plans, w = best_plans(problem, agent, p, x, rng, work=work)
    samples = torch.where(plans.gain > 0, plans.samples, 0)
    n = len(samples)
    step = Stepper.at(replace(problem, warm_up=0), p)
    states, inputs, seen = visited(step, Held(law, plans.first, samples), (x[:n], w))
    held = torch.arange(T).repeat_interleave(n) < samples.repeat(T)
    kept = (~seen.diverged).repeat(T) & ~step.left(states)
    kept &= held | torch.as_tensor(rng.random(len(states)) < further / T)
    relative = plans.gain / plans.gain.mean().clamp(min=torch.finfo(torch.float64).tiny)
    weights = 1.0 + torch.where(held, relative.repeat(T), 0.0)
    return observe(states[kept], p), inputs[kept], weights[kept].float()


@torch.no_grad()
def best_plans(
    problem: CoDesignProblem, agent: ActorCritic, p: Tensor, x: Tensor, rng: np.random.Generator, *, work: int,
    levels: int = 5, durations: int = 5, draws: int = 4, least: int = 16,
) -> tuple[Plans, Tensor]:  # fmt: skip
    """Best plans, and a disturbance of each.

    They are from as many states as `work` steps of the model allow, and from `least`. Held are `levels` values of one
    input, the others as the policy has them, for `durations` from a sample to half an episode. Half of the `draws` of
    the disturbance choose. No plan counts that loses runs or leaves the limits further.
    """
    T, nu = problem.steps - problem.warm_up, problem.model.nu
    counts = np.unique(np.geomspace(1, max(T / 2, 1), durations).round().astype(int)).tolist()
    tries = list(product(range(nu), np.linspace(-1, 1, levels), counts))
    x = x[: max(work // (T * draws * (len(tries) + 1)), least)]
    n = len(x)
    later = replace(problem, warm_up=0)
    step, law = Stepper.at(later, p), mean_law(agent, p)
    w = torch.tensor(later.driving(n * draws, T, rng), dtype=torch.float32)
    limited = problem.limit_tolerance != "off"

    def tried(first: Tensor, samples: Tensor) -> tuple[Tensor, Tensor]:
        """Returns and depths outside the limits (2, n), in the draws that choose and in the others."""
        plan = Held(law, *(part.repeat_interleave(draws, dim=0) for part in (first, samples)))
        seen = simulated(step, plan, (x.repeat_interleave(draws, dim=0), w), depths=limited, guarded=True)
        lost = torch.where(seen.diverged, torch.inf, seen.depth)
        returns, depths = (part.reshape(n, 2, -1).mean(-1).T for part in (seen.total, lost))
        return returns, depths

    first, samples = law(x), torch.zeros(n, dtype=torch.int64)
    own, deep = tried(first, samples)
    chosen, middle, half = own, *(part.expand_as(first) for part in agent.action_range(p))
    usual = first
    for j, level, count in tries:
        inputs = usual.clone()
        inputs[:, j] = middle[:, j] + level * half[:, j]
        returns, depths = tried(inputs, torch.full_like(samples, count))
        ahead = (returns[0] > chosen[0]) & (depths[0] <= deep[0])
        chosen = torch.where(ahead, returns, chosen)
        first = torch.where(ahead[:, None], inputs, first)
        samples = torch.where(ahead, count, samples)
    return Plans(first, samples, chosen[1], own[1]), w[::draws]


def _seen(problem: CoDesignProblem, agent: ActorCritic, p: Tensor, scenarios: ScenarioTensors) -> Tensor:
    """States (T, n, nx) that a policy visits after the warm-up."""
    states, *_ = visited(Stepper.at(problem, p), mean_law(agent, p), scenarios)
    by_sample: Tensor = states.unflatten(0, (-1, len(scenarios[0])))
    return by_sample[problem.warm_up :]


@torch.no_grad()
def _better(problem: CoDesignProblem, one: ActorCritic, other: ActorCritic, p: Tensor, judged: ScenarioTensors) -> bool:
    """Whether an agent is better.

    It returns more than the other, loses no more runs and leaves the limits no further.
    """
    a, b = (episode(problem, agent, p, judged, depths=True) for agent in (one, other))
    further = problem.limit_tolerance != "off" and a.depth.mean() > b.depth.mean()
    return not (further or a.diverged.sum() > b.diverged.sum()) and bool(a.total.mean() > b.total.mean())
