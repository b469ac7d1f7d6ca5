"""Deployments of the case studies, and trainings that end with a candidate that is given."""

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import torch

from ccdtools import CoDesignConfig, OnlineConfig, deploy_and_update
from ccdtools.twin.recombined_returns import NOT_ASKED, recombined_gain
from ccdtools.twin.update_judge import UpdateJudge
from learning import PPOConfig

DESIGN = np.array([2.0])
TINY = CoDesignConfig(
    iterations=1, runs=4, pathwise_runs=8, design_rate=0.0, evaluation_runs=10, ppo=PPOConfig(passes=1, critic_only=1)
)
ONLINE = OnlineConfig(updates=2, window=20, judged=30, training=TINY)


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


def told_independent(monkeypatch, answer=True):
    """Let every log be found so, and keep the runs that were looked at, and what was judged."""
    looked, judged = [], []

    def told(replay, *_):
        looked.append(np.concatenate([log.numbers for log in replay.logs]))
        return replace(NOT_ASKED, independent=answer, possible=answer)

    def spy(replay, drive, objective, count, rng, *risk):
        judged.append(np.concatenate([log.numbers for log in replay.logs]))
        return recombined_gain(replay, drive, objective, count, rng, *risk)

    monkeypatch.setattr("ccdtools.twin.update_judge.independence", told)
    monkeypatch.setattr("ccdtools.twin.update_judge.recombined_gain", spy)
    return looked, judged


def judge(study, **options):
    """Return what compares policies on logged errors of 60 runs."""
    rng = np.random.default_rng(0)
    return UpdateJudge(study.problem(), DESIGN, replace(ONLINE, **options), 60, rng.spawn(1)[0], rng, None)
