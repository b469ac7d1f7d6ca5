"""First policies, which imitate an expert or learn from scratch."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from ccdtools.arrays import Array
from ccdtools.co_design.budgets import SETTLING_RUNS
from ccdtools.co_design.closed_loop import closed_loop_returns
from ccdtools.co_design.design_controllers import long_mpc, lqr_laws, own_cost, saturated_lqr
from ccdtools.co_design.differentiable_model import episode_at, fewer_runs, scenario_tensors
from ccdtools.co_design.environment import EpisodeEnv
from ccdtools.co_design.expert import ExpertData, expert_dataset
from ccdtools.co_design.expert_loops import DesignLaw
from ccdtools.co_design.loops import Law, loops_of, lqr_is_expert
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.secant import stochastic_linearisation
from ccdtools.controllers.controllers import LinearFeedback
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.exceptions import InputError
from ccdtools.progress import at
from learning.networks import ActorCritic, NetworkConfig
from learning.training import train
from learning.warm_start import CloningConfig, fit_actor_critic, fit_further
from mpc import MPCError, NotStabilisableError


def _any_lqr(problem: CoDesignProblem, p: Array) -> LinearFeedback:
    """LQR of the tangent at rest, or of the secant where that has none."""
    try:
        return saturated_lqr(problem, p)
    except NotStabilisableError:
        return stochastic_linearisation(problem, p, np.random.default_rng(0)).controller


EXPERTS: dict[str, Callable[[CoDesignProblem, Array], Any]] = {
    "LQR": _any_lqr,
    "nonlinear MPC": long_mpc,
    "economic MPC": lambda problem, p: long_mpc(problem, p, cost="objective"),
}


class FirstPolicy(NamedTuple):
    """First policy, and what it imitates."""

    agent: ActorCritic
    expert: str | DesignLaw
    samples: int  # none where there is no expert
    data: ExpertData | None = None  # where the samples begin all over X; None of an episode's own starts


def first_policy(
    problem: CoDesignProblem, design: Array, rng: np.random.Generator, *, expert: str | DesignLaw = "auto",
    all_over: bool = True, runs: int = 16, network: NetworkConfig | None = None, cloning: CloningConfig | None = None,
    progress: bool = False, **options: Any,
) -> FirstPolicy:  # fmt: skip
    """First policy of a co-design or a study.

    Parameters
    ----------
    expert : {"auto", "lqr", "mpc", "explicit"} or function of (problem, design)
        What it imitates all over X and all designs, see `expert_dataset`, which takes the `options`. "auto" is LQR,
        or, where LQR brings nothing to rest at the design, the best of LQR (of the secant where the tangent has none)
        and MPC of the model, see `planned_start`, or, where no design has an expert, nothing: PPO learns from scratch.
    """
    if expert == "auto":
        if not lqr_is_expert(problem, design, copy.deepcopy(rng)):
            at("first policy that imitates the best expert")
            planned = planned_start(
                problem, design, rng, all_over=all_over, runs=runs, network=network, cloning=cloning
            )
            if planned is not None:
                return planned
            designs = problem.design.spread()
            if np.isnan(lqr_laws(problem, problem.model.matrices(designs), designs)[0]).any(axis=(1, 2)).all():
                return FirstPolicy(policy_from_scratch(problem, design, rng), "auto", 0)
        expert = "lqr"
    data = expert_dataset(problem, **{"samples": 1000, **options}, rng=rng, expert=expert, progress=progress)
    cloning = CloningConfig() if cloning is None else cloning
    at(f"imitation of {len(data.inputs)} samples in {cloning.steps} steps")
    agent = imitating(
        problem, data.inputs, data.actions, data.values, rng, network=network, config=cloning, progress=progress
    )
    return FirstPolicy(agent, expert, len(data.inputs), data)


def policy_from_scratch(
    problem: CoDesignProblem, design: Array, rng: np.random.Generator, *, updates: int = 200, runs: int = 16,
    steps: int = 64, tries: int = 2,
) -> ActorCritic:  # fmt: skip
    """Best agent that PPO trains with its defaults at a design (np,).

    Of `tries` trainings by `updates` of `steps` of each of `runs`; at a wall one of fifteen did not find what others
    did.
    """
    at("policy that PPO learns from scratch")
    agents = []
    for _ in range(tries):
        seed = int(rng.integers(2**31))
        env = EpisodeEnv(problem, design, runs=runs, rng=rng, divergence=problem.divergence)
        generator = torch.Generator().manual_seed(seed)
        agents.append(train(env, env.agent(seed=seed), iterations=updates, steps=steps, generator=generator).agent)
    scenarios = scenario_tensors(problem, fewer_runs(4 * SETTLING_RUNS, problem.steps), copy.deepcopy(rng))
    v = torch.tensor(problem.design.to_unit(design), dtype=torch.float32)
    with torch.no_grad():
        worth = [problem.risk.values(episode_at(problem, agent, v, scenarios).total).mean() for agent in agents]
    return agents[int(torch.stack(worth).nan_to_num(nan=-torch.inf).argmax())]


def best_expert(problem: CoDesignProblem, design: Array, rng: np.random.Generator, *, runs: int = 4) -> str | None:
    """Name of the best expert at a design (np,).

    One that keeps more runs is better, then one that returns more; None where none keeps a run.
    """
    x0, w = problem.scenarios.sample(runs, problem.steps, rng)
    worth = {}
    for name in EXPERTS if own_cost(problem) else [*EXPERTS][:2]:
        with suppress(MPCError, InputError):
            loops = loops_of(problem, EXPERTS[name](problem, design), design, x0, w)
            if loops.kept.any():
                worth[name] = (loops.kept.sum(), loops.rewards[:, loops.kept].sum(axis=0).mean())
    return max(worth, key=lambda name: worth[name], default=None)


def planned_start(
    problem: CoDesignProblem, design: Array, rng: np.random.Generator, *, all_over: bool = True,
    shares: Sequence[float] = (0.5, 0.75), runs: int = 16, network: NetworkConfig | None = None,
    cloning: CloningConfig | None = None,
) -> FirstPolicy | None:  # fmt: skip
    """Policy that imitates the best expert, in loops that both drive.

    None where no expert keeps a run.

    A policy that only saw the expert's own loops does not know what to do after its own errors. So in rounds at the
    design it drives the given shares of the samples itself, drawn by chance, and the expert, who goes on from there,
    says what it would do in all of them.

    Parameters
    ----------
    all_over : bool
        Whether the expert's own loops are at three other designs, too.
    shares : sequence of float
        Of the samples that the policy drives, a round each.
    runs : int
        Of the expert alone; half as many in every round.
    network, cloning : optional
        Shapes, and rates of fits that take four times the steps: MPC switches near its bounds.

    References
    ----------
    Ross, Gordon, Bagnell, "A reduction of imitation learning and structured prediction to no-regret online learning",
    AISTATS 2011 (DAgger, whose expert drives a part of the samples, too).
    """
    drawn = problem.design.latin_hypercube(3, rng) if all_over else np.empty((0, problem.design.dim))
    designs = [design, *map(problem.design.project, drawn)]
    name = best_expert(problem, design, rng)
    if name is None:
        return None
    expert, at_first = EXPERTS[name], EXPERTS[name](problem, design)
    data: list[tuple[Array, Array, Array]] = []
    for p in designs:
        with suppress(MPCError, InputError):
            data.append(_shared(problem, expert(problem, p), None, p, 0.0, -(-runs // len(designs)), rng))
    if not any(len(part[0]) for part in data):
        return None
    cloning = CloningConfig() if cloning is None else cloning
    options = {"network": network, "config": replace(cloning, steps=4 * cloning.steps)}
    agents = [_imitating_all(problem, data, rng, options)]
    for share in shares:
        driver = LearnedPolicy(agents[-1], design)
        data.append(_shared(problem, at_first, driver, design, share, runs // 2, rng))
        seen, inputs, _ = (np.concatenate(part) for part in zip(*data))
        agents.append(fit_further(agents[-1], seen, inputs, rng, steps=cloning.steps))
    best = max(agents, key=lambda agent: _worth(problem, agent, design, rng))
    return FirstPolicy(best, name, sum(len(part[0]) for part in data))


def _worth(problem: CoDesignProblem, agent: ActorCritic, design: Array, rng: np.random.Generator) -> tuple[float, ...]:
    """Less the share of lost runs, and the mean return."""
    loops = closed_loop_returns(problem, LearnedPolicy(agent, design), design, copy.deepcopy(rng), runs=64)
    return -loops.lost_share, float(np.nan_to_num(loops.summary.mean, nan=-np.inf))


def _imitating_all(
    problem: CoDesignProblem, data: list[tuple[Array, Array, Array]], rng: np.random.Generator, options: dict[str, Any]
) -> ActorCritic:
    """Agent that imitates the samples of all rounds."""
    seen, inputs, values = (np.concatenate(part) for part in zip(*data))
    return imitating(problem, seen, inputs, values, rng, **options)


def imitating(
    problem: CoDesignProblem, seen: Array, inputs: Array, values: Array, rng: np.random.Generator, **options: Any
) -> ActorCritic:
    """Agent of a problem that imitates what was done."""
    bounds = problem.observation_bounds
    return fit_actor_critic(
        seen, inputs, values, action_bounds=problem.action_bounds, input_bounds=bounds, rng=rng, **options
    )


def _shared(
    problem: CoDesignProblem, law: Law, driver: Law | None, p: Array, share: float, runs: int, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Observations, inputs and values of a law.

    Where a driver takes a share of the samples values are unknown.
    """
    x0, w = problem.scenarios.sample(runs, problem.steps, rng)
    law = copy.copy(law)  # without the plans of other runs

    def applied(x: Array, u: Array) -> Array:
        """Inputs of the one or the other, run by run."""
        return u if driver is None else np.where(rng.random((len(x), 1)) < share, driver(x), u)

    states, inputs, values = loops_of(problem, law, p, x0, w, applied).samples()
    seen = np.hstack([states, np.tile(p, (len(states), 1))])
    return seen, inputs, values if driver is None else np.full(len(values), np.nan)
