"""Methods beside each other on the studies where learning matters: a row a method, on common fresh runs.

    python benchmarks/study_methods.py [--studies wall swing_up] [--without METHOD] [--peer] [--iterations 120]
    python benchmarks/study_methods.py --studies benchmarks/fmu_landing.py --runs 100       the real plant is an FMU
    python benchmarks/study_methods.py --sensors --studies suspension          beside nested LQG, on measured outputs

Nested methods and two that learn choose the design; nonlinear MPC stands at that of nested LQR. PPO from scratch and
Stable-Baselines3, which must be installed, learn at the first one, by equal steps. Returns are means of 500 runs of the
model and of the real plant that no method saw, of 8 where a program is solved in every sample. Differences to nested
LQR are in pairs, in % of what its control costs, with 95 % intervals. With sensors every other state is measured, with
noise of a fiftieth of its range, and differences are to nested LQG; learned policies and nonlinear MPC see the estimate
of a Kalman filter, what learns from scratch the last eight outputs and inputs.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

import ccdtools as cc
from ccdtools.arrays import Array
from ccdtools.co_design import DesignEnv, EpisodeEnv
from ccdtools.co_design.imitation import EXPERTS
from ccdtools.co_design.output_filter import estimator_at
from ccdtools.controllers import History
from ccdtools.statistics import paired_difference
from learning import train

STUDIES = ("wall", "backlash_servo", "semi_active_damper", "swing_up", "suspension")
RUNS, FEW, AT_ONCE, HISTORY = 500, 8, 16, 8
End = tuple[Any, Array, str]  # controller, design (np,) and status
Run = Callable[[cc.CoDesignProblem, Array, int], End]  # of a problem, its first design and a seed


def designed(method: Any) -> Run:
    """Co-design by a method of the library."""

    def run(problem: cc.CoDesignProblem, design: Array, seed: int) -> End:
        found = cc.codesign(problem, method=method, rng=np.random.default_rng(seed), design=design)
        return found.controller, found.design, found.status.name

    return run


def planned(problem: cc.CoDesignProblem, design: Array, seed: int) -> End:
    """Nonlinear MPC at the design of nested LQR, or LQG, then behind a filter by cubature where it need be."""
    inner = "lqr" if problem.measurement is None else "lqg"
    found = cc.codesign(problem, method=cc.Nested(inner), rng=np.random.default_rng(seed), design=design)
    planner = EXPERTS["nonlinear MPC"](problem, found.design)
    seen = planner if problem.measurement is None else cc.Observed(planner, estimator_at(problem, found.design))
    return seen, found.design, ""


def cold(steps: int) -> Run:
    """PPO from scratch at the first design."""

    def run(problem: cc.CoDesignProblem, design: Array, seed: int) -> End:
        history = 0 if problem.measurement is None else HISTORY
        env = EpisodeEnv(problem, design, runs=AT_ONCE, rng=np.random.default_rng(seed), history=history)
        generator, length = torch.Generator().manual_seed(seed), problem.steps
        trained = train(env, env.agent(seed=seed), iterations=steps // (AT_ONCE * length), steps=length,
                        generator=generator)  # fmt: skip
        policy = cc.LearnedPolicy(trained.agent, design)
        return History(policy, history) if history else policy, design, ""

    return run


def peer(steps: int) -> Run:
    """PPO of Stable-Baselines3 with its defaults, observations and rewards normalised."""

    def run(problem: cc.CoDesignProblem, design: Array, seed: int) -> End:
        from stable_baselines3 import PPO
        from stable_baselines3.common.env_util import make_vec_env
        from stable_baselines3.common.vec_env import VecNormalize

        history = 0 if problem.measurement is None else HISTORY
        env = VecNormalize(make_vec_env(lambda: DesignEnv(problem, design, history=history), AT_ONCE, seed=seed))
        model = PPO("MlpPolicy", env, n_steps=128, seed=seed, device="cpu").learn(steps)

        def policy(seen):
            return model.predict(env.normalize_obs(seen), deterministic=True)

        return DesignEnv(problem, design, history=history).controller(policy), design, ""

    return run


def methods(iterations: int, steps: int, by_peer: bool, sensors: bool) -> dict[str, Run]:
    """Methods by the names of their rows, the one that others are held against first."""
    config = cc.CoDesignConfig(iterations=iterations, starts=1)
    learned = {
        "gradient through the model": designed(cc.Learned(config=config)),
        "PPO from an imitation": designed(cc.Learned(by="ppo", config=config)),
    }
    nested = {"nested LQG": designed(cc.Nested("lqg")), "nonlinear MPC": planned} if sensors else {
        "nested LQR": designed(cc.Nested("lqr")),
        "nested MPC": designed(cc.Nested("mpc", runs=FEW, starts=1, evaluations=4)), "nonlinear MPC": planned,
    }  # fmt: skip
    scratch = {"PPO from scratch": cold(steps)} | ({"Stable-Baselines3": peer(steps)} if by_peer else {})
    return nested | learned | scratch


def measured(problem: cc.CoDesignProblem) -> cc.CoDesignProblem:
    """Problem of which every other state is measured, with noise."""
    C = np.eye(problem.model.nx)[::2]
    return replace(problem, measurement=cc.Measurement(C, noise=C @ np.ravel(problem.state_scale) / 50))


def scenarios(study: cc.Study, problem: cc.CoDesignProblem, runs: int) -> tuple[cc.Scenario, cc.Scenario]:
    """Fresh runs of the model and of the real plant."""
    rng, real = np.random.default_rng(10**6), study.real
    x0, w = problem.scenarios.sample(runs, study.steps, rng)
    driven = real.disturbance.sample(runs, study.steps, rng)
    seen = {} if problem.measurement is None else {"output": problem.measurement, "seed": 1}
    return cc.Scenario(study.model, x0, w, **seen), cc.Scenario(real.plant, np.tile(real.x0, (runs, 1)), driven, **seen)


def beside(values: Array, reference: Array, size: float) -> str:
    """Mean return, with the gain over the reference on the same runs."""
    kept = np.isfinite(values) & np.isfinite(reference[: len(values)])
    lost = f", {np.mean(~np.isfinite(values)):.0%} lost" if not np.isfinite(values).all() else ""
    if kept.sum() < 2 or values is reference:
        return f"{values[np.isfinite(values)].mean() if kept.any() else np.nan:.5g}{lost}"
    gain = paired_difference(values[kept], reference[: len(values)][kept])
    half = (gain.ci95[1] - gain.ci95[0]) / 2
    return f"{values[kept].mean():.5g} ({100 * gain.mean / size:+.2f} ± {100 * half / size:.2f} %){lost}"


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", nargs="+", default=STUDIES, help="names, or files that declare one")
    parser.add_argument("--peer", action="store_true", help="Stable-Baselines3, too")
    parser.add_argument("--sensors", action="store_true", help="of measured outputs")
    parser.add_argument("--without", nargs="*", default=[], help="methods that are not run")
    parser.add_argument("--iterations", type=int, default=120)
    parser.add_argument("--steps", type=int, default=96_000)
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    print("| study | method | design | model | real plant | time | status |\n|---|---|---|---|---|---|---|")
    for name in asked.studies:
        study = cc.load_study(name)
        problem = measured(study.problem()) if asked.sensors else study.problem()
        places = scenarios(study, problem, asked.runs)
        first: list[tuple[Array, float]] = []  # returns of the first method, and what its control costs
        for method, run in methods(asked.iterations, asked.steps, asked.peer, asked.sensors).items():
            if method in asked.without:
                continue
            began = time.process_time()
            try:
                controller, design, status = run(problem, study.p0, asked.seed)
            except cc.CCDError as error:
                print(f"| {study.name} | {method} | – | – | – | – | {type(error).__name__} |", flush=True)
                continue
            seconds = time.process_time() - began
            runs = FEW if hasattr(controller, "horizon") else asked.runs
            cells = []
            for k, place in enumerate(places):
                trial = place.first(runs).run(controller, design=design, limit=problem.limit)
                values = np.where(trial.diverged, np.nan, trial.returns(problem.objective))
                if len(first) == k:
                    first.append((values, float(problem.made_by_control(np.nanmean(values), design))))
                cells.append(beside(values, *first[k]))
            print(f"| {study.name} | {method} | {problem.design.describe(design)} | {' | '.join(cells)} | "
                  f"{seconds:.0f} s | {status} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
