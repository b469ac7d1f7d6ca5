"""Deployments of the case studies, and trainings that end with a candidate that is given."""

import copy
from types import SimpleNamespace

import numpy as np
import torch

from ccdtools.co_design.configuration import CoDesignConfig
from ccdtools.twin.deployment import deploy_and_update
from ccdtools.twin.online import OnlineConfig
from learning.ppo import PPOConfig
from learning.quantile import QuantileConfig

DESIGN = np.array([2.0])
TINY = CoDesignConfig(
    iterations=1, runs=4, pathwise_runs=8, design_rate=0.0, evaluation_runs=10,
    ppo=PPOConfig.warm(passes=1, critic_only=1),
)  # fmt: skip
ONLINE = OnlineConfig(
    updates=2, window=20, judged=30, training=TINY, quantile=QuantileConfig(hidden=(8,), steps=50, batch=128)
)


def start(n=1):
    return np.tile([-2.0, -2.0], (n, 1))


def disturbances(study, runs, steps, seed=0):
    return study.real.disturbance.sample(runs, steps, np.random.default_rng(seed))


def deployed(study, agent, *, runs, steps, seed=0, config=ONLINE, x0=None):
    return deploy_and_update(
        study.problem(), study.real.plant, agent, DESIGN, x0=start(runs) if x0 is None else x0,
        disturbance=disturbances(study, runs, steps), rng=np.random.default_rng(seed), config=config,
    )  # fmt: skip


def weakened(agent, factor=0.5):
    """The same agent with half its gain, or so many times it."""
    weak = copy.deepcopy(agent)
    with torch.no_grad():
        for parameter in (weak.mean_network.head.weight, weak.mean_network.head.bias, weak.mean_network.skip.weight):
            parameter.mul_(factor)
    return weak


def training_gives(monkeypatch, candidate):
    """Let every training end with one candidate."""
    trained = []

    def codesign(problem, *, agent, design, rng, config):
        trained.append((problem, agent))
        return SimpleNamespace(agent=candidate)

    monkeypatch.setattr("ccdtools.twin.deployment.codesign", codesign)
    return trained
