"""A plant of two states, and trials of laws on it."""

import casadi as ca
import numpy as np

from ccdtools import (
    CoDesignProblem,
    DesignSpace,
    FixedStart,
    Gaussian,
    LinearFeedback,
    Plant,
    QuadraticObjective,
    discretise,
)
from ccdtools.twin import TrialConfig, switchback_on

A = np.array([[0.98, 0.1], [-0.1, 0.9]])
SERVED, BETTER, UNSTABLE = (LinearFeedback(np.array([gain])) for gain in ([0.0, 0.0], [0.3, 0.9], [0.0, -9.0]))
X0 = np.zeros(2)


def plant(share):
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w", 2), ca.SX.sym("p")
    after = ca.DM(A) @ x + share * p * ca.vertcat(0, 0.3) * u + w
    return Plant(x, u, w, p, after, DesignSpace(["p"], [0.5], [1.5]), dt=0.1, continuous=False)


def wide_problem():
    """The plant, in limits that are never met."""
    wide = np.array([1e3, 1e3])
    return CoDesignProblem(
        discretise(plant(1.0)), X=(-wide, wide), U=(-1e3, 1e3), objective=QuadraticObjective(np.eye(2), [[0.1]]),
        scenarios=FixedStart(X0, Gaussian([0.1, 0.1])), steps=100,
    )  # fmt: skip


def tried(problem, candidate, steps=3000, seed=0, served=SERVED, margin=0.005, **options):
    rng = np.random.default_rng(seed)
    w = Gaussian([0.1, 0.1]).sample(1, steps, rng)[0]
    return switchback_on(
        problem, plant(1.1), served, candidate, [1.0], x0=X0, disturbance=w, rng=rng,
        config=TrialConfig(block=40, washout=10, margin=margin), **options,
    )  # fmt: skip
