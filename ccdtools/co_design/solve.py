"""One front door for every way to co-design."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.co_design.reinforcement.ppo import CoDesignConfig, CoDesignResult, codesign_ppo
from ccdtools.exceptions import InputError
from learning.networks import ActorCritic


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
        Warm start, from `learning.warm_start.fit_actor_critic`; copied, not changed.
    design : (np,) array_like
        First design, in physical units.
    rng : numpy.random.Generator
    method : {"ppo"}
    config, judge, progress
        As in `codesign_ppo`.

    Raises
    ------
    InputError
        If `method` is unknown, or as in `codesign_ppo`.
    """
    if method != "ppo":
        raise InputError(f"method: got {method!r}, expected 'ppo'.")
    return codesign_ppo(problem, agent=agent, design=design, rng=rng, config=config, judge=judge, progress=progress)
