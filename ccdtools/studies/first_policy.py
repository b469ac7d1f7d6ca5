"""First policy of a study."""

from __future__ import annotations

import numpy as np

from ccdtools.co_design.imitation import FirstPolicy, first_policy
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.studies.presets import StudyConfig
from ccdtools.studies.study import Study


def imitated_at(
    problem: CoDesignProblem, study: Study, config: StudyConfig, rng: np.random.Generator, *, progress: bool
) -> FirstPolicy:  # fmt: skip
    """First policy of a study, which imitates its expert."""
    return first_policy(
        problem, study.p0, rng, expert=study.laws.get(config.expert, config.expert), runs=min(16, config.mpc_runs),
        network=config.network, cloning=config.cloning, progress=progress, samples=config.samples,
        gamma=config.codesign.ppo.gamma, sets=config.sets, time_limit=config.sets_time_limit,
    )  # fmt: skip
