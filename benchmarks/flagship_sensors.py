"""The semi-active car on its sensors alone: two generations, split by what gains.

    python benchmarks/flagship_sensors.py [--iterations 60] [--seeds 1] [--drives 150]

The car is measured by accelerometers on body and wheel and by the travel, and every law stands behind an extended
Kalman filter of its model. Generation 1 knows the nominal car alone: its policy is learned on the state. What it logs
on the real car tells friction, asymmetry, hardening and stops (`fit_plant`), by which filter, policy and design are
made again. Rows are means over fresh drives of the real car, beside the row named; intervals are paired, 95 %, in % of
that row's cost. Shares are of samples with no load on the tyre, and of drives that meet the end of the travel.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import time
import warnings
from dataclasses import replace

import numpy as np
import torch
from flagship import best_constant, interval

from ccdtools import CoDesignConfig, Scenario, codesign, load_study
from ccdtools.co_design.imitation import first_policy
from ccdtools.co_design.methods.learned import Learned
from ccdtools.co_design.output_filter import estimator_at
from ccdtools.controllers import Observed
from ccdtools.studies.cases._cars import stop
from ccdtools.studies.cases.semi_active_damper import REAL, sensors, unknown_car
from ccdtools.twin import fit_plant
from ccdtools.vehicles import QuarterCar
from learning import CloningConfig

CONSTANT, TUNED = np.array([1.5e4, 2e3]), np.array([2e4, 3e3])  # best of twelve designs for these, by flagship.py
LOGGED, STEPS = 10, 200  # drives of each kind in a deployment, samples of a drive
CAR = QuarterCar()
UNLOADED = 9.81 * (CAR.sprung + CAR.unsprung) / CAR.tyre  # m, at which the tyre carries nothing


def drives(kinds, runs, seed):
    """Fresh drives of the real car, with its sensors."""
    rng = np.random.default_rng(seed)
    return {
        kind: Scenario(REAL, np.zeros((runs, REAL.nx)), drive.sample(runs, STEPS, rng), output=sensors(REAL), seed=seed)
        for kind, drive in kinds.items()
    }


def behind(problem, law, design):
    """Law behind the extended Kalman filter of a problem."""
    return Observed(law, estimator_at(problem, np.asarray(design)))


def two_generations(study, iterations, seed):
    """Rows: name → (controller, design, name of the row beside it); and the fit."""
    began = time.process_time()
    problem = replace(study.problem(), measurement=sensors(study.plant))
    state, rng = replace(problem, measurement=None), np.random.default_rng(seed)
    agent = first_policy(state, study.p0, rng, expert=study.laws[study.expert], samples=study.samples, sets="lqr",
                         cloning=CloningConfig(steps=1000)).agent  # fmt: skip
    made = Learned(agent=agent, history=0, config=CoDesignConfig(iterations=iterations, starts=1))
    one = codesign(problem, method=made, design=study.p0, rng=rng)
    print(f"generation 1: {one.described}, {one.status.name}, {time.process_time() - began:.0f} s", flush=True)
    uses = dict(list(study.real.held_out.items())[:2])
    log = [s.run(one.controller, design=one.design) for s in drives(uses, LOGGED, 1000 + seed).values()]
    fit = fit_plant(problem, log, plant=unknown_car())
    print(f"{fit!r}, {time.process_time() - began:.0f} s", flush=True)
    updated = fit.updated(problem)
    config = CoDesignConfig(iterations=iterations // 2, starts=1, policy_rate=3e-4)
    two = codesign(updated, method=replace(made, agent=one.agent, config=config), design=one.design, rng=rng)
    print(f"generation 2: {two.described}, {two.status.name}, {time.process_time() - began:.0f} s", flush=True)
    tuned = study.laws["clipped LQR, tuned"]
    p = one.design
    return {
        "nested LQG, a constant damper": (best_constant(state, CONSTANT), CONSTANT, None),
        "clipped linear feedback, tuned, own design": (
            behind(problem, tuned(state, TUNED), TUNED), TUNED, "nested LQG, a constant damper",
        ),
        "the same at the design of generation 1": (
            behind(problem, tuned(state, p), p), p, "clipped linear feedback, tuned, own design",
        ),
        "generation 1": (one.controller, p, "the same at the design of generation 1"),
        "filter of the fit": (behind(updated, one.policy, p), p, "generation 1"),
        "generation 2": (two.controller, two.design, "filter of the fit"),
        "clipped linear feedback, tuned, filter of the fit": (
            behind(updated, tuned(replace(updated, measurement=None), p), p), p, "generation 2",
        ),
        "generation 2, its state known": (two.policy, two.design, "generation 2"),
    }  # fmt: skip


def main():
    """Print a table per seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--drives", type=int, default=150)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # of the sampling of the plant, as in the study
    study = load_study("semi_active_damper")
    for seed in range(asked.seeds):
        rows = two_generations(study, asked.iterations, seed)
        for kind, scenario in drives(study.real.held_out, asked.drives, 7).items():
            print(
                f"\nseed {seed}, {kind}\n| law | cost | less than | by | felt | unloaded | at the stop |\n|"
                + "---|" * 7
            )
            costs = {}
            for name, (law, p, beside) in rows.items():
                run = scenario.run(law, design=p)
                cost = costs[name] = -run.returns(study.objective) / STEPS
                x = run.states[:, 1:]
                felt, off = np.sqrt(np.mean(x[..., 4] ** 2)), np.mean(x[..., 0] > UNLOADED)
                ends = np.mean(np.abs(x[..., 2]).max(axis=1) > stop())
                less = "" if beside is None else "{:.1f} ± {:.1f} %".format(
                    *(100 * part / costs[beside].mean() for part in interval(costs[beside] - cost))
                )  # fmt: skip
                print(f"| {name} | {cost.mean():.2f} | {beside or ''} | {less} | {felt:.2f} | {off:.1%} | {ends:.1%} |",
                      flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
