"""The controllers that every learned policy is compared with."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.checks import as_generator, as_instance
from ccdtools.co_design.design_controllers import linear_mpc, saturated_lqr
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.comparison.pid_tuning import tuned_pid
from ccdtools.controllers.controllers import Controller, Passive

REFERENCE = "LQR"


def baselines(problem: CoDesignProblem, design: ArrayLike, *, rng: np.random.Generator) -> dict[str, Controller]:
    """Passive, LQR, tuned PID and online MPC (horizon 20) at one design, by name.

    LQR and MPC are those of the nominal model; the PID is tuned on the problem's own.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_generator("rng", rng)
    design = problem.design.check_one(design)
    return {
        "passive": Passive(problem.model.nu),
        REFERENCE: saturated_lqr(problem, design),
        "PID": tuned_pid(problem, design, rng=rng),
        "MPC": linear_mpc(problem, design),
    }
