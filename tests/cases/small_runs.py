"""Runs that take seconds: a study of a mass on a spring, and a configuration of hardly any iterations."""

from __future__ import annotations

from dataclasses import replace

from ccdtools import CoDesignConfig
from ccdtools.studies import StudyConfig, configuration
from learning import NetworkConfig

SPRING = '''
"""A mass on a spring whose stiffness is the design."""
import casadi as ca
import numpy as np
from ccdtools import DesignSpace, Gaussian, Plant, QuadraticObjective, RealPlant, Study
from invariant_sets import Polytope

Q = np.eye(2)
x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p")
plant = Plant(x, u, w, p, ca.vertcat(x[1], -p * x[0] + u + w), DesignSpace(["k"], [1], [4]), dt=0.1)
noise = Gaussian([0.1])
study = Study(
    name="spring", title="Spring", plant=plant, X=Polytope.from_bounds([-1, -2], [1, 2]),
    U=Polytope.from_bounds([-1], [1]), objective=QuadraticObjective(Q, [[0.1]]), disturbance=noise,
    x0=[0.5, 0], p0=[2], real=RealPlant(plant, noise, x0=[0, 0], runs=30, steps=20), steps=20, samples=20,
)
'''


def tiny(config: StudyConfig) -> StudyConfig:
    """The configuration with as little of everything as a run can do with."""
    few = CoDesignConfig(iterations=2, runs=16, pathwise_runs=16, evaluation_runs=20, evaluate_every=1)
    return replace(
        config, samples=40, model_runs=30, real_runs=30, mpc_runs=2, real_steps=500, codesign=few, redesign=few,
        network=NetworkConfig((8,)), cloning=replace(config.cloning, steps=400),
        online=replace(config.online, updates=1, judged=20, training=few), quantile=replace(config.quantile, steps=50),
    )  # fmt: skip


def tiny_configuration(study, **options) -> StudyConfig:
    """What `configuration` gives, made tiny."""
    return tiny(configuration(study, **options))
