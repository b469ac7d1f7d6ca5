"""One front door for every way to co-design."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import ArrayLike

from ccdtools.arrays import Array
from ccdtools.checks import as_choice, as_flag, as_generator, as_instance, has_method
from ccdtools.co_design.agents import check_agent
from ccdtools.co_design.ascent import Ascent
from ccdtools.co_design.configuration import METHODS, CoDesignConfig
from ccdtools.co_design.episodes import episode_at
from ccdtools.co_design.least_depth import warn_of_unavoidable_depth
from ccdtools.co_design.limits import StateLimitPenalty
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.result import CoDesignResult, Valley
from ccdtools.co_design.risk import check_followed
from ccdtools.co_design.starts import chosen_valleys, leader, race, start_designs
from ccdtools.co_design.task import LimitPenalty, Task
from ccdtools.exceptions import InputError
from learning.networks import ActorCritic


def codesign(
    problem: CoDesignProblem,
    *,
    agent: ActorCritic,
    design: ArrayLike,
    rng: np.random.Generator,
    method: str = "pathwise",
    config: CoDesignConfig | None = None,
    judge: CoDesignProblem | None = None,
    limits: LimitPenalty | None = None,
    progress: bool = False,
) -> CoDesignResult:
    """The best design and policy found for `problem`.

    Parameters
    ----------
    problem : CoDesignProblem
    agent : ActorCritic
        Warm start, from `learning.fit_actor_critic`; copied, not changed.
    design : (np,) array_like
        First design, in physical units.
    rng : numpy.random.Generator
    method : {"pathwise", "ppo", "pathwise+ppo"}
        What moves the policy: its gradient through the model, PPO, or both. `config.design_gradient` says what moves
        the design.
    config : CoDesignConfig, optional
    judge : CoDesignProblem, optional
        What the iterates are scored on, if not `problem` itself: for example replays of what was logged, where
        `problem` holds a learned model whose errors an optimiser may exploit.
    limits : optional
        What leaving X costs, see `LimitPenalty`; by default what `judge.limit_tolerance` asks for.
    progress : bool
        Show a progress bar.

    Raises
    ------
    InputError
        If an argument is of the wrong kind, `design` is not feasible, `agent` does not observe (x, p) over the
        box of designs or acts within other bounds than U, or the objective does not take torch tensors.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_choice("method", method, METHODS)
    as_generator("rng", rng)
    config = as_instance("config", CoDesignConfig() if config is None else config, CoDesignConfig, "a CoDesignConfig")
    judge = as_instance("judge", problem if judge is None else judge, CoDesignProblem, "a CoDesignProblem or None")
    design = problem.design.check_feasible(design)
    check_followed(problem.risk, method, config.design_gradient)
    check_agent(problem, agent)
    as_flag("progress", progress)
    if limits is not None:
        has_method("limits", limits, "prices", "a LimitPenalty, such as a StateLimitPenalty, or None")
    _check_judge(problem, judge)
    _check_objective(problem)
    if limits is None and judge.limit_tolerance != "off":
        limits = StateLimitPenalty(judge)
        warn_of_unavoidable_depth(judge, design)
    task = Task(problem, judge, method, config, limits)
    found = chosen_valleys(task, design, rng)
    ascents = race(task, agent, start_designs(task, design, found), rng, progress=progress)
    return _result(task, ascents, agent, design, found)


def _result(
    task: Task, ascents: list[Ascent], agent: ActorCritic, design: Array, found: tuple[Valley, ...]
) -> CoDesignResult:
    """The winner of the race, with what the others came to."""
    winner = ascents[0]
    space = task.problem.design
    best = winner.region.settled(winner.best.v)
    assert winner.status is not None
    return CoDesignResult(
        best, winner.best.agent, space.active_bounds(best), winner.history(), winner.check, winner.best.limits,
        winner.status, task.method, _gains(task, winner, agent, design), winner.convergence(),
        _with_ends(found, ascents, design), space.active_constraints(best),
    )  # fmt: skip


@torch.no_grad()
def _gains(task: Task, winner: Ascent, agent: ActorCritic, design: Array) -> dict[str, float]:
    """What design and policy gained, one after the other, on the evaluation scenarios."""
    first = torch.tensor(task.problem.design.to_unit(design), dtype=torch.float32)
    before, moved = (
        task.judge.risk.values(episode_at(task.judge, agent, v, winner.evaluation).total).mean().item()
        for v in (first, winner.best.v)
    )
    return {"design": moved - before, "policy": winner.best.score - moved}


def _with_ends(found: tuple[Valley, ...], ascents: list[Ascent], design: Array) -> tuple[Valley, ...]:
    """The valleys, with where the best co-design that began on each of them ended; `design` is the given one."""
    named = []
    for valley in found:
        places = [valley.design, design] if valley.given else [valley.design]
        begun = [one for one in ascents if any(np.array_equal(one.start, place) for place in places)]
        if begun:
            first = leader(begun)
            end = first.region.settled(first.best.v)
            valley = replace(valley, found=end, found_return=first.best.score)
        named.append(valley)
    return tuple(named)


def _check_judge(problem: CoDesignProblem, judge: CoDesignProblem) -> None:
    """Raise an `InputError` unless the judge has the states, inputs and box of designs of `problem`."""
    own = problem.design
    other = judge.design
    same_box = own.names == other.names and np.array_equal([own.lower, own.upper], [other.lower, other.upper])
    if not same_box or (judge.model.nx, judge.model.nu) != (problem.model.nx, problem.model.nu):
        raise InputError("judge", repr(judge), "the states, inputs and box of designs of the problem")


def _check_objective(problem: CoDesignProblem) -> None:
    """Raise an `InputError` unless the objective gives one differentiable reward per row of torch tensors."""
    x = torch.zeros(2, problem.model.nx, requires_grad=True)
    u = torch.zeros(2, problem.model.nu, requires_grad=True)
    try:
        rewards = problem.objective.rewards(x, u, x, torch.tensor(problem.design.centre, dtype=x.dtype))
        fits = torch.is_tensor(rewards) and rewards.shape == (2,) and rewards.requires_grad
    except (TypeError, ValueError, RuntimeError, AttributeError):
        fits = False
    if not fits:
        raise InputError(
            "objective", f"a {type(problem.objective).__name__} whose rewards do not take torch tensors",
            "rewards (n,) of states (n, nx) and inputs (n, nu), NumPy arrays and torch tensors alike",
        )  # fmt: skip
