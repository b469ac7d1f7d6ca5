"""Two generations of the semi-active car on its sensors alone: what the policy earns, and what the twin.

    python benchmarks/semi_active_sensors.py [--seeds 3] [--first 0] [--iterations 60] [--drives 100]

Accelerometers on body and wheel and the travel are measured, and every law stands behind a cubature Kalman filter. The
policy is learned on the states of the nominal car and deployed behind its filter. Four drives of the real car tell
friction, asymmetry, hardening and stops; `fitted_generations` learns on, on that car, and tries the new design and
policy and the former behind the new filter on the real car. A row is the cost of a sample on fresh drives of the real
car, and how much less it is than in the row above: paired over drives, means over seeds, 95 %; in brackets the least
and the most of a seed. `--first` is the first seed.
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

from ccdtools import CoDesignConfig, Scenario, load_study
from ccdtools.co_design.imitation import first_policy
from ccdtools.co_design.methods.learned import Learned
from ccdtools.co_design.output_filter import estimator_at
from ccdtools.controllers import Observed
from ccdtools.studies import fitted_generations
from ccdtools.studies.cases.semi_active_damper import REAL, sensors, unknown_car
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
    """Laws and their designs; each is compared with the row above."""
    began = time.process_time()
    problem = replace(study.problem(), measurement=sensors(study.plant))
    state, rng = replace(problem, measurement=None), np.random.default_rng(seed)
    agent = first_policy(state, study.p0, rng, expert=study.laws[study.expert], samples=study.samples, sets="lqr",
                         cloning=CloningConfig(steps=1000)).agent  # fmt: skip
    method = Learned(agent=agent, history=0, config=CoDesignConfig(iterations=iterations, starts=1))
    real = replace(study.real, runs=4, steps=STEPS)
    first, second = fitted_generations(
        problem, real, method=method, design=study.p0, plant=unknown_car(), rng=rng
    )  # fmt: skip
    told = second.fit
    print(f"seed {seed}, {time.process_time() - began:.0f} s: {first}\n{second}\n{told!r}", flush=True)
    truth = told.unknown.known(problem, np.array([TRUTH[name] for name in told.unknown.free]))
    tuned = study.laws["clipped LQR, tuned"](state, first.design)
    policies = [one.controller.controller for one in (first, second)]

    def behind(policy, car, p):
        """Law of the state behind the filter of a car, and the design."""
        return Observed(policy, estimator_at(car, p)), p

    return fixed | {
        "tuned, at the first design; nominal car": behind(tuned, problem, first.design),
        "generation 1, learned; nominal car": (first.controller, first.design),
        "its policy; fitted car": behind(policies[0], told.likeliest(problem), first.design),
        "generation 2": (second.controller, second.design),
        "its policy; real car": behind(policies[1], truth, second.design),
        "its policy, the state known": (policies[1], second.design),
        "tuned, at the second design; fitted car": behind(
            study.laws["clipped LQR, tuned"](state, second.design), told.likeliest(problem), second.design
        ),
    }


def main():
    """Print the fits of each seed, and a table of each kind of drive."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
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
    for seed in range(asked.first, asked.first + asked.seeds):
        for name, (law, p) in rows(study, asked.iterations, seed, fixed).items():
            for kind, scenario in scenarios.items():
                run = scenario.run(law, design=p)
                costs[kind].setdefault(name, []).append(-run.returns(study.objective) / STEPS)
        for kind, found in costs.items():
            print(f"\n{kind}, seeds {asked.first} to {seed}\n| law; car of its filter | cost | less than above |")
            print("|---|---|---|")
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
