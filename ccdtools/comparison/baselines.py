"""The controllers that every learned policy is compared with."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ccdtools.checks import as_generator, as_instance
from ccdtools.co_design.problem import CoDesignProblem
from ccdtools.comparison.pid_tuning import tuned_pid
from ccdtools.controllers.controllers import Controller, LinearFeedback, Passive
from mpc import LinearMPC, lqr

REFERENCE = "LQR"
HORIZON = 20  # steps, of the MPC


def saturated_lqr(problem: CoDesignProblem, design: ArrayLike) -> LinearFeedback:
    """The LQR of the nominal model at one design, with its inputs clipped to U, or to U(p)."""
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    p = problem.design.check_one(design)
    A, B, _ = problem.model.matrices(p)
    K, _ = lqr(A, B, **problem.weights(p).keywords())
    return LinearFeedback(K, *problem.input_bounds_at(p))


def baselines(problem: CoDesignProblem, design: ArrayLike, *, rng: np.random.Generator) -> dict[str, Controller]:
    """Passive, LQR, tuned PID and online MPC (horizon 20) at one design, by name.

    LQR and MPC are those of the nominal model; the PID is tuned on the problem's own.
    """
    as_instance("problem", problem, CoDesignProblem, "a CoDesignProblem")
    as_generator("rng", rng)
    design = problem.design.check_one(design)
    A, B, _ = problem.model.matrices(design)
    return {
        "passive": Passive(problem.model.nu),
        REFERENCE: saturated_lqr(problem, design),
        "PID": tuned_pid(problem, design, rng=rng),
        "MPC": LinearMPC(
            A, B, **problem.weights(design).keywords(), horizon=HORIZON, X=problem.kept_by_mpc(design),
            U=problem.input_limits(design),
        ),
    }
