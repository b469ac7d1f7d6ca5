"""The semi-active car on its sensors alone: what the policy earns, and what the twin by its filter.

    python benchmarks/semi_active_sensors.py [--seeds 3] [--iterations 60] [--drives 100]

Accelerometers on body and wheel and the travel are measured, and every law stands behind a cubature Kalman filter. The
policy is learned on the states of the nominal car. Four drives of the real car behind the nominal filter, two of each
driver, tell friction, asymmetry, hardening and stops (`fit_plant`); its filter is the same but for these. A row is the
cost of a sample on fresh drives of the real car, and how much less it is than in the row above: paired over drives,
means over seeds, 95 %; in brackets the least and the most of a seed.
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
from flagship import STEPS, best_constant, interval, own_design

from ccdtools import CoDesignConfig, Scenario, codesign, load_study
from ccdtools.co_design.imitation import first_policy
from ccdtools.co_design.methods.learned import Learned
from ccdtools.co_design.output_filter import estimator_at
from ccdtools.controllers import Observed
from ccdtools.studies.cases.semi_active_damper import REAL, sensors, unknown_car
from ccdtools.twin import fit_plant
from learning import CloningConfig

TRUTH = {"friction": 100.0, "asymmetry": 0.4, "hardening": 40.0, "stop": 4e5}  # of REAL


def drives(kinds, runs, seed):
    """Drives of the real car with its sensors, of each kind."""
    rng = np.random.default_rng(seed)
    return {
        kind: Scenario(REAL, np.zeros((runs, REAL.nx)), drive.sample(runs, STEPS, rng), output=sensors(REAL), seed=seed)
        for kind, drive in kinds.items()
    }


def rows(study, iterations, seed, fixed):
    """Laws, their designs and whether each is compared with the row above."""
    began = time.process_time()
    problem = replace(study.problem(), measurement=sensors(study.plant))
    state, rng = replace(problem, measurement=None), np.random.default_rng(seed)
    agent = first_policy(state, study.p0, rng, expert=study.laws[study.expert], samples=study.samples, sets="lqr",
                         cloning=CloningConfig(steps=1000)).agent  # fmt: skip
    method = Learned(agent=agent, history=0, config=CoDesignConfig(iterations=iterations, starts=1))
    one = codesign(problem, method=method, design=study.p0, rng=rng)
    print(f"seed {seed}: {one.described}, {one.status.name}, {time.process_time() - began:.0f} s", flush=True)
    began, p = time.process_time(), one.design
    uses = dict(list(study.real.held_out.items())[:2])
    logs = [s.run(one.controller, design=p) for s in drives(uses, 2, 1000 + seed).values()]
    fit = fit_plant(problem, logs, plant=unknown_car())
    print(f"{fit!r}, {time.process_time() - began:.0f} s", flush=True)
    known = {"nominal": problem, "fitted": fit.likeliest(problem),
             "real": fit.unknown.known(problem, np.array([TRUTH[name] for name in fit.unknown.free]))}  # fmt: skip
    behind = {name: estimator_at(of, p) for name, of in known.items()}
    tuned = study.laws["clipped LQR, tuned"](state, p)
    return fixed | {
        "tuned, at the design of the policy; nominal car": (Observed(tuned, behind["nominal"]), p),
        "learned; nominal car": (one.controller, p),
        "learned; fitted car": (Observed(one.policy, behind["fitted"]), p),
        "learned; real car": (Observed(one.policy, behind["real"]), p),
        "learned, its state known": (one.policy, p),
        "tuned, at that design; fitted car": (Observed(tuned, behind["fitted"]), p),
    }


def main():
    """Print the fits of each seed, and a table of each kind of drive."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--drives", type=int, default=100)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # of the sampling of the plant, as in the study
    study = load_study("semi_active_damper")
    problem, make = study.problem(), study.laws["clipped LQR, tuned"]
    still, own = own_design(problem, best_constant), own_design(problem, make)
    filtered = estimator_at(replace(problem, measurement=sensors(study.plant)), own)
    fixed = {"a constant damper": (best_constant(problem, still), still),
             "tuned clipped feedback; nominal car": (Observed(make(problem, own), filtered), own)}  # fmt: skip
    print(f"own designs: constant {still}, tuned {own}", flush=True)
    scenarios = drives(study.real.held_out, asked.drives, 7)
    costs = {kind: {} for kind in scenarios}  # name → (seeds, drives)
    for seed in range(asked.seeds):
        for name, (law, p) in rows(study, asked.iterations, seed, fixed).items():
            for kind, scenario in scenarios.items():
                run = scenario.run(law, design=p)
                costs[kind].setdefault(name, []).append(-run.returns(study.objective) / STEPS)
        for kind, found in costs.items():
            print(f"\n{kind}, {seed + 1} seeds\n| law; car of its filter | cost | less than above |\n|---|---|---|")
            above = None
            for name, each in found.items():
                cost, less = np.array(each), ""
                if above is not None:
                    mean, half = interval(100 * (above - cost).mean(axis=0) / above.mean())
                    seeds = 100 * (above - cost).mean(axis=1) / above.mean(axis=1)
                    less = f"{mean:.1f} ± {half:.1f} % ({seeds.min():.1f} to {seeds.max():.1f})"
                print(f"| {name} | {cost.mean():.2f} | {less} |", flush=True)
                above = cost


if __name__ == "__main__":
    main()
