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
from ccdtools.co_design.loops import Law, loops_of
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.controllers.learned import LearnedPolicy
from ccdtools.exceptions import InputError
from learning.networks import ActorCritic
from learning.warm_start import CloningConfig, fit_actor_critic
from mpc import MPCError

EXPERTS: dict[str, Callable[[CoDesignProblem, Array], Any]] = {
    "LQR": saturated_lqr,
    "nonlinear MPC": long_mpc,
    "economic MPC": lambda problem, p: long_mpc(problem, p, cost="objective"),
}


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
    shares: Sequence[float] = (0.5, 0.75), runs: int = 16,
) -> ActorCritic | None:  # fmt: skip
    """Agent that imitates the best expert, in loops that both drive.

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
    agents = [_imitating_all(problem, data, rng)]
    for share in shares:
        driver = LearnedPolicy(agents[-1], design)
        data.append(_shared(problem, at_first, driver, design, share, runs // 2, rng))
        agents.append(_imitating_all(problem, data, rng))
    return max(agents, key=lambda agent: _worth(problem, agent, design, rng))


def _worth(problem: CoDesignProblem, agent: ActorCritic, design: Array, rng: np.random.Generator) -> tuple[float, ...]:
    """Less the share of lost runs, and the mean return."""
    loops = closed_loop_returns(problem, LearnedPolicy(agent, design), design, copy.deepcopy(rng), runs=64)
    return -loops.lost_share, float(np.nan_to_num(loops.summary.mean, nan=-np.inf))


def _imitating_all(
    problem: CoDesignProblem, data: list[tuple[Array, Array, Array]], rng: np.random.Generator
) -> ActorCritic:
    """Agent that imitates the samples of all rounds."""
    # longer than one of LQR, as MPC switches near its bounds
    seen, inputs, values = (np.concatenate(part) for part in zip(*data))
    return imitating(problem, seen, inputs, values, rng, config=CloningConfig(steps=4 * CloningConfig.steps))


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
