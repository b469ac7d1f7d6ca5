"""One front door for every way to co-design."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike

from ccdtools.checks import as_choice, as_generator, as_instance
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.reinforcement.ppo import CoDesignConfig, codesign_ppo
from ccdtools.co_design.result import CoDesignResult
from ccdtools.controllers.learned import EDGE
from ccdtools.exceptions import InputError
from learning.networks import ActorCritic

METHODS = ("ppo",)
SAME_BOUNDS = 1e-5  # relative difference of the agent's action bounds from U that rounding to float32 explains


def codesign(
    problem: CoDesignProblem,
    *,
    agent: ActorCritic,
    design: ArrayLike,
    rng: np.random.Generator,
    method: str = "ppo",
    config: CoDesignConfig | None = None,
    judge: CoDesignProblem | None = None,
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
    method : {"ppo"}
        Gradients through the model, with PPO beside them.
    config : CoDesignConfig, optional
    judge : CoDesignProblem, optional
        What the iterates are scored on, if not `problem` itself: for example replays of what was logged, where
        `problem` holds a learned model whose errors an optimiser may exploit.
    progress : bool
        Show a progress bar.

    Raises
    ------
    InputError
        If an argument is of the wrong kind, `design` lies outside its bounds, `agent` does not observe (x, p) over the
        box of designs or acts within other bounds than U, or the objective does not take torch tensors.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_choice("method", method, METHODS)
    as_generator("rng", rng)
    config = as_instance("config", config or CoDesignConfig(), CoDesignConfig, "a CoDesignConfig")
    judge = as_instance("judge", judge or problem, CoDesignProblem, "a CoDesignProblem")
    design = problem.design.check_one(design)
    _check_agent(problem, agent)
    _check_objective(problem)
    return codesign_ppo(
        problem, agent=agent, design=design, rng=rng, config=config, judge=judge, progress=progress
    )  # fmt: skip


def _check_agent(problem: CoDesignProblem, agent: ActorCritic) -> None:
    """Raise an `InputError` unless `agent` was made for the states, designs and inputs of `problem`."""
    as_instance("agent", agent, ActorCritic, "an ActorCritic", "fit_actor_critic makes one.")
    nx = problem.model.nx
    space = problem.design
    observed = len(agent.observation_offset)
    if observed != nx + space.dim:
        raise InputError("agent", f"{observed} inputs", f"{nx} states and {space.dim} design parameters")
    offset = agent.observation_offset[nx:].double().numpy()
    scale = agent.observation_scale[nx:].double().numpy()
    if (np.abs(np.stack([space.lower, space.upper]) - offset) > EDGE * scale).any():
        raise InputError(
            "agent", f"one made for designs in {(offset - scale).tolist()} to {(offset + scale).tolist()}",
            "the whole box of designs", "Pass input_bounds=problem.observation_bounds to fit_actor_critic.",
        )  # fmt: skip
    middle = agent.action_offset.double().numpy()
    half = agent.action_scale.double().numpy()
    lower, upper = problem.input_bounds
    if (
        len(middle) != len(lower)
        or (np.abs(np.stack([middle - half - lower, middle + half - upper])) > SAME_BOUNDS * (upper - lower)).any()
    ):
        raise InputError(
            "agent", f"actions in {(middle - half).tolist()} to {(middle + half).tolist()}",
            f"{lower.tolist()} to {upper.tolist()}, the bounds U",
            "Pass action_bounds=problem.input_bounds to fit_actor_critic.",
        )  # fmt: skip


def _check_objective(problem: CoDesignProblem) -> None:
    """Raise an `InputError` unless the objective gives one differentiable reward per row of torch tensors."""
    x = torch.zeros(2, problem.model.nx, requires_grad=True)
    u = torch.zeros(2, problem.model.nu)
    try:
        rewards = problem.objective.rewards(x, u)
        fits = torch.is_tensor(rewards) and rewards.shape == (2,) and rewards.requires_grad
    except (TypeError, ValueError, RuntimeError, AttributeError):
        fits = False
    if not fits:
        raise InputError(
            "objective", f"a {type(problem.objective).__name__} whose rewards do not take torch tensors",
            "rewards (n,) of states (n, nx) and inputs (n, nu), NumPy arrays and torch tensors alike",
        )  # fmt: skip
