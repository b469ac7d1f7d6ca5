"""First policies that imitate MPC of the model, where LQR is no expert."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.co_design.closed_loop import closed_loop_returns
from ccdtools.co_design.design_controllers import long_mpc, own_cost, saturated_lqr
from ccdtools.co_design.loops import Law, Loops, loops_of
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.exceptions import InputError
from learning.networks import ActorCritic
from learning.warm_start import CloningConfig, fit_actor_critic
from mpc import MPCError

EXPERTS: dict[str, Callable[[CoDesignProblem, Array], Any]] = {
    "LQR": saturated_lqr,
    "MPC by the weights of LQR": long_mpc,
    "MPC of the objective": lambda problem, p: long_mpc(problem, p, cost="objective"),
}


def best_expert(problem: CoDesignProblem, design: Array, rng: np.random.Generator, *, runs: int = 4) -> str:
    """Name of the expert with the best loops at a design (np,); one that keeps more runs is better."""
    x0, w = problem.scenarios.sample(runs, problem.steps, rng)
    worth = {}
    for name in EXPERTS if own_cost(problem) else [*EXPERTS][:2]:
        with suppress(MPCError, InputError):
            loops = loops_of(problem, EXPERTS[name](problem, design), design, x0, w)
            worth[name] = (loops.kept.sum(), np.nan_to_num(loops.rewards.sum(axis=0).mean(), nan=-np.inf))
    return max(worth, key=lambda name: worth[name], default="LQR")


def planned_start(
    problem: CoDesignProblem, design: Array, rng: np.random.Generator, *, all_over: bool = True,
    shares: Sequence[float] = (0.0, 0.5, 0.75), runs: int = 16,
) -> ActorCritic:  # fmt: skip
    """Agent that imitates the best expert, in loops that both drive.

    A policy that only saw the expert's own loops does not know what to do after its own errors. In each round it
    drives the given share of the samples itself, drawn by chance, and the expert, who goes on from there, says what it
    would do in all of them.

    Parameters
    ----------
    all_over : bool
        Whether the loops are at three other designs in each round, too.
    shares : sequence of float
        Of the samples that the policy drives, a round each; none in the first.
    runs : int
        Of every round, over all designs.

    References
    ----------
    Ross, Gordon, Bagnell, "A reduction of imitation learning and structured prediction to no-regret online learning",
    AISTATS 2011 (DAgger, whose expert drives a part of the samples, too).
    """
    others = 3 * all_over
    each = -(-runs // (1 + others))
    expert = EXPERTS[best_expert(problem, design, rng, runs=each)]
    data: list[tuple[Array, Array, Array]] = []
    agents: list[ActorCritic] = []
    sharp = CloningConfig(steps=4 * CloningConfig.steps)  # near its bounds MPC switches
    for share in shares:
        drawn = problem.design.latin_hypercube(others, rng) if others else ()
        designs = [design, *map(problem.design.project, drawn)]
        for p in designs:
            with suppress(MPCError, InputError):
                driver = LearnedPolicy(agents[-1], p) if agents else None
                loops = _shared(problem, expert(problem, p), driver, p, share, each, rng)
                states, inputs, values = loops.samples()
                seen = np.hstack([states, np.tile(p, (len(states), 1))])
                data.append((seen, inputs, values if driver is None else np.full(len(values), np.nan)))
        seen, inputs, values = (np.concatenate(part) for part in zip(*data))
        agents.append(imitating(problem, seen, inputs, values, rng, config=sharp))
    return max(agents, key=lambda agent: _worth(problem, agent, designs, rng))


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
) -> Loops:
    """Loops of a law of which a driver takes a share of the samples."""
    x0, w = problem.scenarios.sample(runs, problem.steps, rng)

    def applied(x: Array, u: Array) -> Array:
        """Inputs of the one or the other, run by run."""
        return u if driver is None else np.where(rng.random((len(x), 1)) < share, driver(x), u)

    return loops_of(problem, law, p, x0, w, applied)


def _worth(problem: CoDesignProblem, agent: ActorCritic, designs: list[Array], rng: np.random.Generator) -> float:
    """Mean return of an agent over designs, on common runs."""
    loops = (closed_loop_returns(problem, LearnedPolicy(agent, p), p, copy.deepcopy(rng), runs=64) for p in designs)
    return float(np.mean([loop.summary.mean for loop in loops]))
