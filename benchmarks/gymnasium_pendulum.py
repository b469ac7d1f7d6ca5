"""Two generations on Gymnasium's Pendulum-v1, whose mass the model has wrong.

    python benchmarks/gymnasium_pendulum.py [--seeds 20] [--first 0] [--mass 0.7] [--exact]

The real plant is the environment itself: a rod of 1 kg whose length is designed, within 2 N·m, from Gymnasium's starts.
Generation 1 is `codesign` with its defaults on a model of another mass, in Gymnasium's steps of Euler, or `--exact`
ones of the differential equation. Its policy is deployed in eight episodes; their states tell the mass (`fit_plant`).
Generation 2 goes on from the policy and the length in service, on the model with that mass. Both are driven on the
environment from 400 fresh common starts: the gain in pairs, with its 95 % interval. One thread.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import casadi as ca
import gymnasium
import numpy as np
import torch

from ccdtools import (
    CoDesignProblem,
    CustomObjective,
    DesignSpace,
    LearnedPolicy,
    Plant,
    RandomStarts,
    Uniform,
    codesign,
    discretise,
    simulate,
)
from ccdtools.plants import BlackBox, from_gymnasium
from ccdtools.statistics import paired_difference
from ccdtools.twin import fit_plant

STEPS, DEPLOYED, FRESH = 200, 8, 400
DT = 0.05
STARTS = Uniform([-np.pi, -1.0], [np.pi, 1.0])
LENGTHS = DesignSpace(["l"], [0.8], [1.25], ["m"])
UNKNOWN = DesignSpace(["l", "m"], [0.8, 0.3], [1.25, 3.0], ["m", "kg"])


def pendulum(mass: float | None, exact: bool) -> Plant:
    """Rod of a mass, or of one that is unknown."""
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    p = ca.SX.sym("p", 1 if mass else 2)
    rate = 15 / p[0] * ca.sin(x[0]) + 3 / ((mass or p[1]) * p[0] ** 2) * u + w
    design = LENGTHS if mass else UNKNOWN
    if exact:
        return Plant(x, u, w, p, [x[1], rate], design, dt=DT)
    speed = x[1] + DT * rate
    return Plant(x, u, w, p, [x[0] + DT * speed, speed], design, dt=DT, continuous=False)


def cost(x: Any, u: Any, p: Any) -> Any:
    """Cost of Pendulum-v1."""
    return ca.atan2(ca.sin(x[0]), ca.cos(x[0])) ** 2 + 0.1 * x[1] ** 2 + 0.001 * u[0] ** 2


def problem(mass: float, exact: bool) -> CoDesignProblem:
    """Co-design by a model of this mass."""
    X, U = ([-12, -8], [12, 8]), (-2, 2)
    return CoDesignProblem(
        discretise(pendulum(mass, exact), X=X, U=U, W=(-0.2, 0.2), compiled=True), X=X, U=U, steps=STEPS,
        limit_tolerance="off", objective=CustomObjective(cost, Q=np.diag([1, 0.1]), R=[[0.001]]),
        scenarios=RandomStarts(STARTS, Uniform([-0.1], [0.1])),
    )  # fmt: skip


def environment() -> BlackBox:
    """Pendulum-v1 as a plant with a length."""

    def write(env: Any, x: np.ndarray) -> None:
        env.state = np.array(x)

    def build(env: Any, p: np.ndarray) -> None:
        env.l = float(p[0])

    made = gymnasium.make("Pendulum-v1")
    return from_gymnasium(made, read=lambda env: env.state, write=write, build=build, dt=DT, design=LENGTHS)


def driven(real: BlackBox, policy: Any, length: np.ndarray, rng: np.random.Generator, runs: int) -> Any:
    """Episodes on the environment."""
    starts = STARTS.sample(runs, 1, rng)[:, 0]
    return simulate(real, policy, x0=starts, steps=STEPS, design=length)


def returns(run: Any) -> np.ndarray:
    """Gymnasium's returns, by its own formula."""
    x, u = run.states[:, :-1], run.inputs[:, :, 0]
    angle = (x[..., 0] + np.pi) % (2 * np.pi) - np.pi
    return -(angle**2 + 0.1 * x[..., 1] ** 2 + 0.001 * u**2).sum(axis=1)


def main() -> None:
    """Print a row a seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--mass", type=float, default=0.7)
    parser.add_argument("--exact", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    real = environment()
    print("| seed | generation 1 | mass | generation 2 | returns | gain | time |\n|---|---|---|---|---|---|---|")
    for seed in range(given.first, given.first + given.seeds):
        rng = np.random.default_rng(seed)
        began = time.process_time()
        stated = problem(given.mass, given.exact)
        first: Any = codesign(stated, rng=rng)
        midway = time.process_time()
        log = driven(real, first.controller, first.design, rng, DEPLOYED)
        fit = fit_plant(stated, log, plant=pendulum(None, given.exact))
        known = problem(float(fit.values[0]), given.exact)
        second: Any = codesign(known, agent=first.agent, design=first.design, rng=rng)
        ended = time.process_time()
        runs = []
        for one in (first, second):
            fresh = np.random.default_rng(10_000 + seed)
            runs.append(returns(driven(real, LearnedPolicy(one.agent, one.design), one.design, fresh, FRESH)))
        gain = paired_difference(runs[1], runs[0])
        designs = [f"{one.design[0]:.3f} m, {one.status.name}" for one in (first, second)]
        told = f"{fit.values[0]:.4f} ± {1.96 * fit.deviations[0]:.4f} kg, {fit.status.name}"
        earned = f"{gain.mean:+.2f} [{gain.ci95[0]:+.2f}, {gain.ci95[1]:+.2f}]"
        times = f"{midway - began:.0f}, {ended - midway:.0f} s"
        means = f"{runs[0].mean():.1f}, {runs[1].mean():.1f}"
        print(f"| {seed} | {designs[0]} | {told} | {designs[1]} | {means} | {earned} | {times} |", flush=True)


if __name__ == "__main__":
    main()
